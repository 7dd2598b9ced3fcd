"""Replay residual (output error) of commanded motion: simulated minus recorded joint angles, eq. (8) of the paper.

In each window, every candidate is simulated from the measured start state with the recorded commands. All windows of
many candidates are simulated in one batch. Residuals are in standard deviations, see `reweighted`.
"""

from copy import copy

import numpy as np

from r2s.identification.blocks import blocks_of
from r2s.identification.parameters import ParameterSpace
from r2s.identification.residuals.windows import StartState, Windows
from r2s.physics.dynamics import Dynamics
from r2s.physics.robot import SIM_DT
from r2s.physics.simulator import Simulator
from r2s.recordings.recording import Recording

USUAL = 0.9  # noise is estimated from this share of the windows: those with the least residual
HUBER = 1.5  # a window is down-weighted if its RMS residual exceeds this multiple of the median
Q_STEP, DQ_STEP, TAU_STEP = 1e-4, 1e-3, 1e-2  # rad, rad/s, Nm: finite-difference steps
TORQUE_SIGMA, MIN_TORQUE_SIGMA = 0.05, 1e-4  # Nm, first guess and lower limit of a window's unexplained torque
BAYES_ROUNDS = 30  # fixed-point iterations of `_random_effects`


class ReplayResidual:
    """Immutable, whitened replay residual of angles averaged over `stride` ms.

    The error of a window is modeled as Z b + e, with encoder noise e ~ N(0, s^2) and unknown b ~ N(0, diag(d)). For
    each joint, b contains the errors of start angle and start velocity, and an unexplained torque that is constant
    over the window. The covariance of Z b + e whitens the error. Finite differences yield the matrix Z. The first
    variances d and s^2 come from the recording, later variances from a fit. `clusters` (R,): block number of each
    row; before a fit, each window is a block.

    Args:
        space: parameters to estimate. recording, windows: see `cut_windows`. stride: ms, averaging time of angles.
        batch: number of candidates that are simulated at once. nthread: number of threads; 0 uses all cores.
    """

    def __init__(
        self,
        space: ParameterSpace,
        recording: Recording,
        windows: Windows,
        *,
        stride: int = 5,
        batch: int = 36,
        nthread: int = 0,
    ):
        self.space, self.windows, self._batch = space, windows, batch
        n = space.n
        self.count = len(windows.q0)
        self._stride, self._period = stride, recording.period
        self._target = self._means(windows.q)
        last = stride * (1 + np.arange(self._target.shape[1]))
        self._seen = np.repeat((last <= windows.length[:, None])[..., None], n, axis=2)
        self.clusters = np.repeat(np.arange(self.count), self._target[0].size)
        self._sim = Simulator(space.robot, space.nominal, batch * self.count, nthread)
        state = StartState.of(recording.resample(SIM_DT))
        self._noise, start = state.noise / np.sqrt(stride), state.sigma.ravel()
        self._min_sigma = np.concatenate([start, np.full(n, MIN_TORQUE_SIGMA)])
        self._sigma = np.concatenate([start, np.full(n, TORQUE_SIGMA)])
        self._reweigh(space.start, fitted=False)

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """Return the residuals (C, R), in standard deviations, of candidates x (C, P)."""
        return (self._white(self.errors(x)) * self._trust[:, None]).reshape(len(x), -1)

    def errors(self, x: np.ndarray) -> np.ndarray:
        """Return simulated minus recorded angles (C, W, S' n) rad of candidates x (C, P); padding rows are 0."""
        return np.concatenate([self._chunk(x[i : i + self._batch]) for i in range(0, len(x), self._batch)])

    def _chunk(self, x: np.ndarray) -> np.ndarray:
        w, d = self.windows, self.space.dynamics(x)
        timing = np.stack(np.broadcast_arrays(d.delay, d.lag, np.zeros(len(x)))[:2], -1)
        kinds, kind = np.unique(timing, axis=0, return_inverse=True)
        delayed = np.stack([w.delayed(*pair) for pair in kinds])
        return self._simulate(d, delayed[kind.ravel()], w.q0, w.dq0)

    def _simulate(self, d: Dynamics, tau: np.ndarray, q0: np.ndarray, dq0: np.ndarray) -> np.ndarray:
        """Simulate C candidates from states (C, W, n) or (W, n) with torques tau (C, W, S, n); return `errors`."""
        count = len(tau)
        ids = np.arange(count * self.count)
        shape = (count, *self.windows.q0.shape)
        self._sim.set_dynamics(d, ids, repeat=self.count)
        n = q0.shape[-1]
        start = q0, dq0, self.windows.bristles(d)
        q0, dq0, bristle = (np.broadcast_to(a, shape).reshape(-1, n) for a in start)
        self._sim.reset(q0, dq0, ids, bristle)
        q = self._sim.rollout(tau.reshape(-1, *tau.shape[2:]), ids=ids)["qpos"]
        error = (self._means(q).reshape(count, *self._target.shape) - self._target) * self._seen
        return np.nan_to_num(error.reshape(count, self.count, -1), nan=1e3, posinf=1e3, neginf=-1e3)

    def _means(self, q: np.ndarray) -> np.ndarray:
        """Return the means (..., S', n) of q (..., S, n) over groups of `stride` successive rows."""
        whole = q.shape[-2] // self._stride
        parts = q[..., : whole * self._stride, :].reshape(*q.shape[:-2], whole, self._stride, q.shape[-1])
        return parts.mean(-2)

    def on(self, space: ParameterSpace) -> "ReplayResidual":
        """Return a copy for the parameter space `space`, with the same weights."""
        other = copy(self)
        other.space = space
        return other

    def reweighted(self, x: np.ndarray, fitted: bool) -> "ReplayResidual":
        """Return a copy with the matrix Z at x (P,) and, if x was `fitted`, with d and s^2 from the errors at x."""
        other = copy(self)
        other._reweigh(x, fitted)
        return other

    def _reweigh(self, x: np.ndarray, fitted: bool) -> None:
        w, n = self.windows, self.space.n
        d = self.space.dynamics(x)
        delayed, eye = w.delayed(d.delay, d.lag), np.eye(n)[:, None]
        zero = np.zeros((n, 1, n))
        q0 = np.concatenate([w.q0[None], w.q0 + Q_STEP * eye, w.q0 + zero, w.q0 + zero])
        dq0 = np.concatenate([w.dq0[None], w.dq0 + zero, w.dq0 + DQ_STEP * eye, w.dq0 + zero])
        push = np.concatenate([np.zeros((1 + 2 * n, 1, 1, n)), TAU_STEP * eye[:, None]])
        parts = []
        for i in range(0, len(q0), self._batch):
            at = slice(i, i + self._batch)
            parts.append(self._simulate(d, delayed + push[at], q0[at], dq0[at]))
        at_x = np.concatenate(parts)
        steps = np.repeat([Q_STEP, DQ_STEP, TAU_STEP], n)
        z = ((at_x[1:] - at_x[0]) / steps[:, None, None]).transpose(1, 2, 0)  # (W, R', 3 n)
        if fitted:
            seconds = SIM_DT * w.tau.shape[1]
            mean = at_x[0].reshape(self._target.shape).mean(1) / self._noise
            block = blocks_of(w.t, w.q0, self._period, mean, seconds)
            self.clusters = np.repeat(block, self._target[0].size)
        self._trust = np.ones(self.count)
        moves = self._seen.any((1, 2))  # a window without a seen row is only padding
        if fitted and moves.any():
            usual = moves
            for _ in range(2):  # an outlier window must not raise the noise of other windows
                self._sigma, self._noise = _random_effects(
                    z[usual], at_x[0, usual], self._seen[usual], self._sigma, self._noise, self._min_sigma
                )
                self._whiten(z)
                size = self._window_rms(at_x[0])
                usual = moves & (size <= np.quantile(size[moves], USUAL))
            self._trust = np.minimum(1.0, HUBER * np.median(size[moves]) / np.maximum(size, 1e-9))
        self._whiten(z)

    def _window_rms(self, error: np.ndarray) -> np.ndarray:
        """Return the RMS (W,) of each window's whitened residual, without padding rows."""
        r = self._white(error[None])[0]
        return np.sqrt((r**2).sum(1) / np.maximum(self._seen.reshape(self.count, -1).sum(1), 1))

    def _white(self, error: np.ndarray) -> np.ndarray:
        """Whiten an angle error (C, W, R') rad; the result is in standard deviations."""
        r = error / np.tile(self._noise, self._target.shape[1])
        part = (r[..., None, :] @ self._axes) * self._shrink[:, None] @ self._axes.transpose(0, 2, 1)
        return r - part[..., 0, :]

    def _whiten(self, z: np.ndarray) -> None:
        """Set A and f in (I + E E^T)^(-1/2) = I - A f A^T; E = z sigma / s = A l V^T, f = 1 - 1 / sqrt(1 + l^2)."""
        effect = z * self._sigma / np.tile(self._noise, self._target.shape[1])[:, None]
        self._axes, size, _ = np.linalg.svd(effect, full_matrices=False)
        self._shrink = 1.0 - 1.0 / np.sqrt(1.0 + size**2)

    def joint_error(self, x: np.ndarray) -> np.ndarray:
        """Return the mean square angle error (C, n) mrad^2 of each joint for candidates x (C, P)."""
        return 1e6 * (self.errors(x).reshape(len(x), -1, self.space.n) ** 2).mean(1)


