"""Searches, which minimize a `Problem` on the unit cube: genetic.py, and least_squares.py with its solver."""
