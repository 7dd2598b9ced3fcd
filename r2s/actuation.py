"""From a policy's torque to what the joints get each millisecond: low-pass, clip, rate limit last.

The order is that of the driver on the real arm; training, evaluation and hardware share this one function.
"""

import math

import numpy as np
from numba import njit

from r2s.robot import SIM_DT, Robot


def low_pass_gain(cutoff_hz: float, dt: float = SIM_DT) -> float:
    """Return the gain of a first-order low-pass per step of dt s (libfranka's `lowpassFilter`)."""
    return dt / (dt + 1.0 / (2.0 * math.pi * cutoff_hz))


@njit(cache=True)
def _condition(target, filtered, last, nstep, gain, tau_max, step_max, out):
    for i in range(target.shape[0]):
        for j in range(target.shape[1]):
            f, u = filtered[i, j], last[i, j]
            for k in range(nstep):
                f += gain * (target[i, j] - f)
                clipped = min(max(f, -tau_max[j]), tau_max[j])
                u += min(max(clipped - u, -step_max[j]), step_max[j])
                out[i, k, j] = u
            filtered[i, j], last[i, j] = f, u


class Actuation:
    """The torque path of m arms; keeps the filter's state and the last command (tau_J_d) of each."""

    def __init__(self, robot: Robot, m: int, *, cutoff_hz: float):
        self.filtered = np.zeros((m, robot.n))
        self.last = np.zeros((m, robot.n))
        self._gain = low_pass_gain(cutoff_hz)
        self._tau_max, self._step_max = robot.tau_max, robot.dtau_max * SIM_DT

    def reset(self, ids: np.ndarray | None = None) -> None:
        """Start the arms `ids` (all by default) from zero torque."""
        at = slice(None) if ids is None else ids
        self.filtered[at] = 0.0
        self.last[at] = 0.0

    def __call__(self, target: np.ndarray, nstep: int) -> np.ndarray:
        """Return the commands (m, nstep, n) Nm of the next `nstep` ms for a constant target (m, n) Nm."""
        out = np.empty((len(target), nstep, target.shape[1]))
        target = np.ascontiguousarray(target, dtype=np.float64)
        _condition(target, self.filtered, self.last, nstep, self._gain, self._tau_max, self._step_max, out)
        return out
