"""Between a policy and an arm, once a millisecond: whatever the policy says, what is sent is within the arm's rules.

In this order: finite -> fresh (watchdog) -> soft start -> less where joints are or would get too fast -> low-pass ->
push away from position and velocity limits -> clip -> rate limit, last, against what the arm applied last. No clock
and no arm in here: `Driver` is a function of states and targets, and the tests give it a million hostile ones.

`Driver` keeps what has been and decides whether a motion goes on; below it are the rules, one compiled function each.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from r2s.actuation import Actuation, SoftLimits, low_pass_gain, soft_push
from r2s.arm.interface import ArmState, InverseInertia
from r2s.robot import SIM_DT, Robot

DEADLINE_S = 0.05  # without a fresh finite target, or PERIODS of a slow policy: then the arm is damped, and stopped
PERIODS = 2.5
DAMP_S = 0.5  # at most
ALLOWED = 0.92  # of the velocity limits: how fast joints may go at all
SLOWER = 0.8  # of what an arm allows near its position limits, where it allows less there
FREE = 0.65  # of the speed that is allowed: above, joints are braked and the policy loses authority
WALL_DDQ = 0.35  # of ddq_max, the deceleration that a way to a position limit is judged by
WALL_Q = 0.05  # rad within the position limits, where the allowed speed has come down to nothing
WALL_RATE = 40.0  # 1/s, of the braking: as fast as the delay of an arm bears, for what the posture weighs
PUSH_S = 0.04  # for which a target must not make a heavy joint faster than is allowed: a stretched arm is light
HEAVY = 0.1  # of the largest inertia at home: lighter joints are held by friction, which is not known here; but all
# count on an arm that allows less speed near position limits, or heavy joints throw the wrist over what is allowed
POSTURE = 8  # cycles between two looks at what the posture weighs
AHEAD_S = 0.035  # at home, that speeds are judged ahead, by accelerations below
AHEAD_GAIN = low_pass_gain(60.0)  # of the low-pass on those, per cycle
Q_INSIDE = 0.02  # rad within the position limits, where the arm is stopped
DQ_INSIDE = 0.95  # of the velocity limits
STILL = 0.02  # rad/s


class Rules(NamedTuple):
    """What holds for an arm wherever it is; arrays (n,).

    Attributes:
        q_min, q_max: rad. most: rad/s, how fast joints may go. brake: rad/s^2, twice the deceleration that a way to a
            position limit is judged by. heavy: whose speed a target must not carry over what is allowed.
        slowing, offset: those of Robot.slowing, the deceleration doubled; where there is none they bound nothing.
        soft_low, soft_high, soft_gain, soft_dq: as of r2s.actuation.SoftLimits.
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


