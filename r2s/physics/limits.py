"""The driver's rules: soft limits, and how much a policy may do when joints are or would get too fast; compiled."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit

from r2s.physics.actuation import low_pass_factor
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
AHEAD_FACTOR = low_pass_factor(60.0)  # of the low-pass on those, per cycle
STILL = 0.02  # rad/s


@dataclass(frozen=True)
class SoftLimits:
    """Torque that pushes a joint back before the arm would stop itself; n joints.

    Attributes:
        q_low, q_high: (n,) rad, where the push begins. q_stiffness: (n,) Nm/rad.
        dq_soft: (n,) rad/s, where it begins. dq_damping: (n,) Nm s/rad.
    """

    q_low: np.ndarray
    q_high: np.ndarray
    q_stiffness: np.ndarray
    dq_soft: np.ndarray
    dq_damping: np.ndarray

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
            q_stiffness=1.5 * torque / q_margin,
            dq_soft=(1 - dq_margin) * robot.dq_max,
            dq_damping=1.5 * torque / (dq_margin * robot.dq_max),
        )

    def __call__(self, q: np.ndarray, dq: np.ndarray) -> np.ndarray:
        """Return the push (..., n) Nm at q, dq (..., n) rad, rad/s."""
        return soft_push(q, dq, self.q_low, self.q_high, self.q_stiffness, self.dq_soft, self.dq_damping)


@njit(cache=True)
def soft_push(q, dq, q_low, q_high, q_stiffness, dq_soft, dq_damping):
    """Return what SoftLimits does; compiled, for a loop at 1 kHz."""
    beyond = np.maximum(0.0, q - q_high) + np.minimum(0.0, q - q_low)
    fast = np.sign(dq) * np.maximum(0.0, np.abs(dq) - dq_soft)
    return -q_stiffness * beyond - dq_damping * fast


class Rules(NamedTuple):
    """What holds for an arm wherever it is; arrays (n,).

    Attributes:
        q_min, q_max: rad. most: rad/s, how fast joints may go. brake: rad/s^2, twice the deceleration that a way to a
            position limit is judged by. heavy: whose speed a target must not carry over what is allowed.
        slowing, offset: those of Robot.slowing, the deceleration doubled; where there is none they bound nothing.
        soft_low, soft_high, soft_stiffness, soft_dq: as of `SoftLimits`.
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
    soft_stiffness: np.ndarray
    soft_dq: np.ndarray


class Driving(NamedTuple):
    """What the driver of an arm keeps to beside `Rules`; arrays (n,).

    Attributes:
        torque: Nm, the most that a target may ask for. tau_max: Nm. step: Nm, most change of a command in a cycle.
        low, high: rad, and fast: rad/s, beyond which the arm is brought to rest.
        factor: of the low-pass on the target, per cycle. deadline: s without a fresh finite target.
        fade: cycles over which the targets of a motion fade in; 0: not at all.
    """

    torque: np.ndarray
    tau_max: np.ndarray
    step: np.ndarray
    low: np.ndarray
    high: np.ndarray
    fast: np.ndarray
    factor: float
    deadline: float
    fade: int


class Posture(NamedTuple):
    """What the arm weighs where it is.

    Attributes:
        mobility: (n, n) 1/(kg m^2), M^-1. weight: (n,), the inertia that a joint feels over that at home, at most 1.
        damping: (n,) Nm s/rad, of the braking. soft_damping: (n,) Nm s/rad, of the soft velocity limits.
    """

    mobility: np.ndarray
    weight: np.ndarray
    damping: np.ndarray
    soft_damping: np.ndarray


class Memory(NamedTuple):
    """What the driver of m arms remembers from cycle to cycle; `drive` and `due` write it.

    Attributes:
        target: (m, n) Nm, the last finite one. filtered, effort: (m, n) Nm, of the low-pass, and what it let through.
        sent: (m, n) Nm, the last command. before: (m, n) rad/s, of the cycle before; nan: there was none.
        ddq: (m, n) rad/s^2, low-passed. mobility (m, n, n), weight, damping, soft_damping (m, n): `Posture`.
        cycle, silent, damped: (m,), cycles in all, since the last finite target, and of bringing to rest.
        weighed: (m,), the cycle of the last look at the posture; -1: there was none.
        why: (m,), RUNS or why the arm is brought to rest. rests: (m,), whether it is at rest.
    """

    target: np.ndarray
    filtered: np.ndarray
    effort: np.ndarray
    sent: np.ndarray
    before: np.ndarray
    ddq: np.ndarray
    mobility: np.ndarray
    weight: np.ndarray
    damping: np.ndarray
    soft_damping: np.ndarray
    cycle: np.ndarray
    silent: np.ndarray
    damped: np.ndarray
    weighed: np.ndarray
    why: np.ndarray
    rests: np.ndarray

    @staticmethod
    def fresh(m: int, n: int) -> "Memory":
        """Return that of m arms of n joints before their first cycle, without torque."""
        rows, square, count = np.zeros((9, m, n)), np.zeros((m, n, n)), np.zeros((5, m), dtype=np.int64)
        rows[4], count[3] = np.nan, -1
        return Memory(*rows[:6], square, *rows[6:], *count, np.zeros(m, dtype=bool))  # type: ignore[call-arg]


