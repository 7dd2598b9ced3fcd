"""Compute the measures of `task=push` from the pose of the box."""

import numpy as np

from r2s.tasks.measures import Measure, MeasureTable
from r2s.tasks.rollout import HOLD_S
from r2s.tasks.task import Episodes

GOOD_M, GOOD_RAD = 0.03, float(np.radians(10.0))
YAW_ERROR, TIP_HEIGHT = 6, 7  # columns of `Episodes.box` after the pose

PUSH = MeasureTable(
    measures=(
        Measure("success", "success", "box within 3 cm and 10 degrees", "%", 100, 0),
        Measure("within_3cm", "3 cm", "box within 3 cm", "%", 100, 0),
        Measure("within_10deg", "10 deg", "box within 10 degrees", "%", 100, 0),
        Measure("distance_median_m", "median\ndistance", "median distance of the box", "mm", 1e3, 1, True),
        Measure("yaw_median_deg", "median\nyaw error", "median yaw error of the box", "deg", 1, 1, True),
        Measure("force_peak_N", "peak force", "largest force on the box", "N", 1, 1, lower_is_better=True),
        Measure("on_table", "on table", "episodes in which the tip meets the table", "%", 100, 0, True),
        Measure("return_push", "return", "return"),
        Measure("stopped", "stopped", "episodes that were stopped", "%", 100, 0, lower_is_better=True),
    ),
    selection=("success", "return_push"),
    rows=(
        *("success", "within_3cm", "within_10deg", "distance_median_m", "yaw_median_deg", "force_peak_N", "on_table"),
        "stopped",
    ),
    comparison=("success", "distance_median_m", "yaw_median_deg", "return_push"),
    curves=("success", "distance_median_m", "yaw_median_deg", "return_push"),
    transfer=("success", "distance_median_m"),
    corner="",
    description="It pushes a box of unknown mass and friction to a pose.",
    error=Measure("distance", "distance", "distance of the box to its goal", "cm", 100.0, lower_is_better=True),
    error_levels=(3.0,),
)


def push_measures(episodes: Episodes, ctrl_hz: int) -> dict[str, float]:
    """Return the measures of `task=push`, which form one row of evaluations.csv.

    within_3cm, within_10deg: share of episodes in which the box stays within 3 cm (10 degrees) of its goal in the
    last 0.5 s. success: share of episodes within 3 cm and 10 degrees, without a stop, and with the tip always above
    the table. distance_median_m, yaw_median_deg: mean distance and mean yaw error in the last 0.5 s, median over
    episodes. force_peak_N: largest force of an episode, read once per control step; mean over episodes. on_table:
    share of episodes in which the tip sinks into the table.
    """
    hold, box = round(HOLD_S * ctrl_hz), episodes.box
    assert box is not None
    ended = ~np.isfinite(episodes.distance[:, -1])
    away, yaw = episodes.distance[:, -hold:], np.abs(box[:, -hold:, YAW_ERROR])
    yaw = np.where(ended[:, None], np.inf, yaw)
    near, aligned = away.max(1) <= GOOD_M, yaw.max(1) <= GOOD_RAD
    low = box[:, :, TIP_HEIGHT].min(1) < 0.0
    force = episodes.force[..., 0].max(1)  # type: ignore[index]
    return {
        "success": float((near & aligned & ~low).mean()),
        "within_3cm": float(near.mean()),
        "within_10deg": float(aligned.mean()),
        "distance_median_m": float(np.median(np.where(ended, np.inf, away.mean(1)))),
        "yaw_median_deg": float(np.degrees(np.median(yaw.mean(1)))),
        "force_peak_N": float(force.mean()),
        "on_table": float(low.mean()),
        "return_push": float(episodes.reward.sum(1).mean()),
        "stopped": float(ended.mean()),
        "q_left_rad": float(np.quantile(episodes.q_left, 0.05)),
        "limited": float(episodes.limited.mean()),
        "collision": float((episodes.collision != "").mean()),
    }
