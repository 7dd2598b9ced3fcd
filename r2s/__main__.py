"""Run the command line: `python -m r2s` does the same as `python run.py`."""

from r2s.cli import main

main()
