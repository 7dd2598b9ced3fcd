"""Compare trainings by their scores over several seeds, and adapters by their measures in several transfers."""
