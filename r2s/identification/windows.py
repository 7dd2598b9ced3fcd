"""A commanded recording in short windows, from measured states, to be replayed by candidates: eq. (8).

Short windows keep the problem well-posed: an arm without feedback drifts, and after seconds the error says more about
the drift than about the parameters.
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

STATE_SAMPLES = 31  # of the local fit that a window's start state comes from, at 1 kHz
SHORTEST = 0.25  # of a window: what is shorter is not worth its start
MOVED = 0.02  # rad that a joint must move to count as moving
SCATTER = 0.1  # Nm, of the commands at which a joint lets go, from posture to posture
LATE = 11  # ms, odd, in which a command may be felt
HISTORY = 40  # ms of commands before a window: what delay and lag still remember


@dataclass(frozen=True)
class Windows:
    """W stretches of a recording: start states, commands and what the joints then did.

    Attributes:
        t: (W,) s, start. q0, dq0: (W, n) rad, rad/s. tau: (W, S, n) Nm, one row per 1 ms step.
        before: (W, HISTORY, n) Nm, the commands before the start. bristle: (W, n), how far the motion before it bent
            the bristles of friction with a memory.
        q: (W, S, n) rad, after each step.
        length: (W,) steps that count; what comes after them fills the array up.
    """

    t: np.ndarray
    q0: np.ndarray
    dq0: np.ndarray
    tau: np.ndarray
    before: np.ndarray
    q: np.ndarray
    bristle: np.ndarray
    length: np.ndarray

    def delayed(self, delay: np.ndarray | float, lag: np.ndarray | float) -> np.ndarray:
        """Return (W, S, n) Nm, what the joints feel of the commands after `delay` and `lag`, s."""
        motors = Motors(len(self.t), self.tau.shape[-1], delay, lag)
        motors.reset(tau=self.before[:, 0])
        return motors(np.concatenate([self.before, self.tau], 1))[:, HISTORY:]


def cut_windows(
    recording: Recording,
    seconds: float,
    limit: int | None = None,
    slowest: float = 0.0,
    edges: np.ndarray | None = None,
) -> Windows:
    """Cut a commanded recording into windows of at most `seconds`, none across two trajectories, end to end.

    With `slowest`, rad/s, a window ends where any joint gets slower than that, and none starts before all are faster
    again: in a dead zone a joint is let go one step sooner or later with the smallest change of any parameter, and
    every other joint feels it. With `edges` (n, 2) Nm, the commands at which a joint at rest was seen to let go,
    only joints count whose command lies between. A joint that never moves does not count.

    The start state is a cubic fitted to 31 ms of measured angles and velocities about it, see `Local`. With `limit`,
    that many windows spread evenly are kept.

    Raises:
        UserError: no trajectory is as long as a window, or hardly ever do all joints move at once.
    """
    grid = recording.resample(SIM_DT)
    steps, half = round(seconds / SIM_DT), STATE_SAMPLES // 2
    longest = max(s.stop - s.start for s in grid.stretches)
    if longest <= max(steps, STATE_SAMPLES) + half:
        raise UserError(
            f"no trajectory is as long as a window of {seconds:g} s; the longest is {longest * SIM_DT:g} s"
        )
    still = np.ptp(grid.q, axis=0) < MOVED
    dq, bristle, local = np.empty_like(grid.q), np.empty_like(grid.q), Local.of(grid)
    first = np.empty(len(grid.t), dtype=int)
    starts: list[int] = []
    lengths: list[int] = []
    for s in grid.stretches:
        first[s] = s.start
        if s.stop - s.start <= STATE_SAMPLES:
            continue
        dq[s] = savgol_filter(grid.q[s], STATE_SAMPLES, 3, deriv=1, delta=SIM_DT, axis=0)
        bristle[s] = presliding(dq[s], SIM_DT, PRESLIDING)
        if not slowest:
            whole = list(range(s.start + half, s.stop - max(steps, half), steps))
            starts += whole
            lengths += [steps] * len(whole)
            continue
        slow = (np.abs(dq[s]) < slowest) & ~still
        if edges is not None:
            slow &= maximum_filter1d(_between(grid.tau[s], edges), LATE, axis=0, origin=(LATE - 1) // 2)
        slow = np.flatnonzero(slow.any(1))
        for a, b in pairwise([-1, *slow.tolist(), s.stop - s.start - 1]):
            run = b - a - 2 - half  # the fit of the start state must not see what was before
            if run < SHORTEST * steps:
                continue
            parts = -(-run // steps)
            starts += [s.start + b - 1 - run + k * (run // parts) for k in range(parts)]
            lengths += [run // parts] * parts
    if not starts:
        raise UserError(
            f"the joints hardly ever move all at once: there are no {SHORTEST * seconds:g} s with all of them "
            f"faster than {slowest:g} rad/s; record a motion of r2s (arm=, data.excitation=), or take "
            "friction.family=bristle, which has no dead zone"
        )
    at, length = np.array(starts), np.array(lengths)
    if limit is not None and len(at) > limit:
        keep = np.linspace(0, len(at) - 1, limit).round().astype(int)
        at, length = at[keep], length[keep]
    rows = np.minimum(at[:, None] + np.arange(steps), (at + length - 1)[:, None])
    q0, dq0 = local(grid, at)
    earlier = np.maximum(at[:, None] - np.arange(HISTORY, 0, -1), first[at][:, None])
    return Windows(
        t=grid.t[at],
        q0=q0,
        dq0=dq0,
        tau=grid.tau[rows],
        before=grid.tau[earlier],
        q=grid.q[rows + 1],
        bristle=bristle[at],
        length=length,
    )


def _between(tau: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Return (T, n) bool: whether commands tau (T, n) may leave a joint at rest, give or take what edges scatter."""
    return (tau > edges[:, 0] - SCATTER) & (tau < edges[:, 1] + SCATTER)


