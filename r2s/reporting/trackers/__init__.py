"""Trackers: what shows a run elsewhere than in its folder, while it goes on. One file each; behind.py calls them."""
