"""Compute a torque within the arm's limits from a policy's command, once per millisecond (the driver).

In each cycle, the driver checks that the command is finite and recent (watchdog). The control law
(r2s/physics/control_laws.py) computes a target torque, which passes soft start and low-pass. The driver adds the
torque of an adapter (r2s/adaptation/adapter.py). The safety filter, which training also uses
(r2s/physics/safety_filter.py), limits the sum of target and adapter torque. Finally, the driver limits the difference
from the torque that the arm applied in the last cycle. The driver has no clock and no connection to an arm: its only
inputs are states and commands. Tests can therefore run the driver on a million adversarial inputs.

`DriverBatch` drives many arms in lock-step; `Driver` drives one arm.
"""

from typing import Any

import numpy as np

from r2s.arm.drive_cycle import (
    ADDED,
    LAW_NOT_FINITE,
    NOT_FINITE,
    REQUESTED,
    RUNS,
    SILENT,
    SPRING,
    TOO_NEAR,
    Bounds,
    Given,
    Memory,
    Model,
    drive_cycle,
)
from r2s.arm.interface import ArmState
from r2s.physics.actuation import low_pass_factor
from r2s.physics.collision import CollisionCheck, empty_scene
from r2s.physics.control_laws import ControlLaw, law_number, torque_law
from r2s.physics.fence import Fence
from r2s.physics.newton_euler import links_of
from r2s.physics.push_limit import HOLD, STOP, PushLimit
from r2s.physics.rigid_body import InverseInertia
from r2s.physics.robot import SIM_DT, Robot
from r2s.physics.safety_filter import filter_limits

DEADLINE_S = 0.05  # s; without a finite command, the driver stops an arm after this time, or after PERIODS if longer
PERIODS = 2.5  # control periods of the policy, see DEADLINE_S
DAMP_S = 0.5  # s, longest time to bring an arm to rest
Q_INSIDE = 0.02  # rad; the driver stops an arm that comes this close to a position limit
DQ_INSIDE = 0.95  # the driver stops an arm above this share of a velocity limit


def spring(robot: Robot) -> np.ndarray:
    """Return the spring stiffness (n,) Nm/rad for `resist`, from the nominal inertia in the home posture."""
    return SPRING**2 / np.diag(InverseInertia(robot)(robot.q_home[None])[0])


