"""End-effector trajectories: curves, joint postures along the curves, and a timing that the arm can follow.

A curve x(u) maps a path parameter u (m) to a position (m), with |dx/du| <= 1. Inverse kinematics yields postures on a
grid of u, which a cubic spline q(u) interpolates. The pace du/dt rises from 0 to its peak along a minimum-jerk
polynomial and falls likewise to 0 at the end. Position, velocity and acceleration of end effector and joints are thus
continuous. `Paths` reduces the pace until torque, speed and acceleration are well within the limits of the arm and of
its safety filter.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from r2s.physics.dynamics import Dynamics
from r2s.physics.inverse_dynamics import InverseDynamics
from r2s.physics.kinematics import HandKinematics
from r2s.physics.robot import Robot
from r2s.physics.safety_filter import APPROACH, DECELERATION, DQ_ALLOWED, OFFSET, Q_HIGH, Q_LOW, RATE, filter_limits

KINDS = ("fourier", "eight", "circle", "waypoints")
SPACE = np.eye(3)
GRID_M = 0.01  # m, step of u between two postures of the inverse kinematics
HARMONICS = 3  # harmonics of a random Fourier curve
LEADS = 60  # number of points from home to a path's start, and of repeated start points that let the posture converge
OFF_M = 1e-4  # m, largest position error of a posture
INSIDE = 0.05  # rad, smallest allowed distance of a path from the position limits of the safety filter
# A path may use these shares of the largest target torque, and of the safety filter's limits of speed and
# acceleration; the remaining share is for friction, feedback and errors of the nominal model.
TORQUE, SPEED, ACCELERATION = 0.5, 0.9, 0.8
SLOWEST = 0.02  # smallest share of the requested pace; `plan` rejects a path that must be slower
CHECK_HZ = 50  # Hz, rate at which a path is checked against limits
TRIES = 20  # largest number of paces tried for a path
PEAK = 1.875  # peak speed / mean speed of a minimum-jerk motion
X, V = slice(0, 3), slice(3, 6)  # columns of position and velocity in a plan; q, dq, ddq follow

Curve = Callable[[np.ndarray], np.ndarray]


def curve(kind: str, rng: np.random.Generator, size: float, axes: np.ndarray = SPACE) -> Curve:
    """Return a curve, u (T,) m -> x(u) - x(0) (T, 3) m, within `size` m of its center and with |dx/du| <= 1.

    axes: (k, 3), orthonormal vectors that span the plane (k = 2) or the space (k = 3) of the curve.
    """
    k = len(axes)
    a, b = np.linalg.qr(rng.standard_normal((k, k)))[0].T[:2] @ axes
    way = rng.choice([-1.0, 1.0])
    match kind:
        case "circle":
            return lambda u: size * (np.outer(np.cos(u / size) - 1, a) + way * np.outer(np.sin(u / size), b))
        case "eight":
            pace = 1 / (np.sqrt(2) * size)  # lemniscate of Gerono, fastest at its crossing
            return lambda u: size * (np.outer(np.sin(pace * u), a) + 0.5 * way * np.outer(np.sin(2 * pace * u), b))
        case "waypoints":
            return _waypoints(rng, size, axes)
    order = np.arange(1, HARMONICS + 1)
    both = rng.standard_normal((2, HARMONICS, k)) @ axes / order[:, None]
    angles = np.linspace(0, 2 * np.pi, 400)[:, None] * order

    def series(angle: np.ndarray) -> np.ndarray:
        return np.sin(angle) @ both[0] + np.cos(angle) @ both[1]

    both *= size / np.linalg.norm(series(angles), axis=1).max()
    fastest = np.linalg.norm((np.cos(angles) * order) @ both[0] - (np.sin(angles) * order) @ both[1], axis=1).max()
    start = series(0.0 * order[None])
    return lambda u: series(np.outer(u / fastest, order)) - start


def _waypoints(rng: np.random.Generator, size: float, axes: np.ndarray) -> Curve:
    """Return a curve of minimum-jerk motions between random points of a ball, or of a disc for two axes."""
    points = [np.zeros(3)]
    length = 0.0
    while length < 8.0:  # m, length in u, longer than the path of any episode
        direction = rng.standard_normal(len(axes)) @ axes
        point = size * rng.uniform(0.3, 1.0) * direction / np.linalg.norm(direction)
        if len(points) == 1 or np.linalg.norm(point - points[-1]) > 0.3 * size:
            length += PEAK * float(np.linalg.norm(point - points[-1]))
            points.append(point)
    legs = np.diff(points, axis=0)
    ends = np.cumsum(PEAK * np.linalg.norm(legs, axis=1))  # |dx/du| peaks at 1 on each leg

    def along(u: np.ndarray) -> np.ndarray:
        k = np.minimum(np.searchsorted(ends, u), len(legs) - 1)
        share = 1.0 - (ends[k] - u) / np.diff(ends, prepend=0.0)[k]
        return np.asarray(points)[k] + smooth(np.clip(share, 0.0, 1.0))[:, None] * legs[k]

    return along


def smooth(s: np.ndarray) -> np.ndarray:
    """Return 10 s^3 - 15 s^4 + 6 s^5, which rises from 0 to 1 with zero slope and curvature at s = 0 and s = 1."""
    return s**3 * (10 - 15 * s + 6 * s**2)


def clock(t: np.ndarray, seconds: float, ramp: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return u, du/dt and d2u/dt2 at t (T,) s for a path parameter u(t) with a peak pace of 1.

    The motion lasts from 0 s to `seconds`. The pace du/dt rises along `smooth` in the first `ramp` s, and falls
    likewise in the last `ramp` s.
    """

    def integral(s: np.ndarray) -> np.ndarray:
        return s**4 * (2.5 - 3 * s + s**2)

    up, down = np.clip(t / ramp, 0, 1), np.clip((seconds - t) / ramp, 0, 1)
    level = np.clip(t - ramp, 0, seconds - 2 * ramp)
    position = ramp * integral(up) + level + ramp * (0.5 - integral(down))
    slope = 30 * (up**2 * (1 - up) ** 2 - down**2 * (1 - down) ** 2) / ramp
    return position, smooth(up) + smooth(down) - 1, slope


