"""Compare trainings over seeds, and adapters over transfers."""
