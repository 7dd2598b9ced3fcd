"""Comparison of trainings over seeds, and of adapters over transfers."""
