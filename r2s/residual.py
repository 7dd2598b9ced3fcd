"""What a candidate gets wrong: one residual per kind of recording, the same for every search.

Commanded torque (no gravity): eq. (8) by replay. The recording is cut into short windows; every candidate starts
each window at the measured state, is fed the recorded commands and is compared with the recorded joint angles, all
candidates and windows at once on one Batch. Short windows keep the problem well-posed: an arm without feedback
drifts, and after seconds the error says more about the drift than about the parameters.

Measured link-side torque (with gravity): there is no command to replay, so the residual is the torque that rigid
dynamics, friction and offset predict at the measured motion, against the measured torque. It exists for commanded
torque, too, where it is a fast start.

Both are in units of their own standard deviation, as far as `adapt` could tell it.
"""

from copy import copy
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.ndimage import maximum_filter1d
from scipy.signal import butter, savgol_filter, sosfiltfilt
from scipy.sparse import csr_array

from r2s.actuation import Motors
from r2s.errors import UserError
from r2s.friction import BRISTLE, WIDTH_DQ, presliding
from r2s.parameters import OF_LINKS, WHOLE_ARM, ParameterSpace
from r2s.recording import Recording
from r2s.regressor import GRAVITY, Links, regressor, rigid_body
from r2s.robot import SIM_DT, Robot
from r2s.simulator import Dynamics, Simulator

STATE_SAMPLES = 31  # of the local fit that a window's start state comes from, at 1 kHz
PRESLIDING = 1e-3  # rad, over which friction turns, where it is not searched
SHORTEST = 0.25  # of a window: what is shorter is not worth its start
MOVED = 0.02  # rad that a joint must move to count as moving
SCATTER = 0.1  # Nm, of the commands at which a joint lets go, from posture to posture
LATE = 11  # ms, odd, in which a command may be felt
HISTORY = 40  # ms of commands before a window: what delay and lag still remember
USUAL, HUBER = (
    0.9,
    1.5,
)  # share of windows that noise is estimated from; size, over the median, from which less counts
LONGEST = 40  # rows: a residual that drifts slowly is not one single row
BLOCK_S = 0.5  # s, stretches that the bootstrap draws
FRICTION_HZ = 500  # friction is evaluated this often, then filtered as the torque is
FRICTION_CUTOFF = 4.0  # of the velocity that friction is evaluated at, over that of the torque
Q_STEP, DQ_STEP, TAU_STEP = 1e-4, 1e-3, 1e-2  # rad, rad/s, Nm: finite differences by start state and torque


@dataclass(frozen=True)
class Windows:
    """W stretches of a recording: start states, commands and what the joints then did.

    Attributes:
        t: (W,) s, start. q0, dq0: (W, n) rad, rad/s. tau: (W, S, n) Nm, one row per 1 ms step.
        before: (W, HISTORY, n) Nm, the commands before the start. turn: (W, n), how far the motion before it bent the
            bristles of friction with a memory.
        q: (W, S, n) rad, after each step.
        length: (W,) steps that count; what comes after them fills the array up.
    """

    t: np.ndarray
    q0: np.ndarray
    dq0: np.ndarray
    tau: np.ndarray
    before: np.ndarray
    q: np.ndarray
    turn: np.ndarray
    length: np.ndarray

    def felt(self, delay: np.ndarray | float, lag: np.ndarray | float) -> np.ndarray:
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
    dq, turn, local = np.empty_like(grid.q), np.empty_like(grid.q), Local.of(grid)
    first = np.empty(len(grid.t), dtype=int)
    starts: list[int] = []
    lengths: list[int] = []
    for s in grid.stretches:
        first[s] = s.start
        if s.stop - s.start <= STATE_SAMPLES:
            continue
        dq[s] = savgol_filter(grid.q[s], STATE_SAMPLES, 3, deriv=1, delta=SIM_DT, axis=0)
        turn[s] = presliding(dq[s], SIM_DT, PRESLIDING)
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
        turn=turn[at],
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
        gains = k * (k - 1) * t ** np.maximum(k - 2, 0)
        size = np.repeat(np.stack([noise, off], 1), STATE_SAMPLES, axis=1)  # (n, 2 S)
        angles = np.broadcast_to(t**k, (n, STATE_SAMPLES, 4))
        both = np.concatenate([angles, speeds - late[:, None, None] * gains], 1) / size[..., None]
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
    sim.reset(windows.q0, windows.dq0, turn=windows.turn)
    return sim.rollout(windows.felt(dynamics.delay, dynamics.lag))["qpos"]