class DriverBatch:
    """The driver for m arms: it computes every torque command that r2s sends to these arms.

    Attributes:
        stopping: for each of the m arms, the reason why the driver is bringing this arm to rest; None: no stop.

    Args:
        robot: provides limits and nominal links. torque: (n,) Nm, largest target torque of each joint.
        m: number of arms. cutoff_hz: cutoff of the low-pass. period_s: s, time between two policy commands.
        soft_start_s: s over which the target torque fades in at the start of a motion; 0: no fade.
        friction: (n,) Nm, friction level of each joint. rotors: (n,) kg m^2, rotor inertias
            (`Dynamics.armature`); if None, `robot.armature`.
        control: control law that maps commands to torques; if None, commands are torques (n,) Nm.
        fence: pairs of bodies; the driver stops an arm before the bodies of a pair touch; None: no fence.
        speed_share: factor on all allowed speeds, in (0, 1].
        push_limit: limits of the tool's contact force and approach speed; None: no limit.
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
        fence: CollisionCheck | None = None,
        speed_share: float = 1.0,
        push_limit: PushLimit | None = None,
    ):
        self._shape, self._fence, self._speed_share = (m, robot.n), fence, speed_share
        own = (robot.n, 0) if control is None else (control.command_size, control.memory_size)
        self._sizes = *own, 0 if fence is None else len(fence.names)
        self._push = np.zeros(0) if push_limit is None else push_limit.columns(robot)
        number = law_number(torque_law if control is None else control.law)
        self._control = float(number), np.zeros(0) if control is None else control.parameters
        self._bounds = Bounds(
            torque=np.array(torque, dtype=float),
            added=ADDED * robot.tau_max,
            spring=spring(robot),
            q_low=robot.q_min + Q_INSIDE,
            q_high=robot.q_max - Q_INSIDE,
            dq_max=DQ_INSIDE * speed_share * robot.dq_max,
            deadline=max(DEADLINE_S, PERIODS * period_s),
            factor=low_pass_factor(cutoff_hz),
            fade=round(soft_start_s / SIM_DT),
        )
        links = links_of(robot, robot.mass, robot.com, robot.inertia)
        self._model = Model(
            friction=np.array(friction, dtype=float),
            links=links,
            rotors=robot.armature if rotors is None else np.array(rotors, dtype=float),
            limits=filter_limits(robot, torque, speed_share),
            fence=Fence(links, empty_scene() if fence is None else fence.scene),
        )
        self._nothing, self._free = np.zeros(self._shape), np.zeros(m, dtype=bool)
        self.reset()
        still = np.zeros(self._shape)
        self(np.tile(robot.q_home, (m, 1)), still, still, None)  # this call compiles the code now, while no arm waits
        self.reset()

    def reset(self, torque: np.ndarray | None = None) -> None:
        """Reset the driver for a new motion; the low-pass starts at `torque` (n,) Nm, by default zero."""
        self._memory = Memory.fresh(*self._shape, *self._sizes, self._push)
        if torque is not None:
            self._memory.filtered[:], self._memory.effort[:] = torque, torque
        self.stopping: list[str | None] = [None] * self._shape[0]

    @property
    def effort(self) -> np.ndarray:
        """(m, n) Nm, target torques after the low-pass, which policies observe."""
        return self._memory.effort

    @property
    def held(self) -> np.ndarray:
        """(m, n) Nm, torque of a stop: adapter torque, `hold`, and contact torque if the stop holds a contact."""
        m = self._memory
        if not self.decides_contact:
            return m.held
        return m.held + m.target * ((m.why != RUNS) & (m.push[:, STOP] == HOLD))[:, None]

    @property
    def decides_contact(self) -> bool:
        """Whether the driver has a `push_limit`. If so, a stop holds the contact force or moves the tip outward."""
        return bool(len(self._push))

    @property
    def limited(self) -> np.ndarray:
        """(m,), number of cycles since the motion began in which the safety filter changed the command."""
        return self._memory.limited

    @property
    def done(self) -> np.ndarray:
        """(m,), whether a stop is complete: the arm is at rest, or DAMP_S has passed since the stop began."""
        m = self._memory
        return (m.why != RUNS) & (m.damped > 0) & (m.rests | (m.damped * SIM_DT >= DAMP_S))

    def __call__(
        self,
        q: np.ndarray,
        dq: np.ndarray,
        tau_J_d: np.ndarray,
        command: np.ndarray | None,
        added: np.ndarray | None = None,
        hold: np.ndarray | None = None,
        contact: np.ndarray | None = None,
    ) -> np.ndarray:
        """Return the torque commands (m, n) Nm of this cycle.

        Args:
            q, dq: (m, n) rad, rad/s, measured in this cycle. If q or dq is not finite, the torque ramps to 0.
            tau_J_d: (m, n) Nm, the torque that the arms applied in the last cycle.
            command: (m, c), new commands for the control law; if None, the last commands still apply.
            added: (m, n) Nm, torque of the adapters in this cycle, clipped to ADDED * tau_max; None: no adapter. If
                an arm's adapter torque is not finite, the driver ignores this torque and the arm's new command.
            hold: (m, n) Nm, part of the target torque that compensates an undeclared payload; None: zero. During a
                stop, the driver still applies the last sum of `hold` and `added` before the stop. This sum is clipped
                to ADDED * tau_max.
            contact: (m,), whether each arm is in contact; if None, no arm is in contact. An arm in
                contact stops without this sum.
        """
        memory, new, adds = self._memory, command is not None, added is not None
        own = np.zeros((len(q), self._sizes[0])) if command is None else np.ascontiguousarray(command)
        given = Given(
            own, new, q if added is None else added, adds,
            self._nothing if hold is None else hold, self._free if contact is None else contact,
        )  # fmt: skip
        out = drive_cycle(q, dq, tau_J_d, given, self._control, self._bounds, self._model, memory)
        if memory.why.any():
            for i in np.flatnonzero(memory.why):
                if self.stopping[i] is None:
                    self.stopping[i] = self._reason(int(memory.why[i]), q[i], dq[i])
        return out

    def stop(self, reason: str) -> None:
        """Bring all arms to rest from the next cycle on; an arm that is already stopping retains its first reason."""
        self._memory.why[self._memory.why == RUNS] = REQUESTED
        self.stopping = [reason if own is None else own for own in self.stopping]

    def _reason(self, why: int, q: np.ndarray, dq: np.ndarray) -> str:
        """Return the message for the stop code `why` of an arm at q, dq (n,) rad, rad/s."""
        bounds = self._bounds
        if why == SILENT:
            return f"no finite action for {1e3 * bounds.deadline:g} ms"
        if why == NOT_FINITE:
            return "the arm's state is not finite"
        if why == LAW_NOT_FINITE:
            return "the controller's torque is not finite"
        if why >= TOO_NEAR and self._fence is not None:
            apart = self._fence.distances(q[None])[0, why - TOO_NEAR]
            return f"{self._fence.names[why - TOO_NEAR]} are {apart:.3f} m apart and would come too near"
        out = np.maximum(bounds.q_low - q, q - bounds.q_high)
        if (out > 0).any():
            j = int(out.argmax())
            return f"joint {j + 1} is at {q[j]:.3f} rad, {Q_INSIDE:g} rad from its limit"
        j = int((np.abs(dq) / bounds.dq_max).argmax())
        return f"joint {j + 1} is at {dq[j]:.3f} rad/s, {DQ_INSIDE * self._speed_share:g} of its limit"


class Driver:
    """The driver of one arm; arguments as in `DriverBatch`."""

    def __init__(self, robot: Robot, torque: np.ndarray, friction: np.ndarray, **settings: Any):
        self._drivers = DriverBatch(robot, torque, 1, friction=friction, **settings)

    def reset(self, torque: np.ndarray | None = None) -> None:
        """Reset the driver for a new motion; the low-pass starts at `torque` (n,) Nm, by default zero."""
        self._drivers.reset(torque)

    @property
    def stopping(self) -> str | None:
        """Reason why the driver is bringing the arm to rest; None: no stop."""
        return self._drivers.stopping[0]

    @property
    def effort(self) -> np.ndarray:
        """(n,) Nm, the target torque after the low-pass, which a policy observes."""
        return self._drivers.effort[0]

    @property
    def held(self) -> np.ndarray:
        """(n,) Nm, torque that a stop still applies; see `DriverBatch.held`."""
        return self._drivers.held[0]

    @property
    def decides_contact(self) -> bool:
        """Whether the driver has a `push_limit`; see `DriverBatch.decides_contact`."""
        return self._drivers.decides_contact

    @property
    def limited(self) -> int:
        """Number of cycles since the motion began in which the safety filter changed the command."""
        return int(self._drivers.limited[0])

    @property
    def done(self) -> bool:
        """Whether a stop is complete: the arm is at rest, or DAMP_S has passed since the stop began."""
        return self.stopping is not None and bool(self._drivers.done[0])

    def stop(self, reason: str) -> None:
        """Bring the arm to rest from the next cycle on; an arm that is already stopping retains its first reason."""
        self._drivers.stop(reason)

    def __call__(
        self,
        state: ArmState,
        command: np.ndarray | None,
        added: np.ndarray | None = None,
        hold: np.ndarray | None = None,
    ) -> np.ndarray:
        """Return the torque command (n,) Nm of this cycle.

        Args:
            state: the arm's state in this cycle.
            command: (c,), input of the control law; if None, the last command still applies.
            added: (n,) Nm, torque of the adapter; None: no adapter. hold: (n,) Nm, see `DriverBatch.__call__`.
        """
        given, more, kept = (None if x is None else x[None] for x in (command, added, hold))
        contact = np.array([state.in_contact])
        return self._drivers(state.q[None], state.dq[None], state.tau_J_d[None], given, more, kept, contact)[0]
