"""The paper's reward, eq. (2), and the curriculum that leads to it.

A reward is a weighted sum of terms. Three of them are not in the paper: a bonus for precision, a price of moving
where precision is, and a price of asking for what the law does not let through. The replay buffer keeps the terms. So
when the curriculum moves its weights, every stored transition is worth what the present weights say.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from r2s.compiled import njit
from r2s.errors import UserError, check_number

K1, K2, K3, K4, K5, K6 = 2.0, 0.03, 0.05, 1.15, 0.03, 0.15  # eq. (2)
PRECISION_M = (0.03, 0.01)  # lengths of the bonus: within them, closer still pays
STILL = (0.2, 0.05)  # rad/s, of the fastest joint, as a hand can lie on the axis of one that turns
TERMS = ("distance", "smoothness", "precision", "stillness", "limited")


@njit(cache=True)
def terms(
    distance: np.ndarray, distance0: np.ndarray, dq: np.ndarray, ddq: np.ndarray, limited: np.ndarray
) -> np.ndarray:
    """Return (m, 5): the two halves of eq. (2), which add up to it, and the three terms that are not in the paper.

    distance    -k1 d, with d the distance over the initial one
    smoothness  -k2 sum tanh|dq| - k3 sum tanh|ddq| / |k4 - min(1, d)| - k5 sum tanh|ddq| / (k6 + d)
    precision   1 - tanh(distance / 3 cm) / 2 - tanh(distance / 1 cm) / 2
    stillness   -precision (tanh(max|dq| / 0.2 rad/s) / 2 + tanh(max|dq| / 0.05 rad/s) / 2)
    limited     -limited

    Args:
        distance, distance0: (m,) m, now and at the start of the episode.
        dq: (m, n) rad/s.
        ddq: (m, n) rad/s^2, mean over the last control period.
        limited: (m,), in which share of it the driver's law changed what was asked for.
    """
    out = np.empty((len(distance), 5))
    for i in range(len(distance)):
        d = distance[i] / distance0[i]
        speed, jerkiness, fastest = 0.0, 0.0, 0.0
        for j in range(dq.shape[1]):
            speed += np.tanh(abs(dq[i, j]))
            jerkiness += np.tanh(abs(ddq[i, j]))
            fastest = max(fastest, abs(dq[i, j]))
        near = 1.0 - 0.5 * (np.tanh(distance[i] / PRECISION_M[0]) + np.tanh(distance[i] / PRECISION_M[1]))
        out[i, 0] = -K1 * d
        out[i, 1] = -K2 * speed - K3 * jerkiness / abs(K4 - min(1.0, d)) - K5 * jerkiness / (K6 + d)
        out[i, 2] = near
        out[i, 3] = -0.5 * near * (np.tanh(fastest / STILL[0]) + np.tanh(fastest / STILL[1]))
        out[i, 4] = -limited[i]
    return out


PAPER = np.array([1.0, 1.0, 0.0, 0.0, 0.0])  # weights of the terms that make eq. (2)


WEIGHTS = tuple((name, "[0, inf)") for name in TERMS[1:])
PATIENCE = 50_000  # env steps in which the price of `limited` grows e-fold where twice the share allowed is limited
DEAREST = 4.0  # the most that it grows


@dataclass(frozen=True)
class Curriculum:
    """The weights of the terms over a training.

    Eq. (2) alone is an exploration problem: its acceleration terms make stopping early attractive. So training starts
    with light smoothness and a bonus for precision, then moves linearly towards eq. (2) between the two `anneal`
    fractions of the budget. reward=paper is the same with constant pairs (1 and 0).

    Attributes:
        smoothness, precision, stillness, limited: weights before and after.
        anneal: fractions of the budget where the change starts and ends.
        limited_most: share of the cycles; None: any. From the first of `anneal` on, while the law changes what is
            asked for in more of them, the price of `limited` grows; and falls back, never below the curriculum's. One
            price does not hold a share: policies of the same make of training that differ in their seed alone are
            limited in 1 to 6 % of the cycles (docs/minutes.md). This is a Lagrange multiplier's integral control
            (Stooke, Achiam and Abbeel, ICML 2020), of the price's logarithm.

    Raises:
        UserError: no pair of numbers, or a number outside its range.
    """

    smoothness: Sequence[float]
    precision: Sequence[float]
    stillness: Sequence[float]
    limited: Sequence[float]
    anneal: Sequence[float]
    limited_most: float | None = None

    def __post_init__(self):
        for name, interval in (*WEIGHTS, ("anneal", "[0, 1]")):
            pair = getattr(self, name)
            if isinstance(pair, str) or not isinstance(pair, Sequence) or len(pair) != 2:
                raise UserError(f"reward.{name}: {pair} is not allowed; two numbers are, before and after")
            for number in pair:
                check_number(f"reward.{name}", number, interval)
        if self.limited_most is not None:
            check_number("reward.limited_most", self.limited_most, "(0, 1]")

    def __call__(self, progress: float, dearer: float = 1.0) -> np.ndarray:
        """Return the (5,) weights at `progress`, the fraction of the training budget that is spent.

        Args:
            dearer: the factor on the price of `limited`, of `dearer`.
        """
        start, end = self.anneal
        at = float(np.clip((progress - start) / max(end - start, 1e-9), 0.0, 1.0))
        pairs = (getattr(self, name) for name in TERMS[1:])
        moving = [before + at * (after - before) for before, after in pairs]
        moving[-1] *= dearer
        return np.array([1.0, *moving])

    def dearer(self, factor: float, progress: float, seen: np.ndarray, env_steps: int) -> float:
        """Return the factor on the price of `limited` after env_steps more of a training.

        Args:
            factor: before. progress: fraction of the budget that is spent.
            seen: (5,), the mean terms of those steps, of `terms`.
        """
        if self.limited_most is None or progress < self.anneal[0]:
            return factor
        limited = -seen[TERMS.index("limited")]
        beyond = min(limited / self.limited_most - 1.0, 1.0)
        return float(np.clip(factor * np.exp(beyond * env_steps / PATIENCE), 1.0, DEAREST))
