"""Build tables of each recording's contribution to an identification, and of the drift since an earlier one."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd

from r2s.identification.contributions import Contribution
from r2s.reporting.tables import number

CONTRIBUTIONS = (
    "RMSE: torque of the fit to all training recordings, mean over joints; left out: of a fit to the others. The "
    "last column tells what a recording's information adds: how much wider intervals would be without it."
)
NARROWER = 1.02  # a recording adds information if, without it, an interval is wider by at least this factor


def contribution_table(parts: Sequence[Contribution], names: Sequence[str]) -> pd.DataFrame:
    """Return a row per recording: use, torque, s, RMSE of the fits with and without it, effect on intervals."""
    rows = {}
    for p in parts:
        cells = {"": p.use, "torque": p.torque, "s": number(p.seconds), "RMSE, Nm": number(np.nanmean(p.rmse))}
        cells["left out, Nm"] = "" if p.left_out is None else number(np.nanmean(p.left_out))
        rows[p.label] = cells | {"intervals without it / with it": _narrower(p, names)}
    return pd.DataFrame.from_dict(rows, orient="index").rename_axis("recording")


def _narrower(p: Contribution, names: Sequence[str]) -> str:
    if p.narrower is None:
        return ""
    k = int(np.argmax(p.narrower))
    if p.narrower[k] < NARROWER:
        return "1: it adds nothing"
    return f"median {np.median(p.narrower):.2f}, {names[k]} {p.narrower[k]:.2f}"


def contribution_entry(parts: Sequence[Contribution], names: Sequence[str]) -> dict[str, Any]:
    """Return the part of summary.json that describes each recording's contribution to the fit."""
    out = {}
    for p in parts:
        own: dict[str, Any] = {
            "use": p.use,
            "torque": p.torque,
            "seconds": p.seconds,
            "torque_rmse_Nm": _listed(p.rmse),
        }
        if p.left_out is not None and p.narrower is not None:
            own |= {"left_out_torque_rmse_Nm": _listed(p.left_out), "contradiction": p.contradiction}
            own |= {"width_without_over_with": dict(zip(names, p.narrower.tolist(), strict=True))}
        out[p.label] = own
    return out


def _listed(x: np.ndarray) -> list[float | None]:
    return [v if np.isfinite(v) else None for v in x.tolist()]


def drift_items(table: pd.DataFrame, run: str) -> tuple[str, pd.DataFrame]:
    """Return sentences that explain a `drift_table`, and the table as strings."""
    changed = table[table["changed"]]
    words = (
        f"Values of {run}, values now, and their difference with its 95 % interval, which counts the errors of both "
        f"identifications. {len(changed)} of {len(table)} differences are significant; without any drift about "
        f"{0.05 * len(table):.0f} would be."
    )
    cells = {c: [number(v) for v in table[c].tolist()] for c in ("then", "now", "difference", "low", "high")}
    cells["95 %"] = [f"[{low}, {high}]" for low, high in zip(cells.pop("low"), cells.pop("high"), strict=True)]
    cells[""] = ["changed" if x else "" for x in table["changed"]]
    named = zip(table["parameter"], table["unit"], strict=True)
    index = [f"{name}, {unit}" if unit != "1" else str(name) for name, unit in named]
    return words, pd.DataFrame(cells, index=index).rename_axis("parameter")


def drift_entry(table: pd.DataFrame, run: str) -> dict[str, Any]:
    """Return the part of summary.json that describes the drift since the identification `run`."""
    values = table.drop(columns="parameter").to_dict("records")
    return {"since": run, "parameters": dict(zip(table["parameter"], values, strict=True))}
