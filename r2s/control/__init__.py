"""Controllers: what runs once a millisecond between a policy's action and the safety filter."""
