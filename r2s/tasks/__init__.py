"""Tasks: goals, observations, rewards, the rollout of an episode, and its measures."""