def _random_effects(
    z: np.ndarray, error: np.ndarray, seen: np.ndarray, sigma: np.ndarray, noise: np.ndarray, min_sigma: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Estimate the standard deviations of b (K,) and e (n,) in error (W, R') = z b + e by maximum evidence.

    MacKay's fixed-point iteration (Neural Computation 4(3), 1992) starts at `sigma` and `noise`. The variance of b is
    the sum of squared estimates of b, divided by the number of well-determined estimates. First, the estimates' mean
    over windows is subtracted, because a wrong parameter (mostly an offset) causes this mean. The standard deviation
    of b is at least `min_sigma`.
    """
    _, rows, k = z.shape
    n = len(noise)
    joint = np.tile(np.arange(n), rows // n)
    counted = np.array([seen[..., j].sum() for j in range(n)])
    for _ in range(BAYES_ROUNDS):
        weighed = z / (noise[joint] ** 2)[:, None]
        gram = weighed.transpose(0, 2, 1) @ z
        scaled = sigma[:, None] * gram * sigma + np.eye(k)
        inverse = np.linalg.inv(scaled)
        mean = sigma * np.einsum("wij,wj->wi", inverse, sigma * np.einsum("wri,wr->wi", weighed, error))
        covariance = sigma[:, None] * inverse * sigma
        left = error - np.einsum("wri,wi->wr", z, mean)
        uncertain = np.einsum("wri,wij,wrj->wr", z, covariance, z, optimize=True)
        total = (left**2 + uncertain).sum(0)
        new = np.array([total[joint == j].sum() for j in range(n)]) / np.maximum(counted, 1)
        noise = np.maximum(np.where(counted > 0, np.sqrt(new), noise), 1e-6)
        determined = 1.0 - np.einsum("wii->wi", covariance) / sigma**2
        about = mean - mean.mean(0)
        sigma = np.maximum(np.sqrt((about**2).sum(0) / np.maximum(determined.sum(0), 1e-3)), min_sigma)
    return sigma, noise
