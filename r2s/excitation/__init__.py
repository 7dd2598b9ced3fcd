"""Plan motions for identification, and check a motion's limits, torque and clearances before an arm runs it."""
