"""Surfaces identified from presses and slides of a torque-controlled arm, without a force sensor."""
