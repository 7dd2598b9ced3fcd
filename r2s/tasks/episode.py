"""Episodes, and how well they reached; the measures serve every simulator and arm."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch

HOLD_S = 0.5  # s, at the end of an episode: reached means reached and held


@dataclass(frozen=True)
class Episodes:
    """E finished episodes of T control steps; row k is the state after step k.

    Attributes:
        t: (T,) s. q, dq: (E, T, n). ee: (E, T, 3) m. goal: (E, 3) m. tau: (E, T, n) Nm, the command at the end of
        the step. distance: (E, T) m. reward: (E, T), eq. (2).
    """

    t: np.ndarray
    q: np.ndarray
    dq: np.ndarray
    ee: np.ndarray
    goal: np.ndarray
    tau: np.ndarray
    distance: np.ndarray
    reward: np.ndarray


class Acts(Protocol):
    """What reaches: a policy, or the model-based reference (both in r2s/learning)."""

    def action(self, observation: torch.Tensor) -> torch.Tensor:
        """Return actions (B, n) in [-1, 1] for observations (B, d)."""
        ...


def measures(episodes: Episodes) -> dict[str, float]:
    """Return one row of evaluations.csv.

    success_x: share of episodes within x of the goal for the whole last 0.5 s. distance_median_m: median over goals
    of the mean distance in that time. return_paper: mean sum of eq. (2). time_to_reach_s: median time after which the
    hand stays within 2 cm, of the episodes that got there. overshoot_m: how far out of 2 cm it came again after it
    had first been within, mean of those that had.
    """
    step = episodes.t[1] - episodes.t[0]
    last = episodes.distance[:, -round(HOLD_S / step) :]
    away = episodes.distance > 0.02
    steps = episodes.distance.shape[1]
    since = np.where(away.any(1), steps - np.argmax(away[:, ::-1], axis=1), 0)
    there = since < steps
    first = np.argmin(away, axis=1)
    later = [
        max(0.0, row[k:-1].max(initial=0.0) - 0.02)
        for row, k, out in zip(episodes.distance, first, away, strict=True)
        if not out.all()
    ]
    return {
        "success_5cm": float((last.max(1) < 0.05).mean()),
        "success_2cm": float((last.max(1) < 0.02).mean()),
        "success_1cm": float((last.max(1) < 0.01).mean()),
        "success_5mm": float((last.max(1) < 0.005).mean()),
        "distance_median_m": float(np.median(last.mean(1))),
        "return_paper": float(episodes.reward.sum(1).mean()),
        "time_to_reach_s": float(np.median(since[there]) * step) if there.any() else float("nan"),
        "overshoot_m": float(np.mean(later)) if later else float("nan"),
    }


def gap(one: Episodes, other: Episodes) -> dict[str, float]:
    """Return how far apart one policy came out on the same goals: RMSE of the hand's path, mm, and of torques, Nm."""
    path = np.linalg.norm(one.ee - other.ee, axis=-1)
    return {
        "ee_path_rmse_mm": float(1e3 * np.sqrt((path**2).mean())),
        "tau_rmse_Nm": float(np.sqrt(((one.tau - other.tau) ** 2).mean())),
    }
