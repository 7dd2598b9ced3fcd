"""Report stage=tune: the trials, and a comparison of the search with a grid search of equal training time."""

from collections.abc import Sequence
from glob import glob
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from r2s.errors import UserError
from r2s.reporting.comparison.trainings import Trained, by_reason, trainings_among
from r2s.reporting.document import Item, report_markdown
from r2s.reporting.figures.panels import panels
from r2s.runs import Run

ORDERS = 2000  # number of random job orders; a mean over them has 1/45 of their standard deviation as standard error
SHARES = (0.1, 0.25, 0.5, 0.75, 1.0)  # fractions of the search's training time at which search and grid are compared


def trials_table(study: Any, folder: Path) -> pd.DataFrame:
    """Return a row per trial: settings, value, wall-clock seconds and env steps."""
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
    """Return the best value (K,) found by the times `at` (K,) s if trials run one by one for `spent` s each.

    Pruned and failed trials take time, but have the value nan. sign: 1 if a larger value is better, else -1.
    """
    ends = np.cumsum(np.asarray(spent, dtype=float))
    best = np.fmax.accumulate(np.where(np.isnan(values), -np.inf, sign * np.asarray(values, dtype=float)))
    found = np.searchsorted(ends, at * (1 + 1e-9), side="right")
    return np.array([sign * best[k - 1] if k and np.isfinite(best[k - 1]) else np.nan for k in found])


def read_grid(against: str, measure: str) -> list[Trained]:
    """Return the finished trainings that match the glob `against` and have the measure `measure`.

    Raises:
        UserError: no finished training matches.
    """
    found, others = trainings_among(sorted(glob(against)))
    grid = [r for r in found if r.learned and measure in r.curve]
    if not grid:
        others |= {r.folder.name: f"no {measure}" for r in found}
        seen = "; ".join(by_reason(others))
        raise UserError(f"tune.against: expected finished trainings with {measure}, {against!r} has none: {seen}")
    return grid


def against_table(trials: pd.DataFrame, measure: str, against: str | None, larger: bool) -> pd.DataFrame | None:
    """Tabulate best values of search and grid at `SHARES` of the search's training time; return None without a grid.

    The order of a grid's jobs is arbitrary, so the grid's best value is averaged over `ORDERS` random orders.

    Args:
        trials: output of `trials_table`. measure: column in evaluations.csv. against: glob of grid runs, or None.
        larger: whether a larger value of the measure is better.
    """
    if not against:
        return None
    grid = read_grid(against, measure)
    sign = 1.0 if larger else -1.0
    at = np.array(SHARES) * trials["wall_clock_s"].sum()
    searched = best_so_far(trials["wall_clock_s"].tolist(), trials["value"].tolist(), at, sign)
    # the value of a job is its last evaluation, as for a trial; summary.json contains evaluations on other goals
    spent, values = (np.array([r.curve[k].iloc[-1] for r in grid]) for k in ("wall_clock_s", measure))
    rng = np.random.default_rng(0)
    orders = [rng.permutation(len(grid)) for _ in range(ORDERS)]
    each = np.stack([best_so_far(spent[o].tolist(), values[o].tolist(), at, sign) for o in orders])
    known = np.isfinite(each).all(axis=0)
    mean = np.where(known, np.where(np.isfinite(each), each, 0.0).mean(axis=0), np.nan)
    jobs = [float(min(len(grid), x / spent.mean())) for x in at]
    return pd.DataFrame({"minutes": at / 60, "tune": searched, "grid": mean, "jobs of the grid": jobs})


def tuning_page(run: Run, trials: pd.DataFrame, against: pd.DataFrame | None, measure: str) -> None:
    """Write report.md with a figure of all trials and of the best values so far."""
    ended = trials[trials["state"] == "complete"]
    spent = trials["wall_clock_s"].cumsum() / 60
    path = run.figure("tune")
    with panels(path, 1, 1, f"{measure} of the trials over compute", height=4.0) as (axis,):
        axis.plot(spent[ended.index], ended["value"], "o", label="completed trials")
        if against is not None:
            for name in ("tune", "grid"):
                axis.plot(against["minutes"], against[name], marker=".", label=f"best so far, {name}")
        axis.set_xlabel("minutes of training, summed over the trials")
    shown = trials.set_index("trial").map(lambda v: f"{v:.4g}" if isinstance(v, float) else str(v))
    sections: dict[str, list[Item]] = {f"Search for settings: {run.folder.name}": [path], "Trials": [shown]}
    if against is not None:
        rows = against.map(lambda v: f"{v:.4g}").set_index("minutes")
        note = "Best so far at equal compute; the grid's is the mean over random orders of its jobs."
        sections["Against the grid"] = [rows, note]
    report_markdown(run.folder / "report.md", sections)
