"""Simulated and real arms with one common interface, and code that commands an arm and records its motion."""
