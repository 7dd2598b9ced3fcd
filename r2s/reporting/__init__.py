"""What a person looks at: tables, pages, figures, the rerun recording, the comparison of runs."""
