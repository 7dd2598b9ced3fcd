"""Between a policy and an arm, once a millisecond: whatever the policy says, what is sent is within the arm's rules.

In this order: finite -> fresh (watchdog) -> soft start -> less where joints are or would get too fast -> low-pass ->
push away from position and velocity limits -> clip -> rate limit, last, against what the arm applied last. No clock
and no arm in here: `Driver` is a function of states and targets, and the tests give it a million hostile ones.
"""

from dataclasses import replace

import numpy as np

from r2s.actuation import Actuation, SoftLimits, low_pass_gain
from r2s.arm.interface import ArmState, InverseInertia
from r2s.robot import SIM_DT, Robot

DEADLINE_S = 0.05  # without a fresh finite target: then the arm is damped, and stopped when it rests
DAMP_S = 0.5  # at most
ALLOWED = 0.92  # of the velocity limits: how fast joints may go at all
FREE = 0.65  # of the speed that is allowed: above, joints are braked and the policy loses authority
WALL_DDQ = 0.35  # of ddq_max, the deceleration that a way to a position limit is judged by
WALL_Q = 0.05  # rad within the position limits, where the allowed speed has come down to nothing
WALL_RATE = 40.0  # 1/s, of the braking: as fast as the delay of an arm bears, for what the posture weighs
PUSH_S = 0.04  # for which a target must not make a heavy joint faster than is allowed: a stretched arm is light
HEAVY = 0.1  # of the largest inertia at home: lighter joints are held by friction, which is not known here
POSTURE = 8  # cycles between two looks at what the posture weighs
AHEAD_S = 0.035  # at home, that speeds are judged ahead, by accelerations below
AHEAD_HZ = 60.0
Q_INSIDE = 0.02  # rad within the position limits, where the arm is stopped
DQ_INSIDE = 0.95  # of the velocity limits
STILL = 0.02  # rad/s


