"""Policies: environment, randomization, algorithms, training, evaluation, and the model-based reference."""
