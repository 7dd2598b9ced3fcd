"""Identification of an arm's payload: mass, center of mass and inertia tensor, from a recording with a payload."""
