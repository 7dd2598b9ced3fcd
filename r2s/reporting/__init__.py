"""Report runs in tables, pages, figures and Rerun recordings; compare runs; show runs in experiment trackers."""
