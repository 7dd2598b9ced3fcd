"""A policy that travels: a bundle of files that another program runs, and the runtime of one file that does."""
