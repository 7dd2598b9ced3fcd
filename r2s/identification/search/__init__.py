"""One file per search; each minimises a Problem on the unit cube and knows nothing of arms."""
