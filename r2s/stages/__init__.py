"""Stages, one file each; only the stages and the command line read the config."""