class ReplayResidual:
    """Residual of a commanded recording: simulated minus recorded angles, means of `stride` ms each, made white.

    `slowest`, `limit` and `edges`: see `cut_windows`.

    A window's error has three sources, and generalised least squares weighs rows by what they make together:
        error = Z b + e,   b ~ N(0, diag(d)) start angle, start velocity and a torque that no candidate explains,
        constant over the window, per joint;   e ~ N(0, s^2) encoder noise.
    Z are finite differences about a candidate; d and s come from the recording, later from what is left (`adapt`).

    Calling it with x (C, P) returns (C, R); `clusters` (R,) says which window a row belongs to.
    """

    unit = "mrad"

    def __init__(
        self,
        robot: Robot,
        space: ParameterSpace,
        recording: Recording,
        *,
        window_s: float = 0.2,
        stride: int = 5,
        slowest: float = 0.0,
        limit: int | None = None,
        edges: np.ndarray | None = None,
        batch: int = 36,
        nthread: int = 0,
    ):
        self.space, self.windows, self._batch = space, cut_windows(recording, window_s, limit, slowest, edges), batch
        w = self.windows
        self.count = len(w.q0)
        self._stride = stride
        self._target = self._means(w.q)
        last = stride * (1 + np.arange(self._target.shape[1]))
        self._seen = np.repeat((last <= w.length[:, None])[..., None], robot.n, axis=2)
        self.clusters = np.repeat(np.arange(self.count), self._target[0].size)
        self._sim = Simulator(robot, space.nominal, batch * self.count, nthread)
        self.candidates = 0
        local = Local.of(recording.resample(SIM_DT))
        self._noise, start = local.noise / np.sqrt(stride), local.sigma.ravel()
        self._least = np.concatenate([start, np.full(robot.n, 1e-4)])
        self._spread = np.concatenate([start, np.full(robot.n, 0.05)])
        self.adapt(space.start, fitted=False)

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """Return residuals (C, R), in standard deviations, for candidates x (C, P)."""
        return (self._white(self.error(x)) * self._trust[:, None]).reshape(len(x), -1)

    def error(self, x: np.ndarray) -> np.ndarray:
        """Return (C, W, S' n) rad: simulated minus recorded angles where they count, else 0."""
        self.candidates += len(x)
        return np.concatenate([self._chunk(x[i : i + self._batch]) for i in range(0, len(x), self._batch)])

    def _chunk(self, x: np.ndarray) -> np.ndarray:
        w, d = self.windows, self.space.dynamics(x)
        timing = np.stack(np.broadcast_arrays(d.delay, d.lag, np.zeros(len(x)))[:2], -1)
        kinds, kind = np.unique(timing, axis=0, return_inverse=True)
        felt = np.stack([w.felt(*pair) for pair in kinds])
        return self._simulate(d, felt[kind.ravel()], w.q0, w.dq0)

    def _simulate(self, d: Dynamics, felt: np.ndarray, q0: np.ndarray, dq0: np.ndarray) -> np.ndarray:
        """Return `error` of C candidates for torques felt (C, W, S, n) and starts (C, W, n) or (W, n)."""
        count = len(felt)
        ids = np.arange(count * self.count)
        shape = (count, *self.windows.q0.shape)
        self._sim.set_dynamics(d, ids, repeat=self.count)
        n = q0.shape[-1]
        q0, dq0, turn = (np.broadcast_to(a, shape).reshape(-1, n) for a in (q0, dq0, self.windows.turn))
        self._sim.reset(q0, dq0, ids, turn)
        q = self._sim.rollout(felt.reshape(-1, *felt.shape[2:]), ids=ids)["qpos"]
        error = (self._means(q).reshape(count, *self._target.shape) - self._target) * self._seen
        return np.nan_to_num(error.reshape(count, self.count, -1), nan=1e3, posinf=1e3, neginf=-1e3)

    def _means(self, q: np.ndarray) -> np.ndarray:
        """Return (..., S', n): means of `stride` rows of q (..., S, n); the noise of each is its own."""
        whole = q.shape[-2] // self._stride
        parts = q[..., : whole * self._stride, :].reshape(*q.shape[:-2], whole, self._stride, q.shape[-1])
        return parts.mean(-2)

    def adapt(self, x: np.ndarray, fitted: bool) -> None:
        """Find Z about x (P,) and the whitening; with `fitted`, d and s as well, from what x leaves unexplained."""
        w, n = self.windows, self.space.n
        d = self.space.dynamics(x)
        felt, eye = w.felt(d.delay, d.lag), np.eye(n)[:, None]
        zero = np.zeros((n, 1, n))
        q0 = np.concatenate([w.q0[None], w.q0 + Q_STEP * eye, w.q0 + zero, w.q0 + zero])
        dq0 = np.concatenate([w.dq0[None], w.dq0 + zero, w.dq0 + DQ_STEP * eye, w.dq0 + zero])
        push = np.concatenate([np.zeros((1 + 2 * n, 1, 1, n)), TAU_STEP * eye[:, None]])
        parts, count = [], len(q0)
        for i in range(0, count, self._batch):
            at = slice(i, i + self._batch)
            parts.append(self._simulate(d, felt + push[at], q0[at], dq0[at]))
        at_x = np.concatenate(parts)
        self.candidates += count
        steps = np.repeat([Q_STEP, DQ_STEP, TAU_STEP], n)
        z = ((at_x[1:] - at_x[0]) / steps[:, None, None]).transpose(1, 2, 0)  # (W, R', 3 n)
        self._trust = np.ones(self.count)
        moves = self._seen.any((1, 2))  # the others have no error at all, and say nothing of its usual size
        if fitted and moves.any():
            usual = moves
            for _ in range(2):  # a window in which something else happened tells nothing of the noise of the others
                self._spread, self._noise = _random_effects(
                    z[usual], at_x[0, usual], self._seen[usual], self._spread, self._noise, self._least
                )
                self._whiten(z)
                size = self._window_size(at_x[0])
                usual = moves & (size <= np.quantile(size[moves], USUAL))
            self._trust = np.minimum(1.0, HUBER * np.median(size[moves]) / np.maximum(size, 1e-9))
        self._whiten(z)

    def _window_size(self, error: np.ndarray) -> np.ndarray:
        """Return (W,) the RMS of a window's white residual, of rows that count."""
        r = self._white(error[None])[0]
        return np.sqrt((r**2).sum(1) / np.maximum(self._seen.reshape(self.count, -1).sum(1), 1))

    def _white(self, error: np.ndarray) -> np.ndarray:
        """Return (C, W, R') in standard deviations."""
        r = error / np.tile(self._noise, self._target.shape[1])
        part = (r[..., None, :] @ self._axes) * self._shrink[:, None] @ self._axes.transpose(0, 2, 1)
        return r - part[..., 0, :]

    def _whiten(self, z: np.ndarray) -> None:
        """Keep the axes and factors of (I + E E^T)^(-1/2) = I - A (1 - 1 / sqrt(1 + l^2)) A^T, E = z d / s."""
        effect = z * self._spread / np.tile(self._noise, self._target.shape[1])[:, None]
        self._axes, size, _ = np.linalg.svd(effect, full_matrices=False)
        self._shrink = 1.0 - 1.0 / np.sqrt(1.0 + size**2)

    @property
    def unexplained(self) -> np.ndarray:
        """(n,) Nm, one standard deviation of the torque over a window that no candidate explains."""
        return self._spread[2 * self.space.n :]

    def joint_error(self, x: np.ndarray) -> np.ndarray:
        """Return (C, n) mrad^2: the mean square error of each joint."""
        return 1e6 * (self.error(x).reshape(len(x), -1, self.space.n) ** 2).mean(1)


