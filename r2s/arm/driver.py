"""The driver: once a millisecond it turns a policy's command into a torque that respects the arm's limits.

In this order: check that the command is finite and fresh (watchdog) -> control law (r2s/physics/control_laws.py) ->
soft start and low-pass -> torque of an adapter (r2s/adaptation/adapter.py) -> safety filter
(r2s/physics/safety_filter.py), the same as in training -> rate limit, last, against the torque that the arm applied
last. The driver has no clock and no arm: it is a function of states and commands, and the tests give it a million
hostile ones.

`DriverBatch` drives many arms in lock-step, `Driver` one.
"""

from collections.abc import Callable
from functools import cache
from types import FunctionType
from typing import Any, NamedTuple

import numpy as np

from r2s.arm.interface import ArmState
from r2s.compiled import njit
from r2s.physics.actuation import condition, low_pass_factor
from r2s.physics.control_laws import BUILT_IN, ControlLaw, chain, control_law, law_number, registered, torque_law
from r2s.physics.newton_euler import WORK as DESK
from r2s.physics.newton_euler import equations, links_of
from r2s.physics.robot import SIM_DT, Robot
from r2s.physics.safety_filter import (
    BRAKE_S,
    DQ_ALLOWED,
    STEP,
    TAU_MAX,
    WORK,
    JointDynamics,
    filter_limits,
    filter_torque,
)

DEADLINE_S = 0.05  # s without a fresh finite command, or PERIODS of a slow policy: then the arm is braked and stopped
PERIODS = 2.5  # control periods
DAMP_S = 0.5  # s, longest time to bring an arm to rest
Q_INSIDE = 0.02  # rad inside the position limits, where the arm is stopped
DQ_INSIDE = 0.95  # share of the velocity limits, where the arm is stopped
STILL = 0.02  # rad/s, below which a joint is at rest
ADDED = 0.3  # share of tau_max that an adapter may add: on a Panda 1.5 kg anywhere within reach, and friction
RUNS, SILENT, NOT_FINITE, OUTSIDE, LAW_NOT_FINITE = range(5)  # values of `Memory.why`


class Memory(NamedTuple):
    """State of the driver of m arms, which `drive_cycle` updates.

    Attributes:
        command: (m, c), the last finite one. law: (m, k), memory of the control law.
        target: (m, n) Nm, torque of the control law. filtered, effort: (m, n) Nm, see `Actuation`.
        sent: (m, n) Nm, the last torque command.
        share: (m,), share of the allowed speeds: 1, and falling while the arm is brought to rest.
        cycle, silent, damped: (m,), cycles in all, since the last finite command, and of braking.
        why: (m,), RUNS or why the arm is brought to rest. limited: (m,), cycles that the safety filter changed.
        rests: (m,), whether the arm is at rest. commanded: (m,), whether there was a command.
    """

    command: np.ndarray
    law: np.ndarray
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
    commanded: np.ndarray

    @staticmethod
    def fresh(m: int, n: int, command: int, law: int) -> "Memory":
        """Return the state of m arms of n joints before their first cycle, without torque."""
        own = np.zeros((m, command)), np.zeros((m, law))
        count, flags = np.zeros((5, m), dtype=np.int64), np.zeros((2, m), dtype=bool)
        return Memory(*own, *np.zeros((4, m, n)), np.ones(m), *count, *flags)  # type: ignore[call-arg]


class Given(NamedTuple):
    """Inputs of a cycle: command (m, c) if `new`, torque `added` (m, n) Nm of an adapter if `adds`."""

    command: np.ndarray
    new: bool
    added: np.ndarray
    adds: bool


class Bounds(NamedTuple):
    """Limits of an arm: target and adapter torque (n,) Nm, stop limits (n,) rad and rad/s, and three numbers.

    deadline: s without a command. factor: of the low-pass. fade: cycles of the soft start.
    """

    torque: np.ndarray
    added: np.ndarray
    q_low: np.ndarray
    q_high: np.ndarray
    dq_max: np.ndarray
    deadline: float
    factor: float
    fade: int


class Model(NamedTuple):
    """Model of the arm: friction (n,) Nm, links of `links_of`, rotors (n,) kg m^2, limits of `filter_limits`."""

    friction: np.ndarray
    links: np.ndarray
    rotors: np.ndarray
    limits: np.ndarray


