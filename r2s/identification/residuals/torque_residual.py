"""Torque residual (equation error): torque predicted at the measured motion minus recorded torque.

For link-side and motor torque, r2s minimizes only the torque residual, because only commands can be replayed. For
commanded torque, a fast fit of the torque residual can precede replays. Residuals are in standard deviations.
"""

from collections.abc import Iterator
from copy import copy
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from r2s.identification.blocks import BLOCK_S, blocks_of
from r2s.identification.parameters import OF_LINKS, WHOLE_ARM, ParameterSpace
from r2s.identification.residuals.modulating_functions import SlidingMotion
from r2s.identification.residuals.planned_motion import PlannedMotion
from r2s.identification.residuals.rigid_body_rows import RigidBodyRows
from r2s.identification.residuals.zero_phase import EDGE_S, SmoothMotion
from r2s.physics.dynamics import Dynamics
from r2s.physics.friction import PRESLIDING, WIDTH_DQ
from r2s.physics.rigid_body import LinkInertia
from r2s.physics.robot import SIM_DT, Robot
from r2s.recordings.lateness import from_q, lateness
from r2s.recordings.parts import give_back, pieces
from r2s.recordings.recording import Recording

STEP = 1e-4  # finite-difference step on the unit cube: far above round-off, too small for curvature to matter
MAX_CORRELATION = 40  # rows, limit of the correlation length, so that rows with slow drift have some weight
MIN_SIGMA = 1e-9  # Nm
MOST_ROWS = 30_000  # recordings above 5 min (at 100 Hz) get fewer rows per s; for a cutoff of 10 Hz, 20 per s suffice
PIECE_S = 60.0  # s, pieces of a recording that are filtered one after another
AT_ONCE = 8  # candidates whose link torques are computed in one pass over the regressor
PART = 2048  # number of moments whose Jacobian is in memory at once
# slide, in presliding distances, after which bristles are bent to 98 % (from rest) or 96 % (from a reversal)
FULLY_BENT = 4.0


