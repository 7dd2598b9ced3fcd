"""Train and evaluate policies: environment, domain randomization, algorithms (one per file) and training loop."""
