"""Stages of r2s, one module each; only stages and the command line read the config."""
