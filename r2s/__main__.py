"""Entry point of `python -m r2s`, which does the same as `python run.py`."""

from r2s.cli import main

main()
