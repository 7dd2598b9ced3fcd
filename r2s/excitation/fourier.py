"""Design an excitation: a finite Fourier series that the arm follows at several speeds.

The series, and the criterion (determinant of the information matrix, D-optimality), follow Swevers et al., IEEE T-RA
13(5), 1997. The information matrix includes a prior, so that unidentifiable quantities do not dominate the
determinant. Only motion at several speeds determines friction curves and delay. The motion therefore consists of
rungs: sections of the series at 10 % to 100 % of full speed, with a rest after each rung. Slow rungs also run
backwards, so that joints reverse at low speed.
"""

from collections.abc import Callable
from functools import partial

import numpy as np

from r2s.errors import UserError
from r2s.excitation.information import COARSE_HZ, information
from r2s.excitation.motion import Excitation
from r2s.excitation.motion_checks import (
    GEOMETRY_HZ,
    TABLE_M,
    TOOL_M,
    TORQUE_SHARE,
    Space,
    check_motion,
    torque_share,
)
from r2s.physics.robot import SIM_DT, Robot

# Ladders, sequences of rungs from slow to fast; a pace is a speed relative to full speed.
SLOWEST = 0.1
REVERSES_BELOW = 0.4  # pace below which a part of a rung runs backwards
RUNG_S = 4.0  # s, approximate duration of a rung and a rest
SHORT = 0.3, 0.8  # paces if the motion has time for only one rung
LADDER = 6  # maximum number of rungs per ladder
BLEND_S = 0.4  # s, transition between two paces
HOLD_S = 0.4  # s, rest between two rungs
ENDS_S = 0.2  # s, rest at both ends
LONGEST_S = 120.0
LEAST_S = 5 * BLEND_S
# Series.
TOP_HZ = 1.0  # frequency of the highest harmonic at full speed
DECAY = 1.5  # harmonic k has an amplitude proportional to k^-DECAY: the acceleration limit bounds high harmonics
SHORTEST_S = 4.0  # s, minimum fundamental period
RANGE = 0.8  # share of min(distance from the center to the nearer position limit, pi rad)
SPEED = 0.65  # share of dq_max
ACCELERATION = 0.7  # share of ddq_max
STUCK_S = 0.12  # s for which a light joint may stick at a reversal, before it catches up at a higher speed
# Search.
DRAWS = 12  # random series
KEPT = 3  # number of safe random series; the search starts from the best of these
TRIES = 5  # candidates per step of the local search
MIN_AMPLITUDE = 0.3  # share of a joint's largest amplitude; a series that is safe only below this share is dropped
MARGIN = 0.3  # least `_safety`: 0.3 of a clearance and 0.03 of tau_max, a reserve for motion between two samples
APPROACH_STEPS = 40  # postures checked on the straight path from q_home to the first posture
FINE = 10  # sample rate for limits / sample rate for information and safety
BLOCK = 5000  # rows of the basis computed at once; the basis of two minutes would take 1 GB
Samples = tuple[np.ndarray, ...]  # offset from the center, velocity, acceleration
# Scores (B,) of B motions (B, T, n) rad, rad/s, rad/s^2 at times (T,) s: (t, q, dq, ddq) -> (B,)
Score = Callable[[np.ndarray, np.ndarray, np.ndarray, np.ndarray], np.ndarray]


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
    """Return an informative motion that passes `motion_checks.check_motion`.

    A random series uses up to 80 % of the position range, 65 % of the velocity limit and 70 % of the acceleration
    limit, and less near obstacles. A local search changes the series to increase the motion's `information`. The
    motion ends within the series' period, so no part of the motion repeats. Equal arguments produce equal motions.

    Args:
        robot: limits, links and nominal model.
        duration: s, including the rests at both ends.
        seed: random seed.
        gravity: whether the recorded torque is link-side torque, with gravity; see `information`.
        effort: number of motions that the local search tries; 0: return the first safe random series.
        q_center: (n,) rad, center posture; None: the middle of the position range.
        table: m, height of the table in the base frame; -inf means no table.
        z_min: m, minimum height of the end effector, for a tool that the MJCF does not contain.

    Raises:
        UserError: an argument is out of range, or no randomly drawn Fourier series is safe.
    """
    if not LEAST_S <= duration <= LONGEST_S:
        raise UserError(f"excitation.duration: expected {LEAST_S:g} to {LONGEST_S:g} s, got {duration:g}")
    if effort < 0:
        raise UserError(f"excitation.effort: expected a number of 0 or more, got {effort}")
    space = Space(robot, table=table, z_min=z_min)
    center = checked_center(robot, space, q_center)
    candidates = Candidates(robot, center, duration, partial(information, robot, gravity=gravity), space)
    motion = candidates.found(np.random.default_rng(seed), effort)
    check_motion(robot, motion, space=space)
    return motion


def checked_center(robot: Robot, space: Space, q_center: np.ndarray | None) -> np.ndarray:
    """Return the center posture (n,) rad of a motion, by default the middle of the position range.

    Raises:
        UserError: the center is outside the limits, or the center or q_home is too near to an obstacle.
    """
    center = 0.5 * np.add(*robot.q_range) if q_center is None else np.asarray(q_center, dtype=float)
    _check_center(robot, center)
    space.check(np.array([robot.q_home, center]), lambda k: ("at robot.q_home", "at excitation.q_center")[k])
    return center


