"""Report an identification: tables, figures and page."""
