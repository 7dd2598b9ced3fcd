"""Residuals between a model and a recording: of torque (equation error) and of replayed motion (output error)."""
