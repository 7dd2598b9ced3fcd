"""Recordings of an arm, and the readers that make one of any log file."""
