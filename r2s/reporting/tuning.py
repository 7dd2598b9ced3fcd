"""What a search for settings found, trial by trial, and against a grid at equal compute."""

from collections.abc import Sequence
from glob import glob
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from r2s.reporting.document import report_markdown
from r2s.reporting.figures import panels
from r2s.reporting.trainings import read_trainings
from r2s.runs import Run

ORDERS = 2000  # in which a grid could have been gone through
SHARES = (0.1, 0.25, 0.5, 0.75, 1.0)


def trials_table(study: Any, folder: Path) -> pd.DataFrame:
    """Return a row per trial: what was drawn, what came of it, and the seconds and steps that it took."""
    rows = []
    for trial in study.trials:
        row = {"trial": trial.number, "state": trial.state.name.lower(), "value": trial.value} | trial.params
        path = folder.parent.parent / "train" / f"{folder.name}_{trial.number}" / "evaluations.csv"
        curve = pd.read_csv(path) if path.is_file() else pd.DataFrame()
        for key in ("env_steps", "wall_clock_s"):
            row[key] = float(curve[key].iloc[-1]) if len(curve) else 0.0
        rows.append(row)
    return pd.DataFrame(rows)


def best_so_far(spent: Sequence[float], values: Sequence[float], at: np.ndarray, sign: float) -> np.ndarray:
    """Return the best value (K,) after each amount of compute `at` (K,) of trials done one after another.

    A trial counts once it has ended; a value that is nan (pruned, failed) takes its compute and brings nothing.
    """
    ends = np.cumsum(np.asarray(spent, dtype=float))
    best = np.fmax.accumulate(np.where(np.isnan(values), -np.inf, sign * np.asarray(values, dtype=float)))
    found = np.searchsorted(ends, at * (1 + 1e-9), side="right")
    return np.array([sign * best[k - 1] if k and np.isfinite(best[k - 1]) else np.nan for k in found])


def against_table(trials: pd.DataFrame, measure: str, against: str | None, larger: bool) -> pd.DataFrame | None:
    """Return the best so far of the search and of a grid, at shares of the compute that the search took.

    The grid's is the mean over `ORDERS` random orders of its jobs: in which order a grid is gone through is chance.

    Args:
        trials: of `trials_table`. measure: of the last evaluation. against: glob of trainings; None: there are none.
        larger: whether larger is better.
    """
    if not against:
        return None
    grid, _ = read_trainings(sorted(glob(against)))
    sign = 1.0 if larger else -1.0
    at = np.array(SHARES) * trials["wall_clock_s"].sum()
    searched = best_so_far(trials["wall_clock_s"].tolist(), trials["value"].tolist(), at, sign)
    # of the evaluations, as a trial's: a summary's last policy was judged on other goals
    spent, values = (np.array([r.curve[k].iloc[-1] for r in grid]) for k in ("wall_clock_s", measure))
    rng = np.random.default_rng(0)
    orders = [rng.permutation(len(grid)) for _ in range(ORDERS)]
    each = np.stack([best_so_far(spent[o].tolist(), values[o].tolist(), at, sign) for o in orders])
    known = np.isfinite(each).all(axis=0)
    mean = np.where(known, np.where(np.isfinite(each), each, 0.0).mean(axis=0), np.nan)
    jobs = [float(min(len(grid), x / spent.mean())) for x in at]
    columns = {"minutes": at / 60, "tune": searched, "grid": mean, "jobs of the grid": jobs}
    return pd.DataFrame(columns)


def tuning_page(run: Run, trials: pd.DataFrame, against: pd.DataFrame | None, measure: str) -> None:
    """Write report.md and its figure: every trial, the best so far, and the grid beside it."""
    ended = trials[trials["state"] == "complete"]
    spent = trials["wall_clock_s"].cumsum() / 60
    path = run.figure("tune")
    with panels(path, 1, 1, f"{measure} of trials over the compute spent", height=4.0) as (axis,):
        axis.plot(spent[ended.index], ended["value"], "o", label="trials that came to their end")
        if against is not None:
            for name in ("tune", "grid"):
                axis.plot(against["minutes"], against[name], marker=".", label=f"best so far, {name}")
        axis.set_xlabel("minutes of training, summed over the trials")
    shown = trials.set_index("trial").map(lambda v: f"{v:.4g}" if isinstance(v, float) else str(v))
    sections: dict[str, list[Any]] = {f"Settings looked for: {run.folder.name}": [path], "Trials": [shown]}
    if against is not None:
        rows = against.map(lambda v: f"{v:.4g}").set_index("minutes")
        note = "The best so far at equal compute; the grid's is the mean over random orders of its jobs."
        sections["Against the grid"] = [rows, note]
    report_markdown(run.folder / "report.md", sections)
