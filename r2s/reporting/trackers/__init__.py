"""Show a running stage in other tools: async_tracker.py calls one tracker per tool."""
