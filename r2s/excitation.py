"""Motions worth recording: random Fourier series at a changing pace, so that every joint sees slow and fast.

The finite Fourier series is Swevers et al., IEEE T-RA 13(5), 1997. Friction curves need more than it gives: a
series of one pace spends little time near rest. So its clock runs through a ladder of paces, from crawling to
full speed, and stands still at both ends.
"""

from dataclasses import dataclass

import mujoco
import numpy as np

from r2s.errors import UserError
from r2s.robot import SIM_DT, Robot

PACES = (0.25, 1.0, 0.1, 0.55, 0.8)  # of full speed; one rung of the ladder each, again and again, slow first
BLEND_S = 0.5  # s between two rungs, and the fade at both ends
RANGE = 0.8  # of the way from the centre to the nearer position limit
SPEED = 0.7  # of dq_max
ACCELERATION = 0.7  # of ddq_max
CANDIDATES = 24
FINALISTS = 12  # checked against the table, which costs more than to draw
KINEMATICS_HZ = 50
MARGIN_M = 0.01  # of height, for what lies between two samples at 50 Hz
SPEED_BINS = (0.02, 0.08, 0.25, 0.5)  # of a joint's allowed speed: what coverage counts, per direction


@dataclass(frozen=True)
class Excitation:
    """A reference motion on a uniform clock, at rest at both ends.

    Attributes:
        t: (T,) s from 0. q, dq, ddq: (T, n) rad, rad/s, rad/s^2.

    """

    t: np.ndarray
    q: np.ndarray
    dq: np.ndarray
    ddq: np.ndarray


def fourier(
    robot: Robot,
    *,
    period: float = 10.0,
    harmonics: int = 5,
    duration: float,
    seed: int,
    dt: float = SIM_DT,
    q_center: np.ndarray | None = None,
    z_min: float = 0.1,
) -> Excitation:
    """Return a random motion within 80 % of the position range and 70 % of the speed and acceleration limits.

    Of several draws the one is taken whose worst joint covers slow and fast speeds of both directions best.
    The pace does not repeat in step with the series: the motion has no period, `Recording.period` stays None.

    Args:
        robot: its limits count, and its kinematics for `z_min`.
        period: s, of the series at full pace.
        harmonics: number of them.
        duration: s, ends included.
        seed: of the draw.
        dt: s.
        q_center: (n,) rad, the posture moved about; the middle of the position range by default.
        z_min: m, the end effector stays above this height; the rest of the arm and self-collision are not
            checked.

    Raises:
        UserError: an argument out of range, or no draw keeps the limits.

    """
    if harmonics < 1 or period <= 0 or dt <= 0:
        raise UserError(f"excitation: harmonics={harmonics}, period={period:g} s and dt={dt:g} s must be positive")
    if duration < 4 * BLEND_S:
        raise UserError(f"excitation.duration={duration:g} s is too short; at least {4 * BLEND_S:g} s")
    center = 0.5 * (robot.q_min + robot.q_max) if q_center is None else np.asarray(q_center, dtype=float)
    _check_center(robot, center)
    clock = _clock(duration, period, dt)
    rng = np.random.default_rng(seed)
    draws = [
        _series(clock, period, harmonics, rng.standard_normal((2, harmonics, robot.n))) for _ in range(CANDIDATES)
    ]
    draws = [_fit_limits(robot, center, draw) for draw in draws]
    height = _Height(robot)
    kept = []
    for draw in sorted(draws, key=lambda d: -coverage(robot, d[1]))[:FINALISTS]:
        if (scale := height.scale(center, draw[0], dt, z_min)) is not None:
            q, dq, ddq = (scale * x for x in draw)
            kept.append(Excitation(clock[0], center + q, dq, ddq))
    if kept:
        best = max(kept, key=lambda e: (coverage(robot, e.dq), np.ptp(e.q, axis=0).min()))
        check_limits(robot, best)
        return best
    raise UserError(
        f"excitation: no motion about q_center={np.round(center, 3).tolist()} keeps the end effector "
        f"{z_min:g} m above the base plane; give another excitation.q_center"
    )


def coverage(robot: Robot, dq: np.ndarray) -> float:
    """Return the least share of time that any joint spends in any speed bin of either direction.

    Args:
        robot: for its velocity limits.
        dq: (T, n) rad/s.

    """
    relative = dq / (SPEED * robot.dq_max)
    edges = np.array([*SPEED_BINS, 1.0 + 1e-9])
    edges = np.concatenate([-edges[::-1], edges])
    counts = np.array([np.histogram(x, edges)[0] for x in relative.T])
    return float(np.delete(counts, len(SPEED_BINS), axis=1).min() / len(dq))  # the middle bin is rest


def check_limits(robot: Robot, excitation: Excitation) -> None:
    """Raise UserError at the first joint whose position, velocity or acceleration leaves its limits."""
    e, r = excitation, robot
    for name, x, low, high, unit in (
        ("position", e.q, r.q_min, r.q_max, "rad"),
        ("velocity", e.dq, -r.dq_max, r.dq_max, "rad/s"),
        ("acceleration", e.ddq, -r.ddq_max, r.ddq_max, "rad/s^2"),
    ):
        bad = np.argwhere(~((x >= low) & (x <= high)))
        if len(bad):
            row, i = bad[0]
            raise UserError(
                f"excitation: {name} of joint {i + 1} is {x[row, i]:.4g} {unit} at {e.t[row]:.3f} s, "
                f"allowed {low[i]:g} to {high[i]:g}"
            )


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


