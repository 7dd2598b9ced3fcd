"""Compare trainings with several seeds, and adapters in several transfers."""
