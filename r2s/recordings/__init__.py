"""Recordings of an arm: the data type, file readers, breakaway ramps and checks."""