class TorqueResidual:
    """Immutable torque residual of a zero-phase filtered recording.

    The constructor computes the regressor of rigid-body torque once. Friction is computed from velocities with a
    higher cutoff, then filtered like recorded torque, so that friction and torque change equally fast at a reversal.

    Args:
        space: the parameters to estimate. recording: a recording, or a planned motion, which needs no filter.
        cutoff_hz: cutoff of the zero-phase filter. rate_hz: residual rows per second.
        presliding_rad: presliding distance in rad, a number or (n,).
        slowest: rad/s. If positive, each row of a recording is a mean over a window in which the joint is faster than
            `slowest` and does not reverse (modulating_functions.py). The weight of such a row accounts for encoder
            noise. If `slowest` is 0, each row is a sample of the zero-phase filtered recording.
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
        self.space, self._period = space, None if isinstance(recording, PlannedMotion) else recording.period
        self.commanded, self.at_motor = recording.torque == "commanded", recording.torque == "motor"
        robot = space.robot
        if isinstance(recording, Recording):
            rate_hz = min(rate_hz, MOST_ROWS / recording.duration)
            slid = FULLY_BENT * PRESLIDING if space.nominal.family.has_memory else 0.0
            if slowest:
                of: Any = partial(SlidingMotion.of, slowest=slowest, slid=slid)
            else:
                # for commanded torque, use the derivative of q: logged dq is late, by a filter's delay or by a step
                late = from_q(robot.n) if self.commanded else lateness(recording, cutoff_hz)
                late = late.as_logged if space.nominal.late_alike else late
                of = partial(SmoothMotion.of, cutoff_hz=cutoff_hz, late=late)
            self._of = partial(of, rate_hz=rate_hz, presliding_rad=presliding_rad)
            m, self._rigid = _joined(robot, recording, self._of)
        else:
            m, self._rigid = recording, RigidBodyRows.of(robot, recording, recording.torque)  # type: ignore[arg-type]
        self.motion: SmoothMotion | SlidingMotion | PlannedMotion = m
        sliding = isinstance(m, SlidingMotion)
        self.seen: np.ndarray = m.seen if sliding else np.abs(m.dq) >= slowest * isinstance(m, PlannedMotion)
        self._noise: np.ndarray = self._rigid.encoder * (m.noise if sliding else 1.0)
        self._sin, self._cos = m.rows(np.sin(m.q)), m.rows(np.cos(m.q))
        self._sharp = bool(slowest)
        self._mean_sign = {memory: m.filtered(self._sign(memory, slice(None))) for memory in (False, True)}
        self.block = blocks_of(m.t, self._rigid.q, self._period)
        # blocks of held-out rows; trajectories share blocks of equal time, so that short ones do not dominate
        self.half_second: np.ndarray = np.unique(np.floor(m.t / BLOCK_S), return_inverse=True)[1]
        self.lead_s, self._external = 0.0, np.zeros(1)
        self._weights = self._weights_at(self._seen_errors(space.start), fitted=False)

    @property
    def clusters(self) -> np.ndarray:
        """(R,) block of each row; errors in different blocks are treated as independent."""
        return np.repeat(self.block, self.space.n)

    @property
    def row_s(self) -> float:
        """Median time between rows in s, rounded to milliseconds."""
        return SIM_DT * max(1, round(float(np.median(np.diff(self.motion.t))) / SIM_DT))

    def _with(self, **changes: Any) -> "TorqueResidual":
        other = copy(self)
        vars(other).update(changes)
        return other

    def on(self, space: ParameterSpace) -> "TorqueResidual":
        """Return a copy for the parameter space `space`, reweighted at the start values of `space`."""
        return self._with(space=space).reweighted(space.start, fitted=False)

    def with_lead(self, lead_s: float) -> "TorqueResidual":
        """Return a copy for a simulator with implicit friction; see `_friction` for the time `lead_s` in s."""
        return self._with(lead_s=lead_s)

    def with_presliding(self, recording: Recording, presliding_rad: np.ndarray) -> "TorqueResidual":
        """Return a copy with the presliding distances `presliding_rad` (n,) rad.

        The method computes the bristle deflections anew from `recording`, the recording of this residual. The copy
        has the weights of an unfitted residual. It shares the other arrays with this residual to save memory.
        """
        of = partial(self._of, presliding_rad=presliding_rad)
        bristle = np.concatenate([of(piece).bristle for piece in _pieces(recording, of)])
        give_back(recording)
        m = replace(self.motion, bristle=bristle)  # type: ignore[arg-type, type-var]
        mean, block = self._mean_sign | {True: m.filtered(bristle)}, blocks_of(m.t, self._rigid.q, self._period)
        return self._with(motion=m, _mean_sign=mean, block=block).on(self.space)

    def within(self, kept: np.ndarray) -> "TorqueResidual":
        """Return a copy restricted to the sample times at which `kept` (T,) is true."""
        return self._with(seen=self.seen & kept[:, None])

    def with_external(self, tau: np.ndarray) -> "TorqueResidual":
        """Return a copy for an arm on which the environment exerts joint torques tau (T, n) Nm."""
        return self._with(_external=tau)

    def predict(self, dynamics: Dynamics, known: "_Known | None" = None) -> np.ndarray:
        """Return the torque (T, n) Nm of rigid bodies, rotors, friction and other terms at the measured motion.

        known: torques of an earlier evaluation; a torque is reused if the parameters on which it depends have not
        changed.
        """
        d, own = dynamics, self._known(dynamics, known)
        # a link-side sensor's gain does not scale friction
        out = own.rigid.copy() if self.commanded or self.at_motor else own.rigid * (1.0 + d.gain)
        out += own.friction - d.offset
        out -= d.drag[:, 0] * self._sin + d.drag[:, 1] * self._cos
        out += d.load * self._rigid.load * self._mean_sign[d.family.has_memory]
        return out * (1.0 + d.gain) if self.at_motor else out

    def _known(self, d: Dynamics, like: "_Known | None" = None, links: np.ndarray | None = None) -> "_Known":
        """Return the torques that are slow to compute; reuse torques in `like` whose parameters have not changed.

        links: (T, n) Nm, torque of the links of `d`; if None, the method computes this torque.
        """
        m, rigid, standard = self.motion, self._rigid, _standard(d).ravel()
        if like and np.array_equal(standard, like.standard) and np.array_equal(d.armature, like.armature):
            torque = like.rigid
        else:
            links = rigid.y @ standard if links is None else links
            torque = rigid.rest + links + d.armature * rigid.rotors
        if like and np.array_equal(d.phi, like.phi):
            friction = like.friction
        else:
            of = partial(self._friction, d)
            friction = m.filtered(of(slice(None))) if isinstance(m, PlannedMotion) else m.filtered(of)
        late = float(d.delay), float(d.lag), float(d.signal_delay)
        recorded = like.recorded if like and late == like.late else self._recorded(*late)
        return _Known(standard, d.armature, torque, d.phi, friction, late, recorded)

    def _recorded(self, delay: float, lag: float, signal_delay: float) -> np.ndarray:
        """Return the recorded commands (T, n) Nm after hold, delay and lag, or measured torque without its delay."""
        m = self.motion
        if self.commanded:
            return m.command(delay, lag)
        return m.earlier(-signal_delay) if signal_delay and isinstance(m, SmoothMotion) else m.tau

    def _sign(self, memory: bool, rows: slice) -> np.ndarray:
        """Return the sign of friction at a slice of the F instants; memory: whether the friction law has a memory."""
        if memory:
            return self.motion.bristle[rows]
        dq = self.motion.friction_dq[rows]  # in windows without stops, friction has fully changed sign
        return np.sign(dq) if self._sharp else np.tanh(dq / WIDTH_DQ)

    def _friction(self, d: Dynamics, rows: slice) -> np.ndarray:
        """Return the unfiltered friction torque in Nm at a slice of the F instants.

        A simulator with implicit integration evaluates friction at the velocity of another instant: `lead_s` later
        if friction rises with speed, else `lead_s` earlier.
        """
        dq, sign = self.motion.friction_dq[rows], self._sign(d.family.has_memory, rows)
        if not self.lead_s:
            return d.friction(dq, sign)
        ddq, way = self.motion.ddq[rows], np.sign(dq)
        old, coming = (dq + s * self.lead_s * ddq for s in (-1.0, 1.0))
        rises = (d.friction(coming, way) - d.friction(old, way)) * np.sign(ddq)
        return d.friction(old, sign) + np.maximum(rises, 0.0) * np.sign(ddq)

    def error(self, dynamics: Dynamics, known: "_Known | None" = None) -> np.ndarray:
        """Return predicted minus recorded torque (T, n) Nm, for commands after hold, delay and lag."""
        own = self._known(dynamics, known)
        return self.predict(dynamics, own) - self._external - own.recorded

    def errors(self, x: np.ndarray) -> np.ndarray:
        """Return the torque errors (C, T, n) Nm of candidates x (C, P)."""
        d = self.space.dynamics(x)
        out = np.empty((len(x), *self.seen.shape))
        standard = _standard(d).reshape(-1, 10 * self.space.n)  # one row if x has no parameters of links
        for i in range(len(x)):
            one, k = d.one(i), i % AT_ONCE
            if k == 0 and i < len(standard):
                links = self._rigid.y @ standard[i : i + AT_ONCE].T
            out[i] = self.error(one, self._known(one, links=links[..., min(k, len(standard) - 1)]))
        return out

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """Return the residuals (C, R), in standard deviations, of candidates x (C, P)."""
        return (self.errors(x) * (self.seen / self.scale)).reshape(len(x), -1)

    def jacobian(self, u: np.ndarray) -> np.ndarray:
        """Return the Jacobian (R, P) with respect to u (P,) on the unit cube."""
        return np.concatenate([j for _, j in self.linearize(u)])

    def linearize(self, u: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Yield residual (r,) and Jacobian (r, P) at u (P,) on the unit cube, in parts of r rows."""
        h = np.where(u > 0.5, -STEP, STEP)
        x, stepped = self.space.from_unit(u), self.space.from_unit(u + h)
        error, changes = self._changes(x, stepped)
        r = error * (self.seen / self.scale)
        for first in range(0, len(self.seen), PART):
            rows = slice(first, first + PART)
            yield r[rows].ravel(), self._assembled(changes, rows, len(x)) / h

    def change(self, x: np.ndarray, stepped: np.ndarray) -> np.ndarray:
        """Return changes (R, P) of the residual; in column k, only parameter k changes from x (P,) to `stepped`."""
        return self._assembled(self._changes(x, stepped)[1], slice(None), len(x))

    def _changes(
        self, x: np.ndarray, stepped: np.ndarray
    ) -> tuple[np.ndarray, list[tuple[str, np.ndarray, np.ndarray]]]:
        """Return the torque error (T, n) at x, and a list of (parameter block, indices in x, change).

        If one block steps from x to `stepped`, torque changes by `change` (T, n). For L link parameters, `change` is
        instead the change of standard parameters (n, 10 n, L), times 1 + gain of each joint. Torque is linear in
        standard parameters, so link parameters need no further evaluation of torque. Other parameters of a joint,
        such as its friction, affect only this joint's torque, so one evaluation steps all joints at once.
        """
        space, n = self.space, self.space.n
        d, places = space.dynamics(x), [space.where(block) for block in space.blocks]
        known = self._known(d)
        base, before = self.error(d, known), known.standard
        out: list[tuple[str, np.ndarray, np.ndarray]] = []
        gain = np.zeros(n) if self.commanded else d.gain
        links = [at for block, at in zip(space.blocks, places, strict=True) if block in OF_LINKS]
        if links:
            at = np.concatenate(links)
            trials = np.repeat(x[None], len(at), axis=0)
            trials[np.arange(len(at)), at] = stepped[at]
            after = _standard(space.dynamics(trials)).reshape(len(at), -1)
            out.append((OF_LINKS[0], at, (1.0 + gain)[:, None, None] * (after - before).T))
        rest = [(block, at) for block, at in zip(space.blocks, places, strict=True) if block not in OF_LINKS]
        trials = np.repeat(x[None], len(rest), axis=0)
        for trial, (_, at) in zip(trials, rest, strict=True):
            trial[at] = stepped[at]
        moved = space.dynamics(trials)
        out += [(block, at, self.error(moved.one(k), known) - base) for k, (block, at) in enumerate(rest)]
        return base, out

    def _assembled(self, changes: list, rows: slice, count: int) -> np.ndarray:
        """Return changes (rows n, P) of the residual, in standard deviations, for the sample times `rows`."""
        n, y, weight = self.space.n, self._rigid.y[rows], self.seen[rows] / self.scale[rows]
        out = np.zeros((len(y), n, count))
        for block, at, change in changes:
            if block in OF_LINKS:
                for j in range(n):
                    out[:, j, at] = weight[:, j, None] * (y[:, j] @ change[j])
            elif block in WHOLE_ARM:
                out[..., at[0]] = weight * change[rows]
            else:
                out[:, np.arange(n), at] = weight * change[rows]
        return out.reshape(-1, count)

    def reweighted(self, x: np.ndarray, fitted: bool) -> "TorqueResidual":
        """Return a copy with rows divided by their standard deviation, estimated from the error at x (P,).

        A joint's standard deviation is the RMS error times the square root of the correlation length; unless x was
        `fitted`, this product is halved. For means over windows, the standard deviation also contains encoder noise,
        which is larger in short windows. If x was `fitted`, the correlation of the error determines the length of
        blocks.
        """
        r = self._seen_errors(x)
        own = {"block": blocks_of(self.motion.t, self._rigid.q, self._period, r)} if fitted else {}
        return self._with(_weights=self._weights_at(r, fitted), **own)

    def noise_at(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return correlation length (n,), in rows, and RMS (n,) Nm of the error at x (P,).

        The RMS does not contain the part of the error that encoder noise explains.
        """
        factor, constant = self._weights_at(self._seen_errors(x), True)
        return factor**2, constant

    def rigid_body_of_last_link(self) -> np.ndarray:
        """Return torque (T, n, 10) per unit of each standard parameter of an undeclared body on the last link."""
        return self._rigid.y[..., -10:]

    def weighted_like(self, other: "TorqueResidual") -> "TorqueResidual":
        """Return a copy with the standard deviations of the residual `other`."""
        return self._with(_weights=other._weights)

    def _seen_errors(self, x: np.ndarray) -> np.ndarray:
        return self.errors(x[None])[0] * self.seen

    def _weights_at(self, r: np.ndarray, fitted: bool) -> tuple[np.ndarray, np.ndarray]:
        constant = _constant_sigma(r, self._noise, self.seen)
        length = np.minimum(_correlation_length(r / np.sqrt(constant**2 + self._noise**2)), MAX_CORRELATION)
        return (1.0 if fitted else 0.5) * np.sqrt(length), constant

    @property
    def scale(self) -> np.ndarray:
        """(T, n) Nm, standard deviation by which each row is divided."""
        factor, constant = self._weights
        return factor * np.sqrt(constant**2 + self._noise**2)


class _Known(NamedTuple):
    """Rigid-body, friction and recorded torque (T, n) Nm, and the parameters on which these torques depend."""

    standard: np.ndarray
    armature: np.ndarray
    rigid: np.ndarray
    phi: np.ndarray
    friction: np.ndarray
    late: tuple[float, float, float]
    recorded: np.ndarray


def _joined(robot: Robot, recording: Recording, of: "partial[Any]") -> tuple[Any, RigidBodyRows]:
    """Filter a recording piece by piece with the function `of`; return the joined motion and rigid-body torque."""
    motions = [of(piece) for piece in _pieces(recording, of)]
    rigid = RigidBodyRows.joined([RigidBodyRows.of(robot, m, recording.torque) for m in motions])
    joined = type(motions[0]).joined(motions)
    del motions
    give_back(recording)
    return joined, rigid


def _pieces(recording: Recording, of: "partial[Any]") -> Iterator[Recording]:
    """Yield overlapping pieces of a recording; the filter `of` removes the overlap."""
    return pieces(recording, PIECE_S, 2 * EDGE_S - 1 / of.keywords["rate_hz"])


def _standard(d: Dynamics) -> np.ndarray:
    """Return the links' standard inertial parameters (..., n, 10)."""
    return LinkInertia(d.mass, d.com, d.inertia).standard()


def _constant_sigma(r: np.ndarray, noise: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Return the constant sigma (n,) Nm with which r (T, n) / sqrt(sigma^2 + noise^2) has an RMS of 1."""
    count = np.maximum(seen.sum(0), 1)
    high = np.maximum((r**2).sum(0) / count, MIN_SIGMA**2)
    low = np.full_like(high, MIN_SIGMA**2)
    for _ in range(40 if noise.any() else 0):
        middle = np.sqrt(low * high)
        more = (r**2 / (noise**2 + middle)).sum(0) > count
        low, high = np.where(more, middle, low), np.where(more, high, middle)
    return np.sqrt(high)


def _correlation_length(r: np.ndarray) -> np.ndarray:
    """Return the lag (n,), in rows, at which the autocorrelation of r (T, n) first falls below 1/e."""
    centred = r - r.mean(0)
    out = np.ones(r.shape[1])
    for j, x in enumerate(centred.T):
        power = np.abs(np.fft.rfft(x, 2 * len(x))) ** 2
        correlation = np.fft.irfft(power)[: len(x)]
        below = np.flatnonzero(correlation < correlation[0] / np.e)
        out[j] = below[0] if len(below) else len(x)
    return out
