"""Show a run in experiment-tracking tools while it is running: async_tracker.py calls one tracker per tool."""
