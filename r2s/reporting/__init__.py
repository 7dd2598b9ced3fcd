"""Report runs: tables, pages, figures, rerun recordings, comparison of runs, trackers."""
