"""Report on runs: tables, pages, figures, Rerun recordings, comparisons of runs, and experiment trackers."""
