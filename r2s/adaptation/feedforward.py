"""Compute a feedforward torque from the estimated payload, friction and offsets.

The feedforward uses the payload's estimated mass and center, clipped by `plausible_payload`. For joint j, the
estimate x with covariance P predicts the torque c = h x - g_d in Nm. The vector h consists of ten payload terms
(gravity, Coriolis, acceleration), the model's friction, and 1 for the offset. The torque g_d is the gravity torque of
the declared payload, which the arm itself compensates. The torque c has the variance s^2 = h P h^T. The feedforward
torque is w c with a weight w. For the true torque c*, the mean square error E (w c - c*)^2 is smallest at w = c*^2 /
(c*^2 + s^2). Because c^2 - s^2 is an unbiased estimate of c*^2, r2s chooses the weight

    w = max(0, 1 - s^2 / c^2).

The weight w is 0 if |c| < s. The torque w c is the positive-part James-Stein estimator (1961) of the single number
c*.

The feedforward follows the motion without delay, but a low-pass with a time constant of 20 ms smooths the torque step
at a new estimate. Without this low-pass, a torque step would twist elastic gears. The Kalman filter would then
attribute the twist to a new payload, and the new estimate would cause the next torque step. On an elastic development
twin without this low-pass, torque steps of 30 Nm occurred at 25 Hz.
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
    """An `Adapter` that adds the estimated torque times a weight; the weight is small if the estimate is uncertain.

    Args:
        arm: the corrected model. noise: uncertainty of the corrected model.
    """

    def __init__(self, arm: ArmModel, noise: Noise):
        self._arm, self._noise, self._n = arm, noise, len(arm.level)
        self.begin()

    def begin(self) -> None:
        """Start a motion from rest, and discard all estimates of earlier motions."""
        n = self._n
        self.estimator = Estimator(self._arm, self._noise)
        self._payload, self._weight, self._slow = np.zeros(BODY), np.zeros(n), np.zeros((n, BODY))
        self._torque, self._remaining = np.zeros(n), np.zeros(n)  # estimated torque; its part that is not yet added

    @property
    def held(self) -> bool:
        """Return whether the estimate is frozen."""
        return self.estimator.held

    @held.setter
    def held(self, held: bool) -> None:
        self.estimator.held = held

    def __call__(self, q: np.ndarray, dq: np.ndarray, tau: np.ndarray) -> np.ndarray:
        """Process one cycle; return the torque (n,) Nm that the driver adds in the next cycle; see `Adapter`."""
        new = self.estimator(q, dq, tau)
        filter, state, residual = self.estimator.internals
        if new:
            plausible_payload(filter.x, self._arm.payload_max, self._payload)
            shrinkage_weights(filter, residual, self._payload, state.terms.declared, self._weight)
            before = self._torque.copy()
        _estimated_torque(filter.x, state, self._payload, self._weight, self._slow, self._torque)
        if new:
            self._remaining += self._torque - before
        self._remaining *= 1.0 - BLENDING
        return self._torque - self._remaining


@njit(cache=True, error_model="numpy")
def plausible_payload(x, most, out):
    """Write a payload's inertial parameters (10,) to `out`, with mass and center of the state x, clipped to `most`.

    most: (2,), largest mass in kg, and largest distance in m from the payload frame to the center. The tensor in
    `out` is that of a ball of water of the same mass, because data hardly determine tensors, and a wrong tensor would
    act as acceleration feedback.
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
def shrinkage_weights(filter, residual, payload, declared, weight):
    """At the end of a 20 ms span, write each joint's weight w (see the module's docstring) to `weight` (n,)."""
    x, P, n = filter.x, filter.P, len(weight)
    h, at = np.empty(BODY + 2), np.empty(BODY + 2, dtype=np.int64)
    for j in range(n):
        mean, variance = residual.friction[j] * x[BODY + j] + x[BODY + n + j] - declared[j], 0.0
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
    """Write w c for `payload` and state x to `torque` (n,) Nm; weight: w; slow (n, 10): low-passed `payload_p`."""
    terms, n, share = state.terms, len(torque), -np.expm1(-SIM_DT / ACCELERATION_S)
    for j in range(n):
        total = x[BODY + j] * state.friction[BEFORE, j] + x[BODY + n + j] - terms.declared[j]
        for c in range(BODY):
            slow[j, c] += share * (terms.payload_p[j, c] - slow[j, c])
            total += payload[c] * ((terms.payload_p[j, c] - slow[j, c]) / ACCELERATION_S - terms.payload_torque[j, c])
        torque[j] = weight[j] * total