class Driver:
    """The last word on every command.

    Attributes:
        stopping: why the arm is being brought to rest, or None. done: it rests, or has had its time: stop it now.

    Args:
        robot: its limits. torque: (n,) Nm, the most that a target may ask for.
        cutoff_hz: low-pass on the target. period_s: s between the targets of a policy.
        soft_start_s: s, over which the targets of a motion fade in; 0: not at all.
    """

    def __init__(
        self,
        robot: Robot,
        torque: np.ndarray,
        *,
        cutoff_hz: float = 100.0,
        period_s: float = 0.02,
        soft_start_s: float = 0.0,
    ):
        self.robot, self._torque, self._fade = robot, torque, round(soft_start_s / SIM_DT)
        self._deadline = max(DEADLINE_S, PERIODS * period_s)
        self._actuation = Actuation(robot, 1, cutoff_hz=cutoff_hz)
        self._step = robot.dtau_max * SIM_DT
        self._low, self._high = robot.q_min + Q_INSIDE, robot.q_max - Q_INSIDE
        self._fast = DQ_INSIDE * robot.dq_max
        self._inverse_inertia = InverseInertia(robot)
        self._home = 1 / np.diag(self._inverse_inertia(robot.q_home))
        soft = SoftLimits.of(robot, torque)
        self._dq_gain = soft.dq_gain
        slowing, offset = robot.slowing or (np.full(robot.n, 1e9), np.zeros(robot.n))
        heavy = HEAVY if robot.slowing is None else 0.0
        self._rules = Rules(
            robot.q_min, robot.q_max, ALLOWED * robot.dq_max, 2 * WALL_DDQ * robot.ddq_max,
            self._home >= heavy * self._home.max(), 2 * slowing, offset,
            soft.q_low, soft.q_high, soft.q_gain, soft.dq_soft,
        )  # fmt: skip
        self.reset()
        still = ArmState(0.0, robot.q_home, *np.zeros((3, robot.n)))
        self(still, None)  # what is compiled or loaded at the first call must not be so while an arm waits
        self.reset()

    def reset(self) -> None:
        """Begin a motion, from zero torque."""
        self._actuation.reset()
        self._target, self._ddq = np.zeros(self.robot.n), np.zeros(self.robot.n)
        self._dq: np.ndarray | None = None
        self._sent = np.zeros(self.robot.n)
        self._cycle, self._silent, self._damped = 0, 0, 0
        self._weighed: int | None = None
        self.stopping: str | None = None

    @property
    def effort(self) -> np.ndarray:
        """(n,) Nm, the target as it has come through the low-pass: what a policy sees of its own commands."""
        return self._actuation.last[0]

    @property
    def done(self) -> bool:
        """Whether a motion that is being stopped is at rest, or has had its time."""
        return self.stopping is not None and (self._rests or self._damped * SIM_DT >= DAMP_S)

    def __call__(self, state: ArmState, target: np.ndarray | None) -> np.ndarray:
        """Return the command (n,) Nm of this cycle.

        Args:
            state: of this cycle; where it is not finite the torque fades out.
            target: (n,) Nm that the policy wants; None where it has said nothing.
        """
        self._cycle += 1
        seen = _finite(state.q) and _finite(state.dq)
        if seen and (self._weighed is None or self._cycle - self._weighed >= POSTURE):
            self._weigh(state.q)
        if target is not None and np.isfinite(target).all():
            self._target = np.clip(target, -self._torque, self._torque)
            self._silent = 0
        else:
            self._silent += 1
        self._watch(state, seen)
        self._rests = seen and _rests(state.dq)
        stopping = self.stopping is not None
        self._damped += stopping
        if seen:
            before = state.dq if self._dq is None else self._dq
            soon = _ahead(state.dq, before, self._ddq, self._posture.weight)
            self._dq = state.dq
            fade = self._cycle / self._fade if self._cycle < self._fade else 1.0
            wanted, push = _shape(state.q, state.dq, soon, self._target, fade, stopping, self._rules, self._posture)
        else:
            wanted, push = np.zeros(self.robot.n), np.zeros(self.robot.n)
        wanted = self._actuation(wanted[None], 1)[0, 0] + push
        last = state.tau_J_d if _finite(state.tau_J_d) else self._sent
        self._sent = _within(wanted, last, self.robot.tau_max, self._step)
        return self._sent.copy()

    def _weigh(self, q: np.ndarray) -> None:
        """Let braking be as strong as the posture bears: what holds the arm at home shakes it where it is lighter."""
        mobility = self._inverse_inertia(q)
        felt = np.minimum(1 / np.diag(mobility), self._home)
        damping = WALL_RATE * felt
        self._weighed = self._cycle
        self._posture = Posture(mobility, felt / self._home, damping, np.minimum(self._dq_gain, damping))

    def _watch(self, state: ArmState, seen: bool) -> None:
        """Decide whether the motion goes on."""
        if self.stopping is not None:
            return
        if self._silent * SIM_DT > self._deadline:
            self.stopping = f"no finite action for {1e3 * self._deadline:g} ms"
        elif not seen:
            self.stopping = "the arm's state is not finite"
        elif not _inside(state.q, state.dq, self._low, self._high, self._fast):
            out = np.maximum(self._low - state.q, state.q - self._high)
            if (out > 0).any():
                j = int(out.argmax())
                self.stopping = f"joint {j + 1} is at {state.q[j]:.3f} rad, {Q_INSIDE:g} rad from its limit"
            else:
                j = int((np.abs(state.dq) / self._fast).argmax())
                self.stopping = f"joint {j + 1} is at {state.dq[j]:.3f} rad/s, {DQ_INSIDE:g} of its limit"


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
