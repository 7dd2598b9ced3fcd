"""The torque path, one millisecond at a time: the driver's low-pass, clip and rate limit, then the motors' delay.

Training, evaluation and hardware share it, so that a policy meets on the arm what it met in simulation. Between the
two acts the driver's law (limits.py), which needs feedback every millisecond: in training inside the physics step
(native_friction.py), on an arm in r2s/arm/driver.py.
"""

import math
from collections.abc import Mapping

import numpy as np

from r2s.compiled import njit
from r2s.physics.robot import SIM_DT, Robot


def low_pass_factor(cutoff_hz: float, dt: float = SIM_DT) -> float:
    """Return the factor of a first-order low-pass per step of dt s (libfranka's `lowpassFilter`)."""
    return dt / (dt + 1.0 / (2.0 * math.pi * cutoff_hz))


@njit(cache=True)
def condition(target, filtered, last, cycle, nstep, factor, fade, tau_max, step_max, out):
    """Write the efforts (m, nstep, n) Nm of the next `nstep` ms into `out`; `Actuation` says what they are.

    Args:
        target: (m, n) Nm. filtered, last: (m, n) Nm, kept from call to call. cycle: (m,), counted here.
        factor: of the low-pass. fade: cycles over which the torque of a motion fades in.
        tau_max: (n,) Nm. step_max: (n,) Nm per cycle.
    """
    for i in range(target.shape[0]):
        for j in range(target.shape[1]):
            f, u = filtered[i, j], last[i, j]
            for k in range(nstep):
                wanted = target[i, j]
                if cycle[i] + k + 1 < fade:
                    wanted *= (cycle[i] + k + 1) / fade
                f += factor * (wanted - f)
                clipped = min(max(f, -tau_max[j]), tau_max[j])
                u += min(max(clipped - u, -step_max[j]), step_max[j])
                out[i, k, j] = u
            filtered[i, j], last[i, j] = f, u
        cycle[i] += nstep


class Actuation:
    """What is asked of m arms: their targets through a low-pass, clipped, and limited in rate.

    Attributes:
        last: (m, n) Nm, the effort: the target as it has come through. filtered: (m, n) Nm, of the low-pass.

    Args:
        robot: its torque range and rate. m: arms.
        cutoff_hz: of the low-pass.
        soft_start_s: s, over which the torque of a motion fades in; 0: not at all.
    """

    def __init__(self, robot: Robot, m: int, *, cutoff_hz: float, soft_start_s: float = 0.0):
        self.filtered = np.zeros((m, robot.n))
        self.last = np.zeros((m, robot.n))
        self._cycle, self._fade = np.zeros(m, dtype=np.int64), round(soft_start_s / SIM_DT)
        self._factor = low_pass_factor(cutoff_hz)
        self._tau_max, self._step_max = robot.tau_max, robot.dtau_max * SIM_DT

    def reset(self, ids: np.ndarray | None = None) -> None:
        """Start the arms `ids` (all by default) from zero torque."""
        at = slice(None) if ids is None else ids
        for array in (self.filtered, self.last, self._cycle):
            array[at] = 0

    def state(self) -> dict[str, np.ndarray]:
        """Return copies of what is kept from step to step, for `set_state`."""
        return {name: getattr(self, name).copy() for name in ("filtered", "last", "_cycle")}

    def set_state(self, state: Mapping[str, np.ndarray]) -> None:
        """Go back to what `state` returned."""
        for name, array in state.items():
            getattr(self, name)[:] = array

    def __call__(self, target: np.ndarray, nstep: int) -> np.ndarray:
        """Return the efforts (m, nstep, n) Nm of the next `nstep` ms for a constant target (m, n) Nm."""
        out = np.empty((len(target), nstep, target.shape[1]))
        target = np.ascontiguousarray(target, dtype=np.float64)
        kept = self.filtered, self.last, self._cycle
        condition(target, *kept, nstep, self._factor, self._fade, self._tau_max, self._step_max, out)
        return out


MAX_DELAY = 0.02  # s, the longest pure delay that is kept in mind


# Steps by which a semi-implicit step answers its torque early: q(k+1) - 2 q(k) + q(k-1) = h^2 a(k), where on an arm
# the torques of steps k - 1 and k make it, half each.
EARLY = 0.5


