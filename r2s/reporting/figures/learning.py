"""Draw the learning curves of single runs."""

from collections.abc import Iterable, Mapping
from pathlib import Path

import pandas as pd

from r2s.reporting.figures.colours import colours
from r2s.reporting.figures.panels import label_axis, panels
from r2s.tasks.measures import Measure


def learning_figure(path: Path, runs: Mapping[str, pd.DataFrame], measures: Iterable[Measure]) -> Path:
    """Draw measures from {run: evaluations.csv} over wall-clock minutes, one panel per measure."""
    shown, colour = list(measures), colours(runs)
    with panels(path, len(shown), min(len(shown), 2), "learning curves", height=3.0) as axes:
        for axis, m in zip(axes, shown, strict=True):
            for label, table in runs.items():
                if m.key in table:
                    minutes = table["wall_clock_s"] / 60
                    axis.plot(minutes, m.scale * table[m.key], color=colour[label], marker=".", label=label)
            label_axis(axis, m)
            axis.set_xlabel("wall clock, minutes")
    return path
