"""One file per stage; with build.py and the command line the only code that sees a config."""
