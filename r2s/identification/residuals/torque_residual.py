"""Torque residual (equation error): torque predicted at the measured motion minus recorded torque.

Link-side and motor torque include gravity and have no command to replay, so this is their only residual. For
commanded torque it is the fast start of a fit. Rows are in units of their own standard deviation, see `reweighted`.
"""

from copy import copy
from typing import Any

import numpy as np

from r2s.identification.parameters import OF_LINKS, WHOLE_ARM, ParameterSpace
from r2s.identification.residuals.modulating_functions import SlidingMotion
from r2s.identification.residuals.planned_motion import PlannedMotion
from r2s.identification.residuals.zero_phase import SmoothMotion
from r2s.physics.dynamics import Dynamics
from r2s.physics.friction import PRESLIDING, WIDTH_DQ
from r2s.physics.rigid_body import LinkInertia, mass_matrix, regressor, rigid_body
from r2s.recordings.recording import Recording

STEP = 1e-4  # of the unit cube: finite differences, far above round-off and far below the residual's curvature
MAX_CORRELATION = 40  # rows: a slowly drifting residual still counts as more than one row
MIN_SIGMA = 1e-9  # Nm
FULLY_BENT = 4.0  # presliding distances after which bristles are bent to 98 %
BLOCK_S = 0.5  # s, length of blocks with independent errors


