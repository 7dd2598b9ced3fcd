"""The arm itself or its twin behind one interface, the driver between policy and arm, and the real clients."""
