"""Disturbance observer: the momentum residual, added to the policy's torque through a first-order low-pass.

With p = M(q) dq and dp/dt = tau + C^T dq - g - friction - d, generalised momentum p yields the disturbance torque
d without accelerations (De Luca and Mattone, ICRA 2003; De Luca, Albu-Schaeffer, Haddadin and Hirzinger, IROS 2006).
Here d is the mean over three spans (momentum_residual.py), and the estimate d^ follows filter_s dd^/dt = d - d^.
Commands pass the identified delay and lag first.

If a joint does not slide throughout the spans, stiction may balance any torque within breakaway. Then d lies between
two bounds, and d^ changes only as much as these require: stiction supports the arm, as in the policy's training.
"""

import numpy as np

from r2s.adaptation.arm_model import ArmModel
from r2s.adaptation.momentum_residual import MomentumResidual, ResidualState, update_residual
from r2s.compiled import njit
from r2s.errors import check_number
from r2s.physics.robot import SIM_DT


class Observer:
    """The `Adapter` that adds the whole disturbance torque, whatever its cause.

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
        """Begin a motion from rest with a disturbance of zero."""
        n = len(self._arm.level)
        self._state, self._residual = ResidualState.fresh(n), MomentumResidual.empty(n)
        self._disturbance = np.zeros((2, n))  # disturbance of the last span, and its low-pass

    def __call__(self, q: np.ndarray, dq: np.ndarray, tau: np.ndarray) -> np.ndarray:
        """Process one cycle and return the torque (n,) Nm to add; see `Adapter`."""
        share = 0.0 if self.held else self._share
        _observe(self._arm, self._state, self._residual, q, dq, tau, share, self._disturbance)
        return self._disturbance[1]


@njit(cache=True, error_model="numpy")
def _observe(arm, state, residual, q, dq, tau, share, disturbance):
    """Process one cycle; write `disturbance` (2, n) Nm: in the last span, and low-passed with the gain `share`."""
    measured, filtered = disturbance[0], disturbance[1]
    if update_residual(arm, state, q, dq, tau, residual):
        for j in range(len(q)):
            measured[j] = residual.y[j]
            if residual.sliding[j] == 0.0:  # stiction bounds the disturbance: take the value nearest to `filtered`
                total = residual.y[j] + residual.friction[j]
                breakaway = max(arm.breakaway[j], abs(residual.friction[j]))
                measured[j] = min(max(filtered[j], total - breakaway), total + breakaway)
    for j in range(len(q)):
        filtered[j] += share * (measured[j] - filtered[j])