def _clock(duration: float, period: float, dt: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return t, and the series' own time s with its first two derivatives by t, each (T,).

    The pace ds/dt goes from rung to rung, and from and to 0, by raised cosines: s is twice differentiable.
    """
    t = dt * np.arange(round(duration / dt) + 1)
    rung = max(0.35 * period, 2 * BLEND_S)  # not a divisor of the period
    count = max(1, round((duration - BLEND_S) / rung))
    starts = np.linspace(0, duration - BLEND_S, count + 1)
    levels = [0.0, *(PACES[k % len(PACES)] for k in range(count)), 0.0]
    s, pace, slope = np.zeros_like(t), np.full_like(t, levels[0]), np.zeros_like(t)
    for start, a, b in zip(starts, levels[:-1], levels[1:], strict=True):
        u = np.clip((t - start) / BLEND_S, 0, 1)
        pace += (b - a) * 0.5 * (1 - np.cos(np.pi * u))
        slope += (b - a) * 0.5 * np.pi / BLEND_S * np.sin(np.pi * u)
        # the integral of the raised cosine, then of the constant after it
        s += (b - a) * (0.5 * BLEND_S * (u - np.sin(np.pi * u) / np.pi) + np.maximum(t - start - BLEND_S, 0))
    return t, s, pace, slope


def _series(clock, period: float, harmonics: int, normal: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return offset, velocity and acceleration (T, n) for coefficients `normal` (2, harmonics, n)."""
    _, s, pace, slope = clock
    omega = 2 * np.pi / period * np.arange(1, harmonics + 1)
    angle = np.outer(s, omega)
    # falling with the harmonic: position range from the low ones, speed from the high ones
    a, b = normal / np.arange(1, harmonics + 1)[:, None]
    sine, cosine = np.sin(angle), np.cos(angle)
    q = sine @ a + cosine @ b
    first = (cosine * omega) @ a - (sine * omega) @ b
    second = -(sine * omega**2) @ a - (cosine * omega**2) @ b
    return q, first * pace[:, None], second * pace[:, None] ** 2 + first * slope[:, None]


def _fit_limits(robot: Robot, center: np.ndarray, draw):
    """Scale each joint of (q, dq, ddq) as far up as its position, velocity and acceleration allow."""
    q, dq, ddq = draw
    room = RANGE * np.array([robot.q_max - center, center - robot.q_min])
    reach = np.array([np.maximum(q.max(0), 1e-9), np.maximum(-q.min(0), 1e-9)])
    fastest, hardest = np.abs(dq).max(0), np.abs(ddq).max(0)
    scale = np.minimum((room / reach).min(0), SPEED * robot.dq_max / np.maximum(fastest, 1e-9))
    scale = np.minimum(scale, ACCELERATION * robot.ddq_max / np.maximum(hardest, 1e-9))
    return q * scale, dq * scale, ddq * scale


class _Height:
    """Shrinks a motion until the end effector stays above a plane."""

    def __init__(self, robot: Robot):
        self.model = robot.model(gravity=False)
        self.data = mujoco.MjData(self.model)
        self.site = self.model.site(robot.ee_site).id

    def scale(self, center: np.ndarray, offset: np.ndarray, dt: float, z_min: float) -> np.ndarray | None:
        """Return (n,) factors of at most 1 for `offset` (T, n); None where not even 0.3 of it would do.

        Each round takes 10 % from the joint that did most to bring the lowest point down.
        """
        factor = np.ones(len(center))
        every = max(1, round(1 / (KINEMATICS_HZ * dt)))
        fine = np.concatenate([offset[::every], offset[-1:]])
        coarse = fine[:: KINEMATICS_HZ // 10]  # most of the shrinking at 10 Hz, the last of it at 50
        for path in (coarse, fine):
            while True:
                heights = self._heights(center + factor * path)
                lowest = int(heights.argmin())
                if heights[lowest] >= z_min + MARGIN_M:
                    break
                sink = -self._climb(center + factor * path[lowest]) * factor * path[lowest]
                factor[int(sink.argmax())] *= 0.9
                if factor.min() < 0.3:
                    return None
        return factor

    def _heights(self, q: np.ndarray) -> np.ndarray:
        out = np.empty(len(q))
        for k, row in enumerate(q):
            self.data.qpos[:] = row
            mujoco.mj_kinematics(self.model, self.data)
            out[k] = self.data.site_xpos[self.site, 2]
        return out

    def _climb(self, q: np.ndarray) -> np.ndarray:
        """Return (n,) m/rad, how each joint raises the end effector."""
        self._heights(q[None])
        mujoco.mj_comPos(self.model, self.data)
        jacobian = np.zeros((3, self.model.nv))
        mujoco.mj_jacSite(self.model, self.data, jacobian, None, self.site)
        return jacobian[2]
