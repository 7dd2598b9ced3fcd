"""One file per search; each minimizes a `Problem` on the unit cube. Their solver: levenberg_marquardt.py."""
