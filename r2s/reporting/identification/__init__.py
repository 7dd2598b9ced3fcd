"""Report an identification in tables, in figures, and as a page (report.md, report.html)."""
