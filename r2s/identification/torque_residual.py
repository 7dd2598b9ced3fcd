"""What a candidate gets wrong of torque, at the measured motion.

For measured link-side torque and for motor torque (both with gravity) there is no command to replay, so the residual
is the torque that rigid dynamics, friction and offset predict against the recorded one. A link-side sensor does not
feel rotors. The residual exists for commanded torque, too, where it is a fast start. In units of its own standard
deviation, as far as `adapt` could tell it.
"""

from copy import copy

import numpy as np

from r2s.identification.parameters import OF_LINKS, WHOLE_ARM, ParameterSpace
from r2s.identification.sliding_motion import SlidingMotion
from r2s.identification.smooth_motion import SmoothMotion
from r2s.physics.dynamics import Dynamics
from r2s.physics.friction import PRESLIDING, WIDTH_DQ
from r2s.physics.rigid_body import LinkInertia, mass_matrix, regressor, rigid_body
from r2s.physics.robot import Robot
from r2s.recordings.recording import Recording

STEP = 1e-4  # of the unit cube: far above round-off, far below the residual's curvature
LONGEST = 40  # rows: a residual that drifts slowly is not one single row
LEAST = 1e-9  # Nm, of a deviation
BENT = 4.0  # presliding distances, after which bristles are as bent as they get: all but 2 %
BLOCK_S = 0.5  # s, stretches whose errors count as independent


