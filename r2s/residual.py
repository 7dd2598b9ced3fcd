"""What a candidate gets wrong: one residual per kind of recording, the same for every search.

Commanded torque (no gravity): eq. (8) by replay. The recording is cut into short windows; every candidate starts
each window at the measured state, is fed the recorded commands and is compared with the recorded joint angles, all
candidates and windows at once on one Batch. Short windows keep the problem well-posed: an arm without feedback
drifts, and after seconds the error says more about the drift than about the parameters.

Measured link-side torque (with gravity): there is no command to replay, so the residual is the torque that rigid
dynamics, friction and offset predict at the measured motion, against the measured torque.
"""

from dataclasses import dataclass

import mujoco
import numpy as np
from scipy.signal import savgol_filter

from r2s.errors import UserError
from r2s.friction import friction_torque
from r2s.parameters import ParameterSpace
from r2s.recording import Recording
from r2s.robot import SIM_DT, Robot
from r2s.simulator import Dynamics, Simulator

ENCODER_MRAD = 0.2  # what replays of 0.2 s miss through encoder noise in their start state
VELOCITY_SAMPLES = 31  # Savitzky-Golay window for a window's start state, samples at 1 kHz


@dataclass(frozen=True)
class Windows:
    """W stretches of a recording: start states, commands and what the joints then did.

    Attributes:
        t: (W,) s, start. q0, dq0: (W, n) rad, rad/s. tau: (W, S, n) Nm, one row per 1 ms step.
        q: (W, S, n) rad, after each step.
    """

    t: np.ndarray
    q0: np.ndarray
    dq0: np.ndarray
    tau: np.ndarray
    q: np.ndarray


def cut_windows(recording: Recording, seconds: float, limit: int | None = None) -> Windows:
    """Cut a commanded recording into windows of `seconds`, none across two trajectories, end to end.

    The start state is a cubic Savitzky-Golay fit over 31 ms of measured angles: its derivative is less noisy than
    the logged velocity and has no delay. With `limit`, that many windows spread evenly are kept.

    Raises:
        UserError: no trajectory is as long as a window.
    """
    grid = recording.resample(SIM_DT)
    steps = round(seconds / SIM_DT)
    q, dq, starts = np.empty_like(grid.q), np.empty_like(grid.q), []
    for s in grid.stretches:
        if s.stop - s.start <= max(steps, VELOCITY_SAMPLES):
            continue
        q[s] = savgol_filter(grid.q[s], VELOCITY_SAMPLES, 3, axis=0)
        dq[s] = savgol_filter(grid.q[s], VELOCITY_SAMPLES, 3, deriv=1, delta=SIM_DT, axis=0)
        starts += list(range(s.start, s.stop - steps, steps))
    if not starts:
        longest = max(s.stop - s.start for s in grid.stretches) * SIM_DT
        raise UserError(f"no trajectory is as long as a window of {seconds:g} s; the longest is {longest:g} s")
    at = np.array(starts)
    if limit is not None and len(at) > limit:
        at = at[np.linspace(0, len(at) - 1, limit).round().astype(int)]
    rows = at[:, None] + np.arange(steps)
    return Windows(t=grid.t[at], q0=q[at], dq0=dq[at], tau=grid.tau[rows], q=grid.q[rows + 1])


def replay(robot: Robot, dynamics: Dynamics, windows: Windows, nthread: int = 0) -> np.ndarray:
    """Return q (W, S, n) rad that an arm with these dynamics does in each window."""
    sim = Simulator(robot, dynamics, len(windows.q0), nthread)
    sim.reset(windows.q0, windows.dq0)
    return sim.rollout(windows.tau)["qpos"]


