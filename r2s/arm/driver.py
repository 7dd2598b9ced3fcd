"""Between a policy and an arm, once a millisecond: whatever the policy says, what is sent is within the arm's rules.

In this order: finite -> fresh (watchdog) -> soft start -> less where joints are or would get too fast -> low-pass ->
push away from position and velocity limits -> clip -> rate limit, last, against what the arm applied last. No clock
and no arm in here: `Driver` is a function of states and targets, and the tests give it a million hostile ones.

`Driver` keeps what has been and decides whether a motion goes on; below it are the rules, one compiled function each.
"""

import numpy as np

from r2s.arm.interface import ArmState
from r2s.physics.actuation import Actuation
from r2s.physics.limits import (
    ALLOWED,
    HEAVY,
    WALL_DDQ,
    WALL_RATE,
    Posture,
    Rules,
    SoftLimits,
    _ahead,
    _finite,
    _inside,
    _rests,
    _shape,
    _within,
)
from r2s.physics.rigid_body import InverseInertia
from r2s.physics.robot import SIM_DT, Robot

DEADLINE_S = 0.05  # without a fresh finite target, or PERIODS of a slow policy: then the arm is damped, and stopped
PERIODS = 2.5
DAMP_S = 0.5  # at most
POSTURE = 8  # cycles between two looks at what the posture weighs
Q_INSIDE = 0.02  # rad within the position limits, where the arm is stopped
DQ_INSIDE = 0.95  # of the velocity limits


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
