"""Build tables of measures as data frames of strings, for the terminal and for reports."""

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from r2s.reporting.document import doubtful
from r2s.tasks.measures import Measure, MeasureTable


def number(value: float | None, form: str = "{:.3g}") -> str:
    """Return a formatted number, or "-" if the number is missing or not finite."""
    return "-" if value is None or not np.isfinite(value) else form.format(value)


def measure_rows(measures: MeasureTable, rows: Mapping[str, Mapping]) -> pd.DataFrame:
    """Return a table of strings with a line per key of `rows`, {simulator or arm: row of evaluations.csv}."""
    return _table([measures[key] for key in measures.rows], rows, measures.corner, decimals=1)


def diagnostic_rows(measures: MeasureTable, rows: Mapping[str, Mapping]) -> pd.DataFrame:
    """Return a table of the diagnostic measures that `rows` contain, such as path gap and limit margin."""
    present = [measures[key] for key in measures.diagnostics if any(key in row for row in rows.values())]
    return _table(present, rows, "", decimals=0)


def _table(columns: Sequence[Measure], rows: Mapping[str, Mapping], corner: str, decimals: int) -> pd.DataFrame:
    """Return a table with a column per measure in `columns`; numbers have at least `decimals` decimals."""
    cells = {
        _counted(label, row): {m.column: m.cell(row.get(m.key), max(decimals, m.digits)) for m in columns}
        for label, row in rows.items()
    }
    return pd.DataFrame.from_dict(cells, orient="index").rename_axis(corner)


def _counted(label: str, row: Mapping) -> str:
    """Return the label of a row; if the arm stopped early, append the number of completed goals."""
    done, asked = row.get("episodes"), row.get("asked")
    return label if done == asked else f"{label}, {done} of {asked} goals done"


def scores_rows(measures: MeasureTable, scores: pd.DataFrame) -> pd.DataFrame:
    """Return a row per group of a `summary_table`: interquartile mean and, with two seeds or more, 95 % interval."""
    out: dict[str, dict[str, str]] = {}
    for r in scores.to_dict("records"):
        m = measures[r["measure"]]
        cells = out.setdefault(r["group"], {"seeds": str(r["seeds"])})
        interval = f"\n[{m.cell(r['low'])}, {m.cell(r['high'])}]" if r["seeds"] > 1 else ""
        cells[m.column] = f"{m.cell(r['iqm'], max(1, m.digits))}{interval}"
    return pd.DataFrame.from_dict(out, orient="index").rename_axis(measures.corner)


def print_measures(console: Console, measures: MeasureTable, rows: Mapping[str, Mapping], title: str) -> None:
    """Print the table of `measure_rows`."""
    print_table(console, measure_rows(measures, rows), title)


def print_table(
    console: Console, frame: pd.DataFrame, title: str, caption: str | None = None, sentences: bool = False
) -> None:
    """Print a table of strings; dim `doubtful` cells, unless the cells contain sentences."""
    how = {"title_justify": "left", "caption_justify": "left", "padding": (0, 1, 0, 0)}
    table = Table(title=title, caption=caption, title_style="bold", box=SIMPLE_HEAD, **how)  # type: ignore[arg-type]
    table.add_column(str(frame.index.name or ""))
    for column in frame.columns:
        table.add_column(str(column), justify="left" if sentences else "right")
    for label, row in frame.iterrows():
        cells = [escape(str(cell)) for cell in row]
        dim = [doubtful(c) and not sentences for c in cells]
        table.add_row(escape(str(label)), *(f"[dim]{c}[/dim]" if d else c for c, d in zip(cells, dim, strict=True)))
    console.print(table, *[""] * bool(caption), sep="\n")
