"""Figures (PNG): panels and colours, learning curves, episodes."""
