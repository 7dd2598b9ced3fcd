"""The report of an identification: tables, figures and page."""
