"""Compute the measures of `task=wipe` from the path error and the contact force along the path."""

import numpy as np

from r2s.tasks.measures import Measure, MeasureTable
from r2s.tasks.press_measures import TOUCH_N, impact_of
from r2s.tasks.task import Episodes

GOOD_N, GOOD_M = 2.0, 0.003  # N, m: a step is wiped if force error and path error are within these limits
SUCCESS = 0.95  # share of a path that must be wiped for success

WIPE = MeasureTable(
    measures=(
        Measure("success", "success", "paths wiped to 95 %", "%", 100, 0),
        Measure("wiped", "wiped", "path within 2 N and 3 mm", "%", 100, 1),
        Measure("within_2N", "2 N", "path within 2 N", "%", 100, 1),
        Measure("within_3mm", "3 mm", "path within 3 mm", "%", 100, 1),
        Measure("force_rmse_N", "force\nRMSE", "force RMSE in motion", "N", 1, 2, True, True),
        Measure("path_rmse_mm", "path\nRMSE", "RMSE of the path", "mm", 1, 2, True, True),
        Measure("impact_N", "impact", "peak force of the impact", "N", 1, 1, lower_is_better=True),
        Measure("contact", "contact", "path in contact", "%", 100, 1),
        Measure("return_wipe", "return", "return"),
        Measure("stopped", "stopped", "episodes that were stopped", "%", 100, 0, lower_is_better=True),
    ),
    selection=("wiped", "force_rmse_N"),
    rows=(
        *("success", "wiped", "within_2N", "within_3mm", "force_rmse_N", "path_rmse_mm", "impact_N", "contact"),
        "stopped",
    ),
    comparison=("wiped", "force_rmse_N", "path_rmse_mm", "impact_N", "return_wipe"),
    curves=("wiped", "force_rmse_N", "path_rmse_mm", "return_wipe"),
    transfer=("force_rmse_N", "path_rmse_mm"),
    corner="",
    description="It follows a timed path on a surface under a normal force.",
    error=Measure("distance", "error", "error of the path", "mm", 1e3, lower_is_better=True),
    error_levels=(10.0, 3.0),
)


def wipe_measures(episodes: Episodes, begin: int, ctrl_hz: int) -> dict[str, float]:
    """Return the measures of `task=wipe`, one row of evaluations.csv; begin: number of steps before the path starts.

    within_2N: share of steps with a force error <= 2 N. within_3mm: share of steps with a path error <= 3 mm. wiped:
    share of steps within 2 N and 3 mm. contact: share of steps with a force above TOUCH_N. In these shares, all steps
    of a stopped episode are failures. success: share of episodes with `wiped` >= SUCCESS. The errors and the impact
    exclude stopped episodes. force_rmse_N, path_rmse_mm: RMS errors. impact_N: peak force within IMPACT_S of the
    first touch, which may precede `begin`; mean over episodes.
    """
    ended = ~np.isfinite(episodes.distance[:, -1])
    runs = ~ended[:, None]
    force, asked = np.moveaxis(episodes.force[:, begin:], -1, 0)  # type: ignore[index]
    error, away = np.abs(force - asked), episodes.distance[:, begin:]
    light, close = (error <= GOOD_N) & runs, (away <= GOOD_M) & runs
    none = bool(ended.all())
    squares = [np.nan, np.nan] if none else [np.mean(x[~ended] ** 2) for x in (error, away)]
    impacts = [impact_of(f, ctrl_hz)[0] for f in episodes.force[~ended, :, 0]]  # type: ignore[index]
    wiped = (light & close).mean(1)
    return {
        "success": float((wiped >= SUCCESS).mean()),
        "wiped": float(wiped.mean()),
        "within_2N": float(light.mean()),
        "within_3mm": float(close.mean()),
        "force_rmse_N": float(np.sqrt(squares[0])),
        "path_rmse_mm": float(1e3 * np.sqrt(squares[1])),
        "impact_N": float("nan") if none else float(np.mean(impacts)),
        "contact": float(((force > TOUCH_N) & runs).mean()),
        "return_wipe": float(episodes.reward.sum(1).mean()),
        "stopped": float(ended.mean()),
        "q_left_rad": float(np.quantile(episodes.q_left, 0.05)),
        "limited": float(episodes.limited.mean()),
        "collision": float((episodes.collision != "").mean()),
    }
