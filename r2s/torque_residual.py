"""What a candidate gets wrong of torque, at the measured motion.

For measured link-side torque (with gravity) there is no command to replay, so the residual is the torque that rigid
dynamics, friction and offset predict against the measured one. It exists for commanded torque, too, where it is a
fast start. In units of its own standard deviation, as far as `adapt` could tell it.
"""

from copy import copy
from dataclasses import dataclass

import numpy as np
from scipy.signal import butter, sosfiltfilt
from scipy.sparse import csr_array

from r2s.errors import UserError
from r2s.friction import BRISTLE, PRESLIDING, WIDTH_DQ, presliding
from r2s.parameters import OF_LINKS, WHOLE_ARM, ParameterSpace
from r2s.recording import Recording
from r2s.regressor import GRAVITY, Links, regressor, rigid_body
from r2s.robot import SIM_DT, Robot
from r2s.simulator import Dynamics

LONGEST = 40  # rows: a residual that drifts slowly is not one single row
BLOCK_S = 0.5  # s, stretches that the bootstrap draws
FRICTION_HZ = 500  # friction is evaluated this often, then filtered as the torque is
FRICTION_CUTOFF = 4.0  # of the velocity that friction is evaluated at, over that of the torque


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
            out[i] = self.off(d.one(i))
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
