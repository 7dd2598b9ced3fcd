"""Stages of r2s, and their helpers; only these modules and the command line read the config."""
