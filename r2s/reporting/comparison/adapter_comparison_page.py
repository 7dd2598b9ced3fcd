"""Write the tables, the figure and the report of a comparison of adapters."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from r2s.physics.robot import Robot
from r2s.reporting.comparison.adapter_comparison import AdapterComparison, verdict
from r2s.reporting.comparison.page import reasons
from r2s.reporting.document import Item, report_markdown
from r2s.reporting.figures.colours import colours
from r2s.reporting.figures.panels import label_axis, panels
from r2s.reporting.tables import number
from r2s.reporting.viewer.data import Content
from r2s.reporting.viewer.recording import write_recording
from r2s.runs import Run
from r2s.tasks.measures import GAP, Measure

ABOUT = (
    "Mean over arms and episodes with a 95 % interval. The bootstrap is paired: it draws arms, and episodes of each "
    "arm, the same for all rows of a condition."
)


def tables(found: AdapterComparison) -> dict[str, pd.DataFrame]:
    """Return {title: table of strings}: a table per measure, one of costs and, if any, one of stopped episodes."""
    s = found.scores
    out = {m.heading: _cells(s[s["measure"] == key], m) for key, m in found.measures.items() if len(s)}
    first = s[s["measure"] == found.headline.key]
    if first["stopped"].any():
        stops = first.assign(cell=[f"{n} of {k}" for n, k in zip(first["stopped"], first["asked"], strict=True)])
        out["stopped episodes"] = _square(stops)
    cost = {"per cycle, µs": [number(x, "{:.0f}") for x in found.costs["us"]]}
    out["cost of an adapter"] = pd.DataFrame(cost, index=found.costs.index).rename_axis("adapter")
    return out


def _cells(scores: pd.DataFrame, m: Measure) -> pd.DataFrame:
    """Return the table of a measure; a cell shows the mean and, on a second line, the 95 % interval."""

    def cell(mean: float, low: float, high: float) -> str:
        return m.cell(mean) + (f"\n[{m.cell(low)}, {m.cell(high)}]" if np.isfinite(low) else "")

    each = [cell(*x) for x in zip(scores["mean"], scores["low"], scores["high"], strict=True)]
    return _square(scores.assign(cell=each))


def _square(scores: pd.DataFrame) -> pd.DataFrame:
    """Arrange the column `cell` as a table with a line per adapter and a column per condition."""
    wide = scores.pivot(index="row", columns="condition", values="cell").fillna("-")
    wide = wide.loc[list(scores["row"].unique()), list(scores["condition"].unique())]
    return wide.rename_axis("adapter").rename_axis(None, axis=1)


def lines(found: AdapterComparison) -> list[str]:
    """Return lines of text about the tables: a verdict per row, names of policies, and omitted episodes."""
    s = found.scores
    out = [verdict(found, row) for row in found.runs]
    if len(s) and not s["stopped"].any():
        out.append("No episode was stopped.")
    elif gone := [m.title for m in found.measures.values() if len(s) and m.root_mean_square]:
        out.append(f"A stopped episode has no {' and no '.join(gone)}: it is left out of them in all rows.")
    runs = [r for members in found.runs.values() for r in members]
    ran = [r.episodes for r in runs if not r.episodes["arm_stopped"].all()]
    blind = sum(GAP.key not in e or e[GAP.key].isna().all() for e in ran)
    if blind:
        out.append(f"{blind} of {len(runs)} transfers have no path gap: with simulator=none there is no prediction.")
    return [*out, *found.key, *found.left_out]


def write(
    run: Run, robot: Robot, found: AdapterComparison, apart: Mapping[str, str], others: Mapping[str, str]
) -> dict[str, pd.DataFrame]:
    """Write adapter_comparison.csv, costs.csv, report.md, a figure and recording.rrd; return the tables of strings.

    Args:
        run: run folder to write to. robot: the arm. found: the comparison. apart: {incomparable run: reason}.
        others: {folder without a finished transfer: reason}.
    """
    shown = tables(found)
    found.scores.to_csv(run.folder / "adapter_comparison.csv", index=False)
    found.costs.to_csv(run.folder / "costs.csv", index_label="row")
    sections: dict[str, Sequence[Item]] = {heading(found): [ABOUT, lines(found)]}
    sections |= {title[0].upper() + title[1:]: [table] for title, table in shown.items()}
    sections |= reasons({"Not comparable with the transfers above": apart, "No finished transfers to an arm": others})
    figures = {}
    if len(found.scores):
        figures["adapter_comparison"] = comparison_figure(run.figure("adapter_comparison"), found)
        sections["Figures"] = list(figures.values())
    write_recording(run.folder / "recording.rrd", robot, Content(figures=figures))
    report_markdown(run.folder / "report.md", sections)
    return shown


def heading(found: AdapterComparison) -> str:
    """Return a heading such as "Adapter comparison: 12 transfers to 2 arms, 50 episodes each"."""
    members = [r for runs in found.runs.values() for r in runs]
    arms = sorted({r.arm for r in members})
    named = arms[0] if len(arms) == 1 else f"{len(arms)} arms"
    named += f" ({'; '.join(arms)})" if 1 < len(arms) <= 3 else ""
    return f"Adapter comparison: {len(members)} transfers to {named}, {members[0].goals} episodes each"


def comparison_figure(path: Path, found: AdapterComparison) -> Path:
    """Draw the mean and 95 % interval of each row and condition, in one panel per measure."""
    names, conditions = list(found.runs), list(found.scores["condition"].unique())
    colour = colours(names)
    with panels(path, len(found.measures), len(found.measures), "adapters: mean and 95 % interval", 3.0) as axes:
        for axis, (key, m) in zip(axes, found.measures.items(), strict=True):
            own = found.scores[found.scores["measure"] == key]
            for k, name in enumerate(names):
                r = own[own["row"] == name].set_index("condition")
                at = np.array([conditions.index(c) for c in r.index]) + 0.15 * (k - (len(names) - 1) / 2)
                low, high = r["low"].fillna(r["mean"]), r["high"].fillna(r["mean"])
                axis.vlines(at, m.scale * low, m.scale * high, color=colour[name], linewidth=3, alpha=0.4)
                axis.plot(at, m.scale * r["mean"], "o", color=colour[name], label=name, markersize=5)
            axis.set_xticks(range(len(conditions)), conditions, fontsize=8)
            axis.set_xlim(-0.5, len(conditions) - 0.5)
            label_axis(axis, m)
    return path
