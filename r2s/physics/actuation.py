"""Convert target torque to joint torque in steps of 1 ms: soft start, low-pass, clip, rate limit, motor delay.

Training, evaluation and hardware share soft start, low-pass, clip and rate limit. These stages therefore delay a
torque equally on the arm and in simulation. The safety filter (safety_filter.py) acts between rate limit and motor
delay. In training and evaluation, the filter runs in the physics step (mujoco_callback.py); on an arm, it runs in the
driver (r2s/arm/driver.py).
"""

import math

import numpy as np

from r2s.compiled import njit
from r2s.physics.robot import SIM_DT, Robot


def low_pass_factor(cutoff_hz: float, dt: float = SIM_DT) -> float:
    """Return the gain of a first-order low-pass for time steps of dt s (libfranka's `lowpassFilter`)."""
    return dt / (dt + 1.0 / (2.0 * math.pi * cutoff_hz))


@njit(cache=True, error_model="numpy", inline="always")
def condition_joint(target, filtered, effort, cycle, factor, fade, tau_max, step_max):
    """Return a joint's low-pass state and effort, Nm, after one cycle of soft start, low-pass, clip and rate limit.

    Args:
        target: Nm, target torque. filtered, effort: Nm, low-pass state and effort of the previous cycle.
        cycle: number of the current cycle, from 1. factor: gain of the low-pass. fade: soft start, cycles.
        tau_max: Nm, largest effort. step_max: Nm, largest change of the effort per cycle.
    """
    faded = target
    if cycle < fade:
        faded *= cycle / fade
    filtered += factor * (faded - filtered)
    clipped = min(max(filtered, -tau_max), tau_max)
    effort += min(max(clipped - effort, -step_max), step_max)
    return filtered, effort


@njit(cache=True)
def condition(target, state, settings, nstep, out):
    """Apply `condition_joint` to m arms; write the efforts (m, nstep, n) Nm of the next `nstep` ms into `out`.

    Args:
        target: (m, n) Nm, target torques.
        state: low-pass states and efforts (m, n) Nm, and cycle numbers (m,), all updated in place.
        settings: arguments of `condition_joint`: factor, fade, tau_max (n,) Nm and step_max (n,) Nm per cycle.
    """
    filtered, effort, cycle = state
    factor, fade, tau_max, step_max = settings
    for i in range(target.shape[0]):
        for j in range(target.shape[1]):
            f, u = filtered[i, j], effort[i, j]
            for k in range(nstep):
                f, u = condition_joint(target[i, j], f, u, cycle[i] + k + 1, factor, fade, tau_max[j], step_max[j])
                out[i, k, j] = u
            filtered[i, j], effort[i, j] = f, u
        cycle[i] += nstep


class Actuation:
    """Convert the target torques of m arms to efforts, by soft start, low-pass, clip and rate limit.

    Attributes:
        last: (m, n) Nm, efforts of the last cycle. filtered: (m, n) Nm, states of the low-pass.

    Args:
        robot: the arm with its torque and rate limits. m: number of arms. cutoff_hz: cutoff of the low-pass.
        soft_start_s: s, time over which the torque of a motion fades in; 0: no soft start.
    """

    def __init__(self, robot: Robot, m: int, *, cutoff_hz: float, soft_start_s: float = 0.0):
        self.filtered = np.zeros((m, robot.n))
        self.last = np.zeros((m, robot.n))
        self._cycle, self._fade = np.zeros(m, dtype=np.int64), round(soft_start_s / SIM_DT)
        self._factor = low_pass_factor(cutoff_hz)
        self._tau_max, self._step_max = robot.tau_max, robot.step_max

    def reset(self, ids: np.ndarray | None = None) -> None:
        """Reset the arms `ids` (all by default) to zero torque."""
        at = slice(None) if ids is None else ids
        for array in (self.filtered, self.last, self._cycle):
            array[at] = 0

    def __call__(self, target: np.ndarray, nstep: int) -> np.ndarray:
        """Return the efforts (m, nstep, n) Nm of the next `nstep` ms for constant target torques (m, n) Nm."""
        out = np.empty((len(target), nstep, target.shape[1]))
        target = np.ascontiguousarray(target, dtype=np.float64)
        settings = self._factor, self._fade, self._tau_max, self._step_max
        condition(target, (self.filtered, self.last, self._cycle), settings, nstep, out)
        return out


