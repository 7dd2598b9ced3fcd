"""The torque path, one millisecond at a time: the driver's low-pass, clip and rate limit, then the motors' delay.

Training, evaluation and hardware share it, so that a policy meets on the arm what it met in simulation. The soft
limits need feedback every millisecond: in simulation they act inside the physics step (native_friction.py), on an arm
the driver adds them, clips the sum and limits its rate once more (r2s/arm/driver.py).
"""

import math
from collections.abc import Mapping

import numpy as np
from numba import njit

from r2s.physics.robot import SIM_DT, Robot


def low_pass_factor(cutoff_hz: float, dt: float = SIM_DT) -> float:
    """Return the factor of a first-order low-pass per step of dt s (libfranka's `lowpassFilter`)."""
    return dt / (dt + 1.0 / (2.0 * math.pi * cutoff_hz))


@njit(cache=True)
def _condition(target, filtered, last, nstep, factor, tau_max, step_max, out):
    for i in range(target.shape[0]):
        for j in range(target.shape[1]):
            f, u = filtered[i, j], last[i, j]
            for k in range(nstep):
                f += factor * (target[i, j] - f)
                clipped = min(max(f, -tau_max[j]), tau_max[j])
                u += min(max(clipped - u, -step_max[j]), step_max[j])
                out[i, k, j] = u
            filtered[i, j], last[i, j] = f, u


class Actuation:
    """The torque path of m arms; keeps the filter's state and the last command (tau_J_d) of each."""

    def __init__(self, robot: Robot, m: int, *, cutoff_hz: float):
        self.filtered = np.zeros((m, robot.n))
        self.last = np.zeros((m, robot.n))
        self._factor = low_pass_factor(cutoff_hz)
        self._tau_max, self._step_max = robot.tau_max, robot.dtau_max * SIM_DT

    def reset(self, ids: np.ndarray | None = None) -> None:
        """Start the arms `ids` (all by default) from zero torque."""
        at = slice(None) if ids is None else ids
        self.filtered[at] = 0.0
        self.last[at] = 0.0

    def state(self) -> dict[str, np.ndarray]:
        """Return copies of the filter's state and the last command, for `set_state`."""
        return {"filtered": self.filtered.copy(), "last": self.last.copy()}

    def set_state(self, state: Mapping[str, np.ndarray]) -> None:
        """Go back to what `state` returned."""
        self.filtered[:], self.last[:] = state["filtered"], state["last"]

    def __call__(self, target: np.ndarray, nstep: int) -> np.ndarray:
        """Return the commands (m, nstep, n) Nm of the next `nstep` ms for a constant target (m, n) Nm."""
        out = np.empty((len(target), nstep, target.shape[1]))
        target = np.ascontiguousarray(target, dtype=np.float64)
        _condition(target, self.filtered, self.last, nstep, self._factor, self._tau_max, self._step_max, out)
        return out


MAX_DELAY = 0.02  # s, the longest pure delay that is kept in mind


# Steps by which a semi-implicit step answers its torque early: q(k+1) - 2 q(k) + q(k-1) = h^2 a(k), where on an arm
# the torques of steps k - 1 and k make it, half each.
EARLY = 0.5


@njit(cache=True)
def delayed(tau, delay, lag, steps, line, motor, out):
    """Delay each arm's commands by `delay` steps and lag them by `lag` steps: the mean torque of each step.

    A command that comes within a step acts for what is left of it. With a lag m' = (u - m) / lag the mean over a
    time s from m is u + (m - u) (1 - exp(-s / lag)) lag / s.
    """
    history = line.shape[1]
    for i in range(tau.shape[0]):
        whole = int(delay[i])
        late = delay[i] - whole
        first = np.exp(-late / lag[i]) if lag[i] > 0.0 else 0.0
        second = np.exp(-(1.0 - late) / lag[i]) if lag[i] > 0.0 else 0.0
        for k in range(steps):
            newer, older = k - whole, k - whole - 1
            for j in range(tau.shape[2]):
                a = tau[i, newer, j] if newer >= 0 else line[i, history + newer, j]
                b = tau[i, older, j] if older >= 0 else line[i, history + older, j]
                m = motor[i, j]
                between = b + (m - b) * first
                after = a + (between - a) * second
                out[i, k, j] = (1.0 - late) * a + late * b + lag[i] * ((m - between) + (between - after))
                motor[i, j] = after
        for k in range(history):
            from_tau = steps - history + k
            for j in range(tau.shape[2]):
                line[i, k, j] = tau[i, from_tau, j] if from_tau >= 0 else line[i, k + steps, j]


class Motors:
    """What the joints of m simulated arms feel of their commands; keeps what is under way.

    A pure delay, then a first-order lag, as they are on an arm whose time is continuous: the simulated one is half a
    step early (EARLY), which is made up for here.
    """

    def __init__(self, m: int, n: int, delay: np.ndarray | float = 0.0, lag: np.ndarray | float = 0.0):
        self._line, self._motor = np.zeros((m, int(MAX_DELAY / SIM_DT) + 3, n)), np.zeros((m, n))
        self._delay, self._lag = np.zeros(m), np.zeros(m)
        self.set(delay, lag)

    def set(self, delay: np.ndarray | float, lag: np.ndarray | float, ids: np.ndarray | None = None) -> None:
        """Give the arms `ids` (all by default) delay and lag, s, one for all of them or (m,)."""
        at = slice(None) if ids is None else ids
        self._delay[at] = np.clip(np.asarray(delay) / SIM_DT, 0.0, MAX_DELAY / SIM_DT) + EARLY
        self._lag[at] = np.asarray(lag) / SIM_DT

    def reset(self, ids: np.ndarray | None = None, tau: np.ndarray | float = 0.0) -> None:
        """Let the arms `ids` (all by default) have felt the constant torque `tau` (m, n) Nm for long."""
        at = slice(None) if ids is None else ids
        self._motor[at] = tau
        self._line[at] = np.asarray(tau)[..., None, :] if np.ndim(tau) else tau

    def state(self) -> dict[str, np.ndarray]:
        """Return copies of delays, lags and what is under way, for `set_state`."""
        return {name: getattr(self, name).copy() for name in ("_line", "_motor", "_delay", "_lag")}

    def set_state(self, state: Mapping[str, np.ndarray]) -> None:
        """Go back to what `state` returned."""
        for name, array in state.items():
            getattr(self, name)[:] = array

    def __call__(self, tau: np.ndarray) -> np.ndarray:
        """Return (m, nstep, n) Nm at the joints for commands (m, nstep, n) Nm, one per ms."""
        out = np.empty(tau.shape)
        delayed(tau, self._delay, self._lag, tau.shape[1], self._line, self._motor, out)
        return out