SLOTS = int(MAX_DELAY / SIM_DT) + 3  # commands that are kept


@njit(cache=True)
def turn(line, motor, cycle, delay, lag, out):
    """Take the newest command of a line into one arm's motors; write the mean torque (n,) Nm of the step into `out`.

    A command that comes within a step acts for what is left of it. With a lag m' = (u - m) / lag the mean over a
    time s from m is u + (m - u) (1 - exp(-s / lag)) lag / s.

    Args:
        line: (SLOTS, n) Nm, the command of cycle k in row k % SLOTS. motor: (n,) Nm, kept from step to step.
        cycle: of the newest command, from SLOTS on. delay, lag: steps.
    """
    whole = int(delay)
    late = delay - whole
    first = np.exp(-late / lag) if lag > 0.0 else 0.0
    second = np.exp(-(1.0 - late) / lag) if lag > 0.0 else 0.0
    newer, older = (cycle - whole) % SLOTS, (cycle - whole - 1) % SLOTS
    for j in range(len(motor)):
        a, b, m = line[newer, j], line[older, j], motor[j]
        between = b + (m - b) * first
        after = a + (between - a) * second
        out[j] = (1.0 - late) * a + late * b + lag * ((m - between) + (between - after))
        motor[j] = after


@njit(cache=True)
def delayed(tau, delay, lag, steps, line, motor, cycle, out):
    """Delay each arm's commands by `delay` steps and lag them by `lag` steps: the mean torque of each step."""
    for i in range(tau.shape[0]):
        for k in range(steps):
            line[i, cycle[i] % SLOTS] = tau[i, k]
            turn(line[i], motor[i], cycle[i], delay[i], lag[i], out[i, k])
            cycle[i] += 1


def steps_late(delay: np.ndarray | float, lag: np.ndarray | float) -> tuple[np.ndarray, np.ndarray]:
    """Return delay and lag, s, in steps, as `turn` takes them: at most MAX_DELAY, and half a step more (EARLY)."""
    steps = np.clip(np.asarray(delay) / SIM_DT, 0.0, MAX_DELAY / SIM_DT) + EARLY
    return steps, np.asarray(lag) / SIM_DT


class Motors:
    """What the joints of m simulated arms feel of their commands; keeps what is under way.

    A pure delay, then a first-order lag, as they are on an arm whose time is continuous: the simulated one is half a
    step early (EARLY), which is made up for here.
    """

    def __init__(self, m: int, n: int, delay: np.ndarray | float = 0.0, lag: np.ndarray | float = 0.0):
        self._line, self._motor = np.zeros((m, SLOTS, n)), np.zeros((m, n))
        self._cycle = np.full(m, SLOTS)
        self._delay, self._lag = np.zeros(m), np.zeros(m)
        self.set(delay, lag)

    def set(self, delay: np.ndarray | float, lag: np.ndarray | float, ids: np.ndarray | None = None) -> None:
        """Give the arms `ids` (all by default) delay and lag, s, one for all of them or (m,)."""
        at = slice(None) if ids is None else ids
        self._delay[at], self._lag[at] = steps_late(delay, lag)

    def reset(self, ids: np.ndarray | None = None, tau: np.ndarray | float = 0.0) -> None:
        """Let the arms `ids` (all by default) have felt the constant torque `tau` (m, n) Nm for long."""
        at = slice(None) if ids is None else ids
        self._motor[at] = tau
        self._line[at] = np.asarray(tau)[..., None, :] if np.ndim(tau) else tau

    def state(self) -> dict[str, np.ndarray]:
        """Return copies of delays, lags and what is under way, for `set_state`."""
        return {name: getattr(self, name).copy() for name in ("_line", "_motor", "_cycle", "_delay", "_lag")}

    def set_state(self, state: Mapping[str, np.ndarray]) -> None:
        """Go back to what `state` returned."""
        for name, array in state.items():
            getattr(self, name)[:] = array

    def __call__(self, tau: np.ndarray) -> np.ndarray:
        """Return (m, nstep, n) Nm at the joints for commands (m, nstep, n) Nm, one per ms."""
        out = np.empty(tau.shape)
        delayed(tau, self._delay, self._lag, tau.shape[1], self._line, self._motor, self._cycle, out)
        return out
