"""Show a run in other tools while it is running: async_tracker.py calls a tracker for each tool."""
