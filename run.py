"""Entry point: `python run.py stage=... GROUP=OPTION KEY=VALUE`; `python run.py --help` lists all options.

r2s/cli.py composes the config and calls one stage of r2s/stages.
"""

import sys

if __name__ == "__main__":
    try:
        from r2s.cli import main
    except KeyboardInterrupt:  # during the import
        sys.exit(130)
    main()