class ReplayResidual:
    """Residual of a commanded recording: simulated minus recorded joint angles in mrad, every `stride` ms.

    With `limit`, that many windows. Within a window a joint counts until it is slower than `slowest` rad/s for the
    first time.

    Calling it with x (C, P) returns (C, R); `clusters` (R,) says which window a row belongs to (errors within a
    window are correlated, so intervals count windows, not samples).
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
        slowest: float = 0.02,
        limit: int | None = None,
        batch: int = 36,
        nthread: int = 0,
    ):
        self.space, self.windows, self._batch = space, cut_windows(recording, window_s, limit), batch
        w = self.windows
        self.count = len(w.q0)
        self._every = slice(stride - 1, None, stride)
        self._target = w.q[:, self._every]
        # once a joint was inside the dead zone its angle tells of breakaway, which is not searched: leave it out
        speed = np.abs(np.gradient(savgol_filter(w.q, VELOCITY_SAMPLES, 3, axis=1), SIM_DT, axis=1))
        still = np.maximum.accumulate(speed < slowest, axis=1)
        self._seen = ~still[:, self._every]
        self.clusters = np.repeat(np.arange(self.count), self._target[0].size)
        self._sim = Simulator(robot, space.nominal, batch * self.count, nthread)
        self._q0, self._dq0, self._tau = (np.concatenate([a] * batch) for a in (w.q0, w.dq0, w.tau))
        self.candidates = 0

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """Return residuals (C, R) in mrad for candidates x (C, P)."""
        self.candidates += len(x)
        return np.concatenate([self._chunk(x[i : i + self._batch]) for i in range(0, len(x), self._batch)])

    def _chunk(self, x: np.ndarray) -> np.ndarray:
        m = len(x) * self.count
        ids = np.arange(m)
        self._sim.set_dynamics(self.space.dynamics(x), ids, repeat=self.count)
        self._sim.reset(self._q0[:m], self._dq0[:m], ids)
        q = self._sim.rollout(self._tau[:m], ids=ids)["qpos"][:, self._every]
        error = 1e3 * (q.reshape(len(x), *self._target.shape) - self._target) * self._seen
        return np.nan_to_num(error.reshape(len(x), -1), nan=1e6, posinf=1e6, neginf=-1e6)

    def joint_error(self, x: np.ndarray) -> np.ndarray:
        """Return (C, n) mrad^2: the mean square error of each joint."""
        return (self(x).reshape(len(x), -1, self._target.shape[-1]) ** 2).mean(1)

    def scale(self, x: np.ndarray, fitted: bool) -> np.ndarray:
        """Return (n,) mrad: one standard deviation of a row, where a whole window says one thing.

        Before a fit that is encoder noise alone; of a `fitted` x (P,) it is what the model leaves unexplained.
        """
        left = np.sqrt(self.joint_error(x[None])[0]) if fitted else 0.0
        return np.sqrt(self._target.shape[1]) * np.maximum(ENCODER_MRAD, np.full(self._target.shape[-1], left))

    def error(self, x: np.ndarray) -> np.ndarray:
        """Return (C,) mrad: eq. (8) per sample, the mean over time of the norm over joints."""
        n = self._target.shape[-1]
        return np.linalg.norm(self(x).reshape(len(x), -1, n), axis=-1).mean(-1)


class TorqueResidual:
    """Residual of any recording: predicted minus recorded torque in Nm, at `rate_hz`, zero-phase filtered.

    The prediction is linear in tensors and offsets, so it is a product with a regressor made once.
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
        block_s: float = 0.5,
    ):
        self.space = space
        self.motion = Motion.of(recording, cutoff_hz, rate_hz)
        gravity = recording.torque == "measured"
        self._rigid, self._regressor = inertia_regressor(robot, self.motion, gravity)
        block = (self.motion.t / block_s).astype(int)
        self.clusters = np.repeat(np.unique(block, return_inverse=True)[1], robot.n)
        self.candidates = 0

    def predict(self, dynamics: Dynamics) -> np.ndarray:
        """Return (..., T, n) Nm: rigid-body torque + friction - offset at the measured motion."""
        tensors = six(dynamics.inertia).reshape(*dynamics.inertia.shape[:-3], -1)
        rigid = self._rigid + np.einsum("tnk,...k->...tn", self._regressor, tensors)
        friction = friction_torque(self.motion.dq, dynamics.phi[..., None, :, :])
        return rigid + friction - dynamics.offset[..., None, :]

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """Return residuals (C, R) in Nm for candidates x (C, P)."""
        self.candidates += len(x)
        return (self.predict(self.space.dynamics(x)) - self.motion.tau).reshape(len(x), -1)

    def scale(self, x: np.ndarray, fitted: bool) -> np.ndarray:
        """Return (n,) Nm: one standard deviation of an independent row: RMS at a `fitted` x (P,), else half of it.

        Real torque keeps that much unexplained whatever the parameters; the factor is how many rows in a row say
        the same thing, so that a prior weighs against independent rows.
        """
        r = self.predict(self.space.dynamics(x)) - self.motion.tau
        return (1.0 if fitted else 0.5) * np.sqrt((r**2).mean(0) * _correlation_length(r))

    def error(self, x: np.ndarray) -> np.ndarray:
        """Return (C,) Nm: eq. (8) per sample, the mean over time of the norm over joints."""
        n = self.motion.tau.shape[-1]
        return np.linalg.norm(self(x).reshape(len(x), -1, n), axis=-1).mean(-1)


