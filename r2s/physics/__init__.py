"""The arm and its physics: links, friction, limits, and a simulator for many arms at once."""
