"""Friction at rest: breakaway from ramps, friction at the onset of sliding, presliding, stiction."""
