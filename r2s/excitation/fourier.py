"""Motions worth recording: Fourier series chosen for what they tell about an arm, run through a ladder of speeds.

The finite Fourier series is Swevers et al., IEEE T-RA 13(5), 1997; choosing it by the determinant of the information
matrix (D-optimality) too, here with a prior, so that what a short motion cannot tell does not spoil the measure.
Friction curves and delay need more than a series of one pace gives: a clock leads the series through a ladder from
crawling to full speed, turns back on the slow rungs, where every joint then reverses at low speed, and stands still
between the rungs.
"""

from collections.abc import Callable
from functools import partial

import numpy as np

from r2s.errors import UserError
from r2s.excitation.motion import Excitation
from r2s.excitation.safety import (
    GEOMETRY_HZ,
    TABLE_M,
    TOOL_M,
    TORQUE_SHARE,
    Motion,
    Space,
    check_motion,
    gravity_torque,
    torque_share,
)
from r2s.physics.rigid_body import LinkInertia, regressor, six
from r2s.physics.robot import SIM_DT, Robot

# the ladder of paces, 1: full speed
SLOWEST = 0.1
TURNS_BELOW = 0.4  # a rung slower than this goes back part of its way
RUNG_S = 4.0  # about, with its hold
SHORT = 0.3, 0.8  # where there is time for one rung only: slow and fast, without a hold
LADDER = 6  # rungs at most, then the next ladder begins
BLEND_S = 0.4  # between two paces
HOLD_S = 0.4  # at rest between two rungs
ENDS_S = 0.2  # at rest at both ends
LONGEST_S = 120.0
LEAST_S = 5 * BLEND_S
# the series
TOP_HZ = 1.0  # of its own time
FALL = 1.5  # of the amplitude with the harmonic: position range from the low ones, acceleration from the high
SHORTEST_S = 4.0  # fundamental period, at least
RANGE = 0.8  # of the way from the centre to the nearer position limit, or of half a turn
SPEED = 0.65  # of dq_max
ACCELERATION = 0.7  # of ddq_max
STUCK_S = 0.12  # a light joint may stick so long where it reverses, and then catches up: faster by that much
# the search
DRAWS = 12
KEPT = 3  # of them are made safe
TRIES = 5  # changes at a time
LEAST = 0.3  # of a joint's amplitude; what needs less to be safe is dropped
MARGIN = 0.3  # of each clearance, and 0.03 of tau_max: for what lies between two samples
WAY_STEPS = 40  # postures on the straight way from q_home to the first one, which is to be free
FINE = 10  # samples for limits per sample for information and safety
COARSE_HZ = 10
BLOCK = 5000  # rows of the basis at a time
# the measure of information
NOISE = 0.002  # of tau_max, in a sample
FRICTION_PRIOR = 0.05  # of tau_max, standard deviation of each friction coefficient
DRAG_PRIOR = 0.01  # of tau_max, of a torque that goes with the sine of the angle, as a cable's
MASS_PRIOR = 0.03, 0.005  # of a link's mass; m, of its centre
SCALE_PRIOR = 0.3  # of a link's tensor, or of its trace
DELAY_PRIOR = 3e-3  # s
SLOPE = 0.05  # of dq_max, about where friction changes sign
RESTING = 1e-3  # of dq_max; below, a joint may be stuck and its torque says nothing


Moved = tuple[np.ndarray, ...]  # three: offset from the centre, velocity, acceleration


