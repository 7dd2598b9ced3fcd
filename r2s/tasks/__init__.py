"""Tasks: their goals, observations and rewards, the rollout of an episode, and the measures of a policy."""