@dataclass(frozen=True)
class Motion:
    """A recording made smooth enough to differentiate: t (T,) s; q, dq, ddq, tau (T, n)."""

    t: np.ndarray
    q: np.ndarray
    dq: np.ndarray
    ddq: np.ndarray
    tau: np.ndarray

    @staticmethod
    def of(recording: Recording, cutoff_hz: float, rate_hz: float) -> "Motion":
        """Resample on logged time, low-pass both ways, differentiate, keep `rate_hz`; edges of 50 ms are dropped.

        Raises:
            UserError: nothing is left.
        """
        smooth = recording.resample(SIM_DT).smooth(cutoff_hz)
        ddq, keep = smooth.acceleration(), []
        step, edge = round(1 / (rate_hz * SIM_DT)), round(0.05 / SIM_DT)
        for s in smooth.stretches:
            keep += list(range(s.start + edge, s.stop - edge, step))
        if not keep:
            raise UserError(f"no trajectory is longer than 0.1 s; the recording lasts {recording.duration:g} s")
        return Motion(smooth.t[keep], smooth.q[keep], smooth.dq[keep], ddq[keep], smooth.tau[keep])


def six(tensor: np.ndarray) -> np.ndarray:
    """Return (..., 6) xx, yy, zz, xy, xz, yz of symmetric tensors (..., 3, 3)."""
    return tensor[..., [0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]


def inertia_regressor(robot: Robot, motion: Motion, gravity: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return the torque without link tensors (T, n) Nm and what each tensor component adds (T, n, 6 n).

    Inverse dynamics is linear in the tensors; point masses carry the rest (masses and centres of mass).
    """
    model = robot.model(gravity=gravity)
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_LIMIT)
    data = mujoco.MjData(model)
    bodies = model.jnt_bodyid
    samples, n = motion.q.shape
    omega, alpha = np.empty((samples, n, 3)), np.empty((samples, n, 3))
    jac = np.empty((samples, n, 3, n))
    jacp, jacr = np.empty((3, n)), np.empty((3, n))
    rigid = np.empty((samples, n))
    velocity = np.empty(6)
    for i in range(samples):
        data.qpos, data.qvel, data.qacc = motion.q[i], motion.dq[i], motion.ddq[i]
        mujoco.mj_inverse(model, data)
        mujoco.mj_rnePostConstraint(model, data)
        rigid[i] = data.qfrc_inverse
        for k, body in enumerate(bodies):
            rotation = data.xmat[body].reshape(3, 3)
            mujoco.mj_jacBody(model, data, jacp, jacr, body)
            jac[i, k] = rotation.T @ jacr
            mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, body, velocity, 1)
            omega[i, k] = velocity[:3]
            mujoco.mj_objectAcceleration(model, data, mujoco.mjtObj.mjOBJ_XBODY, body, velocity, 1)
            alpha[i, k] = velocity[:3]
    # torque of a link's tensor alone, in link axes: J_r^T (I alpha + omega x I omega)
    basis = np.zeros((6, 3, 3))
    for c, (a, b) in enumerate([(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)]):
        basis[c, a, b] = basis[c, b, a] = 1.0
    spin = np.einsum("cab,tkb->tkca", basis, alpha)
    spin += np.cross(omega[:, :, None], np.einsum("cab,tkb->tkca", basis, omega))
    regressor = np.einsum("tkan,tkca->tnkc", jac, spin).reshape(samples, n, 6 * n)
    return rigid - regressor @ six(robot.inertia).ravel(), regressor


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