def _random_effects(
    z: np.ndarray,
    error: np.ndarray,
    seen: np.ndarray,
    spread: np.ndarray,
    noise: np.ndarray,
    least: np.ndarray,
    rounds: int = 30,
) -> tuple[np.ndarray, np.ndarray]:
    """Return standard deviations of b (K,) and e (n,) of error (W, R') = z b + e, by maximum evidence.

    The fixed point of MacKay, Neural Computation 4(3), 1992: d = sum(mean^2) / (number of well-determined b), from
    `spread` and `noise` on. What b has in common over all windows is a parameter that is still wrong, an offset above
    all, and no noise: taken for noise it would keep the next fit from putting it right. No d falls below `least`
    (K,): of start angle and velocity what the encoder gives.
    """
    _, rows, k = z.shape
    n = len(noise)
    joint = np.tile(np.arange(n), rows // n)
    counted = np.array([seen[..., j].sum() for j in range(n)])
    for _ in range(rounds):
        weighed = z / (noise[joint] ** 2)[:, None]
        gram = weighed.transpose(0, 2, 1) @ z
        scaled = spread[:, None] * gram * spread + np.eye(k)
        inverse = np.linalg.inv(scaled)
        mean = spread * np.einsum("wij,wj->wi", inverse, spread * np.einsum("wri,wr->wi", weighed, error))
        covariance = spread[:, None] * inverse * spread
        left = error - np.einsum("wri,wi->wr", z, mean)
        uncertain = np.einsum("wri,wij,wrj->wr", z, covariance, z, optimize=True)
        total = (left**2 + uncertain).sum(0)
        new = np.array([total[joint == j].sum() for j in range(n)]) / np.maximum(counted, 1)
        noise = np.maximum(np.where(counted > 0, np.sqrt(new), noise), 1e-6)
        determined = 1.0 - np.einsum("wii->wi", covariance) / spread**2
        about = mean - mean.mean(0)
        spread = np.maximum(np.sqrt((about**2).sum(0) / np.maximum(determined.sum(0), 1e-3)), least)
    return spread, noise


class TorqueResidual:
    """Residual of any recording: predicted minus recorded torque, zero-phase filtered, at `rate_hz`.

    The rigid part is a product with a regressor made once. Friction is evaluated at less smoothed velocities and then
    filtered as the torque was, because a filter rounds the step of friction at a reversal.
    """

    unit = "Nm"

    def __init__(
        self,
        robot: Robot,
        space: ParameterSpace,
        recording: Recording,
        *,
        cutoff_hz: float = 10.0,
        rate_hz: float = 100.0,
        block_s: float = BLOCK_S,
        presliding_rad: float = PRESLIDING,
    ):
        self.space = space
        self.motion = m = Motion.of(recording, cutoff_hz, rate_hz, presliding_rad)
        self.commanded = recording.torque == "commanded"
        gravity = None if self.commanded else GRAVITY
        self._rest, y = rigid_body(robot, m.q, m.dq, m.ddq, gravity)
        self._y = y.reshape(*m.q.shape, -1)
        still = np.zeros_like(m.q)
        y = regressor(robot, m.q, still, still, GRAVITY)
        self._gravity = y.reshape(*m.q.shape, -1)
        self._nominal = Links(robot.mass, robot.com, robot.inertia).standard().ravel()
        self._load = np.abs(self._gravity @ self._nominal)
        block = (m.t / block_s).astype(int)
        self.clusters = np.repeat(np.unique(block, return_inverse=True)[1], robot.n)
        self.candidates = 0
        self._scale = np.ones(robot.n)
        self.adapt(space.start, fitted=False)

    def on(self, space: ParameterSpace) -> "TorqueResidual":
        """Return this residual for candidates of another space."""
        other = copy(self)
        other.space = space
        other.adapt(space.start, fitted=False)
        return other

    def predict(self, dynamics: Dynamics) -> np.ndarray:
        """Return (T, n) Nm: rigid-body torque + friction - offset at the measured motion, of one arm."""
        d, m = dynamics, self.motion
        standard = self._standard(d).ravel()
        out = self._rest + self._y @ standard
        if d.gain is not None and not self.commanded:
            out = out * (1.0 + d.gain)
        turn = m.turn if d.family == BRISTLE else None
        out += m.filtered(d.friction(m.fast, turn)) - d.offset
        if self.commanded and (d.mass is not None or d.com is not None):  # what the compensation leaves
            out += self._gravity @ (standard - self._nominal)
        if d.drag is not None:
            out -= d.drag[:, 0] * np.sin(m.q) + d.drag[:, 1] * np.cos(m.q)
        if d.load is not None:
            out += d.load * self._load * m.filtered(np.tanh(m.fast / WIDTH_DQ) if turn is None else turn)
        return out

    def error(self, x: np.ndarray) -> np.ndarray:
        """Return (C, T, n) Nm, predicted minus recorded, the recorded one as late as the joints feel it."""
        self.candidates += len(x)
        out = np.empty((len(x), *self.motion.q.shape))
        d = self.space.dynamics(x)
        for i in range(len(x)):
            out[i] = self.off(_pick(d, i))
        return out

    def off(self, dynamics: Dynamics) -> np.ndarray:
        """Return (T, n) Nm, predicted minus recorded, of one arm."""
        late = float(dynamics.delay) + float(dynamics.lag) if self.commanded else 0.0
        return self.predict(dynamics) - self.motion.tau_at(late)

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """Return residuals (C, R), in standard deviations, for candidates x (C, P)."""
        return (self.error(x) / self._scale).reshape(len(x), -1)

    def change(self, x: np.ndarray, stepped: np.ndarray) -> np.ndarray:
        """Return (R, P): what the residual at x (P,) changes by as each value in turn goes to `stepped` (P,).

        The same as P calls with one value changed, but joints do not see each other's friction and the torque is
        linear in standard parameters, so a dozen evaluations do.
        """
        space, n = self.space, self.space.n
        d = space.dynamics(x)
        base, out = self.off(d), np.zeros((*self.motion.q.shape, len(x)))
        reach = self._y * (np.ones(n) if d.gain is None or self.commanded else 1.0 + d.gain)[:, None]
        reach = reach + self._gravity if self.commanded else reach
        before = self._standard(d).ravel()
        for block in space.blocks:
            at = space.where(block)
            if block in OF_LINKS:
                trials = np.repeat(x[None], n, axis=0)
                trials[np.arange(n), at] = stepped[at]
                after = self._standard(space.dynamics(trials)).reshape(n, -1)
                out[..., at] = reach @ (after - before).T
                continue
            trial = x.copy()
            trial[at] = stepped[at]
            moved = self.off(space.dynamics(trial)) - base
            if block in WHOLE_ARM:
                out[..., at[0]] = moved
            else:
                out[:, np.arange(n), at] = moved
        return (out / self._scale[:, None]).reshape(-1, len(x))

    def _standard(self, d: Dynamics) -> np.ndarray:
        """Return (..., n, 10) standard parameters."""
        robot = self.space.robot
        mass = robot.mass if d.mass is None else d.mass
        return Links(mass, robot.com if d.com is None else d.com, d.inertia).standard()

    def adapt(self, x: np.ndarray, fitted: bool) -> None:
        """Set what counts as one standard deviation of an independent row, per joint.

        It is the RMS at a `fitted` x (P,), else half of it, times how many rows in a row say the same thing.
        """
        r = self.error(x[None])[0]
        self._scale = (1.0 if fitted else 0.5) * np.sqrt((r**2).mean(0) * np.minimum(_correlation_length(r), LONGEST))


def _pick(d: Dynamics, i: int) -> Dynamics:
    """Return the i-th of a batch of dynamics; fields without a batch stay."""
    depth = {"phi": 2, "offset": 1, "breakaway": 2, "inertia": 3, "mass": 1, "com": 2, "load": 1, "drag": 2}
    depth |= {"gain": 1, "delay": 0, "lag": 0}
    one = {k: getattr(d, k) for k in depth}
    return replace(d, **{k: v[i] for k, v in one.items() if v is not None and np.ndim(v) > depth[k]})


@dataclass(frozen=True)
class Motion:
    """A recording made smooth enough to differentiate, on T moments.

    Attributes:
        t: (T,) s. q, dq, ddq, tau: (T, n), low-passed both ways.
        fast: (F, n) rad/s at FRICTION_HZ, less smoothed. turn: (F, n), its presliding sign. low_pass: (T, F), sparse:
            what `filtered` multiplies with.
        late: (T, L, n) Nm, tau at the moment and each ms before it.
    """

    t: np.ndarray
    q: np.ndarray
    dq: np.ndarray
    ddq: np.ndarray
    tau: np.ndarray
    fast: np.ndarray
    turn: np.ndarray
    low_pass: csr_array
    late: np.ndarray

    @staticmethod
    def of(recording: Recording, cutoff_hz: float, rate_hz: float, presliding_rad: float = PRESLIDING) -> "Motion":
        """Resample on logged time, low-pass both ways, differentiate, keep `rate_hz`; edges are dropped.

        Raises:
            UserError: nothing is left.
        """
        grid = recording.resample(SIM_DT)
        smooth, quick = grid.smooth(cutoff_hz), grid.smooth(min(FRICTION_CUTOFF * cutoff_hz, 0.4 / SIM_DT))
        kernel = _impulse_response(cutoff_hz, FRICTION_HZ)
        every, reach = round(1 / (FRICTION_HZ * SIM_DT)), len(kernel) // 2
        ddq, keep, rows, fast, turn = smooth.acceleration(), [], [], [], []
        step, edge, base = round(1 / (rate_hz * SIM_DT)), round(0.05 / SIM_DT), 0
        for s in smooth.stretches:
            some = np.arange(s.start + edge, s.stop - edge, step)
            at = np.arange(s.start, s.stop, every)
            near = np.clip((some[:, None] - s.start) // every + np.arange(-reach, reach + 1), 0, len(at) - 1)
            keep.append(some)
            rows.append(base + near)
            fast.append(quick.dq[at])
            turn.append(presliding(quick.dq[s], SIM_DT, presliding_rad)[::every])
            base += len(at)
        kept = np.concatenate(keep)
        if not len(kept):
            raise UserError(f"no trajectory is longer than 0.1 s; the recording lasts {recording.duration:g} s")
        columns = np.concatenate(rows)
        ends = len(kernel) * np.arange(len(kept) + 1)
        low_pass = csr_array((np.tile(kernel, len(kept)), columns.ravel(), ends), shape=(len(kept), base))
        late = np.stack([smooth.tau[np.maximum(kept - k, 0)] for k in range(edge)], 1)
        return Motion(
            smooth.t[kept], smooth.q[kept], smooth.dq[kept], ddq[kept], smooth.tau[kept],
            np.concatenate(fast), np.concatenate(turn), low_pass, late,
        )  # fmt: skip

    def filtered(self, x: np.ndarray) -> np.ndarray:
        """Return (T, n): the low-pass of x (F, n) at the moments."""
        return self.low_pass @ x

    def tau_at(self, delay: float) -> np.ndarray:
        """Return (T, n) Nm: the torque `delay` s before each moment."""
        at = min(max(delay / SIM_DT, 0.0), self.late.shape[1] - 2)
        k = int(at)
        return self.late[:, k] + (at - k) * (self.late[:, k + 1] - self.late[:, k])


def _impulse_response(cutoff_hz: float, rate_hz: float) -> np.ndarray:
    """Return the two-sided kernel of `Recording.smooth` at a rate, cut where it has faded; its sum is 1."""
    reach = int(1.5 * rate_hz / cutoff_hz)
    pulse = np.zeros(8 * reach + 1)
    pulse[4 * reach] = 1.0
    kernel = sosfiltfilt(butter(4, cutoff_hz, fs=rate_hz, output="sos"), pulse)[3 * reach : 5 * reach + 1]
    return kernel / kernel.sum()


def _correlation_length(r: np.ndarray) -> np.ndarray:
    """Return (n,) samples: how far the residual's autocorrelation reaches before it falls below 1/e."""
    centred = r - r.mean(0)
    out = np.ones(r.shape[1])
    for j, x in enumerate(centred.T):
        power = np.abs(np.fft.rfft(x, 2 * len(x))) ** 2
        correlation = np.fft.irfft(power)[: len(x)]
        below = np.flatnonzero(correlation < correlation[0] / np.e)
        out[j] = below[0] if len(below) else len(x)
    return out
