"""Timed paths of a hand: curves at any tilt, the postures that follow them, and a pace that the arm can keep.

A curve is x(u) m, u in metres at its fastest. Postures q(u) come from inverse kinematics on a grid and a cubic
spline through it. The clock u(t) ramps in from rest and out to rest with minimum-jerk speed, at a pace of v m/s. So
position, velocity and acceleration of hand and joints are continuous, and one number, the pace, is made smaller until
torque, speed and the acceleration that the driver's law lets through have room left.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from r2s.physics.dynamics import Dynamics
from r2s.physics.limits import APPROACH, MOST, OFFSET, Q_HIGH, Q_LOW, RATE, SLOWING, limits
from r2s.physics.robot import Robot
from r2s.tasks.hand import Hand
from r2s.tasks.model_torque import ModelTorque

KINDS = ("fourier", "eight", "circle", "waypoints")
GRID_M = 0.01  # of u between two postures of the inverse kinematics
HARMONICS = 3  # of a random Fourier curve
LEADS = 60  # points on the way from home to a path's start, and as many in which the posture settles there
OFF_M = 1e-4  # that a posture's hand may be off the curve
INSIDE = 0.05  # rad, from where the driver's law lets nothing through
# shares that a path leaves to friction, to feedback and to what the nominal model does not know
TORQUE, SPEED, PUSH = 0.5, 0.9, 0.8  # of what an action may ask for, of the law's speed, of its acceleration
SLOWEST = 0.02  # of the pace that was drawn: slower, the path is given up
CHECK_HZ = 50
TRIES = 20  # to find a pace
X, V = slice(0, 3), slice(3, 6)  # columns of a plan; then q, dq, ddq

Curve = Callable[[np.ndarray], np.ndarray]


def curve(kind: str, rng: np.random.Generator, size: float) -> Curve:
    """Return x(u) - x(0), (T, 3) m of u (T,) m: no point is farther than `size` m from its middle, speed <= 1."""
    a, b, _ = np.linalg.qr(rng.standard_normal((3, 3)))[0].T
    way = rng.choice([-1.0, 1.0])
    match kind:
        case "circle":
            return lambda u: size * (np.outer(np.cos(u / size) - 1, a) + way * np.outer(np.sin(u / size), b))
        case "eight":
            pace = 1 / (np.sqrt(2) * size)  # of the lemniscate of Gerono, fastest where it crosses itself
            return lambda u: size * (np.outer(np.sin(pace * u), a) + 0.5 * way * np.outer(np.sin(2 * pace * u), b))
        case "waypoints":
            return _waypoints(rng, size)
    order = np.arange(1, HARMONICS + 1)
    both = rng.standard_normal((2, HARMONICS, 3)) / order[:, None]
    turn = np.linspace(0, 2 * np.pi, 400)[:, None] * order

    def series(angle: np.ndarray) -> np.ndarray:
        return np.sin(angle) @ both[0] + np.cos(angle) @ both[1]

    both *= size / np.linalg.norm(series(turn), axis=1).max()
    fastest = np.linalg.norm((np.cos(turn) * order) @ both[0] - (np.sin(turn) * order) @ both[1], axis=1).max()
    at_first = series(0.0 * order[None])
    return lambda u: series(np.outer(u / fastest, order)) - at_first


def _waypoints(rng: np.random.Generator, size: float) -> Curve:
    """Return minimum-jerk motions between points of a ball, at rest in each."""
    points = [np.zeros(3)]
    far = 0.0
    while far < 8.0:  # m of u, more than an episode goes
        direction = rng.standard_normal(3)
        point = size * rng.uniform(0.3, 1.0) * direction / np.linalg.norm(direction)
        if len(points) == 1 or np.linalg.norm(point - points[-1]) > 0.3 * size:
            far += 1.875 * float(np.linalg.norm(point - points[-1]))
            points.append(point)
    legs = np.diff(points, axis=0)
    ends = np.cumsum(1.875 * np.linalg.norm(legs, axis=1))  # the peak speed of each is 1

    def along(u: np.ndarray) -> np.ndarray:
        k = np.minimum(np.searchsorted(ends, u), len(legs) - 1)
        share = 1.0 - (ends[k] - u) / np.diff(ends, prepend=0.0)[k]
        return np.asarray(points)[k] + smooth(np.clip(share, 0.0, 1.0))[:, None] * legs[k]

    return along


def smooth(s: np.ndarray) -> np.ndarray:
    """Return 10 s^3 - 15 s^4 + 6 s^5: from 0 to 1 with neither slope nor curvature at both ends."""
    return s**3 * (10 - 15 * s + 6 * s**2)


def clock(t: np.ndarray, seconds: float, ramp: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return how far a clock of pace 1 has come, its pace and the slope of that at t (T,) s, zero outside.

    The pace is `smooth` from 0 to 1 over the first and from 1 to 0 over the last `ramp` s of `seconds`.
    """

    def risen(s: np.ndarray) -> np.ndarray:
        return s**4 * (2.5 - 3 * s + s**2)

    up, down = np.clip(t / ramp, 0, 1), np.clip((seconds - t) / ramp, 0, 1)
    level = np.clip(t - ramp, 0, seconds - 2 * ramp)
    come = ramp * risen(up) + level + ramp * (0.5 - risen(down))
    slope = 30 * (up**2 * (1 - up) ** 2 - down**2 * (1 - down) ** 2) / ramp
    return come, smooth(up) + smooth(down) - 1, slope


