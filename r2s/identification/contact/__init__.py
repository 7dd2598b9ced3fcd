"""Identification of a surface from presses and slides of a torque-controlled arm, without a force sensor."""
