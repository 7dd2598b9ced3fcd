"""List run folders with their status, age and main results, for `r2s list`."""

import csv
import json
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from rich.console import Console

from r2s.reporting.measures import measures_of
from r2s.runs import status_of

LOST = ("failed", "killed")
COLUMNS = ["status", "age", "result"]
LONGEST = 46  # largest number of shown letters of a run name; the time at the start of the name identifies the run
LEAST = 20  # least number of shown letters of a result


def run_rows(root: str | Path, *, stage: str | None = None, failed: bool = False) -> pd.DataFrame:
    """Return a table with a row of strings per run folder below `root`, the newest run last.

    Args:
        root: folder of all runs. stage: list only runs of this stage. failed: list only failed and killed runs.
    """
    found = []
    for path in Path(root).glob(f"{stage or '*'}/*/meta.json"):
        try:
            meta = json.loads(path.read_text())
            start, status = datetime.fromisoformat(meta["start"]), status_of(meta)
        except (ValueError, KeyError, TypeError):
            continue  # not a meta.json of r2s
        if not failed or status in LOST:
            found.append((start, path.parent, status, meta))
    rows = {}
    for start, folder, status, meta in sorted(found, key=lambda f: f[0]):
        cells = status, ago((datetime.now().astimezone() - start).total_seconds()), _result(folder, meta)
        rows[f"{folder.parent.name}/{folder.name}"] = dict(zip(COLUMNS, cells, strict=True))
    return pd.DataFrame.from_dict(rows, orient="index", columns=COLUMNS).rename_axis("run")


def print_runs(console: Console, runs: pd.DataFrame, title: str) -> None:
    """Print `runs`, a table of `run_rows`, with a line per run; in a terminal, cut lines to the terminal's width."""
    rows = [("run", *runs.columns), *((str(name), *map(str, row)) for name, row in runs.iterrows())]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    if console.is_terminal:
        widths[0] = min(widths[0], LONGEST)
        widths[-1] = max(LEAST, console.width - sum(widths[:-1]) - 2 * (len(widths) - 1))

    def cell(text: str, width: int) -> str:
        return text if len(text) <= width else f"{text[: width - 1]}…"

    lines = ["  ".join(cell(*c).ljust(c[1]) for c in zip(row, widths, strict=True)).rstrip() for row in rows]
    for line in (title, "", lines[0], "─" * min(console.width, max(map(len, lines))), *lines[1:]):
        console.print(line, markup=False, highlight=False, soft_wrap=True)


def ago(seconds: float) -> str:
    """Return an age as text in seconds, minutes, hours or days: "40 s", "12 min", "5 h", "3 d"."""
    for size, unit in ((86400, "d"), (3600, "h"), (60, "min")):
        if seconds >= size:
            return f"{seconds / size:.0f} {unit}"
    return f"{max(seconds, 0):.0f} s"


def _result(folder: Path, meta: Mapping[str, Any]) -> str:
    """Return the main results of a finished run, the error of a failed run, or the progress of any other run."""
    summary = folder / "summary.json"
    try:
        if summary.is_file():
            return _key_figures(folder, meta.get("stage", ""), json.loads(summary.read_text()))
        if "error" in meta:
            return str(meta["error"]).splitlines()[0].removeprefix("Stopped: ")
        with open(folder / "evaluations.csv", newline="") as file:
            *_, row = csv.DictReader(file)
        return f"{_in_words(folder, row)} after {float(row['env_steps']) / 1e3:.0f}k env steps"
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return "-"


def _key_figures(folder: Path, stage: str, summary: Mapping[str, Any]) -> str:
    if stage == "tune":
        number = sum(summary["trials"].values())
        return f"best of {number} trials: {summary['best']['value']:.4g}"
    if stage == "identify" and "validation" not in summary:
        if "gears" in summary:
            found = summary["gears"]
            count, seen = len(found["identifiable"]), sum(found["identifiable"])
            return f"gears up to {max(found['stiffness_Nm_per_rad']):.3g} Nm/rad, {seen} of {count} determined"
        if "payload" in summary:
            return f"payload {summary['payload']['mass_kg']:.3g} kg"
        found = summary["contact"]
        return f"surface {found['slope_N_per_m']:.3g} N/m, friction {found['friction']:.2g}"
    if stage == "identify":
        side = summary["validation"]
        after, before = (float(np.mean(side[k])) for k in ("torque_rmse_Nm", "nominal_torque_rmse_Nm"))
        return f"torque RMSE {after:.3g} Nm, nominal {before:.3g}"
    if stage == "estimate":
        return f"payload {summary['mass_kg']:.3g} ± {summary['mass_kg_half']:.2g} kg"
    if stage == "excite":
        known = [x["identifiable"] for x in summary["expected_width95"].values()]
        return f"{summary['seconds']:.1f} s of motion for {sum(known)} of {len(known)} values"
    if stage == "results":
        return f"{summary['equal']} of {summary['cells']} cells equal, {summary['beyond intervals']} beyond intervals"
    if stage == "train":
        return _in_words(folder, summary["best"])
    if stage == "compare":
        what, name = ("scores", "group") if "scores" in summary else ("adapter_comparison", "row")
        count = len({row[name] for row in summary[what]})
        return f"{count} {'groups of runs' if what == 'scores' else 'adapters'} compared"
    rows = summary["reach"] if stage == "pipeline" else summary
    if stage == "pipeline":  # only the transfers to the arm, which are the goal of a pipeline
        rows = {where: row for where, row in rows.items() if not where.endswith((", mujoco", ", predicted"))}
    table = measures_of(folder)
    measure = table[table.transfer[0]]
    cells = [f"{where} {measure.cell(row.get(measure.key))}" for where, row in rows.items()]
    return f"{measure.heading}: {', '.join(cells)}"


def _in_words(folder: Path, row: Mapping[str, Any]) -> str:
    return ", ".join(measures_of(folder).in_words(row))
