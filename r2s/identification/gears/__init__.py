"""Identify the stiffness of elastic gears from the response of the motors to a multisine torque."""
