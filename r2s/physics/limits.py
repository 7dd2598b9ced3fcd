"""The driver's rules: soft limits, and how much a policy may do when joints are or would get too fast; compiled."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit

from r2s.physics.actuation import low_pass_gain
from r2s.physics.robot import SIM_DT, Robot

ALLOWED = 0.92  # of the velocity limits: how fast joints may go at all
SLOWER = 0.8  # of what an arm allows near its position limits, where it allows less there
FREE = 0.65  # of the speed that is allowed: above, joints are braked and the policy loses authority
WALL_DDQ = 0.35  # of ddq_max, the deceleration that a way to a position limit is judged by
WALL_Q = 0.05  # rad within the position limits, where the allowed speed has come down to nothing
WALL_RATE = 40.0  # 1/s, of the braking: as fast as the delay of an arm bears, for what the posture weighs
PUSH_S = 0.04  # for which a target must not make a heavy joint faster than is allowed: a stretched arm is light
HEAVY = 0.1  # of the largest inertia at home: lighter joints are held by friction, which is not known here; but all
# count on an arm that allows less speed near position limits, or heavy joints throw the wrist over what is allowed
AHEAD_S = 0.035  # at home, that speeds are judged ahead, by accelerations below
AHEAD_GAIN = low_pass_gain(60.0)  # of the low-pass on those, per cycle
STILL = 0.02  # rad/s


@dataclass(frozen=True)
class SoftLimits:
    """Torque that pushes a joint back before the arm would stop itself; n joints.

    Attributes:
        q_low, q_high: (n,) rad, where the push begins. q_gain: (n,) Nm/rad.
        dq_soft: (n,) rad/s, where it begins. dq_gain: (n,) Nm s/rad.
    """

    q_low: np.ndarray
    q_high: np.ndarray
    q_gain: np.ndarray
    dq_soft: np.ndarray
    dq_gain: np.ndarray

    @staticmethod
    def of(robot: Robot, torque: np.ndarray, *, q_margin: float = 0.1, dq_margin: float = 0.45) -> "SoftLimits":
        """Return limits that outweigh an action's full `torque` (n,) Nm at 2/3 of each margin.

        Args:
            robot: gives the hard limits.
            torque: what the policy can ask for.
            q_margin: rad before a position limit. dq_margin: share of dq_max before the velocity limit.
        """
        return SoftLimits(
            q_low=robot.q_min + q_margin,
            q_high=robot.q_max - q_margin,
            q_gain=1.5 * torque / q_margin,
            dq_soft=(1 - dq_margin) * robot.dq_max,
            dq_gain=1.5 * torque / (dq_margin * robot.dq_max),
        )

    def __call__(self, q: np.ndarray, dq: np.ndarray) -> np.ndarray:
        """Return the push (..., n) Nm at q, dq (..., n) rad, rad/s."""
        return soft_push(q, dq, self.q_low, self.q_high, self.q_gain, self.dq_soft, self.dq_gain)


@njit(cache=True)
def soft_push(q, dq, q_low, q_high, q_gain, dq_soft, dq_gain):
    """Return what SoftLimits does; compiled, for a loop at 1 kHz."""
    beyond = np.maximum(0.0, q - q_high) + np.minimum(0.0, q - q_low)
    fast = np.sign(dq) * np.maximum(0.0, np.abs(dq) - dq_soft)
    return -q_gain * beyond - dq_gain * fast


class Rules(NamedTuple):
    """What holds for an arm wherever it is; arrays (n,).

    Attributes:
        q_min, q_max: rad. most: rad/s, how fast joints may go. brake: rad/s^2, twice the deceleration that a way to a
            position limit is judged by. heavy: whose speed a target must not carry over what is allowed.
        slowing, offset: those of Robot.slowing, the deceleration doubled; where there is none they bound nothing.
        soft_low, soft_high, soft_gain, soft_dq: as of r2s.physics.actuation.SoftLimits.
    """

    q_min: np.ndarray
    q_max: np.ndarray
    most: np.ndarray
    brake: np.ndarray
    heavy: np.ndarray
    slowing: np.ndarray
    offset: np.ndarray
    soft_low: np.ndarray
    soft_high: np.ndarray
    soft_gain: np.ndarray
    soft_dq: np.ndarray


class Posture(NamedTuple):
    """What the arm weighs where it is.

    Attributes:
        mobility: (n, n) 1/(kg m^2), M^-1. weight: (n,), the inertia that a joint feels over that at home, at most 1.
        damping: (n,) Nm s/rad, of the braking. dq_gain: (n,) Nm s/rad, of the soft velocity limits.
    """

    mobility: np.ndarray
    weight: np.ndarray
    damping: np.ndarray
    dq_gain: np.ndarray


@njit(cache=True)
def _finite(x):
    return np.isfinite(x).all()


@njit(cache=True)
def _rests(dq):
    return (np.abs(dq) < STILL).all()


@njit(cache=True)
def _inside(q, dq, low, high, fast):
    return (q >= low).all() and (q <= high).all() and (np.abs(dq) <= fast).all()


@njit(cache=True)
def _ahead(dq, before, ddq, weight):
    """Return (n,) rad/s, how fast the joints will be by the time that the torque can be another: it takes ms.

    Less far ahead where a joint is lighter than at home: fed back late, its acceleration would shake it. `ddq` (n,)
    is kept from cycle to cycle.
    """
    ddq += AHEAD_GAIN * ((dq - before) / SIM_DT - ddq)
    return dq + AHEAD_S * weight * ddq


@njit(cache=True)
def _shape(q, dq, soon, target, fade, stopping, rules, posture):
    """Return the part of `target` (n,) Nm that is let through, and the push (n,) Nm that limits add."""
    up, down = _bounds(q, rules)
    push = soft_push(q, dq, rules.soft_low, rules.soft_high, rules.soft_gain, rules.soft_dq, posture.dq_gain)
    if stopping:
        return np.zeros_like(q), push - posture.damping * soon
    wanted = target * (fade * _authority(up, down, soon))
    wanted = wanted * _room(up, down, dq, wanted, rules.heavy, posture.mobility)
    return wanted, push + _wall(up, down, soon, posture.damping)


@njit(cache=True)
def _bounds(q, rules):
    """Return (n,) rad/s, how fast a joint may go up and down at q: less on the way to a position limit."""
    return _bound(rules.q_max - WALL_Q - q, rules), _bound(q - rules.q_min - WALL_Q, rules)


@njit(cache=True)
def _bound(way, rules):
    """Return (n,) rad/s for joints that have `way` (n,) rad left to WALL_Q from a position limit."""
    ours = np.sqrt(rules.brake * np.maximum(way, 0.0))
    arms = np.sqrt(rules.slowing * np.maximum(way + WALL_Q, 0.0) + rules.offset**2) - rules.offset
    return np.minimum(np.minimum(rules.most, ours), SLOWER * arms)


@njit(cache=True)
def _authority(up, down, dq):
    """Return the share of its torque that a policy has: less of all of it when any joint is nearly too fast.

    A light joint between heavy ones is thrown about by torques that are not its own.
    """
    near = np.maximum(dq / np.maximum(up, 1e-3), -dq / np.maximum(down, 1e-3)).max()
    return min(max((1.0 - near) / (1.0 - FREE), 0.0), 1.0)


@njit(cache=True)
def _room(up, down, dq, wanted, heavy, mobility):
    """Return the share of `wanted` (n,) Nm that in PUSH_S makes no heavy joint faster than is allowed.

    Speeds tell too late where the arm is light: with joints 1 and 3 in line, 10 Nm turn the elbow from rest to its
    limit within 10 ms, twice the delay of an arm.
    """
    gain = PUSH_S * (mobility @ wanted)
    left = np.where(gain > 0, up - dq, down + dq)
    share = np.maximum(left, 0.0) / np.maximum(np.abs(gain), 1e-9)
    return min(1.0, share[heavy].min())


@njit(cache=True)
def _wall(up, down, dq, damping):
    """Return (n,) Nm that brakes what is too fast, for where it is."""
    return -damping * (np.maximum(dq - FREE * up, 0.0) - np.maximum(-dq - FREE * down, 0.0))


@njit(cache=True)
def _within(wanted, last, tau_max, step):
    """Return (n,) Nm: clipped, then no further than `step` (n,) from what the arm applied last."""
    clipped = np.minimum(np.maximum(wanted, -tau_max), tau_max)
    return last + np.minimum(np.maximum(clipped - last, -step), step)
