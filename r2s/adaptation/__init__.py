"""Estimate payload, friction, offsets and external wrench while an arm works, and correct the arm's torque."""
