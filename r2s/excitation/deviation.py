"""How far an arm may deviate from a planned motion: less where a joint moves a link towards an obstacle."""

from dataclasses import dataclass

import numpy as np

from r2s.excitation.motion_checks import DEVIATION, Motion, Space, geometry_rows
from r2s.physics.fence import FENCE_M


@dataclass(frozen=True)
class DeviationLimits:
    """A deviation e (n,) rad is allowed in cycle k if `weights` @ |e| <= 1 in each row.

    Attributes:
        weights: (R, K, n) 1/rad. every: cycles for which a set of rows holds.

    """

    weights: np.ndarray
    every: int = 1

    @classmethod
    def uniform(cls, n: int, most: float) -> "DeviationLimits":
        """Return the limit `most` rad of each of n joints."""
        return cls(np.eye(n)[None] / most)

    @classmethod
    def along(cls, space: Space, motion: Motion, most: float) -> "DeviationLimits":
        """Return the deviation that `deviation_weights` allows at both ends of a cycle of the motion."""
        rows = geometry_rows(motion)
        weights = deviation_weights(space, motion.q[rows], most)
        return cls(np.maximum(weights[:-1], weights[1:]), int(rows[1] - rows[0]))

    def share(self, k: int, deviation: np.ndarray) -> np.ndarray:
        """Return (K, n), the parts of each limit that the joints' deviation (n,) rad takes in cycle k; sums <= 1."""
        return self.weights[min(k // self.every, len(self.weights) - 1)] * np.abs(deviation)


def deviation_weights(space: Space, q: np.ndarray, most: float) -> np.ndarray:
    """Return weights (T, K + n, n) 1/rad of the deviations that clear the fence at q (T, n) rad.

    No joint deviates by more than `most`, and no distance shrinks to below the fence: each joint takes its lever's
    part of what there is, to first order. A deviation of all joints by DEVIATION is allowed everywhere: an arm that
    starts too near must be able to leave.
    """
    distances, levers = space.measured(q)
    levers = levers[:, 1:]
    room = np.maximum(distances[:, 1:] - FENCE_M, min(DEVIATION, most) * levers.sum(2))
    single = np.broadcast_to(np.eye(q.shape[1]) / most, (len(q), q.shape[1], q.shape[1]))
    return np.concatenate([levers / np.maximum(room, 1e-9)[..., None], single], axis=1)
