"""Trackers show a run outside its folder while it is running; async_tracker.py calls them."""
