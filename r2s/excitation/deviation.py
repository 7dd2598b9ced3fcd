"""Compute how far an arm may deviate from a planned motion without a collision."""

from dataclasses import dataclass

import numpy as np

from r2s.excitation.motion_checks import DEVIATION, Motion, Space, geometry_rows
from r2s.physics.fence import FENCE_M


@dataclass(frozen=True)
class DeviationLimits:
    """Limits on the deviation e (n,) rad of an arm from its motion: weights[k // every] @ |e| <= 1 in cycle k.

    Attributes:
        weights: (R, K, n) 1/rad, coefficients of |e| in K linear limits for each of R time intervals.
        every: number of cycles per time interval.
    """

    weights: np.ndarray
    every: int = 1

    @classmethod
    def uniform(cls, n: int, most: float) -> "DeviationLimits":
        """Return limits that allow a deviation of `most` rad for each of n joints in all cycles."""
        return cls(np.eye(n)[None] / most)

    @classmethod
    def along(cls, space: Space, motion: Motion, most: float) -> "DeviationLimits":
        """Return limits along a motion; each time interval has the larger of the weights at its two end postures."""
        rows = geometry_rows(motion)
        weights = deviation_weights(space, motion.q[rows], most)
        return cls(np.maximum(weights[:-1], weights[1:]), int(rows[1] - rows[0]))

    def share(self, k: int, deviation: np.ndarray) -> np.ndarray:
        """Return the fractions (K, n) of the limits that the joints use in cycle k; a row's sum must be at most 1."""
        return self.weights[min(k // self.every, len(self.weights) - 1)] * np.abs(deviation)


def deviation_weights(space: Space, q: np.ndarray, most: float) -> np.ndarray:
    """Return the weights (T, K + n, n) 1/rad of `DeviationLimits` at postures q (T, n) rad.

    The first K limits ensure, to first order, that each distance of a link from the table, an obstacle or another
    link stays above FENCE_M. The last n limits keep each joint within `most` rad of its planned angle. All joints
    may deviate by DEVIATION even near an obstacle, so that an arm that starts too near to the obstacle can move away.
    """
    distances, levers = space.measured(q)
    levers = levers[:, 1:]
    room = np.maximum(distances[:, 1:] - FENCE_M, min(DEVIATION, most) * levers.sum(2))
    single = np.broadcast_to(np.eye(q.shape[1]) / most, (len(q), q.shape[1], q.shape[1]))
    return np.concatenate([levers / np.maximum(room, 1e-9)[..., None], single], axis=1)
