"""Tables, pages, figures, rerun recordings, comparison of runs, trackers."""
