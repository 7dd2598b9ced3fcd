"""What a person reads of the league of adapters: its tables for the terminal, report.md and one figure."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from r2s.physics.robot import Robot
from r2s.reporting.colours import colours
from r2s.reporting.document import report_markdown
from r2s.reporting.figures import panels
from r2s.reporting.league import League, verdict
from r2s.reporting.measures import Measure
from r2s.reporting.tables import number
from r2s.reporting.viewer import write_recording
from r2s.runs import Run

ABOUT = (
    "Mean over arms and episodes, with a 95 % interval. The bootstrap is paired: it draws arms, and of each arm its "
    "episodes, the same for all rows of a condition."
)


def tables(league: League) -> dict[str, pd.DataFrame]:
    """Return {title: table of strings}: one per measure, of stops where there are any, and of what adapters cost."""
    s = league.scores
    found = {m.title: _cells(s[s["measure"] == key], m) for key, m in league.measures.items() if len(s)}
    first = s[s["measure"] == next(iter(league.measures))] if len(s) else s
    if len(first) and first["stopped"].any():
        stops = first.assign(cell=[f"{n} of {k}" for n, k in zip(first["stopped"], first["asked"], strict=True)])
        found["episodes that were stopped"] = _square(stops)
    costs = league.costs
    cost = {"a cycle, µs": [number(x, "{:.0f}") for x in costs["us"]]}
    cost["training, minutes"] = [number(x, "{:.1f}") for x in costs["minutes"]]
    found["what an adapter costs"] = pd.DataFrame(cost, index=costs.index).rename_axis("adapter")
    return found


def _cells(scores: pd.DataFrame, measure: Measure) -> pd.DataFrame:
    """Return the means of one measure over their intervals."""

    def cell(mean: float, low: float, high: float) -> str:
        if not np.isfinite(mean):
            return "-"
        return measure.cell(mean) + (f"\n[{measure.cell(low)}, {measure.cell(high)}]" if np.isfinite(low) else "")

    each = [cell(*x) for x in zip(scores["mean"], scores["low"], scores["high"], strict=True)]
    return _square(scores.assign(cell=each))


def _square(scores: pd.DataFrame) -> pd.DataFrame:
    """Return the column `cell` with a row per row and a column per condition, both in the order they come."""
    wide = scores.pivot(index="row", columns="condition", values="cell").fillna("-")
    wide = wide.loc[list(scores["row"].unique()), list(scores["condition"].unique())]
    return wide.rename_axis("adapter").rename_axis(None, axis=1)


def lines(league: League) -> list[str]:
    """Return what is said below the tables: a line per row, and what does not count."""
    s = league.scores
    said = [verdict(league, row) for row in league.runs]
    if len(s) and not s["stopped"].any():
        said.append("No episode was stopped.")
    elif len(s) and "rmse" in league.measures:
        said.append(
            "An episode that was stopped in one row has no RMSE and no gap: it is left out of both in all rows."
        )
    runs = [r for members in league.runs.values() for r in members]
    blind = sum(r.episodes["gap"].isna().all() and not r.episodes["stopped"].all() for r in runs)
    if blind:
        said.append(f"{blind} of {len(runs)} transfers have no path gap: with simulator=none nothing was predicted.")
    return [*said, *league.key, *league.left_out]


def write(
    run: Run, robot: Robot, league: League, apart: Mapping[str, str], others: Mapping[str, str]
) -> dict[str, pd.DataFrame]:
    """Write league.csv, costs.csv, report.md, a figure and recording.rrd; return the tables of strings.

    Args:
        run, robot: whose. apart: {run: why it cannot be compared with these}. others: {folder: why it is no finished
            transfer}.
    """
    shown = tables(league)
    league.scores.to_csv(run.folder / "league.csv", index=False)
    league.costs.to_csv(run.folder / "costs.csv", index_label="row")
    sections: dict[str, Sequence] = {heading(league): [ABOUT, lines(league)]}
    sections |= {title[0].upper() + title[1:]: [table] for title, table in shown.items()}
    if apart:
        sections["Set apart: these cannot be compared with the transfers above"] = [
            [f"{k}: {v}" for k, v in apart.items()]
        ]
    if others:
        sections["No finished transfers to an arm"] = [[f"{k}: {v}" for k, v in others.items()]]
    figures = {}
    if len(league.scores):
        figures["league"] = league_figure(run.figure("league"), league)
        sections["Figures"] = list(figures.values())
    write_recording(run.folder / "recording.rrd", robot, figures=figures)
    report_markdown(run.folder / "report.md", sections)
    return shown


def heading(league: League) -> str:
    """Return what the league is of: "League of adapters: 12 transfers, 2 arms"."""
    members = [r for runs in league.runs.values() for r in runs]
    arms = sorted({r.arm for r in members})
    named = arms[0] if len(arms) == 1 else f"{len(arms)} arms"
    named += f" ({'; '.join(arms)})" if 1 < len(arms) <= 3 else ""
    return f"League of adapters: {len(members)} transfers to {named}, {members[0].goals} episodes each"


def league_figure(path: Path, league: League) -> Path:
    """Draw a dot and a 95 % interval per row and condition, one panel per measure."""
    names, conditions = list(league.runs), list(league.scores["condition"].unique())
    colour = colours(names)
    with panels(path, len(league.measures), len(league.measures), "league of adapters", 3.0) as axes:
        for axis, (key, m) in zip(axes, league.measures.items(), strict=True):
            own = league.scores[league.scores["measure"] == key]
            for k, name in enumerate(names):
                r = own[own["row"] == name].set_index("condition")
                at = np.array([conditions.index(c) for c in r.index]) + 0.15 * (k - (len(names) - 1) / 2)
                low, high = r["low"].fillna(r["mean"]), r["high"].fillna(r["mean"])
                axis.vlines(at, m.scale * low, m.scale * high, color=colour[name], linewidth=3, alpha=0.4)
                axis.plot(at, m.scale * r["mean"], "o", color=colour[name], label=name, markersize=5)
            axis.set_xticks(range(len(conditions)), conditions, fontsize=8)
            axis.set_title(m.title, loc="left")
    return path
