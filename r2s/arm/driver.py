"""Between a policy and an arm, once a millisecond: whatever the policy says, what is sent is within the arm's rules.

In this order: finite -> fresh (watchdog) -> soft start -> low-pass -> what an adapter adds
(r2s/adaptation/adapter.py) -> the law of r2s/physics/limits.py, the same as in training -> rate limit, last, against
what the arm applied last. No clock and no arm in here: `Driver` is a function of states and targets, and the tests
give it a million hostile ones.

`Drivers` is that of many arms in lock-step, `Driver` that of one.
"""

from typing import Any, NamedTuple

import numpy as np

from r2s.arm.interface import ArmState
from r2s.compiled import njit
from r2s.physics.actuation import condition, low_pass_factor
from r2s.physics.limits import BRAKE_S, MOST, STEP, TAU_MAX, WORK, guard, limits
from r2s.physics.newton_euler import WORK as DESK
from r2s.physics.newton_euler import equations, links_of
from r2s.physics.robot import SIM_DT, Robot

DEADLINE_S = 0.05  # without a fresh finite target, or PERIODS of a slow policy: then the arm is braked, and stopped
PERIODS = 2.5
DAMP_S = 0.5  # at most
Q_INSIDE = 0.02  # rad within the position limits, where the arm is stopped
DQ_INSIDE = 0.95  # of the velocity limits
STILL = 0.02  # rad/s
ADDED = 0.3  # of tau_max, the most that an adapter adds: on a Panda 1.5 kg anywhere within reach, and friction
RUNS, SILENT, NOT_FINITE, OUTSIDE = range(4)  # `Memory.why`


class Memory(NamedTuple):
    """What the driver of m arms remembers from cycle to cycle; `drive` writes it.

    Attributes:
        target: (m, n) Nm, the last finite one. filtered, effort: (m, n) Nm, as of `Actuation`.
        sent: (m, n) Nm, the last command.
        share: (m,), of the allowed speeds that is left: 1, or less and less while the arm is brought to rest.
        cycle, silent, damped: (m,), cycles in all, since the last finite target, and of bringing to rest.
        why: (m,), RUNS or why the arm is brought to rest. rests: (m,), whether it is at rest.
        limited: (m,), cycles in which the law changed what was asked for.
    """

    target: np.ndarray
    filtered: np.ndarray
    effort: np.ndarray
    sent: np.ndarray
    share: np.ndarray
    cycle: np.ndarray
    silent: np.ndarray
    damped: np.ndarray
    why: np.ndarray
    limited: np.ndarray
    rests: np.ndarray

    @staticmethod
    def fresh(m: int, n: int) -> "Memory":
        """Return that of m arms of n joints before their first cycle, without torque."""
        count = np.zeros((5, m), dtype=np.int64)
        return Memory(*np.zeros((4, m, n)), np.ones(m), *count, np.zeros(m, dtype=bool))  # type: ignore[call-arg]


class Drivers:
    """The last word on every command of m arms.

    Attributes:
        stopping: m times why the arm is being brought to rest, or None.

    Args:
        robot: its limits, and what it is believed to weigh. torque: (n,) Nm, the most that a target may ask for.
        m: arms. cutoff_hz: low-pass on the target. period_s: s between the targets of a policy.
        soft_start_s: s, over which the targets of a motion fade in; 0: not at all.
        friction: (n,) Nm, how much is believed to hold each joint.
        rotors: (n,) kg m^2, believed inertia of each joint's rotor, as of `Dynamics.armature`; None: the robot's.
    """

    def __init__(
        self,
        robot: Robot,
        torque: np.ndarray,
        m: int,
        *,
        friction: np.ndarray,
        cutoff_hz: float = 100.0,
        period_s: float = 0.02,
        soft_start_s: float = 0.0,
        rotors: np.ndarray | None = None,
    ):
        self._shape, self._torque, self._limits = (m, robot.n), torque, limits(robot, torque)
        self._friction = np.array(friction, dtype=float)
        self._low, self._high = robot.q_min + Q_INSIDE, robot.q_max - Q_INSIDE
        self._fast, self._most = DQ_INSIDE * robot.dq_max, ADDED * robot.tau_max
        self._factor, self._fade = low_pass_factor(cutoff_hz), round(soft_start_s / SIM_DT)
        self._deadline = max(DEADLINE_S, PERIODS * period_s)
        own = robot.armature if rotors is None else np.array(rotors, dtype=float)
        self._arm = links_of(robot, robot.mass, robot.com, robot.inertia), own
        self.reset()
        still = np.zeros(self._shape)
        self(np.tile(robot.q_home, (m, 1)), still, still, None)  # to compile while no arm waits
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
    def limited(self) -> np.ndarray:
        """(m,), in how many cycles of the motion the law changed what was asked for."""
        return self._memory.limited

    @property
    def done(self) -> np.ndarray:
        """(m,), whether a motion that is being stopped is at rest, or has had its time."""
        m = self._memory
        return (m.why != RUNS) & (m.rests | (m.damped * SIM_DT >= DAMP_S))

    def __call__(
        self,
        q: np.ndarray,
        dq: np.ndarray,
        tau_J_d: np.ndarray,
        target: np.ndarray | None,
        added: np.ndarray | None = None,
    ) -> np.ndarray:
        """Return the commands (m, n) Nm of this cycle.

        Args:
            q, dq: (m, n) rad, rad/s, of this cycle; where they are not finite the torque fades out.
            tau_J_d: (m, n) Nm, what the arms applied last.
            target: (m, n) Nm that the policies want; None where they have said nothing.
            added: (m, n) Nm that adapters add in this cycle, up to ADDED of tau_max; None: there are none. Where it
                is not finite nothing is added, and a target that comes with it is not heard.
        """
        memory, said, adds = self._memory, target is not None, added is not None
        bounds = self._torque, self._low, self._high, self._fast, self._most
        settings = self._deadline, self._factor, self._fade
        arm = self._friction, *self._arm, self._limits
        wanted = target if said else q, said, added if adds else q, adds
        out = drive(q, dq, tau_J_d, *wanted, *bounds, *settings, *arm, memory)
        if memory.why.any():
            for i in np.flatnonzero(memory.why):
                if self.stopping[i] is None:
                    self.stopping[i] = self._reason(int(memory.why[i]), q[i], dq[i])
        return out

    def _reason(self, why: int, q: np.ndarray, dq: np.ndarray) -> str:
        """Return in words why the arm at q, dq (n,) is being brought to rest."""
        if why == SILENT:
            return f"no finite action for {1e3 * self._deadline:g} ms"
        if why == NOT_FINITE:
            return "the arm's state is not finite"
        out = np.maximum(self._low - q, q - self._high)
        if (out > 0).any():
            j = int(out.argmax())
            return f"joint {j + 1} is at {q[j]:.3f} rad, {Q_INSIDE:g} rad from its limit"
        j = int((np.abs(dq) / self._fast).argmax())
        return f"joint {j + 1} is at {dq[j]:.3f} rad/s, {DQ_INSIDE:g} of its limit"


