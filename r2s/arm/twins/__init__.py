"""The hidden twins: simulated stand-ins for a real arm, whose parameters no other code reads."""
