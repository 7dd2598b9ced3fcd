"""Figures of trainings: learning curves, bands over seeds, scores with intervals."""

from collections.abc import Mapping
from pathlib import Path
from textwrap import fill

import pandas as pd

from r2s.reporting.colours import colours
from r2s.reporting.comparison import band, scores
from r2s.reporting.figures import panels
from r2s.reporting.grouping import Groups
from r2s.reporting.statistics import interquartile_mean
from r2s.reporting.tables import SUCCESS

RETURN = "return, eq. (2) over 4 s"
MOST_DRAWN = 12  # groups in one figure: as many as there are colours


def learning_figure(path: Path, runs: Mapping[str, pd.DataFrame]) -> Path:
    """Draw success at 5, 2 and 1 cm and the paper's return over minutes; runs are {name: evaluations.csv}."""
    shown = {
        "success_5cm": "success at 5 cm, %",
        "success_2cm": "success at 2 cm, %",
        "success_1cm": "success at 1 cm, %",
        "return_paper": RETURN,
    }
    colour = colours(runs)
    with panels(path, len(shown), 2, "learning: every evaluation", height=3.0) as axes:
        for axis, (column, title) in zip(axes, shown.items(), strict=True):
            scale = 100 if column in SUCCESS else 1
            for label, table in runs.items():
                if column in table:
                    minutes = table["wall_clock_s"] / 60
                    axis.plot(minutes, scale * table[column], color=colour[label], marker=".", label=label)
            if column in SUCCESS:
                axis.set_ylim(-3, 103)
            axis.set_title(title, loc="left")
            axis.set_xlabel("wall clock, minutes")
    return path


def bands_figure(path: Path, groups: Groups) -> Path:
    """Draw learning curves of groups of seeds: interquartile mean and range, over env steps, updates and minutes.

    Of more than `MOST_DRAWN` groups the best are drawn, by the return of their last evaluation. What did not learn
    is a dotted line.
    """
    shown = {"success_1cm": "success at 1 cm, %", "return_paper": RETURN}
    over = {"env_steps": ("environment steps, thousand", 1e-3), "updates": ("updates, thousand", 1e-3)}
    over |= {"wall_clock_s": ("wall clock, minutes", 1 / 60)}
    grouped = groups.members
    best = sorted(grouped, key=lambda label: -interquartile_mean(scores(grouped[label], "return_paper")))[:MOST_DRAWN]
    drawn = {label: group for label, group in grouped.items() if label in best}
    title = "learning: interquartile mean and range of the seeds"
    title += f", the best {len(drawn)} of {len(grouped)} groups" if len(drawn) < len(grouped) else ""
    colour = colours(drawn)
    key = "\n".join(fill(f"{label} = {groups.key[label]}", 140) for label in drawn if label in groups.key)
    with panels(path, len(shown) * len(over), len(over), title, 3.0, key) as axes:
        places = [(y, x) for y in shown for x in over]
        for axis, (y, x) in zip(axes, places, strict=True):
            scale = 100 if y in SUCCESS else 1
            for label, group in drawn.items():
                if not group[0].learned:
                    level = scale * float(interquartile_mean(scores(group, y)))
                    axis.axhline(level, color=colour[label], label=label, linestyle=":", linewidth=2)
                    continue
                at, (middle, low, high) = band(group, x, y)
                axis.fill_between(over[x][1] * at, scale * low, scale * high, color=colour[label], alpha=0.15, lw=0)
                axis.plot(over[x][1] * at, scale * middle, color=colour[label], label=label, lw=1.8)
            axis.set_title(shown[y], loc="left")
            axis.set_xlabel(over[x][0])
    return path


def scores_figure(path: Path, table: pd.DataFrame) -> Path:
    """Draw what `summary_table` returns: a dot and a 95 % interval per group, one panel per measure."""
    names = {"success_1cm": "success at 1 cm, %", "success_5mm": "success at 5 mm, %"}
    names |= {"distance_median_m": "median distance, mm", "return_paper": RETURN}
    scale = {"success_1cm": 100, "success_5mm": 100, "distance_median_m": 1e3, "return_paper": 1}
    labels = list(dict.fromkeys(table["group"]))
    colour = colours(labels)
    title = "last evaluation: interquartile mean and 95 % interval over seeds"
    with panels(path, len(names), len(names), title, 0.9 + 0.3 * len(labels)) as axes:
        for axis, measure in zip(axes, names, strict=True):
            rows = table[table["measure"] == measure].set_index("group")
            for i, label in enumerate(labels):
                r = scale[measure] * rows.loc[label, ["iqm", "low", "high"]].astype(float)
                axis.plot([r["low"], r["high"]], [i, i], color=colour[label], linewidth=4, alpha=0.4)
                axis.plot([r["iqm"]], [i], "o", color=colour[label])
            axis.set_yticks(range(len(labels)), labels if axis is axes[0] else [""] * len(labels))
            axis.set_ylim(len(labels) - 0.5, -0.5)
            axis.set_title(names[measure], loc="left")
    return path