@dataclass(frozen=True)
class Paths:
    """Planner of paths that an arm can follow.

    Attributes:
        robot: the arm. torque: (n,) Nm, largest target torque.
        seconds: s, duration of a path. ramp: s, duration of acceleration and of deceleration.
    """

    robot: Robot
    torque: np.ndarray
    seconds: float
    ramp: float

    def __post_init__(self):
        own = Dynamics.of(self.robot, np.zeros((self.robot.n, 3)))
        object.__setattr__(self, "_hand", HandKinematics(self.robot))
        object.__setattr__(self, "_model", InverseDynamics(self.robot, own))
        object.__setattr__(self, "_limits", filter_limits(self.robot, self.torque))

    def postures(self, start: np.ndarray, shape: Curve, pace: float) -> tuple[CubicSpline, np.ndarray] | None:
        """Return the spline q(u) and the points (T, 3) m of the curve from `start` (3,) m.

        The result is None if a point of the curve is out of reach, or a posture is too close to a position limit.
        """
        home, hand, limits = self.robot.q_home, self._hand, self._limits  # type: ignore[attr-defined]
        first = hand.place(home[None])[0]
        lead = first + np.clip(np.arange(2 * LEADS) / LEADS, 0, 1)[:, None] * (start - first)
        ready, off = hand.follow(home, lead)
        if off > OFF_M and np.linalg.norm(hand.place(ready[-1:])[0] - start) > OFF_M:
            return None
        u = np.linspace(0, pace * (self.seconds - self.ramp), 4 + int(pace * self.seconds / GRID_M))
        points = start + shape(u)
        q, off = hand.follow(ready[-1], points)
        if off > OFF_M or (q < limits[:, Q_LOW] + INSIDE).any() or (q > limits[:, Q_HIGH] - INSIDE).any():
            return None
        return CubicSpline(u, q), points

    def timed(self, q: CubicSpline, pace: float, t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return q, dq, ddq (T, n) of the path at t (T,) s for a pace in m/s."""
        u, rate, slope = (pace * x[:, None] for x in clock(t, self.seconds, self.ramp))
        along = q(u[:, 0], 1)
        return q(u[:, 0]), along * rate, q(u[:, 0], 2) * rate**2 + along * slope

    def strain(self, q: np.ndarray, dq: np.ndarray, ddq: np.ndarray) -> float:
        """Return the largest ratio of torque or motion to its allowed value on a path: at most 1 if feasible.

        The nominal model predicts the path's torque. The safety filter requires -RATE (v + dq) <= ddq and
        ddq <= RATE (v - dq), where v is the speed limit in the posture q.
        """
        limits = self._limits  # type: ignore[attr-defined]
        shares = [np.abs(self._model.rigid(q, dq, ddq)) / (TORQUE * self.torque)]  # type: ignore[attr-defined]
        for sign, distance in ((1.0, limits[:, Q_HIGH] - q), (-1.0, q - limits[:, Q_LOW])):
            allowed = np.minimum(limits[:, DQ_ALLOWED], APPROACH * distance)
            if np.isfinite(limits[:, DECELERATION]).all():
                allowed = np.minimum(
                    allowed, np.sqrt(limits[:, DECELERATION] * distance + limits[:, OFFSET] ** 2) - limits[:, OFFSET]
                )
            shares.append((sign * dq + np.maximum(sign * ddq, 0) / (ACCELERATION * RATE)) / (SPEED * allowed))
        return float(max(s.max() for s in shares))

    def plan(self, start: np.ndarray, shape: Curve, pace: float, t: np.ndarray) -> np.ndarray | None:
        """Reduce `pace` m/s until `strain` <= 1, and return the plan (T, 6 + 3 n) at t (T,) s; None if infeasible.

        The columns are position and velocity of the end effector, m, m/s, then q, dq, ddq. t may exceed `seconds`.
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
            pace *= 0.99 / np.sqrt(strain)  # accelerations scale with the pace squared
            if pace < SLOWEST * first:
                return None
        return None

    def rows(self, q: np.ndarray, dq: np.ndarray, ddq: np.ndarray) -> np.ndarray:
        """Return the plan (T, 6 + 3 n) for the joint motion q, dq, ddq, each (T, n)."""
        hand, h = self._hand, 1e-5  # type: ignore[attr-defined]
        v = (hand.place(q + h * dq) - hand.place(q - h * dq)) / (2 * h)
        return np.hstack([hand.place(q), v, q, dq, ddq])


def at_time(plans: np.ndarray, k: np.ndarray, ahead_s: float, hz: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return q, dq, ddq (m, n) of the plans, `ahead_s` seconds after the rows k (m,); ddq is linear between rows."""
    n, whole = (plans.shape[2] - 6) // 3, int(ahead_s * hz)
    rows, last = np.arange(len(plans)), plans.shape[1] - 1
    a, b = plans[rows, np.minimum(k + whole, last)], plans[rows, np.minimum(k + whole + 1, last)]
    h = ahead_s - whole / hz
    q, dq, ddq = a[:, 6 : 6 + n], a[:, 6 + n : 6 + 2 * n], a[:, 6 + 2 * n :]
    jerk = (b[:, 6 + 2 * n :] - ddq) * hz
    return q + h * (dq + h * (ddq / 2 + h * jerk / 6)), dq + h * (ddq + h * jerk / 2), ddq + h * jerk
