"""Estimate payload, friction, offsets and external wrench of a working arm; add a torque against model errors."""