class TorqueResidual:
    """Residual of any recording, zero-phase filtered, at `rate_hz`. Immutable: `on` and `reweighted` return copies.

    The rigid-body part is a product with a regressor computed once. Friction is evaluated at velocities with a higher
    cutoff and then filtered like the torque, because a filter rounds the step of friction at a reversal.

    Args:
        space, recording: the parameters, and the data, or a planned motion, which needs no filter.
        cutoff_hz, rate_hz: of the zero-phase filter, and of the rows.
        presliding_rad: distance over which bristles bend, one or (n,).
        slowest: rad/s. If positive, rows are means over windows in which a joint is faster and does not reverse
            (modulating_functions.py), weighted by their encoder noise.
    """

    def __init__(
        self,
        space: ParameterSpace,
        recording: Recording | PlannedMotion,
        *,
        cutoff_hz: float = 10.0,
        rate_hz: float = 100.0,
        presliding_rad: np.ndarray | float = PRESLIDING,
        slowest: float = 0.0,
    ):
        self.space, robot = space, space.robot
        m: SmoothMotion | SlidingMotion | PlannedMotion
        if isinstance(recording, PlannedMotion):
            m, self.seen, self._noise = recording, np.abs(recording.dq) >= slowest, np.zeros_like(recording.q)
        elif slowest:
            slid = FULLY_BENT * PRESLIDING if space.nominal.family.has_memory else 0.0
            m = sliding = SlidingMotion.of(recording, rate_hz, slowest, slid, presliding_rad)
            encoder_torque = m.rows(mass_matrix(robot, m.q) ** 2) @ sliding.encoder**2
            self.seen, self._noise = sliding.seen, sliding.noise * np.sqrt(encoder_torque)
        else:
            m = SmoothMotion.of(recording, cutoff_hz, rate_hz, presliding_rad)
            self.seen, self._noise = np.ones_like(m.q, dtype=bool), np.zeros_like(m.q)
        self.motion, self.commanded = m, recording.torque == "commanded"
        # a link-side sensor does not measure the torque that accelerates the rotors
        self._rotors = 0.0 if recording.torque == "measured" else m.rows(m.ddq)
        self.at_motor = recording.torque == "motor"
        gravity = None if self.commanded else robot.gravity
        rest, y = rigid_body(robot, m.q, m.dq, m.ddq, gravity)
        self._rest = m.rows(rest - robot.armature * m.ddq)  # the candidate adds its own rotors
        self._y = m.rows(y.reshape(*m.q.shape, -1))
        still = np.zeros_like(m.q)
        y = regressor(robot, m.q, still, still, robot.gravity)
        self._gravity = m.rows(y.reshape(*m.q.shape, -1))
        self._nominal = LinkInertia(robot.mass, robot.com, robot.inertia).standard().ravel()
        self._load = np.abs(self._gravity @ self._nominal)
        self._sin, self._cos = m.rows(np.sin(m.q)), m.rows(np.cos(m.q))
        # sign of friction, by has_memory; a sliding joint has its full friction however slow it is
        dq = m.friction_dq
        self._sign = {False: np.sign(dq) if slowest else np.tanh(dq / WIDTH_DQ), True: m.bristle}
        self._mean_sign = {memory: m.filtered(sign) for memory, sign in self._sign.items()}
        block = (m.t / BLOCK_S).astype(int)
        self.clusters = np.repeat(np.unique(block, return_inverse=True)[1], robot.n)
        self.lead_s, self._external = 0.0, np.zeros(1)
        self._weights = self._weights_at(space.start, fitted=False)

    def _with(self, **changes: Any) -> "TorqueResidual":
        other = copy(self)
        vars(other).update(changes)
        return other

    def on(self, space: ParameterSpace) -> "TorqueResidual":
        """Return this residual for another parameter space."""
        return self._with(space=space).reweighted(space.start, fitted=False)

    def with_lead(self, lead_s: float) -> "TorqueResidual":
        """Return this residual with friction evaluated `lead_s` ahead, see `implicit_friction` in problem.py."""
        return self._with(lead_s=lead_s)

    def within(self, kept: np.ndarray) -> "TorqueResidual":
        """Return this residual without the moments that are not `kept` (T,) bool."""
        return self._with(seen=self.seen & kept[:, None])

    def with_external(self, tau: np.ndarray) -> "TorqueResidual":
        """Return this residual for an arm on which its environment exerts the joint torque tau (T, n) Nm."""
        return self._with(_external=tau)

    def predict(self, dynamics: Dynamics) -> np.ndarray:
        """Return (T, n) Nm: torque of rigid bodies, rotors and friction minus offset, at the measured motion."""
        d, m = dynamics, self.motion
        standard = _standard(d).ravel()
        out = self._rest + self._y @ standard + d.armature * self._rotors
        if not self.commanded and not self.at_motor:  # a link-side sensor sits before friction
            out = out * (1.0 + d.gain)
        out += m.filtered(self._friction(d)) - d.offset
        if self.commanded:  # error of the gravity compensation
            out += self._gravity @ (standard - self._nominal)
        out -= d.drag[:, 0] * self._sin + d.drag[:, 1] * self._cos
        out += d.load * self._load * self._mean_sign[d.family.has_memory]
        return out * (1.0 + d.gain) if self.at_motor else out

    def _friction(self, d: Dynamics) -> np.ndarray:
        """Return (F, n) Nm, friction before filtering.

        A simulator that integrates friction implicitly uses the velocity of the step before, `lead_s` too old, and
        corrects it where friction rises.
        """
        m, sign = self.motion, self._sign[d.family.has_memory]
        if not self.lead_s:
            return d.friction(m.friction_dq, sign)
        old, coming = (m.friction_dq + s * self.lead_s * m.ddq for s in (-1.0, 1.0))
        way = np.sign(m.friction_dq)
        rises = (d.friction(coming, way) - d.friction(old, way)) * np.sign(m.ddq)
        return d.friction(old, sign) + np.maximum(rises, 0.0) * np.sign(m.ddq)

    def error(self, dynamics: Dynamics) -> np.ndarray:
        """Return (T, n) Nm, predicted minus recorded torque; a command is shifted to when it acts on the joints."""
        m, free = self.motion, self.predict(dynamics) - self._external
        return free - (m.command(float(dynamics.delay), float(dynamics.lag)) if self.commanded else m.tau)

    def errors(self, x: np.ndarray) -> np.ndarray:
        """Return `error` (C, T, n) for candidates x (C, P)."""
        d = self.space.dynamics(x)
        out = np.empty((len(x), *self._rest.shape))
        for i in range(len(x)):
            out[i] = self.error(d.one(i))
        return out

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """Return residuals (C, R), in standard deviations, for candidates x (C, P)."""
        return (self.errors(x) * (self.seen / self.scale)).reshape(len(x), -1)

    def jacobian(self, u: np.ndarray) -> np.ndarray:
        """Return the Jacobian (R, P) at u (P,) of the unit cube."""
        h = np.where(u > 0.5, -STEP, STEP)
        return self.change(self.space.from_unit(u), self.space.from_unit(u + h)) / h

    def change(self, x: np.ndarray, stepped: np.ndarray) -> np.ndarray:
        """Return (R, P): the change of the residual at x (P,) as each value in turn goes to `stepped` (P,).

        A dozen evaluations suffice: friction acts on its own joint, and torque is linear in standard parameters.
        """
        space, n = self.space, self.space.n
        d = space.dynamics(x)
        base, out = self.error(d), np.zeros((*self._rest.shape, len(x)))
        reach = self._y + self._gravity if self.commanded else self._y * (1.0 + d.gain)[:, None]
        before = _standard(d).ravel()
        for block in space.blocks:
            at = space.where(block)
            if block in OF_LINKS:
                trials = np.repeat(x[None], n, axis=0)
                trials[np.arange(n), at] = stepped[at]
                after = _standard(space.dynamics(trials)).reshape(n, -1)
                out[..., at] = reach @ (after - before).T
                continue
            trial = x.copy()
            trial[at] = stepped[at]
            moved = self.error(space.dynamics(trial)) - base
            if block in WHOLE_ARM:
                out[..., at[0]] = moved
            else:
                out[:, np.arange(n), at] = moved
        return (out * (self.seen / self.scale)[..., None]).reshape(-1, len(x))

    def reweighted(self, x: np.ndarray, fitted: bool) -> "TorqueResidual":
        """Return this residual in units of the standard deviation of an independent row at x (P,).

        Per joint this is the RMS at a `fitted` x, else half of it, times the square root of the correlation length.
        If the encoder noise is known, the RMS is that noise, larger for short windows, plus a constant.
        """
        return self._with(_weights=self._weights_at(x, fitted))

    def weighted_like(self, other: "TorqueResidual") -> "TorqueResidual":
        """Return this residual with the standard deviations of another one."""
        return self._with(_weights=other._weights)

    def _weights_at(self, x: np.ndarray, fitted: bool) -> tuple[np.ndarray, np.ndarray]:
        r = self.errors(x[None])[0] * self.seen
        constant = _constant_sigma(r, self._noise, self.seen)
        length = np.minimum(_correlation_length(r / np.sqrt(constant**2 + self._noise**2)), MAX_CORRELATION)
        return (1.0 if fitted else 0.5) * np.sqrt(length), constant

    @property
    def scale(self) -> np.ndarray:
        """(T, n) Nm, standard deviation of an independent row."""
        factor, constant = self._weights
        return factor * np.sqrt(constant**2 + self._noise**2)


