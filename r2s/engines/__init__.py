"""Other physics engines than the one trained in, behind one small interface."""
