"""Draw figures (PNG): panels and colours, learning curves, episodes."""