MAX_DELAY = 0.02  # s, longest pure delay that `Motors` can simulate
# Steps by which a semi-implicit simulation responds too early. In such a simulation, q(k+1) - 2 q(k) + q(k-1) is h^2
# a(k). On an arm with the constant acceleration a(k) in step k, this second difference is h^2 (a(k-1) + a(k)) / 2.
EARLY = 0.5
SLOTS = int(MAX_DELAY / SIM_DT) + 3  # number of commands in the delay line


@njit(cache=True)
def motor_torque(line, motor, cycle, delay, lag, out):
    """Advance the motors of one arm by a step; write the mean torque (n,) Nm of the step into `out`.

    If a command takes effect in the middle of a step, the previous command acts until that time. The motor torque m
    follows the command u: dm/dt = (u - m) / lag. For a constant command u and an initial torque m0, the mean of m
    over s steps is u + (m0 - u) (1 - exp(-s / lag)) lag / s.

    Args:
        line: (SLOTS, n) Nm, recent commands; row k % SLOTS is the command of cycle k. motor: (n,) Nm, motor torques.
        cycle: cycle of the newest command, at least SLOTS. delay: pure delay, steps. lag: time constant, steps.
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
    """Write the motors' mean torques in each step into `out`; delay and lag are in steps, as in `motor_torque`."""
    for i in range(tau.shape[0]):
        for k in range(steps):
            line[i, cycle[i] % SLOTS] = tau[i, k]
            motor_torque(line[i], motor[i], cycle[i], delay[i], lag[i], out[i, k])
            cycle[i] += 1


def steps_late(delay: np.ndarray | float, lag: np.ndarray | float) -> tuple[np.ndarray, np.ndarray]:
    """Convert delay and lag from s to steps for `motor_torque`.

    The function limits the delay to MAX_DELAY, and adds EARLY steps to it.
    """
    steps = np.clip(np.asarray(delay) / SIM_DT, 0.0, MAX_DELAY / SIM_DT) + EARLY
    return steps, np.asarray(lag) / SIM_DT


class Motors:
    """Convert the commands of m simulated arms to joint torques, by a pure delay and then a first-order lag.

    Delay and lag may contain fractions of a step. The simulation responds half a step too early (EARLY), so `Motors`
    adds half a step of delay.
    """

    def __init__(self, m: int, n: int, delay: np.ndarray | float = 0.0, lag: np.ndarray | float = 0.0):
        self._line, self._motor = np.zeros((m, SLOTS, n)), np.zeros((m, n))
        self._cycle = np.full(m, SLOTS)
        self._delay, self._lag = np.zeros(m), np.zeros(m)
        self.set(delay, lag)

    def set(self, delay: np.ndarray | float, lag: np.ndarray | float, ids: np.ndarray | None = None) -> None:
        """Set delay and lag, s, of the m arms `ids` (all by default); each is one value, or an array (m,)."""
        at = slice(None) if ids is None else ids
        self._delay[at], self._lag[at] = steps_late(delay, lag)

    def reset(self, ids: np.ndarray | None = None, tau: np.ndarray | float = 0.0) -> None:
        """Reset the arms `ids` (all by default) to the steady state under constant torques `tau` (m, n) Nm."""
        at = slice(None) if ids is None else ids
        self._motor[at] = tau
        self._line[at] = np.asarray(tau)[..., None, :] if np.ndim(tau) else tau

    def __call__(self, tau: np.ndarray) -> np.ndarray:
        """Return the joint torques (m, nstep, n) Nm for the commands (m, nstep, n) Nm, one per ms."""
        out = np.empty(tau.shape)
        delayed(tau, self._delay, self._lag, tau.shape[1], self._line, self._motor, self._cycle, out)
        return out
