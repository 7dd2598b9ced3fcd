"""Figures of trainings: learning curves, bands over seeds, scores with intervals."""

from collections.abc import Mapping
from pathlib import Path
from textwrap import fill

import pandas as pd

from r2s.reporting.colours import colours
from r2s.reporting.comparison import band, scores, shown_of
from r2s.reporting.figures import panels
from r2s.reporting.grouping import Groups
from r2s.reporting.measures import ALL, shown
from r2s.reporting.statistics import interquartile_mean

MOST_DRAWN = 12  # groups in one figure: as many as there are colours


def learning_figure(path: Path, runs: Mapping[str, pd.DataFrame]) -> Path:
    """Draw the task's measures over minutes, of reaching success at 5, 2, 1 cm and the paper's return.

    Args:
        path: of the PNG. runs: {name: evaluations.csv}.
    """
    columns = shown(str(column) for table in runs.values() for column in table).curves
    colour = colours(runs)
    with panels(path, len(columns), 2, "learning: every evaluation", height=3.0) as axes:
        for axis, column in zip(axes, columns, strict=True):
            measure, scale = ALL[column], ALL[column].scale
            for label, table in runs.items():
                if column in table:
                    minutes = table["wall_clock_s"] / 60
                    axis.plot(minutes, scale * table[column], color=colour[label], marker=".", label=label)
            if scale == 100:
                axis.set_ylim(-3, 103)
            axis.set_title(measure.title, loc="left")
            axis.set_xlabel("wall clock, minutes")
    return path


def bands_figure(path: Path, groups: Groups) -> Path:
    """Draw learning curves of groups of seeds: interquartile mean and range, over env steps, updates and minutes.

    Of more than `MOST_DRAWN` groups the best are drawn, of reaching by the return of their last evaluation. What did
    not learn is a dotted line.
    """
    over = {"env_steps": ("environment steps, thousand", 1e-3), "updates": ("updates, thousand", 1e-3)}
    over |= {"wall_clock_s": ("wall clock, minutes", 1 / 60)}
    grouped = groups.members
    drawn_of = {key: ALL[key].title for key in shown_of(grouped).judged}
    by = shown_of(grouped).judged[1]
    sign = 1 if ALL[by].lower else -1
    best = sorted(grouped, key=lambda label: sign * interquartile_mean(scores(grouped[label], by)))[:MOST_DRAWN]
    drawn = {label: group for label, group in grouped.items() if label in best}
    title = "learning: interquartile mean and range of the seeds"
    title += f", the best {len(drawn)} of {len(grouped)} groups" if len(drawn) < len(grouped) else ""
    colour = colours(drawn)
    key = "\n".join(fill(f"{label} = {groups.key[label]}", 140) for label in drawn if label in groups.key)
    with panels(path, len(drawn_of) * len(over), len(over), title, 3.0, key) as axes:
        places = [(y, x) for y in drawn_of for x in over]
        for axis, (y, x) in zip(axes, places, strict=True):
            scale = ALL[y].scale
            for label, group in drawn.items():
                if not group[0].learned:
                    level = scale * float(interquartile_mean(scores(group, y)))
                    axis.axhline(level, color=colour[label], label=label, linestyle=":", linewidth=2)
                    continue
                at, (middle, low, high) = band(group, x, y)
                axis.fill_between(over[x][1] * at, scale * low, scale * high, color=colour[label], alpha=0.15, lw=0)
                axis.plot(over[x][1] * at, scale * middle, color=colour[label], label=label, lw=1.8)
            axis.set_title(drawn_of[y], loc="left")
            axis.set_xlabel(over[x][0])
    return path


def scores_figure(path: Path, table: pd.DataFrame) -> Path:
    """Draw what `summary_table` returns: a dot and a 95 % interval per group, one panel per measure."""
    names = {key: ALL[key].title for key in shown(set(table["measure"])).scored}
    labels = list(dict.fromkeys(table["group"]))
    colour = colours(labels)
    title = "last evaluation: interquartile mean and 95 % interval over seeds"
    with panels(path, len(names), len(names), title, 0.9 + 0.3 * len(labels)) as axes:
        for axis, measure in zip(axes, names, strict=True):
            rows = table[table["measure"] == measure].set_index("group")
            for i, label in enumerate(labels):
                r = ALL[measure].scale * rows.loc[label, ["iqm", "low", "high"]].astype(float)
                axis.plot([r["low"], r["high"]], [i, i], color=colour[label], linewidth=4, alpha=0.4)
                axis.plot([r["iqm"]], [i], "o", color=colour[label])
            axis.set_yticks(range(len(labels)), labels if axis is axes[0] else [""] * len(labels))
            axis.set_ylim(len(labels) - 0.5, -0.5)
            axis.set_title(names[measure], loc="left")
    return path
