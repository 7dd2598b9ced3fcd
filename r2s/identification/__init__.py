"""Real2Sim: what the simulated arm must be to do what the recorded one did."""
