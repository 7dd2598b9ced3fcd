"""Arms behind one interface: driver, policy runners, recorder, hidden twins, and clients of real arms."""