@dataclass(frozen=True)
class Local:
    """The state to start a replay from, by a cubic fitted to 31 ms of measured angles and velocities about it.

    The two sensors of a joint are weighed by their noise. Logged velocities are late, by half a step in a simulator,
    by a filter on an arm: how late a joint's are is found by comparing them with the derivative of its angles.

    Attributes:
        noise: (n,) rad, of the angles, robust. kernel: (n, 2, 2 STATE_SAMPLES) from angles and velocities to both.
        sigma: (2, n) rad, rad/s, standard deviation of what the fit returns.
    """

    noise: np.ndarray
    kernel: np.ndarray
    sigma: np.ndarray

    @staticmethod
    def of(grid: Recording) -> "Local":
        """Return the fit for a recording at 1 kHz."""
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
        t, k = SIM_DT * (np.arange(STATE_SAMPLES) - STATE_SAMPLES // 2)[:, None], np.arange(4)
        speeds = k * t ** np.maximum(k - 1, 0)
        accelerations = k * (k - 1) * t ** np.maximum(k - 2, 0)
        size = np.repeat(np.stack([noise, off], 1), STATE_SAMPLES, axis=1)  # (n, 2 S)
        angles = np.broadcast_to(t**k, (n, STATE_SAMPLES, 4))
        both = np.concatenate([angles, speeds - late[:, None, None] * accelerations], 1) / size[..., None]
        cubic = np.linalg.pinv(both) / size[:, None]
        # MuJoCo moves by the velocity that a step ends with: q(t) = q0 + v t + a t^2 / 2 starts from v - a h / 2
        kernel = np.stack([cubic[:, 0], cubic[:, 1] - SIM_DT * cubic[:, 2]], 1)
        return Local(noise, kernel, np.sqrt(((kernel * size[:, None]) ** 2).sum(-1)).T)

    def __call__(self, grid: Recording, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return q, dq (W, n) rad, rad/s at rows `at` (W,), each at least half of 31 rows from its stretch's ends."""
        rows = at[:, None] + np.arange(STATE_SAMPLES) - STATE_SAMPLES // 2
        seen = np.concatenate([grid.q[rows], grid.dq[rows]], 1)
        q, dq = np.einsum("nks,wsn->kwn", self.kernel, seen)
        return q, dq


def replay(robot: Robot, dynamics: Dynamics, windows: Windows, nthread: int = 0) -> np.ndarray:
    """Return q (W, S, n) rad that an arm with these dynamics does in each window."""
    sim = Simulator(robot, dynamics, len(windows.q0), nthread)
    sim.reset(windows.q0, windows.dq0, bristle=windows.bristle)
    return sim.rollout(windows.delayed(dynamics.delay, dynamics.lag))["qpos"]
