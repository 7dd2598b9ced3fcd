"""Searches that minimize a `Problem` on the unit cube: a genetic algorithm and least squares."""
