"""Export a trained policy as a bundle: files that another program can run, with a runtime in a single file."""
