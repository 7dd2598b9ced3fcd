"""Physics engines other than the training engine, behind one small interface."""
