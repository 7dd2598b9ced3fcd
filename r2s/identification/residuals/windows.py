"""Cut a recording of commands into windows, and replay each window from its measured start state (paper, eq. (8)).

A simulated arm without feedback departs from the recorded motion. Windows are short, because the accumulated error
hides the effect of wrong parameters after some seconds.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.ndimage import maximum_filter1d
from scipy.signal import savgol_filter

from r2s.errors import UserError
from r2s.physics.actuation import Motors
from r2s.physics.dynamics import Dynamics
from r2s.physics.friction import PRESLIDING, presliding
from r2s.physics.robot import SIM_DT, Robot
from r2s.physics.simulator import Simulator
from r2s.recordings.recording import Recording

STATE_SAMPLES = 31  # ms, length of the local fit for a window's start state
HALF = STATE_SAMPLES // 2
SHORTEST = 0.25  # least share of the full window length; shorter windows contain too little information
MOVED = 0.02  # rad, least range of motion of a moving joint
# scatter of breakaway commands between postures, relative to the largest tau_max (a Panda: 0.1 Nm of 87 Nm)
SCATTER = 0.1 / 87.0
MAX_LATENCY_STEPS = 11  # ms, longest latency of a command; odd, as a filter length
HISTORY = 40  # ms, length of the commands before a window; delay and lag shift them into the window


@dataclass(frozen=True)
class Windows:
    """W windows of a recording, with start states, commands and recorded joint angles.

    Attributes:
        t: (W,) s, start time. q0, dq0: (W, n) rad, rad/s, start state. tau: (W, S, n) Nm, commands, one per ms.
        before: (W, HISTORY, n) Nm, commands before a window. q: (W, S, n) rad, recorded angles after each step.
        length: (W,) number of steps per window; `tau` and `q` have padding after this number of rows.
        at: (W,) start row of each window in `dq`. dq: (T, n) rad/s, velocity of the whole recording, one row per ms.
        begins: rows of `dq` at which trajectories begin.
    """

    t: np.ndarray
    q0: np.ndarray
    dq0: np.ndarray
    tau: np.ndarray
    before: np.ndarray
    q: np.ndarray
    length: np.ndarray
    at: np.ndarray
    dq: np.ndarray
    begins: tuple[int, ...]

    def delayed(self, delay: np.ndarray | float, lag: np.ndarray | float) -> np.ndarray:
        """Return the torques (W, S, n) Nm that act on the joints after a `delay` and a `lag`, both in s."""
        motors = Motors(len(self.t), self.tau.shape[-1], delay, lag)
        motors.reset(tau=self.before[:, 0])
        return motors(np.concatenate([self.before, self.tau], 1))[:, HISTORY:]

    def bristles(self, d: Dynamics) -> np.ndarray:
        """Return the presliding state (..., W, n) at the start of each window, for dynamics with batch axes (...).

        The presliding state starts at 0 in each trajectory and follows recorded velocity; without friction memory, it
        is 0.
        """
        if not d.family.has_memory:
            return np.zeros((len(self.at), self.dq.shape[1]))
        named = "presliding" in d.family.names[: d.phi.shape[-1]]  # a user's friction law may lack this parameter
        distance = d.phi[..., d.family.names.index("presliding")] if named else np.full(d.phi.shape[:-1], PRESLIDING)
        kinds, kind = np.unique(distance.reshape(-1, distance.shape[-1]), axis=0, return_inverse=True)
        pieces = [self.dq[a:b] for a, b in pairwise([*self.begins, len(self.dq)])]
        own = [np.concatenate([presliding(p, SIM_DT, z) for p in pieces])[self.at] for z in kinds]
        return np.stack(own)[kind.ravel()].reshape(*distance.shape[:-1], len(self.at), -1)


def cut_windows(
    recording: Recording,
    seconds: float,
    limit: int | None = None,
    slowest: float = 0.0,
    edges: np.ndarray | None = None,
) -> Windows:
    """Cut a commanded recording into consecutive windows of at most `seconds`, each within one trajectory.

    Args:
        limit: largest number of windows; a longer recording yields `limit` evenly spaced windows.
        slowest: rad/s. In a window, all joints are faster than `slowest`, because tiny parameter changes could shift
            a slow joint's breakaway. Joints that never move are ignored.
        edges: (n, 2) Nm, lower and upper breakaway command of each joint, widened by SCATTER. A slow joint ends a
            window only if its command lies between its two breakaway commands.

    Raises:
        UserError: no trajectory is as long as a window, or at almost all times a joint is slower than `slowest`.
    """
    grid = recording.resample(SIM_DT)
    steps = round(seconds / SIM_DT)
    longest = max(s.stop - s.start for s in grid.stretches)
    if longest <= max(steps, STATE_SAMPLES) + HALF:
        raise UserError(
            f"no trajectory is as long as a window of {seconds:g} s; the longest is {longest * SIM_DT:g} s"
        )
    still = np.ptp(grid.q, axis=0) < MOVED
    dq, start_state = np.zeros_like(grid.q), StartState.of(grid)
    first = np.empty(len(grid.t), dtype=int)
    starts: list[int] = []
    lengths: list[int] = []
    for s in grid.stretches:
        first[s] = s.start
        if s.stop - s.start <= STATE_SAMPLES:
            continue
        dq[s] = savgol_filter(grid.q[s], STATE_SAMPLES, 3, deriv=1, delta=SIM_DT, axis=0)
        if not slowest:
            whole = list(range(s.start + HALF, s.stop - max(steps, HALF), steps))
            starts += whole
            lengths += [steps] * len(whole)
            continue
        slow = (np.abs(dq[s]) < slowest) & ~still
        if edges is not None:
            between = (grid.tau[s] > edges[:, 0]) & (grid.tau[s] < edges[:, 1])
            slow &= maximum_filter1d(between, MAX_LATENCY_STEPS, axis=0, origin=(MAX_LATENCY_STEPS - 1) // 2)
        found = _between_stops(np.flatnonzero(slow.any(1)), s.stop - s.start, steps)
        starts += [s.start + start for start, _ in found]
        lengths += [count for _, count in found]
    if not starts:
        raise UserError(
            f"all joints hardly ever move at once: no {SHORTEST * seconds:g} s in which each is faster than "
            f"{slowest:g} rad/s; record an excitation of r2s (arm=, data.excitation=), or use a friction family with "
            "memory, friction.family=bristle"
        )
    at, length = np.array(starts), np.array(lengths)
    if limit is not None and len(at) > limit:
        keep = np.linspace(0, len(at) - 1, limit).round().astype(int)
        at, length = at[keep], length[keep]
    rows = np.minimum(at[:, None] + np.arange(steps), (at + length - 1)[:, None])
    q0, dq0 = start_state(grid, at)
    earlier = np.maximum(at[:, None] - np.arange(HISTORY, 0, -1), first[at][:, None])
    begins = tuple(s.start for s in grid.stretches)
    of_windows = grid.t[at], q0, dq0, grid.tau[rows], grid.tau[earlier], grid.q[rows + 1], length, at
    return Windows(*of_windows, dq, begins)


def _between_stops(slow: np.ndarray, count: int, steps: int) -> list[tuple[int, int]]:
    """Split `count` rows at the `slow` rows into windows of at most `steps` rows; return (start, length) of each."""
    out = []
    for a, b in pairwise([-1, *slow.tolist(), count - 1]):
        run = b - a - 2 - HALF  # the fit of a start state uses only rows without slow joints
        if run < SHORTEST * steps:
            continue
        parts = -(-run // steps)
        out += [(b - 1 - run + k * (run // parts), run // parts) for k in range(parts)]
    return out


@dataclass(frozen=True)
class StartState:
    """Estimate a replay's start state: fit a cubic to 31 ms of measured angles and velocities, weighted by noise.

    Logged velocities are late relative to angles: by half a step in a simulator, by a filter's delay on an arm. For
    each joint, the fit compares velocities with the derivative of the angles, and corrects late velocities.

    Attributes:
        noise: (n,) rad, robust estimate of angle noise. kernel: (n, 2, 2 STATE_SAMPLES), matrix that maps measured
            angles and velocities to the start state. sigma: (2, n) rad, rad/s, standard deviation of the start state.
    """

    noise: np.ndarray
    kernel: np.ndarray
    sigma: np.ndarray

    @staticmethod
    def of(grid: Recording) -> "StartState":
        """Return the estimator of start states in `grid`, a recording at 1 kHz."""
        n = grid.n_joints
        seen = [s for s in grid.stretches if s.stop - s.start > STATE_SAMPLES]

        def smooth(deriv: int) -> np.ndarray:
            fits = (savgol_filter(grid.q[s], STATE_SAMPLES, 3, deriv, SIM_DT, axis=0) for s in seen)
            return np.concatenate([np.zeros((1, n)), *fits])

        q, dq = (np.concatenate([np.zeros((1, n)), *(a[s] for s in seen)]) for a in (grid.q, grid.dq))
        noise = np.maximum(1.48 * np.median(np.abs(q - smooth(0)), axis=0), 3e-6)
        ddq, lead = smooth(2), dq - smooth(1)
        late = -(lead * ddq).sum(0) / np.maximum((ddq**2).sum(0), 1e-12)
        off = np.maximum(np.sqrt(((lead + late * ddq) ** 2).mean(0)), 1e-5)
        t, k = SIM_DT * (np.arange(STATE_SAMPLES) - HALF)[:, None], np.arange(4)
        speeds = k * t ** np.maximum(k - 1, 0)
        accelerations = k * (k - 1) * t ** np.maximum(k - 2, 0)
        size = np.repeat(np.stack([noise, off], 1), STATE_SAMPLES, axis=1)  # (n, 2 S)
        angles = np.broadcast_to(t**k, (n, STATE_SAMPLES, 4))
        both = np.concatenate([angles, speeds - late[:, None, None] * accelerations], 1) / size[..., None]
        cubic = np.linalg.pinv(both) / size[:, None]
        # MuJoCo integrates q with dq at the end of a step, so for q(t) = q0 + v t + a t^2 / 2, dq0 is v - a h / 2
        kernel = np.stack([cubic[:, 0], cubic[:, 1] - SIM_DT * cubic[:, 2]], 1)
        return StartState(noise, kernel, np.sqrt(((kernel * size[:, None]) ** 2).sum(-1)).T)

    def __call__(self, grid: Recording, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return start states q, dq (W, n) rad, rad/s at rows `at` (W,), HALF rows or more from trajectory ends."""
        rows = at[:, None] + np.arange(STATE_SAMPLES) - HALF
        seen = np.concatenate([grid.q[rows], grid.dq[rows]], 1)
        q, dq = np.einsum("nks,wsn->kwn", self.kernel, seen)
        return q, dq


def windows_or_none(recording: Recording, seconds: float, limit: int | None = None) -> Windows | None:
    """Return the result of `cut_windows`, or None if no trajectory is as long as a window."""
    try:
        return cut_windows(recording, seconds, limit)
    except UserError:
        return None


def replay(robot: Robot, dynamics: Dynamics, windows: Windows, nthread: int = 0) -> np.ndarray:
    """Simulate an arm with `dynamics` over each window, and return its angles q (W, S, n) rad."""
    sim = Simulator(robot, dynamics, len(windows.q0), nthread)
    sim.reset(windows.q0, windows.dq0, bristle=windows.bristles(dynamics))
    return sim.rollout(windows.delayed(dynamics.delay, dynamics.lag))["qpos"]
