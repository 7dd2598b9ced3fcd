"""Adaptation of a working arm: estimates of payload, friction and offsets, and torque corrections from them."""