def fourier(
    robot: Robot,
    *,
    duration: float,
    seed: int,
    gravity: bool = False,
    effort: int = 200,
    q_center: np.ndarray | None = None,
    table: float = TABLE_M,
    z_min: float = TOOL_M,
) -> Excitation:
    """Return a motion that is safe by `motion_checks.check_motion` and tells much about the arm.

    Random series, each joint as large as 80 % of the position range, 65 % of the velocity limit, 70 % of the
    acceleration limit and what is around allow, then a local search for more `information`. The series' period is
    longer than the way its clock goes: the motion does not repeat itself, `Recording.period` stays None. The same
    arguments give the same motion; how fast the machine is does not matter.

    Args:
        robot: its limits, links and nominal model.
        duration: s, ends included.
        seed: of the draws; another seed is another motion.
        gravity: what to find out, as in `information`.
        effort: motions tried by the local search; 0: a random draw as it is.
        q_center: (n,) rad, the posture moved about; the middle of the position range by default.
        table: m, height of the table in the base frame; -inf where there is none.
        z_min: m, least height of the end effector, which carries what the MJCF does not show.

    Raises:
        UserError: an argument out of range, or no draw is safe.

    """
    if not LEAST_S <= duration <= LONGEST_S:
        raise UserError(f"excitation.duration={duration:g} s is not allowed; {LEAST_S:g} to {LONGEST_S:g} s are")
    if effort < 0:
        raise UserError(f"excitation.effort={effort} must not be negative")
    center = 0.5 * np.add(*robot.q_range) if q_center is None else np.asarray(q_center, dtype=float)
    _check_center(robot, center)
    space = Space(robot, table=table, z_min=z_min)
    space.check(np.array([robot.q_home, center]), lambda k: ("at robot.q_home", "at excitation.q_center")[k])
    family = _Family(robot, center, duration, gravity, space)
    rng = np.random.default_rng(seed)
    best = family.draw(rng, KEPT if effort else 1)
    motion = family.finish(*family.climb(rng, best, effort)) if best else None
    if motion is None:
        raise UserError(
            f"excitation: no motion about q_center={np.round(center, 3).tolist()} keeps clear of the table at "
            f"{table:g} m, of the arm itself and of {100 * TORQUE_SHARE:g} % of tau_max, with the end effector "
            f"{z_min:g} m above the base plane; give another excitation.q_center"
        )
    check_motion(robot, motion, table=table, z_min=z_min)
    return motion


def information(robot: Robot, motion: Motion, *, gravity: bool = False) -> float:
    """Return what a recording of this motion tells, in nats: half the log det of posterior over prior precision.

    The unknowns, with independent normal priors: per joint an offset, Coulomb friction as a tanh, its width, its
    shift, viscous friction, and a drag that goes with the angle; per link mass and centre, whose errors gravity shows
    even where the arm compensates the nominal ones; per link the tensor's scale, and one delay of the command; or,
    with gravity (link-side torque), the whole tensor and no delay. Noise is 0.2 % of tau_max in each of 10 samples
    per second. Rows where a joint rests do not count: there its friction may be anything.
    """
    every = round(1 / (COARSE_HZ * SIM_DT))
    q, dq, ddq = (x[None, ::every] for x in (motion.q, motion.dq, motion.ddq))
    return float(_information(robot, motion.t[::every], q, dq, ddq, gravity)[0])


