"""Selection of the model structure by cross-validation: the friction family, and the terms besides friction."""
