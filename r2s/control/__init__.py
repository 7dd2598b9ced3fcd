"""Controllers, which map a policy's action to joint torque at 1 kHz, before the safety filter."""