def _information(
    robot: Robot, t: np.ndarray, q: np.ndarray, dq: np.ndarray, ddq: np.ndarray, gravity: bool
) -> np.ndarray:
    """Return (B,) nats for B motions (B, T, n) at the times t (T,)."""
    n, shape = robot.n, (len(q), len(t), robot.n)
    flat = q.reshape(-1, n), dq.reshape(-1, n), ddq.reshape(-1, n)
    y = regressor(robot, *flat, gravity=robot.gravity).reshape(*shape, n, 10)
    speed, bend = dq / robot.dq_max, dq / (SLOPE * robot.dq_max)
    step, bump = np.tanh(bend), 1 / np.cosh(np.minimum(np.abs(bend), 50)) ** 2
    curves = FRICTION_PRIOR * np.stack([np.ones_like(dq), step, bend * bump, bump, speed], -1)
    curves = np.concatenate([curves, DRAG_PRIOR * np.stack([np.sin(q), np.cos(q)], -1)], -1)
    friction = np.zeros((*shape, n, 7))
    friction[:, :, range(n), range(n)] = curves * robot.tau_max[:, None]
    mass, center = MASS_PRIOR
    points = y[..., :4] * np.outer(robot.mass, [mass, center, center, center])
    if gravity:
        tensors = y[..., 4:] * (SCALE_PRIOR * np.trace(robot.inertia, axis1=1, axis2=2)[:, None])
        delay = np.zeros((*shape, 0))
    else:
        tensors = SCALE_PRIOR * np.einsum("btjkc,kc->btjk", y[..., 4:], six(robot.inertia))
        torque = np.einsum("btjkc,kc->btj", y, LinkInertia(robot.mass, robot.com, robot.inertia).standard())
        torque -= gravity_torque(robot, flat[0]).reshape(shape)
        coulomb = FRICTION_PRIOR * robot.tau_max * bump / (SLOPE * robot.dq_max) * ddq
        delay = DELAY_PRIOR * (np.gradient(torque, t, axis=1) + coulomb)[..., None]
    columns = [x.reshape(*shape, -1) for x in (friction, points, tensors, delay)]
    rows = np.concatenate(columns, -1) / (NOISE * robot.tau_max[:, None])
    rows *= (np.abs(speed) > RESTING)[..., None]
    rows = rows.reshape(len(q), -1, rows.shape[-1])
    return 0.5 * np.linalg.slogdet(np.eye(rows.shape[-1]) + rows.transpose(0, 2, 1) @ rows)[1]


