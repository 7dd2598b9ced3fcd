"""Recordings of an arm, and how files of all kinds become one."""
