"""Compensation by the estimate: what the payload, the friction and the offsets that are known now ask for is added.

Of a payload it takes mass and centre, for a body that may be in a hand (`thing`). Of a joint j the estimate x says
c = h x Nm, with h what its numbers make of this motion: the payload's ten by weight, Coriolis and acceleration,
friction's share by the friction that is believed, the offset by 1. Its variance is s^2 = h P h^T. What is added is
w c. Of an estimate c of c*, unbiased and of variance s^2, E (w c - c*)^2 is least at w = c*^2 / (c*^2 + s^2);
c^2 - s^2 is an unbiased estimate of c*^2, which gives

    w = max(0, 1 - s^2 / c^2)

(James and Stein's shrinkage of 1961, its positive part, of one number): nothing of what may as well be zero.

What is added follows the motion at once, but a new estimate comes in over a span, through a low-pass. A step of the
torque twists elastic gears, and makes motors run ahead of their links; the balance of momentum takes that for a
torque that lacks, and so for another payload. On a development twin of make 2 steps of 30 Nm kept themselves going,
at 25 Hz.
"""

import numpy as np

from r2s.adaptation.believed import Believed
from r2s.adaptation.estimator import Estimator
from r2s.adaptation.kalman import Noise, T
from r2s.adaptation.momentum import BODY
from r2s.compiled import njit
from r2s.physics.limits import RATE
from r2s.physics.payload import FARTHEST_M, MOST_KG, WATER
from r2s.physics.robot import SIM_DT

COMES = -np.expm1(-SIM_DT / T)  # of what is still to come in of an estimate, in a cycle
RATE_S = 1 / RATE  # s, of the low-pass from which accelerations are told: a late arm bears a loop of that rate


class Compensation:
    """The `Adapter` that adds what `Estimator` is sure of.

    Args:
        arm: what is believed of it. noise: how wrong that may be.
    """

    def __init__(self, arm: Believed, noise: Noise):
        self._arm, self._noise, self._n = arm, noise, len(arm.level)
        self.begin()

    def begin(self) -> None:
        """Begin a motion from rest: nothing is known of the arm beyond its identification."""
        n = self._n
        self.estimator = Estimator(self._arm, self._noise)
        self._carried, self._weight, self._slow = np.zeros(BODY), np.zeros(n), np.zeros((n, BODY))
        self._says, self._lacks = np.zeros(n), np.zeros(n)  # the estimate; what is still to come in of it

    def __call__(self, q: np.ndarray, dq: np.ndarray, tau: np.ndarray) -> np.ndarray:
        """Hear a cycle and return (n,) Nm to add; arguments as of `Adapter`."""
        new = self.estimator(q, dq, tau)
        filter, kept, balance = self.estimator.inside
        if new:
            thing(filter.x, self._carried)
            weigh(filter, balance, self._carried, self._weight)
            before = self._says.copy()
        _say(filter, kept, self._carried, self._weight, self._slow, self._says)
        if new:
            self._lacks += self._says - before
        self._lacks *= 1.0 - COMES
        return self._says - self._lacks


@njit(cache=True, error_model="numpy")
def thing(x, out):
    """Write the ten numbers of a payload that may be in a hand, with mass and centre of x (10,) as near as can be.

    Up to MOST_KG, up to FARTHEST_M from the hand, with the tensor of a ball of water about its centre: tensors are
    hardly seen, and a wrong one is fed back with the acceleration.
    """
    m = min(max(x[0], 0.0), MOST_KG)
    out[:] = 0.0
    if m == 0.0:
        return
    far = np.sqrt(x[1] ** 2 + x[2] ** 2 + x[3] ** 2) / x[0]
    within = min(1.0, FARTHEST_M / far) if far > 0.0 else 1.0
    cx, cy, cz = within * x[1] / x[0], within * x[2] / x[0], within * x[3] / x[0]
    own = 0.4 * m * (3.0 * m / (4.0 * np.pi * WATER)) ** (2.0 / 3.0)
    out[0], out[1], out[2], out[3] = m, m * cx, m * cy, m * cz
    out[4], out[5], out[6] = own + m * (cy**2 + cz**2), own + m * (cx**2 + cz**2), own + m * (cx**2 + cy**2)
    out[7], out[8], out[9] = -m * cx * cy, -m * cx * cz, -m * cy * cz


@njit(cache=True, error_model="numpy")
def weigh(filter, balance, carried, weight):
    """Write the weights (n,) of what is known of each joint at the end of a span."""
    x, P, n = filter.x, filter.P, len(weight)
    h, at = np.empty(BODY + 2), np.empty(BODY + 2, dtype=np.int64)
    for j in range(n):
        mean, variance = balance.rub[j] * x[BODY + j] + x[BODY + n + j], 0.0
        for c in range(BODY):
            h[c], at[c] = balance.payload[j, c], c
            mean += h[c] * carried[c]
        h[BODY], at[BODY] = balance.rub[j], BODY + j
        h[BODY + 1], at[BODY + 1] = 1.0, BODY + n + j
        for a in range(BODY + 2):
            for b in range(BODY + 2):
                variance += h[a] * h[b] * P[at[a], at[b]]
        weight[j] = max(0.0, 1.0 - variance / (mean * mean)) if mean != 0.0 else 0.0


@njit(cache=True, error_model="numpy")
def _say(filter, kept, carried, weight, slow, says):
    """Write (n,) Nm asked for now; slow: (n, 10), the payload's columns of the momentum through a low-pass."""
    x, n, share = filter.x, len(says), -np.expm1(-SIM_DT / RATE_S)
    for j in range(n):
        asked = x[BODY + j] * kept.rubbed[0, j] + x[BODY + n + j]
        for c in range(BODY):
            slow[j, c] += share * (kept.payload_now[j, c] - slow[j, c])
            asked += carried[c] * ((kept.payload_now[j, c] - slow[j, c]) / RATE_S - kept.payload_push[0, j, c])
        says[j] = weight[j] * asked
