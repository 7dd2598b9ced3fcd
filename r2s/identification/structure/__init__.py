"""Selection of the model structure by cross-validation: friction family, and terms besides it."""