@dataclass(frozen=True)
class Paths:
    """The paths that an arm can follow.

    Attributes:
        robot: the arm. torque: (n,) Nm, the most that a target asks for.
        seconds: of a path. ramp: s, of its beginning and of its end.
    """

    robot: Robot
    torque: np.ndarray
    seconds: float
    ramp: float

    def __post_init__(self):
        own = Dynamics.of(self.robot, np.zeros((self.robot.n, 3)))
        more = {"hand": Hand(self.robot), "model": ModelTorque(self.robot, own)}
        more["law"] = limits(self.robot, self.torque)
        for name, value in more.items():
            object.__setattr__(self, f"_{name}", value)

    def postures(self, start: np.ndarray, shape: Curve, pace: float) -> tuple[CubicSpline, np.ndarray] | None:
        """Return q(u) and the points (T, 3) m that it goes through, for the curve from `start` (3,) m.

        None where the arm does not reach a point or comes too near to a position limit.
        """
        home, hand, law = self.robot.q_home, self._hand, self._law  # type: ignore[attr-defined]
        first = hand.place(home[None])[0]
        lead = first + np.clip(np.arange(2 * LEADS) / LEADS, 0, 1)[:, None] * (start - first)
        ready, off = hand.follow(home, lead)
        if off > OFF_M and np.linalg.norm(hand.place(ready[-1:])[0] - start) > OFF_M:
            return None
        u = np.linspace(0, pace * (self.seconds - self.ramp), 4 + int(pace * self.seconds / GRID_M))
        points = start + shape(u)
        q, off = hand.follow(ready[-1], points)
        if off > OFF_M or (q < law[:, Q_LOW] + INSIDE).any() or (q > law[:, Q_HIGH] - INSIDE).any():
            return None
        return CubicSpline(u, q), points

    def timed(self, q: CubicSpline, pace: float, t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return q, dq, ddq (T, n) at t (T,) s of the path at a pace in m/s."""
        come, rate, slope = (pace * x[:, None] for x in clock(t, self.seconds, self.ramp))
        along = q(come[:, 0], 1)
        return q(come[:, 0]), along * rate, q(come[:, 0], 2) * rate**2 + along * slope

    def strain(self, q: np.ndarray, dq: np.ndarray, ddq: np.ndarray) -> float:
        """Return the largest share of what a path may ask for: torque of the nominal model, and the law's bounds.

        The law's are -RATE (v + dq) <= ddq <= RATE (v - dq), with v the speed that it allows at q
        (r2s/physics/limits.py).
        """
        law = self._law  # type: ignore[attr-defined]
        shares = [np.abs(self._model.rigid(q, dq, ddq)) / (TORQUE * self.torque)]  # type: ignore[attr-defined]
        for sign, way in ((1.0, law[:, Q_HIGH] - q), (-1.0, q - law[:, Q_LOW])):
            allowed = np.minimum(law[:, MOST], APPROACH * way)
            if np.isfinite(law[:, SLOWING]).all():
                allowed = np.minimum(allowed, np.sqrt(law[:, SLOWING] * way + law[:, OFFSET] ** 2) - law[:, OFFSET])
            shares.append((sign * dq + np.maximum(sign * ddq, 0) / (PUSH * RATE)) / (SPEED * allowed))
        return float(max(s.max() for s in shares))

    def plan(self, start: np.ndarray, shape: Curve, pace: float, t: np.ndarray) -> np.ndarray | None:
        """Return the plan (T, 6 + 3 n) at t (T,) s, which may end later than the path; None: there is none.

        Columns: the hand's place and velocity, m, m/s; q, dq, ddq of the joints. It is slower than `pace` m/s where
        `strain` is above 1.
        """
        found = self.postures(start, shape, pace)
        if found is None:
            return None
        q, first = found[0], pace
        coarse = np.arange(0, self.seconds, 1 / CHECK_HZ)
        for _ in range(TRIES):
            strain = self.strain(*self.timed(q, pace, coarse))
            if strain <= 1.0:
                return self.rows(*self.timed(q, pace, t))
            pace *= 0.99 / np.sqrt(strain)  # between the square, of accelerations, and the root: from above
            if pace < SLOWEST * first:
                return None
        return None

    def rows(self, q: np.ndarray, dq: np.ndarray, ddq: np.ndarray) -> np.ndarray:
        """Return a plan (T, 6 + 3 n) of these joint motions (T, n)."""
        hand, h = self._hand, 1e-5  # type: ignore[attr-defined]
        v = (hand.place(q + h * dq) - hand.place(q - h * dq)) / (2 * h)
        return np.hstack([hand.place(q), v, q, dq, ddq])


def later(
    plans: np.ndarray, k: np.ndarray, late: float, hz: int, n: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return q, dq, ddq (m, n) of plans `late` s after their rows k (m,); the acceleration is linear between rows."""
    whole = int(late * hz)
    rows, last = np.arange(len(plans)), plans.shape[1] - 1
    a, b = plans[rows, np.minimum(k + whole, last)], plans[rows, np.minimum(k + whole + 1, last)]
    h = late - whole / hz
    q, dq, ddq = a[:, 6 : 6 + n], a[:, 6 + n : 6 + 2 * n], a[:, 6 + 2 * n :]
    jerk = (b[:, 6 + 2 * n :] - ddq) * hz
    return q + h * (dq + h * (ddq / 2 + h * jerk / 6)), dq + h * (ddq + h * jerk / 2), ddq + h * jerk
