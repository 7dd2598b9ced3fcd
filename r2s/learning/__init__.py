"""Policies: the training environment, randomization, one file per algorithm, the training loop, evaluation."""
