"""Disturbance observer: add the low-passed momentum residual to the policy's torque.

The momentum p = M(q) dq obeys dp/dt = tau + C^T dq - g - friction - d. This equation yields the disturbance torque d
without accelerations (De Luca and Mattone, ICRA 2003; De Luca, Albu-Schaeffer, Haddadin and Hirzinger, IROS 2006).
Here tau is the command after the identified delay and lag. The observer uses the mean of d over 60 ms
(momentum_residual.py). A first-order low-pass with the time constant filter_s yields the estimate d^: filter_s dd^/dt
= d - d^.

Unless a joint slides during the whole 60 ms, stiction may hold the joint, and the residual yields only bounds on the
disturbance d. An estimate d^ within these bounds then stays unchanged, because stiction also supports the arm in
training.
"""

import numpy as np

from r2s.adaptation.arm_model import ArmModel
from r2s.adaptation.momentum_residual import MomentumResidual, ResidualState, update_residual
from r2s.compiled import njit
from r2s.errors import check_number
from r2s.physics.robot import SIM_DT


class Observer:
    """An `Adapter` that adds the estimated disturbance torque, whatever causes the disturbance.

    Attributes:
        held: whether the estimated disturbance is frozen.

    Args:
        arm: identified model. filter_s: s, time constant of the low-pass.

    Raises:
        UserError: filter_s is not above 0.
    """

    def __init__(self, arm: ArmModel, filter_s: float):
        check_number("filter_s", filter_s, "(0, inf)")
        self._arm, self._share = arm, -np.expm1(-SIM_DT / filter_s)
        self.held = False
        self.begin()

    def begin(self) -> None:
        """Start a motion from rest; set the estimated disturbance to zero."""
        n = len(self._arm.level)
        self._state, self._residual = ResidualState.fresh(n), MomentumResidual.empty(n)
        self._disturbance = np.zeros((2, n))  # 60 ms mean of the disturbance, and its low-pass

    def __call__(self, q: np.ndarray, dq: np.ndarray, tau: np.ndarray) -> np.ndarray:
        """Process one cycle; return the torque (n,) Nm that the driver adds in the next cycle; see `Adapter`."""
        share = 0.0 if self.held else self._share
        _observe(self._arm, self._state, self._residual, q, dq, tau, share, self._disturbance)
        return self._disturbance[1]


@njit(cache=True, error_model="numpy")
def _observe(arm, state, residual, q, dq, tau, share, disturbance):
    """Process one cycle; update `disturbance` (2, n) Nm: 60 ms mean, and this mean low-passed with gain `share`."""
    measured, filtered = disturbance[0], disturbance[1]
    if update_residual(arm, state, q, dq, tau, residual):
        for j in range(len(q)):
            measured[j] = residual.y[j]
            if residual.sliding[j] == 0.0:  # only bounds are known: take the allowed value nearest to `filtered`
                total = residual.y[j] + residual.friction[j]
                breakaway = max(arm.breakaway[j], abs(residual.friction[j]))
                measured[j] = min(max(filtered[j], total - breakaway), total + breakaway)
    for j in range(len(q)):
        filtered[j] += share * (measured[j] - filtered[j])
