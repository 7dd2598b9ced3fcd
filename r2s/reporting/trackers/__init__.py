"""Show runs in experiment-tracking tools: async_tracker.py calls one tracker per tool."""