class _Family:
    """The motions to choose from: coefficients x (2 H, n) of a series, and a share a (n,) of each joint's amplitude.

    The amplitude itself is the largest that the joint's limits allow: every x is a shape, and allowed.
    """

    def __init__(self, robot: Robot, center: np.ndarray, duration: float, gravity: bool, space: Space):
        self.robot, self.center, self.gravity, self.space = robot, center, gravity, space
        self.clock = _clock(duration)
        self.period = max(1.1 * float(np.ptp(self.clock[1])), SHORTEST_S)
        self.harmonics = max(3, round(TOP_HZ * self.period))
        every = round(1 / (COARSE_HZ * FINE * SIM_DT))
        self.t = self.clock[0][:: every * FINE]
        self.basis = self._basis(slice(None, None, every))

    def draw(self, rng: np.random.Generator, count: int) -> tuple[float, np.ndarray, np.ndarray] | None:
        """Return (information, x, a): the best of some draws that can be made safe; None where none can."""
        shapes = [rng.standard_normal((2 * self.harmonics, self.robot.n)) for _ in range(DRAWS)]
        full = np.ones(self.robot.n)
        if count > 1:
            shapes = [shapes[k] for k in np.argsort(-self.information([(x, full) for x in shapes]))]
        kept: list[tuple[float, np.ndarray, np.ndarray]] = []
        for x in shapes:
            if (a := self._shrunk(full, partial(self._coarse, x), 0.9, MARGIN, LEAST)) is not None:
                kept.append((float(self.information([(x, a)])[0]), x, a))
            if len(kept) == count:
                break
        return max(kept, key=lambda k: k[0], default=None)

    def climb(
        self, rng: np.random.Generator, best: tuple[float, np.ndarray, np.ndarray], effort: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return (x, a) after a local search: joint by joint a part is changed, a little or much, if that helps."""
        most, x, a = best
        for _ in range(-(-effort // TRIES)):
            tried = [self._changed(rng, x, a) for _ in range(TRIES)]
            nats = self.information(tried)
            for k in np.argsort(-nats):
                if nats[k] <= most:
                    break
                if self._safe(*tried[k]):
                    most, (x, a) = nats[k], tried[k]
                    break
        return x, a

    def _changed(self, rng: np.random.Generator, x: np.ndarray, a: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        j, size = rng.integers(self.robot.n), 10 ** rng.uniform(-1.5, 0)
        x, a = x.copy(), a.copy()
        x[:, j] = np.sqrt(1 - 0.9 * size**2) * x[:, j] + size * rng.standard_normal(len(x))
        a[j] = np.clip(a[j] * np.exp(0.5 * size * rng.standard_normal()), LEAST, 1)
        return x, a

    def finish(self, x: np.ndarray, a: np.ndarray) -> Excitation | None:
        """Return the motion on the arm's clock, smaller where its dense samples want it; None where that is much."""
        # in blocks: the basis of two minutes would fill a gigabyte
        blocks = [[b @ x for b in self._basis(slice(k, k + BLOCK))] for k in range(0, len(self.clock[0]), BLOCK)]
        series = tuple(np.concatenate(part) for part in zip(*blocks, strict=True))
        every = round(1 / (GEOMETRY_HZ * SIM_DT))
        dense = partial(self._scaled, series)
        less = self._shrunk(a, lambda a: tuple(m[::every] for m in dense(a)), 0.98, MARGIN / 3, LEAST / 2)
        if less is None:
            return None
        offset, dq, ddq = dense(less)
        return Excitation(self.clock[0], self.center + offset, dq, ddq)

    def information(self, motions: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
        """Return (B,) nats, of several (x, a) at once: that is faster."""
        offset, dq, ddq = (np.stack(m) for m in zip(*(self._coarse(x, a) for x, a in motions), strict=True))
        return _information(self.robot, self.t, self.center + offset, dq, ddq, self.gravity)

    def _basis(self, rows: slice) -> Moved:
        """Return (T, 2 H) matrices that turn x into a series, its velocity and its acceleration, on these ms."""
        _, s, pace, slope = (c[rows, None] for c in self.clock)
        order = np.arange(1, self.harmonics + 1)
        omega = 2 * np.pi / self.period * order
        sine, cosine = np.sin(s * omega) / order**FALL, np.cos(s * omega) / order**FALL
        first = np.hstack([cosine * omega, -sine * omega])
        second = np.hstack([-sine * omega**2, -cosine * omega**2])
        return np.hstack([sine, cosine]), first * pace, second * pace**2 + first * slope

    def _scaled(self, series: Moved, a: np.ndarray) -> Moved:
        """Return offset from the centre, velocity and acceleration, each (T, n), as large as a says."""
        r = self.robot
        q, dq, ddq = series
        room = RANGE * np.minimum([r.q_max - self.center, self.center - r.q_min], np.pi)
        reach = np.maximum([q.max(0), -q.min(0)], 1e-9)
        scale = np.minimum((room / reach).min(0), SPEED * r.dq_max / np.maximum(np.abs(dq).max(0), 1e-9))
        hardest = np.minimum(ACCELERATION * r.ddq_max, (1 - SPEED) * r.dq_max / STUCK_S)
        scale = a * np.minimum(scale, hardest / np.maximum(np.abs(ddq).max(0), 1e-9))
        return q * scale, dq * scale, ddq * scale

    def _coarse(self, x: np.ndarray, a: np.ndarray) -> Moved:
        q, dq, ddq = self._scaled(tuple(b @ x for b in self.basis), a)
        return q[::FINE], dq[::FINE], ddq[::FINE]

    def _safety(self, offset: np.ndarray, dq: np.ndarray, ddq: np.ndarray) -> np.ndarray:
        """Return (T,): the least of the distances in clearances and of the torques in tenths; negative: forbidden."""
        q = self.center + offset
        torque = (TORQUE_SHARE - torque_share(self.robot, q, dq, ddq)).min(1)
        return np.minimum((self.space.gaps(q) / self.space.clearance).min(1), 10 * torque)

    def _safe(self, x: np.ndarray, a: np.ndarray) -> bool:
        moved = self._coarse(x, a)
        if self._safety(*(m[::5] for m in moved)).min() < MARGIN or self._safety(*moved).min() < MARGIN:
            return False
        return self._within_reach(moved[0][0], MARGIN)

    def _within_reach(self, offset: np.ndarray, margin: float) -> bool:
        home = self.robot.q_home
        way = home + np.linspace(0, 1, WAY_STEPS)[:, None] * (self.center + offset - home)
        return bool((self.space.gaps(way) / self.space.clearance).min() >= margin)

    def _shrunk(
        self, a: np.ndarray, moved: Callable[[np.ndarray], Moved], by: float, margin: float, least: float
    ) -> np.ndarray | None:
        """Return a, smaller until `_safety` is `margin`; None where less than `least` of a joint would be left.

        Each round takes from the joint that helps most at the most dangerous sample.
        """
        a = a.copy()
        for every in (5, 1):  # most of the shrinking on few samples
            while True:
                rows = tuple(m[::every] for m in moved(a))
                danger = self._safety(*rows)
                worst = int(danger.argmin())
                if danger[worst] >= margin:
                    break
                less = 1 - 0.1 * np.eye(self.robot.n)
                helped = self._safety(*(m[worst] * less for m in rows))
                j = int(helped.argmax())
                a[j] *= by
                if a[j] < least or helped[j] <= danger[worst]:
                    return None
        return a if self._within_reach(moved(a)[0][0], margin) else None


def _clock(duration: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return t, and the series' own time s with its first two derivatives by t, each (T,).

    The pace ds/dt goes from level to level by raised cosines: s is twice differentiable.
    """
    t = SIM_DT * np.arange(round(duration / SIM_DT) + 1)
    levels, shares, fixed = [0.0], [0.0], [ENDS_S]  # a level lasts fixed seconds, and a share of what is left
    rungs = _rungs(duration)
    for k, rung in enumerate(rungs):
        levels += [*rung, 0.0]
        shares += [*((0.4, 0.6) if len(rung) > 1 else (1.0,)), 0.0]
        rest = HOLD_S if k < len(rungs) - 1 else ENDS_S
        fixed += [BLEND_S] * len(rung) + [BLEND_S + rest]
    length = np.array(fixed) + np.array(shares) * (t[-1] - sum(fixed)) / sum(shares)
    starts = np.cumsum(length) - length
    s, pace, slope = np.zeros((3, len(t)))
    for start, a, b in zip(starts[1:], levels[:-1], levels[1:], strict=True):
        u = np.clip((t - start) / BLEND_S, 0, 1)
        pace += (b - a) * 0.5 * (1 - np.cos(np.pi * u))
        slope += (b - a) * 0.5 * np.pi / BLEND_S * np.sin(np.pi * u)
        # the integral of the raised cosine, then of the constant after it
        s += (b - a) * (0.5 * BLEND_S * (u - np.sin(np.pi * u) / np.pi) + np.maximum(t - start - BLEND_S, 0))
    return t, s, pace, slope


def _rungs(duration: float) -> list[list[float]]:
    """Return the paces of each rung: ladders from slow to fast, the slow rungs with a way back."""
    count = int(duration / RUNG_S + 0.5)
    if count < 2:
        return [list(SHORT)]
    ladders = -(-count // LADDER)
    sizes = [count // ladders + (k < count % ladders) for k in range(ladders)]
    paces = [float(p) for size in sizes for p in np.linspace(SLOWEST, 1, size)]
    return [[p, -p] if p < TURNS_BELOW else [p] for p in paces]


def _check_center(robot: Robot, center: np.ndarray) -> None:
    if center.shape != (robot.n,):
        raise UserError(f"excitation.q_center: {center.size} values for {robot.n} joints")
    inside = (center > robot.q_min) & (center < robot.q_max)
    if not inside.all():
        i = int(np.argmin(inside))
        raise UserError(
            f"excitation.q_center: joint {i + 1} at {center[i]:g} rad, allowed "
            f"{robot.q_min[i]:g} to {robot.q_max[i]:g}"
        )
