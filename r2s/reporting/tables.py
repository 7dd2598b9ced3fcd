"""What a person reads: tables for the terminal, and the same in report.md and report.html.

A table is a DataFrame of strings first, so that the terminal and the reports say the same. What only the report of an
identification has is in identification_page.py and paper_tables.py, figures are in *_figures.py.
"""

from collections.abc import Mapping

import numpy as np
import pandas as pd
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from r2s.reporting.document import doubtful
from r2s.reporting.measures import REACH, shown

SUCCESS = {key: REACH.known[key].short for key in REACH.row if key.startswith("success")}


def scores_rows(table: pd.DataFrame) -> pd.DataFrame:
    """Return one row of strings per group: interquartile mean over [95 % interval] of each measure.

    One seed has no interval.
    """
    known = shown(set(table["measure"]))
    out: dict[str, dict[str, str]] = {}
    for r in table.to_dict("records"):
        measure = known.known[r["measure"]]
        cells = out.setdefault(r["group"], {"seeds": str(r["seeds"])})
        interval = f"\n[{measure.cell(r['low'])}, {measure.cell(r['high'])}]" if r["seeds"] > 1 else ""
        cells[measure.short] = f"{measure.cell(r['iqm'], max(1, measure.digits))}{interval}"
    return pd.DataFrame.from_dict(out, orient="index").rename_axis(known.corner)


def number(value: float | None, form: str = "{:.3g}") -> str:
    """Return a number as tables show it; "-" where there is none."""
    return "-" if value is None or not np.isfinite(value) else form.format(value)


def reach_rows(rows: Mapping[str, Mapping]) -> pd.DataFrame:
    """Return one row per label from dicts with the keys of evaluations.csv (shares from 0 to 1)."""
    table, known = {}, shown(key for row in rows.values() for key in row)
    for label, row in rows.items():
        cells = {}
        for key in known.row:
            measure = known.known[key]
            value = row.get("return_smooth", row.get(key)) if key == "return_paper" else row.get(key)
            scaled = None if value is None else measure.scale * value
            cells[measure.short] = number(scaled, f"{{:.{max(1, measure.digits)}f}}")
        table[_counted(label, row)] = cells
    return pd.DataFrame.from_dict(table, orient="index").rename_axis(known.corner)


def _counted(label: str, row: Mapping) -> str:
    """Return the label, with how many of the goals it is about where an arm was stopped before all were done."""
    done, asked = row.get("episodes"), row.get("asked")
    return label if done == asked else f"{label}, {done} of {asked} goals done"


REACHING = ("time_to_reach_s", "overshoot_m")


def gap_rows(rows: Mapping[str, Mapping]) -> pd.DataFrame:
    """Return one row per label: how far from the simulation that the policy was trained in, and how it moved."""
    columns = {
        "path from simulation, mm": ("ee_path_rmse_mm", 1, "{:.2g}"),
        "torque from simulation, Nm": ("tau_rmse_Nm", 1, "{:.2g}"),
        "time to reach, s": ("time_to_reach_s", 1, "{:.2f}"),
        "overshoot, mm": ("overshoot_m", 1e3, "{:.1f}"),
        "limited, %": ("limited", 100, "{:.1f}"),
        "to position limits, rad": ("q_left_rad", 1, "{:.2f}"),
        "collisions, %": ("collision", 100, "{:.1f}"),
        "stops": ("stops", 1, "{:.0f}"),
    }
    if shown(key for row in rows.values() for key in row) is not REACH:  # which a path has no use for
        columns = {title: column for title, column in columns.items() if column[0] not in REACHING}
    table = {
        _counted(label, row): {
            title: number(None if row.get(key) is None else scale * row[key], form)
            for title, (key, scale, form) in columns.items()
        }
        for label, row in rows.items()
    }
    return pd.DataFrame.from_dict(table, orient="index").rename_axis("")


def reach_table(console: Console, rows: Mapping[str, Mapping], title: str) -> None:
    """Print what `reach_rows` returns."""
    print_table(console, reach_rows(rows), title)


def print_table(console: Console, frame: pd.DataFrame, title: str, caption: str | None = None) -> None:
    """Print a table of strings; what is uncertain is dimmed."""
    table = Table(
        title=title,
        caption=caption,
        title_justify="left",
        caption_justify="left",
        title_style="bold",
        box=SIMPLE_HEAD,
    )
    table.add_column(str(frame.index.name or ""))
    for column in frame.columns:
        table.add_column(str(column), justify="right")
    for label, row in frame.iterrows():
        cells = [escape(str(cell)) for cell in row]
        table.add_row(escape(str(label)), *(f"[dim]{c}[/dim]" if doubtful(c) else c for c in cells))
    console.print(table)
