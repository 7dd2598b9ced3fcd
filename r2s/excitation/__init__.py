"""Exciting trajectories for identification, and safety checks of a motion."""
