"""Compute the measures of `task=press` from the contact force and the requested force."""

import numpy as np

from r2s.tasks.measures import Measure, MeasureTable
from r2s.tasks.task import Episodes

WINDOW_S = 1.0  # s, duration of the two windows of the RMS force error, one before the force step, one before the end
IMPACT_S = 0.1  # s, duration of the impact, which begins at the first touch
TOUCH_N = 0.5  # N, force above which the tip is in contact
GOOD_N, OVER_N, OVER_SHARE = 1.0, 2.0, 0.2  # limits for success: RMS error N, overshoot N, overshoot / step

PRESS = MeasureTable(
    measures=(
        Measure("success", "success", "success", "%", 100, 0),
        Measure("force_rmse_N", "RMSE", "force RMSE before the step and at the end", "N", 1, 2, True, True),
        Measure("force_rmse_first_N", "RMSE\nfirst", "force RMSE before the step", "N", 1, 2, True, True),
        Measure("force_rmse_last_N", "RMSE\nlast", "force RMSE at the end", "N", 1, 2, True, True),
        Measure("overshoot_N", "overshoot", "overshoot of the step", "N", 1, 2, lower_is_better=True),
        Measure("overshoot_share", "overshoot", "overshoot of the step", "%", 100, 0, lower_is_better=True),
        Measure("impact_N", "impact", "peak force of the impact", "N", 1, 1, lower_is_better=True),
        Measure("contact", "contact", "time in contact after the first touch", "%", 100, 1),
        Measure("return_press", "return", "return"),
        Measure("stopped", "stopped", "episodes that were stopped", "%", 100, 0, lower_is_better=True),
    ),
    selection=("success", "force_rmse_N"),
    rows=(
        *("success", "force_rmse_first_N", "force_rmse_last_N", "overshoot_N", "overshoot_share", "impact_N"),
        *("contact", "stopped"),
    ),
    comparison=("success", "force_rmse_N", "overshoot_N", "impact_N", "return_press"),
    curves=("success", "force_rmse_N", "overshoot_N", "return_press"),
    transfer=("force_rmse_N", "overshoot_N"),
    corner="",
    description="It touches a surface and holds a force against it, which steps in the middle of the episode.",
    error=Measure("distance", "error", "error of the force", "N", 1.0, lower_is_better=True),
    error_levels=(5.0, 2.0, 1.0),
)


def press_measures(episodes: Episodes, step: int, ctrl_hz: int) -> dict[str, float]:
    """Return the measures of `task=press`, which form one row of evaluations.csv.

    force_rmse_first_N: RMS force error in the second before the force step. force_rmse_last_N: RMS force error in the
    last second. The next four measures are means over episodes. overshoot_N: largest overshoot beyond the new force,
    in the direction of the step. overshoot_share: overshoot_N divided by the height of the step. impact_N: largest
    force within IMPACT_S of the first touch. contact: share of time in contact after the first touch. All measures
    above exclude stopped episodes. success: share of all episodes that meet three conditions: no stop; both RMS
    errors <= GOOD_N; overshoot_N <= OVER_N or overshoot_share <= OVER_SHARE.
    """
    ended = ~np.isfinite(episodes.distance[:, -1])
    runs = episodes.force[~ended]  # type: ignore[index]
    rows = [_measured(f[:, 0], f[:, 1], step, ctrl_hz) for f in runs]
    first, last, over, share, impact, contact = np.array(rows).T if rows else np.full((6, 1), np.nan)
    good = (np.maximum(first, last) <= GOOD_N) & ((over <= OVER_N) | (share <= OVER_SHARE))
    squares = float(np.mean(first**2)), float(np.mean(last**2))
    return {
        "success": float(good.sum() / len(ended)),
        "force_rmse_N": float(np.sqrt(np.mean(squares))),
        "force_rmse_first_N": float(np.sqrt(squares[0])),
        "force_rmse_last_N": float(np.sqrt(squares[1])),
        "overshoot_N": float(over.mean()),
        "overshoot_share": float(share.mean()),
        "impact_N": float(impact.mean()),
        "contact": float(contact.mean()),
        "return_press": float(episodes.reward.sum(1).mean()),
        "stopped": float(ended.mean()),
        "q_left_rad": float(np.quantile(episodes.q_left, 0.05)),
        "limited": float(episodes.limited.mean()),
        "collision": float((episodes.collision != "").mean()),
    }


def _measured(force: np.ndarray, asked: np.ndarray, step: int, ctrl_hz: int) -> tuple[float, ...]:
    """Return both RMS force errors N, overshoot N, overshoot / step, impact force N, share of time in contact."""
    window = round(WINDOW_S * ctrl_hz)
    error, change = force - asked, asked[-1] - asked[0]
    rmse = [float(np.sqrt((error[part] ** 2).mean())) for part in (slice(step - window, step), slice(-window, None))]
    over = max(0.0, float((np.sign(change) * error[step:]).max()))
    return *rmse, over, over / abs(change), *impact_of(force, ctrl_hz)


def impact_of(force: np.ndarray, ctrl_hz: int) -> tuple[float, float]:
    """Return the peak force, N, within IMPACT_S of the first touch, and the share of time in contact from then on."""
    touched = np.flatnonzero(force > TOUCH_N)
    if not len(touched):
        return 0.0, 0.0
    since = force[touched[0] :]
    return float(since[: 1 + round(IMPACT_S * ctrl_hz)].max()), float((since > TOUCH_N).mean())
