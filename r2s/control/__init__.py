"""Controllers: they map a policy's action to torque every millisecond, before the safety filter."""