class TorqueResidual:
    """Residual of any recording: predicted minus recorded torque, zero-phase filtered, at `rate_hz`.

    The rigid part is a product with a regressor made once. Friction is evaluated at less smoothed velocities and then
    filtered as the torque was, because a filter rounds the step of friction at a reversal. With `slowest`, rad/s,
    rows are means over windows in which a joint is faster and does not turn, and count by how noisy they are.
    """

    def __init__(
        self,
        robot: Robot,
        space: ParameterSpace,
        recording: Recording,
        *,
        cutoff_hz: float = 10.0,
        rate_hz: float = 100.0,
        block_s: float = BLOCK_S,
        presliding_rad: np.ndarray | float = PRESLIDING,
        slowest: float = 0.0,
    ):
        self.space = space
        m: SmoothMotion | SlidingMotion
        if slowest:
            bends = BENT * PRESLIDING if space.nominal.family.has_memory else 0.0
            m = sliding = SlidingMotion.of(recording, rate_hz, slowest, bends, presliding_rad)
            carried = m.rows(mass_matrix(robot, m.q) ** 2) @ sliding.encoder**2
            self.seen, self._noise = sliding.seen, sliding.noise * np.sqrt(carried)
        else:
            m = SmoothMotion.of(recording, cutoff_hz, rate_hz, presliding_rad)
            self.seen, self._noise = np.ones_like(m.q, dtype=bool), np.zeros_like(m.q)
        self.motion, self.commanded = m, recording.torque == "commanded"
        # a link-side sensor does not feel rotors
        self._rotors = 0.0 if recording.torque == "measured" else m.rows(m.ddq)
        self.at_motor = recording.torque == "motor"
        gravity = None if self.commanded else robot.gravity
        rest, y = rigid_body(robot, m.q, m.dq, m.ddq, gravity)
        self._rest = m.rows(rest - robot.armature * m.ddq)  # rotors are the candidate's
        self._y = m.rows(y.reshape(*m.q.shape, -1))
        still = np.zeros_like(m.q)
        y = regressor(robot, m.q, still, still, robot.gravity)
        self._gravity = m.rows(y.reshape(*m.q.shape, -1))
        self._nominal = LinkInertia(robot.mass, robot.com, robot.inertia).standard().ravel()
        self._load = np.abs(self._gravity @ self._nominal)
        self._sin, self._cos = m.rows(np.sin(m.q)), m.rows(np.cos(m.q))
        # by has_memory; a joint that slides has all of its friction, however slow: no law turns in such rows
        self._way = {False: np.sign(m.fast) if slowest else np.tanh(m.fast / WIDTH_DQ), True: m.bristle}
        self._sign = {memory: m.filtered(way) for memory, way in self._way.items()}
        block = (m.t / block_s).astype(int)
        self.clusters = np.repeat(np.unique(block, return_inverse=True)[1], robot.n)
        self.ahead = 0.0  # s, half a step of a simulator that made the recording: `answers_early`
        self.candidates = 0
        self._scale = np.ones_like(self._rest)
        self.adapt(space.start, fitted=False)

    def on(self, space: ParameterSpace) -> "TorqueResidual":
        """Return this residual for candidates of another space."""
        other = copy(self)
        other.space = space
        other.adapt(space.start, fitted=False)
        return other

    def predict(self, dynamics: Dynamics) -> np.ndarray:
        """Return (T, n) Nm: rigid bodies and rotors + friction - offset at the measured motion, of one arm."""
        d, m = dynamics, self.motion
        standard = self._standard(d).ravel()
        out = self._rest + self._y @ standard + d.armature * self._rotors
        if not self.commanded and not self.at_motor:  # the sensor sits before what is added below
            out = out * (1.0 + d.gain)
        out += m.filtered(self._friction(d)) - d.offset
        if self.commanded:  # what the compensation leaves
            out += self._gravity @ (standard - self._nominal)
        out -= d.drag[:, 0] * self._sin + d.drag[:, 1] * self._cos
        out += d.load * self._load * self._sign[d.family.has_memory]
        return out * (1.0 + d.gain) if self.at_motor else out

    def _friction(self, d: Dynamics) -> np.ndarray:
        """Return (F, n) Nm: friction at the fast velocities.

        A simulator's step knows the velocity of the step before, `ahead` s too old, and makes up for it where
        friction rises: it solves for that at the step's end.
        """
        m, bristle = self.motion, self._way[d.family.has_memory]
        if not self.ahead:
            return d.friction(m.fast, bristle)
        old, coming = (m.fast + s * self.ahead * m.ddq for s in (-1.0, 1.0))
        way = np.sign(m.fast)
        rises = (d.friction(coming, way) - d.friction(old, way)) * np.sign(m.ddq)
        return d.friction(old, bristle) + np.maximum(rises, 0.0) * np.sign(m.ddq)

    def error(self, x: np.ndarray) -> np.ndarray:
        """Return (C, T, n) Nm, predicted minus recorded, the recorded one as late as the joints feel it."""
        self.candidates += len(x)
        out = np.empty((len(x), *self._rest.shape))
        d = self.space.dynamics(x)
        for i in range(len(x)):
            out[i] = self.off(d.one(i))
        return out

    def off(self, dynamics: Dynamics) -> np.ndarray:
        """Return (T, n) Nm, predicted minus recorded, of one arm."""
        if not self.commanded:
            return self.predict(dynamics) - self.motion.tau
        return self.predict(dynamics) - self.motion.felt(float(dynamics.delay), float(dynamics.lag))

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """Return residuals (C, R), in standard deviations, for candidates x (C, P)."""
        return (self.error(x) * (self.seen / self._scale)).reshape(len(x), -1)

    def jacobian(self, u: np.ndarray) -> np.ndarray:
        """Return (R, P), the Jacobian at u (P,) on the unit cube."""
        h = np.where(u > 0.5, -STEP, STEP)
        return self.change(self.space.from_unit(u), self.space.from_unit(u + h)) / h

    def change(self, x: np.ndarray, stepped: np.ndarray) -> np.ndarray:
        """Return (R, P): what the residual at x (P,) changes by as each value in turn goes to `stepped` (P,).

        The same as P calls with one value changed, but joints do not see each other's friction and the torque is
        linear in standard parameters, so a dozen evaluations do.
        """
        space, n = self.space, self.space.n
        d = space.dynamics(x)
        base, out = self.off(d), np.zeros((*self._rest.shape, len(x)))
        reach = self._y + self._gravity if self.commanded else self._y * (1.0 + d.gain)[:, None]
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
        return (out * (self.seen / self._scale)[..., None]).reshape(-1, len(x))

    def _standard(self, d: Dynamics) -> np.ndarray:
        """Return (..., n, 10) standard parameters."""
        return LinkInertia(d.mass, d.com, d.inertia).standard()

    def adapt(self, x: np.ndarray, fitted: bool) -> None:
        """Set what counts as one standard deviation of an independent row, per joint.

        It is the RMS at a `fitted` x (P,), else half of it, times how many rows in a row say the same thing. Where
        the encoder's noise is known the RMS is what it makes of the rows, short ones more, and one constant beside.
        """
        r = self.error(x[None])[0] * self.seen
        beside = _beside(r, self._noise, self.seen)
        alike = np.minimum(_correlation_length(r / np.sqrt(beside**2 + self._noise**2)), LONGEST)
        self._weigh((1.0 if fitted else 0.5) * np.sqrt(alike), beside)

    def weigh_like(self, other: "TorqueResidual") -> None:
        """Take the standard deviations that `other` found."""
        self._weigh(*other._weighed)

    def _weigh(self, factor: np.ndarray, beside: np.ndarray) -> None:
        self._weighed = factor, beside
        self._scale = factor * np.sqrt(beside**2 + self._noise**2)


def _beside(r: np.ndarray, noise: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Return (n,) Nm: the deviation that beside noise (T, n) gives the residual r (T, n) an RMS of 1."""
    count = np.maximum(seen.sum(0), 1)
    high = np.maximum((r**2).sum(0) / count, LEAST**2)
    low = np.full_like(high, LEAST**2)
    for _ in range(40 if noise.any() else 0):
        middle = np.sqrt(low * high)
        more = (r**2 / (noise**2 + middle)).sum(0) > count
        low, high = np.where(more, middle, low), np.where(more, high, middle)
    return np.sqrt(high)


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
