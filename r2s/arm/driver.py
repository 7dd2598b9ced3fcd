"""Between a policy and an arm, once a millisecond: whatever the policy says, what is sent is within the arm's rules.

In this order: finite -> fresh (watchdog) -> soft start -> less where joints are or would get too fast -> low-pass ->
push away from position and velocity limits -> clip -> rate limit, last, against what the arm applied last. No clock
and no arm in here: `Driver` is a function of states and targets, and the tests give it a million hostile ones.

`Drivers` is that of many arms in lock-step, `Driver` that of one; the law is compiled, r2s/physics/limits.py.
"""

import numpy as np

from r2s.arm.interface import ArmState
from r2s.physics import limits
from r2s.physics.actuation import low_pass_factor
from r2s.physics.limits import ALLOWED, HEAVY, WALL_DDQ, WALL_RATE, Driving, Memory, Rules, SoftLimits
from r2s.physics.rigid_body import InverseInertia
from r2s.physics.robot import SIM_DT, Robot

DEADLINE_S = 0.05  # without a fresh finite target, or PERIODS of a slow policy: then the arm is damped, and stopped
PERIODS = 2.5
DAMP_S = 0.5  # at most
POSTURE = 8  # cycles between two looks at what the posture weighs
Q_INSIDE = 0.02  # rad within the position limits, where the arm is stopped
DQ_INSIDE = 0.95  # of the velocity limits


class Drivers:
    """The last word on every command of m arms.

    Attributes:
        stopping: m times why the arm is being brought to rest, or None.

    Args:
        robot: its limits. torque: (n,) Nm, the most that a target may ask for. m: arms.
        cutoff_hz: low-pass on the target. period_s: s between the targets of a policy.
        soft_start_s: s, over which the targets of a motion fade in; 0: not at all.
    """

    def __init__(
        self,
        robot: Robot,
        torque: np.ndarray,
        m: int,
        *,
        cutoff_hz: float = 100.0,
        period_s: float = 0.02,
        soft_start_s: float = 0.0,
    ):
        self._shape = m, robot.n
        self._inverse_inertia = InverseInertia(robot, m)
        home = np.tile(robot.q_home, (m, 1))
        self._home = 1 / np.diag(self._inverse_inertia(home)[0])
        soft = SoftLimits.of(robot, torque)
        self._soft_damping = soft.dq_damping
        slowing, offset = robot.slowing or (np.full(robot.n, 1e9), np.zeros(robot.n))
        heavy = HEAVY if robot.slowing is None else 0.0
        self._rules = Rules(
            robot.q_min, robot.q_max, ALLOWED * robot.dq_max, 2 * WALL_DDQ * robot.ddq_max,
            self._home >= heavy * self._home.max(), 2 * slowing, offset,
            soft.q_low, soft.q_high, soft.q_stiffness, soft.dq_soft,
        )  # fmt: skip
        self._driving = Driving(
            torque, robot.tau_max, robot.dtau_max * SIM_DT,
            robot.q_min + Q_INSIDE, robot.q_max - Q_INSIDE, DQ_INSIDE * robot.dq_max,
            low_pass_factor(cutoff_hz), max(DEADLINE_S, PERIODS * period_s), round(soft_start_s / SIM_DT),
        )  # fmt: skip
        self.reset()
        still = np.zeros(self._shape)
        self(home, still, still, None)  # what is compiled at the first call must not be so while an arm waits
        self.reset()

    def reset(self) -> None:
        """Begin a motion, from zero torque."""
        self._memory = Memory.fresh(*self._shape)
        self.stopping: list[str | None] = [None] * self._shape[0]

    @property
    def effort(self) -> np.ndarray:
        """(m, n) Nm, the targets as they have come through the low-pass: what a policy sees of its own commands."""
        return self._memory.effort

    @property
    def done(self) -> np.ndarray:
        """(m,), whether a motion that is being stopped is at rest, or has had its time."""
        m = self._memory
        return (m.why != limits.RUNS) & (m.rests | (m.damped * SIM_DT >= DAMP_S))

    def __call__(self, q: np.ndarray, dq: np.ndarray, tau_J_d: np.ndarray, target: np.ndarray | None) -> np.ndarray:
        """Return the commands (m, n) Nm of this cycle.

        Args:
            q, dq: (m, n) rad, rad/s, of this cycle; where they are not finite the torque fades out.
            tau_J_d: (m, n) Nm, what the arms applied last.
            target: (m, n) Nm that the policies want; None where they have said nothing.
        """
        memory = self._memory
        due = limits.due(q, dq, POSTURE, memory)
        if due.any():
            self._weigh(q, np.flatnonzero(due))
        said = target is not None
        out = limits.drive(q, dq, tau_J_d, target if said else q, said, self._driving, self._rules, memory)
        if memory.why.any():
            for i in np.flatnonzero(memory.why):
                if self.stopping[i] is None:
                    self.stopping[i] = self._reason(int(memory.why[i]), q[i], dq[i])
        return out

    def _weigh(self, q: np.ndarray, ids: np.ndarray) -> None:
        """Let braking be as strong as the posture bears: what holds the arm at home shakes it where it is lighter."""
        memory, mobility = self._memory, self._inverse_inertia(q[ids], ids)
        felt = np.minimum(1 / np.diagonal(mobility, axis1=1, axis2=2), self._home)
        damping = WALL_RATE * felt
        memory.weighed[ids], memory.mobility[ids] = memory.cycle[ids], mobility
        memory.weight[ids], memory.damping[ids] = felt / self._home, damping
        memory.soft_damping[ids] = np.minimum(self._soft_damping, damping)

    def _reason(self, why: int, q: np.ndarray, dq: np.ndarray) -> str:
        """Return in words why the arm at q, dq (n,) is being brought to rest."""
        driving = self._driving
        if why == limits.SILENT:
            return f"no finite action for {1e3 * driving.deadline:g} ms"
        if why == limits.NOT_FINITE:
            return "the arm's state is not finite"
        out = np.maximum(driving.low - q, q - driving.high)
        if (out > 0).any():
            j = int(out.argmax())
            return f"joint {j + 1} is at {q[j]:.3f} rad, {Q_INSIDE:g} rad from its limit"
        j = int((np.abs(dq) / driving.fast).argmax())
        return f"joint {j + 1} is at {dq[j]:.3f} rad/s, {DQ_INSIDE:g} of its limit"


class Driver:
    """The last word on every command of one arm; arguments as of `Drivers`."""

    def __init__(self, robot: Robot, torque: np.ndarray, **settings: float):
        self._drivers = Drivers(robot, torque, 1, **settings)

    def reset(self) -> None:
        """Begin a motion, from zero torque."""
        self._drivers.reset()

    @property
    def stopping(self) -> str | None:
        """Why the arm is being brought to rest, or None."""
        return self._drivers.stopping[0]

    @property
    def effort(self) -> np.ndarray:
        """(n,) Nm, the target as it has come through the low-pass: what a policy sees of its own commands."""
        return self._drivers.effort[0]

    @property
    def done(self) -> bool:
        """Whether a motion that is being stopped is at rest, or has had its time."""
        return bool(self._drivers.done[0])

    def __call__(self, state: ArmState, target: np.ndarray | None) -> np.ndarray:
        """Return the command (n,) Nm of this cycle; `target` (n,) Nm, None where the policy has said nothing."""
        wanted = None if target is None else target[None]
        return self._drivers(state.q[None], state.dq[None], state.tau_J_d[None], wanted)[0]