class Candidates:
    """Candidate motions (x, a); x (2 H, n): coefficients of a series; a (n,): amplitude / largest amplitude.

    A joint's limits determine the joint's largest amplitude; the coefficients x determine only the motion's shape.

    Args:
        robot: limits and links. center: (n,) rad, center posture. duration: s, duration of a motion.
        space: computes link distances. score: function that returns higher scores for better motions, see `Score`.
    """

    def __init__(self, robot: Robot, center: np.ndarray, duration: float, score: Score, space: Space):
        self.robot, self.center, self.score, self.space = robot, center, score, space
        self.clock = _clock(duration)
        self.period = max(1.1 * float(np.ptp(self.clock[1])), SHORTEST_S)
        self.harmonics = max(3, round(TOP_HZ * self.period))
        every = round(1 / (COARSE_HZ * FINE * SIM_DT))
        self.t = self.clock[0][:: every * FINE]
        self.basis = self._basis(slice(None, None, every))

    def found(
        self, rng: np.random.Generator, effort: int, report: Callable[[float], None] = lambda share: None
    ) -> Excitation:
        """Return the best motion of `effort` tries; call `report` with the completed fraction of the tries.

        Raises:
            UserError: no randomly drawn Fourier series is safe.
        """
        best = self.draw(rng, KEPT if effort else 1)
        motion = self.finish(*self.search(rng, best, effort, report)) if best else None
        if motion is None:
            raise UserError(
                f"excitation: no motion about q_center={np.round(self.center, 3).tolist()} keeps clear of the table "
                f"at {self.space.table:g} m, of the arm itself and of obstacles, and needs less than "
                f"{100 * TORQUE_SHARE:g} % of tau_max, with the end effector {self.space.floor:g} m above the base "
                "plane; set another excitation.q_center"
            )
        return motion

    def draw(self, rng: np.random.Generator, count: int) -> tuple[float, np.ndarray, np.ndarray] | None:
        """Return (score, x, a) of the best among up to `count` safe random series; None if no series is safe."""
        shapes = [rng.standard_normal((2 * self.harmonics, self.robot.n)) for _ in range(DRAWS)]
        full = np.ones(self.robot.n)
        if count > 1:
            shapes = [shapes[k] for k in np.argsort(-self.scores([(x, full) for x in shapes]))]
        kept: list[tuple[float, np.ndarray, np.ndarray]] = []
        for x in shapes:
            if (a := self._shrink(full, partial(self._coarse, x), 0.9, MARGIN, MIN_AMPLITUDE)) is not None:
                kept.append((float(self.scores([(x, a)])[0]), x, a))
            if len(kept) == count:
                break
        return max(kept, key=lambda k: k[0], default=None)

    def search(
        self,
        rng: np.random.Generator,
        best: tuple[float, np.ndarray, np.ndarray],
        effort: int,
        report: Callable[[float], None],
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the best (x, a) of a local search from `best`; each step changes one joint's motion at random."""
        most, x, a = best
        steps = -(-effort // TRIES)
        for step in range(steps):
            tried = [self._changed(rng, x, a) for _ in range(TRIES)]
            scores = self.scores(tried)
            for k in np.argsort(-scores):
                if scores[k] <= most:
                    break
                if self._safe(*tried[k]):
                    most, (x, a) = scores[k], tried[k]
                    break
            report((step + 1) / steps)
        return x, a

    def _changed(self, rng: np.random.Generator, x: np.ndarray, a: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        j, size = rng.integers(self.robot.n), 10 ** rng.uniform(-1.5, 0)
        x, a = x.copy(), a.copy()
        x[:, j] = np.sqrt(1 - 0.9 * size**2) * x[:, j] + size * rng.standard_normal(len(x))
        a[j] = np.clip(a[j] * np.exp(0.5 * size * rng.standard_normal()), MIN_AMPLITUDE, 1)
        return x, a

    def finish(self, x: np.ndarray, a: np.ndarray) -> Excitation | None:
        """Return the 1 kHz motion, with `a` reduced until it is safe at GEOMETRY_HZ; None if `a` gets too small."""
        blocks = [[b @ x for b in self._basis(slice(k, k + BLOCK))] for k in range(0, len(self.clock[0]), BLOCK)]
        series = tuple(np.concatenate(part) for part in zip(*blocks, strict=True))
        every = round(1 / (GEOMETRY_HZ * SIM_DT))
        dense = partial(self._scaled, series)
        less = self._shrink(a, lambda a: tuple(m[::every] for m in dense(a)), 0.98, MARGIN / 3, MIN_AMPLITUDE / 2)
        if less is None:
            return None
        offset, dq, ddq = dense(less)
        return Excitation(self.clock[0], self.center + offset, dq, ddq)

    def scores(self, motions: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
        """Return the scores (B,) of B motions (x, a); one call for all B saves time."""
        offset, dq, ddq = (np.stack(m) for m in zip(*(self._coarse(x, a) for x, a in motions), strict=True))
        return self.score(self.t, self.center + offset, dq, ddq)

    def _basis(self, rows: slice) -> Samples:
        """Return matrices (T, 2 H) that map x to position, velocity and acceleration at `rows` of the motion."""
        _, s, pace, slope = (c[rows, None] for c in self.clock)
        order = np.arange(1, self.harmonics + 1)
        omega = 2 * np.pi / self.period * order
        sine, cosine = np.sin(s * omega) / order**DECAY, np.cos(s * omega) / order**DECAY
        first = np.hstack([cosine * omega, -sine * omega])
        second = np.hstack([-sine * omega**2, -cosine * omega**2])
        return np.hstack([sine, cosine]), first * pace, second * pace**2 + first * slope

    def _scaled(self, series: Samples, a: np.ndarray) -> Samples:
        """Return offset from the center, velocity and acceleration (T, n) of a series with the amplitudes `a`."""
        r = self.robot
        q, dq, ddq = series
        room = RANGE * np.minimum([r.q_max - self.center, self.center - r.q_min], np.pi)
        reach = np.maximum([q.max(0), -q.min(0)], 1e-9)
        scale = np.minimum((room / reach).min(0), SPEED * r.dq_max / np.maximum(np.abs(dq).max(0), 1e-9))
        hardest = np.minimum(ACCELERATION * r.ddq_max, (1 - SPEED) * r.dq_max / STUCK_S)
        scale = a * np.minimum(scale, hardest / np.maximum(np.abs(ddq).max(0), 1e-9))
        return q * scale, dq * scale, ddq * scale

    def _coarse(self, x: np.ndarray, a: np.ndarray) -> Samples:
        q, dq, ddq = self._scaled(tuple(b @ x for b in self.basis), a)
        return q[::FINE], dq[::FINE], ddq[::FINE]

    def _safety(self, offset: np.ndarray, dq: np.ndarray, ddq: np.ndarray) -> np.ndarray:
        """Return safety (T,), the smaller of gap / clearance and torque reserve / (0.1 tau_max); unsafe below 0."""
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
        path = home + np.linspace(0, 1, APPROACH_STEPS)[:, None] * (self.center + offset - home)
        return bool((self.space.gaps(path) / self.space.clearance).min() >= margin)

    def _shrink(
        self, a: np.ndarray, moved: Callable[[np.ndarray], Samples], by: float, margin: float, least: float
    ) -> np.ndarray | None:
        """Reduce the amplitudes `a` until `_safety` is at least `margin`, and return the reduced amplitudes.

        Each round reduces the amplitude of the joint whose reduction most improves the least safe sample. Return None
        if an amplitude falls below `least`, if no reduction helps, or if the way from q_home is unsafe.
        """
        a = a.copy()
        for every in (5, 1):  # first every fifth sample, so that most rounds are fast
            while True:
                rows = tuple(m[::every] for m in moved(a))
                safety = self._safety(*rows)
                worst = int(safety.argmin())
                if safety[worst] >= margin:
                    break
                less = 1 - 0.1 * np.eye(self.robot.n)
                improved = self._safety(*(m[worst] * less for m in rows))
                j = int(improved.argmax())
                a[j] *= by
                if a[j] < least or improved[j] <= safety[worst]:
                    return None
        return a if self._within_reach(moved(a)[0][0], margin) else None


def _clock(duration: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the time t, the argument s of the series, ds/dt and d2s/dt2, each (T,).

    Between two paces, the rate ds/dt follows a raised cosine.
    """
    t = SIM_DT * np.arange(round(duration / SIM_DT) + 1)
    levels, shares, fixed = [0.0], [0.0], [ENDS_S]  # a level lasts `fixed` s plus its share of the remaining time
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
        # integral of the raised cosine and of the constant pace after the cosine
        s += (b - a) * (0.5 * BLEND_S * (u - np.sin(np.pi * u) / np.pi) + np.maximum(t - start - BLEND_S, 0))
    return t, s, pace, slope


def _rungs(duration: float) -> list[list[float]]:
    """Return each rung's paces (speed / full speed); a ladder starts slowly, and slow rungs also run backwards."""
    count = int(duration / RUNG_S + 0.5)
    if count < 2:
        return [list(SHORT)]
    ladders = -(-count // LADDER)
    sizes = [count // ladders + (k < count % ladders) for k in range(ladders)]
    paces = [float(p) for size in sizes for p in np.linspace(SLOWEST, 1, size)]
    return [[p, -p] if p < REVERSES_BELOW else [p] for p in paces]


def _check_center(robot: Robot, center: np.ndarray) -> None:
    if center.shape != (robot.n,):
        raise UserError(f"excitation.q_center: expected {robot.n} values, got {center.size}")
    inside = (center > robot.q_min) & (center < robot.q_max)
    if not inside.all():
        i = int(np.argmin(inside))
        raise UserError(
            f"excitation.q_center: expected {robot.q_min[i]:g} to {robot.q_max[i]:g} rad, got {center[i]:g} "
            f"(joint {i + 1})"
        )
