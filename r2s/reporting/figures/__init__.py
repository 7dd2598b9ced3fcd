"""Draw figures (PNG): panels and colors, learning curves, episodes."""
