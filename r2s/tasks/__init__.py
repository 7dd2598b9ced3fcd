"""Define tasks (goals, observations, rewards), run policies in episodes of a task, and compute measures of them."""