def _standard(d: Dynamics) -> np.ndarray:
    """Return (..., n, 10) standard inertial parameters."""
    return LinkInertia(d.mass, d.com, d.inertia).standard()


def _constant_sigma(r: np.ndarray, noise: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Return (n,) Nm: the constant deviation that with noise (T, n) scales the residual r (T, n) to an RMS of 1."""
    count = np.maximum(seen.sum(0), 1)
    high = np.maximum((r**2).sum(0) / count, MIN_SIGMA**2)
    low = np.full_like(high, MIN_SIGMA**2)
    for _ in range(40 if noise.any() else 0):
        middle = np.sqrt(low * high)
        more = (r**2 / (noise**2 + middle)).sum(0) > count
        low, high = np.where(more, middle, low), np.where(more, high, middle)
    return np.sqrt(high)


def _correlation_length(r: np.ndarray) -> np.ndarray:
    """Return (n,) rows: the lag at which the autocorrelation of r (T, n) first falls below 1/e."""
    centred = r - r.mean(0)
    out = np.ones(r.shape[1])
    for j, x in enumerate(centred.T):
        power = np.abs(np.fft.rfft(x, 2 * len(x))) ** 2
        correlation = np.fft.irfft(power)[: len(x)]
        below = np.flatnonzero(correlation < correlation[0] / np.e)
        out[j] = below[0] if len(below) else len(x)
    return out
