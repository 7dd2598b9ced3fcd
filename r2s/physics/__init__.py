"""The arm and its physics: links, friction, limits, and the simulator of many arms at once."""
