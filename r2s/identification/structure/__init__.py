"""Model structure, selected by cross-validation: the friction family and the other terms."""
