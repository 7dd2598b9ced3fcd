"""What is estimated while an arm works: what it carries, how its friction drifts, when that changes."""
