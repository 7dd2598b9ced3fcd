"""Report stage=results: recomputed cells of a page that differ from committed cells, and a summary of all pages."""

import json
from pathlib import Path
from typing import Any

import pandas as pd
from rich.console import Console

from r2s.files import atomic_write
from r2s.reporting.document import report_markdown
from r2s.reporting.page_comparison import VERDICTS
from r2s.reporting.tables import print_table
from r2s.runs import Run

SHOWN = 20  # largest number of cells that are printed
NOTE = "without interval: the figure has changed, and the page states no interval that would judge it"


def page_report(console: Console, run: Run, page: str, commit: str, cells: pd.DataFrame) -> dict[str, Any]:
    """Print the cells that differ; write differences.csv, report.md and a report of all pages; return a summary.

    Args:
        run: run folder to write to. page: page name. commit: commit of the new page. cells: table of `compare_pages`.
    """
    counts = {verdict: int((cells["verdict"] == verdict).sum()) for verdict in VERDICTS}
    cells.to_csv(run.folder / "differences.csv", index=False)
    shown = _shown(cells[cells["verdict"] != "equal"])
    words = ", ".join(f"{count} {verdict}" for verdict, count in counts.items() if count)
    title = f"{page}: {len(cells)} cells, {words or 'no table'}"
    print_table(console, shown.head(SHOWN), title, NOTE)
    if len(shown) > SHOWN:
        console.print(f"{len(shown) - SHOWN} more in {run.folder / 'report.md'}", markup=False)
    report_markdown(run.folder / "report.md", {title: [f"Commit {commit}. {NOTE}.", shown]})
    summary = {"page": page, "commit": commit, "cells": len(cells), **counts}
    all_pages(run.folder.parent, summary)
    return summary


def all_pages(folder: Path, last: dict[str, Any]) -> None:
    """Write report.md in `folder` with a row per page: from this run's summary `last` and older summaries."""
    done = {last["page"]: last}
    for path in sorted(folder.glob("*/summary.json")):
        other = json.loads(path.read_text())
        done.setdefault(other["page"], other)
    rows = {
        page: {"commit": done[page]["commit"][:7]} | {k: str(done[page][k]) for k in ("cells", *VERDICTS)}
        for page in sorted(done)
    }
    table = pd.DataFrame.from_dict(rows, orient="index").rename_axis("page")
    with atomic_write(folder / "report.md") as part:
        report_markdown(part, {"Results made again": [NOTE + ".", table]})


def _shown(cells: pd.DataFrame) -> pd.DataFrame:
    """Return cells as strings, sorted by verdict (beyond intervals, without interval, others), then by change."""
    order = cells.assign(rank=cells["verdict"].map({"beyond intervals": 0, "without interval": 1}).fillna(2))
    order = order.sort_values(["rank", "change"], ascending=[True, False])
    change = order["change"].map(lambda x: "" if pd.isna(x) else f"{100 * x:.0f} %")
    several = cells["section"].nunique() > 1
    names = [f"{s}: {row}" if several else row for s, row in zip(order["section"], order["row"], strict=True)]
    table = order[["column", "committed", "now", "verdict"]].assign(change=change)
    table.index = pd.Index(names, name="section: row" if several else "row")
    return table