@njit(cache=True)
def drive(
    q, dq, applied, target, said, added, adds, torque, low, high, fast, most, deadline, factor, fade,
    friction, links, armature, limits, memory,
):  # fmt: skip
    """Return the commands (m, n) Nm of this cycle; arguments as of `Drivers`, links: `links_of` the arm."""
    out, (m, n) = np.empty_like(memory.sent), q.shape
    work, effort = np.empty((2 * n + WORK, n)), np.empty((1, 1, n))
    inertia, bias, desk, weightless = np.empty((n, n)), np.empty(n), np.empty((n, DESK)), np.zeros(3)
    mass = np.empty(n * (n + 1) // 2)  # its lower triangle, row by row
    for i in range(m):
        seen = np.isfinite(q[i]).all() and np.isfinite(dq[i]).all()
        helped = adds and np.isfinite(added[i]).all()
        if said and np.isfinite(target[i]).all() and helped == adds:
            memory.target[i] = np.minimum(np.maximum(target[i], -torque), torque)
            memory.silent[i] = 0
        else:
            memory.silent[i] += 1
        if memory.why[i] == RUNS:
            if memory.silent[i] * SIM_DT > deadline:
                memory.why[i] = SILENT
            elif not seen:
                memory.why[i] = NOT_FINITE
            elif not ((q[i] >= low).all() and (q[i] <= high).all() and (np.abs(dq[i]) <= fast).all()):
                memory.why[i] = OUTSIDE
        stopping = memory.why[i] != RUNS
        memory.damped[i] += stopping
        memory.rests[i] = seen and (np.abs(dq[i]) < STILL).all()
        if stopping:  # from the speed that there is, at once
            memory.target[i] = 0.0
            if seen and memory.damped[i] == 1:
                memory.share[i] = min(1.0, (np.abs(dq[i]) / limits[:, MOST]).max())
            memory.share[i] = max(0.0, memory.share[i] - SIM_DT / BRAKE_S)  # compiled in: see limits.py
        at = slice(i, i + 1)
        condition(
            memory.target[at], memory.filtered[at], memory.effort[at], memory.cycle[at], 1, factor, fade,
            limits[:, TAU_MAX], limits[:, STEP], effort,
        )  # fmt: skip
        last = applied[i] if np.isfinite(applied[i]).all() else memory.sent[i]
        if seen:
            equations(links, weightless, q[i], dq[i], inertia, bias, desk)
            for j in range(n):
                inertia[j, j] += armature[j]
                for k in range(j + 1):
                    mass[j * (j + 1) // 2 + k] = inertia[j, k]
            share, now = memory.share[i], effort[0, 0]
            if helped and not stopping:
                faded = min(1.0, memory.cycle[i] / fade) if fade > 0 else 1.0
                for j in range(n):
                    now[j] += faded * min(max(added[i, j], -most[j]), most[j])
            changed = guard(q[i], dq[i], now, last, share, friction, mass, bias, limits, work, out[i])
            memory.limited[i] += changed
        else:
            for j in range(n):
                out[i, j] = last[j] + min(max(-last[j], -limits[j, STEP]), limits[j, STEP])
        memory.sent[i] = out[i]
    return out


class Driver:
    """The last word on every command of one arm; arguments as of `Drivers`."""

    def __init__(self, robot: Robot, torque: np.ndarray, friction: np.ndarray, **settings: Any):
        self._drivers = Drivers(robot, torque, 1, friction=friction, **settings)

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
    def limited(self) -> int:
        """In how many cycles of the motion the law changed what was asked for."""
        return int(self._drivers.limited[0])

    @property
    def done(self) -> bool:
        """Whether a motion that is being stopped is at rest, or has had its time."""
        return self.stopping is not None and bool(self._drivers.done[0])

    def __call__(self, state: ArmState, target: np.ndarray | None, added: np.ndarray | None = None) -> np.ndarray:
        """Return the command (n,) Nm of this cycle.

        Args:
            state: of the arm. target: (n,) Nm, None where the policy has said nothing.
            added: (n,) Nm that an adapter adds; None: there is none.
        """
        wanted, more = (None if x is None else x[None] for x in (target, added))
        return self._drivers(state.q[None], state.dq[None], state.tau_J_d[None], wanted, more)[0]
