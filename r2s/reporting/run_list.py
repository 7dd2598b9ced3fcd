"""The runs below a root: status, what came of them, and how old they are."""

import csv
import json
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from r2s.reporting.measures import in_short
from r2s.runs import status_of

LOST = ("failed", "killed")


def run_rows(root: str | Path, *, stage: str | None = None, failed: bool = False) -> pd.DataFrame:
    """Return a row of strings per run folder of runs/<stage>/<name>, the youngest last.

    Args:
        root: where run folders live. stage: only runs of this one. failed: only what failed or was killed.
    """
    found = []
    for path in Path(root).glob(f"{stage or '*'}/*/meta.json"):
        try:
            meta = json.loads(path.read_text())
            start, status = datetime.fromisoformat(meta["start"]), status_of(meta)
        except (ValueError, KeyError, TypeError):
            continue  # not ours
        if not failed or status in LOST:
            found.append((start, path.parent, status, meta))
    rows = {}
    for start, folder, status, meta in sorted(found, key=lambda f: f[0]):
        age = (datetime.now().astimezone() - start).total_seconds()
        rows[f"{folder.parent.name}/{folder.name}"] = {
            "status": status,
            "what came of it": _figures(folder, meta),
            "age": ago(age),
        }
    table = pd.DataFrame.from_dict(rows, orient="index", columns=["status", "what came of it", "age"])
    return table.rename_axis("run")


def ago(seconds: float) -> str:
    """Return an age in its largest unit: 40 s, 12 min, 5 h, 3 d."""
    for size, unit in ((86400, "d"), (3600, "h"), (60, "min")):
        if seconds >= size:
            return f"{seconds / size:.0f} {unit}"
    return f"{max(seconds, 0):.0f} s"


def _figures(folder: Path, meta: Mapping[str, Any]) -> str:
    """Return the key figures of a run; of one that is not done how far it came, or why it ended."""
    summary = folder / "summary.json"
    try:
        if summary.is_file():
            return _last_word(meta.get("stage", ""), json.loads(summary.read_text()))
        if "error" in meta:
            return str(meta["error"]).splitlines()[0]
        with open(folder / "evaluations.csv", newline="") as file:
            *_, row = csv.DictReader(file)
        return f"{_success(row)} after {float(row['env_steps']) / 1e3:.0f}k env steps"
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return "-"


def _last_word(stage: str, document: Mapping[str, Any]) -> str:
    if stage == "identify":
        side = document["validation"]
        after, before = (float(np.mean(side[k])) for k in ("torque_rmse_Nm", "nominal_torque_rmse_Nm"))
        return f"torque RMSE {after:.3g} Nm, nominal {before:.3g}"
    if stage == "train":
        return _success(document["best"])
    if stage == "compare":
        groups = {row["group"] for row in document["scores"]}
        return f"{len(groups)} group{'s' * (len(groups) != 1)} of runs"
    rows = document["reach"] if stage == "pipeline" else document
    if any("path_rmse_mm" in row for row in rows.values()):
        return "RMSE " + "; ".join(f"{where} {row['path_rmse_mm']:.2f}" for where, row in rows.items()) + " mm"
    return "; ".join(f"{where} {100 * row['success_1cm']:.0f} %" for where, row in rows.items()) + " < 1 cm"


def _success(row: Mapping[str, Any]) -> str:
    return ", ".join(in_short(row))
