"""What is asked of an arm, its reward, and how an episode is judged."""
