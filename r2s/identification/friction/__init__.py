"""Friction at and near rest: breakaway from ramps, friction at the onset of sliding, presliding, stiction."""
