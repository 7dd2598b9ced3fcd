"""Write the page of stage=compare for trainings: tables, learning curves and scores per group."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from textwrap import fill
from typing import Any

import pandas as pd

from r2s.physics.robot import Robot
from r2s.reporting.comparison.grouping import Groups
from r2s.reporting.comparison.scores import (
    at_edges,
    band,
    improvement_matrix,
    improvement_table,
    measures_in,
    scores,
    sensitivity_table,
    summary_table,
)
from r2s.reporting.comparison.statistics import interquartile_mean
from r2s.reporting.document import Item, report_markdown
from r2s.reporting.figures.colours import OTHERS, colours
from r2s.reporting.figures.panels import label_axis, panels
from r2s.reporting.tables import scores_rows
from r2s.reporting.viewer.data import Content
from r2s.reporting.viewer.recording import write_recording
from r2s.runs import Run
from r2s.tasks.measures import MeasureTable

OVER = {  # x axes of learning curves: title, scale
    "env_steps": ("environment steps, thousand", 1e-3),
    "updates": ("updates, thousand", 1e-3),
    "wall_clock_s": ("wall clock, minutes", 1 / 60),
}


def comparison_page(
    run: Run, robot: Robot, grouped: Groups, apart: Mapping[str, str], others: Mapping[str, str]
) -> dict[str, pd.DataFrame]:
    """Write tables (CSV), figures, report.md and recording.rrd of a comparison of trainings.

    Args:
        run: run folder to write to. robot: the arm. grouped: trainings in groups; the runs of a group differ only in
            their seeds. apart: {incomparable run: reason}. others: {folder without a finished training: reason}.

    Returns:
        {"scores": table, "improvement": table, "sensitivity": table}; scores.py describes the columns of the tables.
    """
    groups, measures = grouped.members, measures_in(grouped.members)
    tables = {"scores": summary_table(groups), "improvement": improvement_table(groups)}
    tables["sensitivity"] = sensitivity_table(groups)
    last = {r.folder.name: {"group": label, "seed": r.seed} | r.last for label, g in groups.items() for r in g}
    pd.DataFrame.from_dict(last, orient="index").to_csv(run.folder / "last.csv", index_label="run")
    for name, table in tables.items():
        if len(table):
            table.to_csv(run.folder / f"{name}.csv", index=False)
    figures = {"learning": bands_figure(run.figure("learning"), grouped)}
    figures["scores"] = scores_figure(run.figure("scores"), tables["scores"], measures)
    curves = {f"{label}, run {k}": r.curve for label, g in groups.items() for k, r in enumerate(g, 1)}
    write_recording(run.folder / "recording.rrd", robot, Content(measures, curves=curves, figures=figures))
    sections = _sections(grouped, tables, apart, others)
    report_markdown(run.folder / "report.md", sections | {"Figures": list(figures.values())})
    return tables


def _sections(
    grouped: Groups, tables: Mapping[str, pd.DataFrame], apart: Mapping[str, str], others: Mapping[str, str]
) -> dict[str, Sequence[Item]]:
    count, measures = sum(map(len, grouped.members.values())), measures_in(grouped.members)
    sections: dict[str, Sequence[Item]] = {
        f"{count} runs in {len(grouped.members)} groups, last evaluation": [
            "Interquartile mean over seeds (the mean of fewer than four) with a 95 % bootstrap interval, none for a "
            "single seed. A group is named by the overrides that differ among groups.",
            scores_rows(measures, tables["scores"]),
            *([[f"{label}: {name}" for label, name in grouped.key.items()]] if grouped.key else []),
        ]
    }
    sections |= reasons({"Not comparable with the runs above": apart, "No finished trainings": others})
    if len(tables["improvement"]):
        heading = "Probability that a run of one group is better than a run of another"
        for key in measures.selection:
            matrix = improvement_matrix(tables["improvement"], key)
            sections[f"{heading}: {measures[key].title}, last evaluation"] = [matrix]
    if len(tables["sensitivity"]):
        what = measures[measures.selection[-1]].title
        table = tables["sensitivity"].round(2).astype(str).replace("nan", "-").set_index("algo")
        note = (
            "held_out scores the best setting at seeds that did not choose it; without two seeds there is no spread."
        )
        edges = at_edges(grouped.members)
        section: list[Any] = [table, note, *([edges] if edges else [])]
        sections[f"Sensitivity of the last {what} to the settings (small spread: little tuning)"] = section
    return sections


def reasons(parts: Mapping[str, Mapping[str, str]]) -> dict[str, Sequence[Item]]:
    """Return the report sections for `parts`, {heading: {run: reason}}; a heading without runs has no section."""
    return {heading: [[f"{k}: {v}" for k, v in why.items()]] for heading, why in parts.items() if why}


def bands_figure(path: Path, groups: Groups) -> Path:
    """Draw learning curves over env steps, updates and minutes: interquartile mean and range of the seeds.

    Each row of panels shows one measure. If there are more groups than colors, only the groups with the best last
    evaluation are drawn. A dotted line shows a model-based controller.
    """
    grouped, table = groups.members, measures_in(groups.members)
    by = table[table.selection[-1]]
    best = sorted(grouped, key=lambda label: -by.sign * interquartile_mean(scores(grouped[label], by.key)))
    drawn = {label: group for label, group in grouped.items() if label in best[: len(OTHERS)]}
    title = "learning curves: interquartile mean and range of the seeds"
    title += f", the best {len(drawn)} of {len(grouped)} groups" if len(drawn) < len(grouped) else ""
    colour = colours(drawn)
    key = "\n".join(fill(f"{label} = {groups.key[label]}", 140) for label in drawn if label in groups.key)
    with panels(path, len(table.selection) * len(OVER), len(OVER), title, 3.0, key) as axes:
        places = [(table[y], x) for y in table.selection for x in OVER]
        for axis, (m, x) in zip(axes, places, strict=True):
            name, scale = OVER[x]
            for label, group in drawn.items():
                if not group[0].learned:
                    level = m.scale * float(interquartile_mean(scores(group, m.key)))
                    axis.axhline(level, color=colour[label], label=label, linestyle=":", linewidth=2)
                    continue
                at, (middle, low, high) = band(group, x, m.key)
                axis.fill_between(scale * at, m.scale * low, m.scale * high, color=colour[label], alpha=0.15, lw=0)
                axis.plot(scale * at, m.scale * middle, color=colour[label], label=label, lw=1.8)
            label_axis(axis, m)
            axis.set_xlabel(name)
    return path


def scores_figure(path: Path, table: pd.DataFrame, measures: MeasureTable) -> Path:
    """Draw a `summary_table`: interquartile mean and 95 % interval per group, one panel per measure."""
    shown, labels = [measures[key] for key in measures.scores], list(dict.fromkeys(table["group"]))
    colour = colours(labels)
    title = "last evaluation: interquartile mean and 95 % interval over seeds"
    with panels(path, len(shown), len(shown), title, 0.9 + 0.3 * len(labels)) as axes:
        for axis, m in zip(axes, shown, strict=True):
            rows = table[table["measure"] == m.key].set_index("group")
            for i, label in enumerate(labels):
                r = m.scale * rows.loc[label, ["iqm", "low", "high"]].astype(float)
                axis.plot([r["low"], r["high"]], [i, i], color=colour[label], linewidth=4, alpha=0.4)
                axis.plot([r["iqm"]], [i], "o", color=colour[label])
            axis.set_yticks(range(len(labels)), labels if axis is axes[0] else [""] * len(labels))
            axis.set_ylim(len(labels) - 0.5, -0.5)
            axis.set_title(m.heading, loc="left")
    return path
