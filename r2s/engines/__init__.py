"""Physics engines with a common interface, in addition to MuJoCo, which is the engine of the training."""
