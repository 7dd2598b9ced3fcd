"""Simulated and real arms behind one interface, and the code that drives them and records their motion."""
