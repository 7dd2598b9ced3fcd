"""Report on runs: tables, pages, figures, rerun recordings, comparisons of runs, and experiment trackers."""