RUNS, SILENT, NOT_FINITE, OUTSIDE = range(4)  # `Memory.why`


@njit(cache=True)
def due(q, dq, every, memory):
    """Begin a cycle; return (m,), whose posture was looked at `every` cycles ago."""
    out = np.empty(len(q), np.bool_)
    for i in range(len(q)):
        memory.cycle[i] += 1
        long = memory.weighed[i] < 0 or memory.cycle[i] - memory.weighed[i] >= every
        out[i] = long and _finite(q[i]) and _finite(dq[i])
    return out


@njit(cache=True)
def drive(q, dq, applied, target, said, driving, rules, memory):
    """Return the commands (m, n) Nm of this cycle; r2s/arm/driver.py says in which order what is done.

    Args:
        q, dq: (m, n) rad, rad/s, where they are not finite the torque fades out. applied: (m, n) Nm, tau_J_d.
        target: (m, n) Nm. said: whether the policies said anything in this cycle.
        driving, rules, memory: what the arms are held to, and what has been; `due` has begun the cycle.
    """
    out = np.empty_like(memory.sent)
    for i in range(len(q)):
        seen = _finite(q[i]) and _finite(dq[i])
        if said and _finite(target[i]):
            memory.target[i] = np.minimum(np.maximum(target[i], -driving.torque), driving.torque)
            memory.silent[i] = 0
        else:
            memory.silent[i] += 1
        if memory.why[i] == RUNS:
            if memory.silent[i] * SIM_DT > driving.deadline:
                memory.why[i] = SILENT
            elif not seen:
                memory.why[i] = NOT_FINITE
            elif not _inside(q[i], dq[i], driving.low, driving.high, driving.fast):
                memory.why[i] = OUTSIDE
        memory.rests[i] = seen and _rests(dq[i])
        stopping = memory.why[i] != RUNS
        memory.damped[i] += stopping
        if seen:
            before = dq[i] if np.isnan(memory.before[i, 0]) else memory.before[i]
            soon = _ahead(dq[i], before, memory.ddq[i], memory.weight[i])
            memory.before[i] = dq[i]
            fade = memory.cycle[i] / driving.fade if memory.cycle[i] < driving.fade else 1.0
            posture = Posture(memory.mobility[i], memory.weight[i], memory.damping[i], memory.soft_damping[i])
            wanted, push = _shape(q[i], dq[i], soon, memory.target[i], fade, stopping, rules, posture)
        else:
            wanted, push = np.zeros(q.shape[1]), np.zeros(q.shape[1])
        last = applied[i] if _finite(applied[i]) else memory.sent[i]
        for j in range(q.shape[1]):  # as r2s.physics.actuation.Actuation
            memory.filtered[i, j] += driving.factor * (wanted[j] - memory.filtered[i, j])
            clipped = min(max(memory.filtered[i, j], -driving.tau_max[j]), driving.tau_max[j])
            change = clipped - memory.effort[i, j]
            memory.effort[i, j] += min(max(change, -driving.step[j]), driving.step[j])
        memory.sent[i] = _within(memory.effort[i] + push, last, driving.tau_max, driving.step)
        out[i] = memory.sent[i]
    return out


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
    ddq += AHEAD_FACTOR * ((dq - before) / SIM_DT - ddq)
    return dq + AHEAD_S * weight * ddq


@njit(cache=True)
def _shape(q, dq, soon, target, fade, stopping, rules, posture):
    """Return the part of `target` (n,) Nm that is let through, and the push (n,) Nm that limits add."""
    up, down = _bounds(q, rules)
    push = soft_push(
        q, dq, rules.soft_low, rules.soft_high, rules.soft_stiffness, rules.soft_dq, posture.soft_damping
    )
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
