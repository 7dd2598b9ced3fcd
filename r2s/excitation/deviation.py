"""Compute how far an arm may deviate from a planned motion without a collision."""

from dataclasses import dataclass

import numpy as np

from r2s.excitation.motion_checks import DEVIATION, Motion, Space, geometry_rows
from r2s.physics.fence import FENCE_M


@dataclass(frozen=True)
class DeviationLimits:
    """Limits of the deviation e (n,) rad from a motion: in cycle k, weights[k // every] @ |e| must be at most 1.

    Attributes:
        weights: (R, K, n) 1/rad: K linear limits in each of R time intervals. every: cycles per interval.

    """

    weights: np.ndarray
    every: int = 1

    @classmethod
    def uniform(cls, n: int, most: float) -> "DeviationLimits":
        """Return limits that allow each of n joints a deviation of `most` rad in all cycles."""
        return cls(np.eye(n)[None] / most)

    @classmethod
    def along(cls, space: Space, motion: Motion, most: float) -> "DeviationLimits":
        """Return limits along a motion: in an interval, the smaller limits of `deviation_weights` at its two ends."""
        rows = geometry_rows(motion)
        weights = deviation_weights(space, motion.q[rows], most)
        return cls(np.maximum(weights[:-1], weights[1:]), int(rows[1] - rows[0]))

    def share(self, k: int, deviation: np.ndarray) -> np.ndarray:
        """Return the share (K, n) of each limit that each joint uses in cycle k; a row's sum must be at most 1."""
        return self.weights[min(k // self.every, len(self.weights) - 1)] * np.abs(deviation)


def deviation_weights(space: Space, q: np.ndarray, most: float) -> np.ndarray:
    """Return weights (T, K + n, n) 1/rad that limit deviations from q (T, n) rad, so that links avoid obstacles.

    K limits keep each distance above FENCE_M to first order: a joint's deviation reduces a distance in proportion to
    the joint's lever. n limits keep the deviation of each joint below `most`. All joints may always deviate by
    DEVIATION, so that an arm that starts too near to an obstacle can move away.
    """
    distances, levers = space.measured(q)
    levers = levers[:, 1:]
    room = np.maximum(distances[:, 1:] - FENCE_M, min(DEVIATION, most) * levers.sum(2))
    single = np.broadcast_to(np.eye(q.shape[1]) / most, (len(q), q.shape[1], q.shape[1]))
    return np.concatenate([levers / np.maximum(room, 1e-9)[..., None], single], axis=1)
