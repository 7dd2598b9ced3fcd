"""What a person looks at: tables, pages, figures, the rerun recording, and the comparison of runs."""