class DriverBatch:
    """The last stage of every torque command of m arms.

    Attributes:
        stopping: m times why the arm is being brought to rest, or None.

    Args:
        robot: its limits and nominal links. torque: (n,) Nm, largest target.
        m: arms. cutoff_hz: low-pass on the target. period_s: s between the commands of a policy.
        soft_start_s: s over which the targets of a motion fade in; 0: not at all.
        friction: (n,) Nm, level of each joint's friction. rotors: (n,) kg m^2, see `Dynamics.armature`; None: the
            robot's. control: control law; None: commands are torques (n,) Nm.
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
        control: ControlLaw | None = None,
    ):
        self._shape = m, robot.n
        self._sizes = (robot.n, 0) if control is None else (control.command_size, control.memory_size)
        number = law_number(torque_law if control is None else control.law)
        self._control = float(number), np.zeros(0) if control is None else control.parameters
        self._drive = compiled_cycle(registered() if number >= len(BUILT_IN) else BUILT_IN)
        self._bounds = Bounds(
            torque=np.array(torque, dtype=float),
            added=ADDED * robot.tau_max,
            q_low=robot.q_min + Q_INSIDE,
            q_high=robot.q_max - Q_INSIDE,
            dq_max=DQ_INSIDE * robot.dq_max,
            deadline=max(DEADLINE_S, PERIODS * period_s),
            factor=low_pass_factor(cutoff_hz),
            fade=round(soft_start_s / SIM_DT),
        )
        self._model = Model(
            friction=np.array(friction, dtype=float),
            links=links_of(robot, robot.mass, robot.com, robot.inertia),
            rotors=robot.armature if rotors is None else np.array(rotors, dtype=float),
            limits=filter_limits(robot, torque),
        )
        self.reset()
        still = np.zeros(self._shape)
        self(np.tile(robot.q_home, (m, 1)), still, still, None)  # compile before an arm waits
        self.reset()

    def reset(self) -> None:
        """Begin a motion, from zero torque."""
        self._memory = Memory.fresh(*self._shape, *self._sizes)
        self.stopping: list[str | None] = [None] * self._shape[0]

    @property
    def effort(self) -> np.ndarray:
        """(m, n) Nm, the target torques after the low-pass, which policies observe."""
        return self._memory.effort

    @property
    def limited(self) -> np.ndarray:
        """(m,), number of cycles of the motion in which the safety filter changed the command."""
        return self._memory.limited

    @property
    def done(self) -> np.ndarray:
        """(m,), whether a motion that is being stopped is at rest, or DAMP_S is over."""
        m = self._memory
        return (m.why != RUNS) & (m.rests | (m.damped * SIM_DT >= DAMP_S))

    def __call__(
        self,
        q: np.ndarray,
        dq: np.ndarray,
        tau_J_d: np.ndarray,
        command: np.ndarray | None,
        added: np.ndarray | None = None,
    ) -> np.ndarray:
        """Return the torque commands (m, n) Nm of this cycle.

        Args:
            q, dq: (m, n) rad, rad/s, of this cycle; if they are not finite the torque fades out.
            tau_J_d: (m, n) Nm, the torque that the arms applied last.
            command: (m, c) of the controller; None: no new one.
            added: (m, n) Nm of adapters in this cycle, clipped to ADDED of tau_max; None: no adapter. If it is not
                finite, nothing is added, and the command of the same cycle is ignored.
        """
        memory, new, adds = self._memory, command is not None, added is not None
        own = np.zeros((len(q), self._sizes[0])) if command is None else np.ascontiguousarray(command)
        given = Given(own, new, q if added is None else added, adds)
        out = self._drive(q, dq, tau_J_d, given, self._control, self._bounds, self._model, memory)
        if memory.why.any():
            for i in np.flatnonzero(memory.why):
                if self.stopping[i] is None:
                    self.stopping[i] = self._reason(int(memory.why[i]), q[i], dq[i])
        return out

    def _reason(self, why: int, q: np.ndarray, dq: np.ndarray) -> str:
        """Return in words why the arm at q, dq (n,) is being brought to rest."""
        bounds = self._bounds
        if why == SILENT:
            return f"no finite action for {1e3 * bounds.deadline:g} ms"
        if why == NOT_FINITE:
            return "the arm's state is not finite"
        if why == LAW_NOT_FINITE:
            return "the controller's torque is not finite"
        out = np.maximum(bounds.q_low - q, q - bounds.q_high)
        if (out > 0).any():
            j = int(out.argmax())
            return f"joint {j + 1} is at {q[j]:.3f} rad, {Q_INSIDE:g} rad from its limit"
        j = int((np.abs(dq) / bounds.dq_max).argmax())
        return f"joint {j + 1} is at {dq[j]:.3f} rad/s, {DQ_INSIDE:g} of its limit"


@njit(cache=True)
def _watch(i, q, dq, given, bounds, memory):
    """Take the command of arm i, and decide whether the arm has to stop; return whether its state is finite."""
    seen = np.isfinite(q).all() and np.isfinite(dq).all()
    helped = given.adds and np.isfinite(given.added[i]).all()
    if given.new and np.isfinite(given.command[i]).all() and helped == given.adds:
        memory.command[i] = given.command[i]
        memory.commanded[i] = True
        memory.silent[i] = 0
    else:
        memory.silent[i] += 1
    if memory.why[i] == RUNS:
        if memory.silent[i] * SIM_DT > bounds.deadline:
            memory.why[i] = SILENT
        elif not seen:
            memory.why[i] = NOT_FINITE
        elif not ((q >= bounds.q_low).all() and (q <= bounds.q_high).all() and (np.abs(dq) <= bounds.dq_max).all()):
            memory.why[i] = OUTSIDE
    return seen


def _drive_cycle(q, dq, applied, given, control, bounds, model, memory):
    """Return the commands (m, n) Nm of this cycle.

    Args:
        q, dq, applied: (m, n), state and last torque. given: `Given`. control: number and parameters of the law.
        bounds: `Bounds`. model: `Model`. memory: `Memory`, updated.
    """
    out, (m, n) = np.empty_like(memory.sent), q.shape
    number, parameters = control
    limits = model.limits
    work, effort = np.empty((2 * n + WORK, n)), np.empty((1, 1, n))
    inertia, bias, desk, weightless = np.empty((n, n)), np.empty(n), np.empty((n, DESK)), np.zeros(3)
    mass, law_torque = np.empty(n * (n + 1) // 2), np.empty(n)  # mass: the lower triangle, row by row
    for i in range(m):
        seen = _watch(i, q[i], dq[i], given, bounds, memory)
        stopping = memory.why[i] != RUNS
        memory.damped[i] += stopping
        memory.rests[i] = seen and (np.abs(dq[i]) < STILL).all()
        if stopping:  # brake from the present speed, at once
            memory.target[i] = 0.0
            if seen and memory.damped[i] == 1:
                memory.share[i] = min(1.0, (np.abs(dq[i]) / limits[:, DQ_ALLOWED]).max())
            memory.share[i] = max(0.0, memory.share[i] - SIM_DT / BRAKE_S)
        elif memory.commanded[i]:
            control_law(number, q[i], dq[i], memory.command[i], parameters, memory.law[i], law_torque)
            if np.isfinite(law_torque).all():
                memory.target[i] = np.minimum(np.maximum(law_torque, -bounds.torque), bounds.torque)
            else:
                memory.why[i] = LAW_NOT_FINITE
                memory.target[i] = 0.0
        at = slice(i, i + 1)
        conditioned = memory.filtered[at], memory.effort[at], memory.cycle[at]
        settings = bounds.factor, bounds.fade, limits[:, TAU_MAX], limits[:, STEP]
        condition(memory.target[at], conditioned, settings, 1, effort)
        last = applied[i] if np.isfinite(applied[i]).all() else memory.sent[i]
        if seen:
            equations(model.links, weightless, q[i], dq[i], inertia, bias, desk)
            for j in range(n):
                inertia[j, j] += model.rotors[j]
                for k in range(j + 1):
                    mass[j * (j + 1) // 2 + k] = inertia[j, k]
            share, now = memory.share[i], effort[0, 0]
            if given.adds and not stopping and np.isfinite(given.added[i]).all():
                faded = min(1.0, memory.cycle[i] / bounds.fade) if bounds.fade > 0 else 1.0
                for j in range(n):
                    now[j] += faded * min(max(given.added[i, j], -bounds.added[j]), bounds.added[j])
            arm = JointDynamics(q[i], dq[i], mass, bias)
            changed = filter_torque(arm, now, last, share, model.friction, limits, work, out[i])
            memory.limited[i] += changed
        else:
            for j in range(n):
                out[i, j] = last[j] + min(max(-last[j], -limits[j, STEP]), limits[j, STEP])
        memory.sent[i] = out[i]
    return out


drive_cycle = njit(cache=True)(_drive_cycle)


@cache
def compiled_cycle(laws: tuple[Callable, ...]) -> Callable:
    """Return `drive_cycle` with these control laws; other than built-in ones are compiled in each process."""
    if laws == BUILT_IN:
        return drive_cycle
    return njit(FunctionType(_drive_cycle.__code__, {**globals(), "control_law": chain(laws)}))


class Driver:
    """The driver of one arm; arguments as in `DriverBatch`."""

    def __init__(self, robot: Robot, torque: np.ndarray, friction: np.ndarray, **settings: Any):
        self._drivers = DriverBatch(robot, torque, 1, friction=friction, **settings)

    def reset(self) -> None:
        """Begin a motion, from zero torque."""
        self._drivers.reset()

    @property
    def stopping(self) -> str | None:
        """Why the arm is being brought to rest, or None."""
        return self._drivers.stopping[0]

    @property
    def effort(self) -> np.ndarray:
        """(n,) Nm, the target torque after the low-pass, which a policy observes."""
        return self._drivers.effort[0]

    @property
    def limited(self) -> int:
        """Number of cycles of the motion in which the safety filter changed the command."""
        return int(self._drivers.limited[0])

    @property
    def done(self) -> bool:
        """Whether a motion that is being stopped is at rest, or DAMP_S is over."""
        return self.stopping is not None and bool(self._drivers.done[0])

    def __call__(self, state: ArmState, command: np.ndarray | None, added: np.ndarray | None = None) -> np.ndarray:
        """Return the torque command (n,) Nm of this cycle.

        Args:
            state: of the arm. command: (c,) of the controller; None: no new one.
            added: (n,) Nm of an adapter; None: no adapter.
        """
        given, more = (None if x is None else x[None] for x in (command, added))
        return self._drivers(state.q[None], state.dq[None], state.tau_J_d[None], given, more)[0]
