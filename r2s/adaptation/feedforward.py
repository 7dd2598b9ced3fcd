"""Feedforward of the estimated payload, friction and offsets.

The feedforward uses the payload's estimated mass and center, clipped by `plausible_payload`. For joint j, the
estimate x predicts a torque c = h x, Nm. The row h contains the payload's ten columns (gravity, Coriolis,
acceleration), the model's friction, and 1 for the offset. The variance of c is s^2 = h P h^T, with the covariance P
of x. The feedforward is w c. For the true torque c*, the mean square error E (w c - c*)^2 is least at
w = c*^2 / (c*^2 + s^2). Since c^2 - s^2 is an unbiased estimate of c*^2, the weight is

    w = max(0, 1 - s^2 / c^2).

This is James-Stein shrinkage (1961, positive part) for one number: w = 0 if |c| is below its standard deviation s.

The feedforward follows the motion without delay, but a low-pass over one span smooths the step at a new estimate. A
torque step twists elastic gears, which the Kalman filter interprets as another payload. This causes the next
step. On an elastic development twin, such steps of 30 Nm repeated at 25 Hz.
"""

import numpy as np

from r2s.adaptation.arm_model import ArmModel
from r2s.adaptation.estimator import Estimator
from r2s.adaptation.kalman import Noise
from r2s.adaptation.momentum import BODY
from r2s.adaptation.momentum_residual import BEFORE
from r2s.adaptation.tuning import ACCELERATION_S, BLENDING
from r2s.compiled import njit
from r2s.physics.payload import WATER
from r2s.physics.robot import SIM_DT


class Feedforward:
    """An `Adapter` that adds the estimated torque, with less weight if the estimate is uncertain.

    Args:
        arm: the corrected model. noise: uncertainty of the corrected model.
    """

    def __init__(self, arm: ArmModel, noise: Noise):
        self._arm, self._noise, self._n = arm, noise, len(arm.level)
        self.begin()

    def begin(self) -> None:
        """Start a motion from rest, and discard all earlier estimates."""
        n = self._n
        self.estimator = Estimator(self._arm, self._noise)
        self._payload, self._weight, self._slow = np.zeros(BODY), np.zeros(n), np.zeros((n, BODY))
        self._torque, self._remaining = np.zeros(n), np.zeros(n)  # estimated torque; part of it still to be added

    @property
    def held(self) -> bool:
        """Whether the estimate is frozen."""
        return self.estimator.held

    @held.setter
    def held(self, held: bool) -> None:
        self.estimator.held = held

    def __call__(self, q: np.ndarray, dq: np.ndarray, tau: np.ndarray) -> np.ndarray:
        """Process one cycle and return the torque (n,) Nm to add; see `Adapter`."""
        new = self.estimator(q, dq, tau)
        filter, state, residual = self.estimator.internals
        if new:
            plausible_payload(filter.x, self._arm.payload_max, self._payload)
            shrinkage_weights(filter, residual, self._payload, self._weight)
            before = self._torque.copy()
        _estimated_torque(filter.x, state, self._payload, self._weight, self._slow, self._torque)
        if new:
            self._remaining += self._torque - before
        self._remaining *= 1.0 - BLENDING
        return self._torque - self._remaining


@njit(cache=True, error_model="numpy")
def plausible_payload(x, most, out):
    """Write the ten parameters of a payload with the mass and center of x (10,), clipped to the arm's limits.

    most: (2,) kg, m, largest mass, and largest distance of the payload's center from its frame. The tensor is that
    of a ball of water, because the data hardly determine it and a wrong tensor would feed back the acceleration.
    """
    m = min(max(x[0], 0.0), most[0])
    out[:] = 0.0
    if m == 0.0:
        return
    far = np.sqrt(x[1] ** 2 + x[2] ** 2 + x[3] ** 2) / x[0]
    within = min(1.0, most[1] / far) if far > 0.0 else 1.0
    cx, cy, cz = within * x[1] / x[0], within * x[2] / x[0], within * x[3] / x[0]
    own = 0.4 * m * (3.0 * m / (4.0 * np.pi * WATER)) ** (2.0 / 3.0)
    out[0], out[1], out[2], out[3] = m, m * cx, m * cy, m * cz
    out[4], out[5], out[6] = own + m * (cy**2 + cz**2), own + m * (cx**2 + cz**2), own + m * (cx**2 + cy**2)
    out[7], out[8], out[9] = -m * cx * cy, -m * cx * cz, -m * cy * cz


@njit(cache=True, error_model="numpy")
def shrinkage_weights(filter, residual, payload, weight):
    """Write the shrinkage weights (n,) of the joints' torques at the end of a span."""
    x, P, n = filter.x, filter.P, len(weight)
    h, at = np.empty(BODY + 2), np.empty(BODY + 2, dtype=np.int64)
    for j in range(n):
        mean, variance = residual.friction[j] * x[BODY + j] + x[BODY + n + j], 0.0
        for c in range(BODY):
            h[c], at[c] = residual.payload[j, c], c
            mean += h[c] * payload[c]
        h[BODY], at[BODY] = residual.friction[j], BODY + j
        h[BODY + 1], at[BODY + 1] = 1.0, BODY + n + j
        for a in range(BODY + 2):
            for b in range(BODY + 2):
                variance += h[a] * h[b] * P[at[a], at[b]]
        weight[j] = max(0.0, 1.0 - variance / (mean * mean)) if mean != 0.0 else 0.0


@njit(cache=True, error_model="numpy")
def _estimated_torque(x, state, payload, weight, slow, torque):
    """Write the torque (n,) Nm of the estimate x times `weight`; update `slow` (n, 10), a low-pass of `payload_p`."""
    terms, n, share = state.terms, len(torque), -np.expm1(-SIM_DT / ACCELERATION_S)
    for j in range(n):
        total = x[BODY + j] * state.friction[BEFORE, j] + x[BODY + n + j]
        for c in range(BODY):
            slow[j, c] += share * (terms.payload_p[j, c] - slow[j, c])
            total += payload[c] * ((terms.payload_p[j, c] - slow[j, c]) / ACCELERATION_S - terms.payload_torque[j, c])
        torque[j] = weight[j] * total
