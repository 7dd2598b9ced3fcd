"""Hidden twins: simulated arms that replace a real arm, with parameters that no other code reads."""
