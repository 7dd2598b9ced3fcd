"""Train and evaluate policies: simulate tasks, randomize dynamics, update networks (one algorithm per file)."""
