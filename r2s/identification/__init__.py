"""Real2Sim: the friction, inertia, offsets and delay with which a simulated arm moves as the recorded one did."""