class Driver:
    """The last word on every command.

    Attributes:
        stopping: why the arm is being brought to rest, or None. done: it rests, or has had its time: stop it now.

    Args:
        robot: its limits. torque: (n,) Nm, the most that a target may ask for.
        cutoff_hz: low-pass on the target.
        soft_start_s: s, over which the targets of a motion fade in; 0: not at all.
    """

    def __init__(self, robot: Robot, torque: np.ndarray, *, cutoff_hz: float = 100.0, soft_start_s: float = 0.0):
        self.robot, self._torque, self._fade = robot, torque, round(soft_start_s / SIM_DT)
        self._actuation = Actuation(robot, 1, cutoff_hz=cutoff_hz)
        self._soft = SoftLimits.of(robot, torque)
        self._step = robot.dtau_max * SIM_DT
        self._low, self._high = robot.q_min + Q_INSIDE, robot.q_max - Q_INSIDE
        self._fast = DQ_INSIDE * robot.dq_max
        self._dq_gain, self._weight = self._soft.dq_gain, np.ones(robot.n)
        self._inverse_inertia = InverseInertia(robot)
        self._home = 1 / np.diag(self._inverse_inertia(robot.q_home))
        self._heavy = self._home >= HEAVY * self._home.max()
        self.reset()

    def reset(self) -> None:
        """Begin a motion, from zero torque."""
        self._actuation.reset()
        self._target, self._ddq = np.zeros(self.robot.n), np.zeros(self.robot.n)
        self._dq: np.ndarray | None = None
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
        seen = bool(np.isfinite(state.q).all() and np.isfinite(state.dq).all())
        if seen and (self._weighed is None or self._cycle - self._weighed >= POSTURE):
            self._weigh(state.q)
        if target is not None and np.isfinite(target).all():
            self._target = np.clip(target, -self._torque, self._torque)
            self._silent = 0
        else:
            self._silent += 1
        self._watch(state, seen)
        self._rests = seen and bool((np.abs(state.dq) < STILL).all())
        wanted, push = np.zeros(self.robot.n), np.zeros(self.robot.n)
        if seen:
            bounds, soon = self._bounds(state.q), self._ahead(state.dq)
            push = self._soft(state.q, state.dq) + self._wall(bounds, soon)
        if self.stopping is not None:
            self._damped += 1
        else:  # the state is seen, or the motion would be stopping
            fade = self._cycle / self._fade if self._cycle < self._fade else 1.0
            wanted = self._target * (fade * self._authority(bounds, soon))
            wanted = wanted * self._room(bounds, state.dq, wanted)
        wanted = self._actuation(wanted[None], 1)[0, 0] + push
        wanted = np.clip(wanted, -self.robot.tau_max, self.robot.tau_max)
        return state.tau_J_d + np.clip(wanted - state.tau_J_d, -self._step, self._step)

    def _weigh(self, q: np.ndarray) -> None:
        """Let braking be as strong as the posture bears: what holds the arm at home shakes it where it is lighter."""
        self._weighed, self._mobility = self._cycle, self._inverse_inertia(q)
        felt = np.minimum(1 / np.diag(self._mobility), self._home)
        self._weight, self._damping = felt / self._home, WALL_RATE * felt
        self._soft = replace(self._soft, dq_gain=np.minimum(self._dq_gain, self._damping))

    def _ahead(self, dq: np.ndarray) -> np.ndarray:
        """Return (n,) rad/s, how fast the joints will be by the time that the torque can be another: it takes ms.

        Less far ahead where a joint is lighter than at home: fed back late, its acceleration would shake it.
        """
        before = dq if self._dq is None else self._dq
        self._ddq += low_pass_gain(AHEAD_HZ) * ((dq - before) / SIM_DT - self._ddq)
        self._dq = dq
        return dq + AHEAD_S * self._weight * self._ddq

    def _bounds(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return (n,) rad/s, how fast a joint may go up and down at q: less on the way to a position limit."""
        r, brake = self.robot, 2 * WALL_DDQ * self.robot.ddq_max
        up = np.sqrt(brake * np.maximum(r.q_max - WALL_Q - q, 0.0))
        down = np.sqrt(brake * np.maximum(q - r.q_min - WALL_Q, 0.0))
        most = ALLOWED * r.dq_max
        return np.minimum(most, up), np.minimum(most, down)

    def _authority(self, bounds: tuple[np.ndarray, np.ndarray], dq: np.ndarray) -> float:
        """Return the share of its torque that a policy has: less of all of it when any joint is nearly too fast.

        A light joint between heavy ones is thrown about by torques that are not its own.
        """
        up, down = bounds
        near = np.maximum(dq / np.maximum(up, 1e-3), -dq / np.maximum(down, 1e-3)).max()
        return float(np.clip((1.0 - near) / (1.0 - FREE), 0.0, 1.0))

    def _room(self, bounds: tuple[np.ndarray, np.ndarray], dq: np.ndarray, wanted: np.ndarray) -> float:
        """Return the share of `wanted` (n,) Nm that in PUSH_S makes no heavy joint faster than is allowed.

        Speeds tell too late where the arm is light: with joints 1 and 3 in line, 10 Nm turn the elbow from rest to
        its limit within 10 ms, twice the delay of an arm.
        """
        up, down = bounds
        gain = PUSH_S * (self._mobility @ wanted)
        left = np.where(gain > 0, up - dq, down + dq)
        share = np.maximum(left, 0.0) / np.maximum(np.abs(gain), 1e-9)
        return float(min(1.0, share[self._heavy].min()))

    def _wall(self, bounds: tuple[np.ndarray, np.ndarray], dq: np.ndarray) -> np.ndarray:
        """Return (n,) Nm that brakes what is too fast, for where it is; anything, when the motion is to end."""
        if self.stopping is not None:
            return -self._damping * dq
        up, down = bounds
        return -self._damping * (np.maximum(dq - FREE * up, 0.0) - np.maximum(-dq - FREE * down, 0.0))

    def _watch(self, state: ArmState, seen: bool) -> None:
        """Decide whether the motion goes on."""
        if self.stopping is not None:
            return
        if self._silent * SIM_DT > DEADLINE_S:
            self.stopping = f"no finite action for {1e3 * DEADLINE_S:g} ms"
        elif not seen:
            self.stopping = "the arm's state is not finite"
        elif (state.q < self._low).any() or (state.q > self._high).any():
            j = int(np.maximum(self._low - state.q, state.q - self._high).argmax())
            self.stopping = f"joint {j + 1} is at {state.q[j]:.3f} rad, {Q_INSIDE:g} rad from its limit"
        elif (np.abs(state.dq) > self._fast).any():
            j = int((np.abs(state.dq) / self._fast).argmax())
            self.stopping = f"joint {j + 1} is at {state.dq[j]:.3f} rad/s, {DQ_INSIDE:g} of its limit"
