"""Physics engines other than MuJoCo, the training engine, with a common interface."""
