"""Residuals between model and recording: of predicted torque (equation error) or replayed motion (output error)."""
