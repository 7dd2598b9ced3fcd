"""Identification of an arm's payload: mass, centre of mass and inertia tensor, from a loaded recording."""
