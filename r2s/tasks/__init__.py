"""What is asked of an arm, and how it is judged."""
