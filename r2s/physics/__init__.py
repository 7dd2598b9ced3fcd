"""The arm and its physics: what it is, how it moves, what limits it. Needs no learning library."""
