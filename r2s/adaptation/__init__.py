"""Adaptation of a working arm: estimates of payload, friction, offsets and wrench, and torque corrections."""
