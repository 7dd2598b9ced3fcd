"""`python -m r2s`: same as `python run.py`."""

from r2s.cli import main

main()
