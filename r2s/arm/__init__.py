"""Arms with one common interface: driver, policy runners, recorder, hidden twins, and clients of real arms."""
