"""One file per stage. Stages and the command line are the only code that sees a config."""
