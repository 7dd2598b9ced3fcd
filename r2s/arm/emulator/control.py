"""The box between an FCI server and an arm: modes, control cycles, missed answers, reflexes and injected faults.

It stands for Franka's Control, without sockets and without a clock: `cycle` is one millisecond.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from r2s.arm import fci
from r2s.arm.interface import Arm, ArmState, ArmStopped
from r2s.errors import UserError, choices, nearest
from r2s.physics.robot import SIM_DT, Robot

KINDS = ("late", "drop", "discontinuity", "joint_limit", "estop", "press", "hold")
PATIENCE = 20  # cycles without an answer, in a row, until Franka's arms stop themselves
RATE_OVER = 100  # commands that control_command_success_rate looks back on
FELT_HZ = 15.0  # of the low-pass on the estimate of external torque
HOLD = 5e3, 100.0  # Nm/rad and Nm s/rad, of what holds a link: stiffer than a hand, and stable at 1 kHz
INSIDE = 0.02  # rad from a position limit, to which an operator opens an arm that stopped beyond it
_ERRORS = (  # the words of `Reflexes`, and libfranka's place of the same error
    ("steps", fci.TORQUE_DISCONTINUITY),
    ("torque", fci.TORQUE_RANGE),
    ("position", fci.JOINT_POSITION_LIMITS),
    ("velocity", fci.JOINT_VELOCITY),
)


@dataclass(frozen=True)
class Fault:
    """Something that goes wrong in a motion, always at the same place.

    Attributes:
        kind: 'late': the answers of these cycles come too late, the arm reuses its last torque. 'drop': the states
            of these cycles never reach the client. 'discontinuity': the first joint's torque arrives as a step of
            twice what is allowed. 'joint_limit': the arm finds itself at a position limit. 'estop': somebody
            presses the stop button, and keeps it pressed. 'press': presses it, and releases it after `cycles` ms.
            'hold': something holds the first link where it is; the arm behind must have `external` for that.
        cycle: the first control cycle concerned, from 0.
        motion: of the server, from 0; a `move_to` of our clients is one unless the arm is there already.
        cycles: how many in a row; 20 late or dropped ones are more than the arm bears.

    """

    kind: str
    cycle: int
    motion: int = 0
    cycles: int = 1

    def __post_init__(self):
        if self.kind not in KINDS:
            raise UserError(f"fault '{self.kind}': allowed are {choices(KINDS)}{nearest(self.kind, KINDS)}")
        if self.cycle < 0 or self.motion < 0 or self.cycles < 1:
            raise UserError(
                f"fault '{self.kind}': cycle={self.cycle} and motion={self.motion} count from 0, "
                f"cycles={self.cycles} from 1"
            )


class Control:
    """Runs torque motions on an arm of 7 joints and keeps its RobotState.

    Attributes:
        state: RobotState of `version`, but for message_id.
        running: whether a motion takes commands.
        stopped_by: why the last motion was aborted, in the arm's words; None if it was not.

    """

    def __init__(self, arm: Arm, version: int, faults: Sequence[Fault] = (), patience: int = PATIENCE):
        if arm.robot.n != 7:
            raise UserError(f"an FCI server has an arm of 7 joints; {arm.robot.name} has {arm.robot.n}")
        if any(f.kind == "hold" for f in faults) and not hasattr(arm, "external"):
            raise UserError(f"fault 'hold': {type(arm).__name__} has nothing that could push it; SimulatedArm has")
        self.state = np.zeros((), dtype=fci.STATE[version])
        self.running = False
        self.stopped_by: str | None = None
        self._arm, self._version, self._faults, self._patience = arm, version, tuple(faults), patience
        self._forward = fci.Forward(arm.robot)
        self._motion, self._cycle, self._missed = -1, 0, 0
        self._answered: deque[bool] = deque(maxlen=RATE_OVER)
        self._mode, self._pressed = fci.IDLE, 0
        self._felt, self._held_at = Felt(arm.robot), np.zeros(0)
        self._collision = np.full(7, np.inf)
        for frame in ("F_T_EE", "EE_T_K", "F_T_NE", "NE_T_EE"):
            self.state[frame] = np.eye(4).ravel()
        self.state["O_ddP_O"] = arm.robot.gravity  # which the client's model wants to know
        self._hold(arm.robot.q_home)

    @property
    def can_move(self) -> bool:
        """Whether a motion may begin."""
        return self._mode == fci.IDLE and not self.running

    @property
    def aborted_as(self) -> str:
        """Return the Move status of an aborted motion."""
        return "EmergencyAborted" if self._mode == fci.USER_STOPPED else "ReflexAborted"

    @property
    def lost(self) -> bool:
        """Whether the state of this cycle does not reach the client."""
        return self.running and self._has("drop")

    def begin(self) -> None:
        """Start a motion from where the arm stands; `first_answer` must come before the first `cycle`."""
        self.running, self.stopped_by = True, None
        self._motion, self._cycle, self._missed = self._motion + 1, 0, 0
        self._answered.clear()
        self._felt.begin(self._arm.read())
        self.state["errors"] = self.state["reflex_reason"] = 0
        self._sense()

    def first_answer(self) -> None:
        """Note that the client is in its loop: from now on cycles count."""
        self._answered.append(True)
        self._sense()

    def cycle(self, tau: np.ndarray | None) -> None:
        """Advance the arm by 1 ms under tau (7,) Nm, or under its last torque if no answer came (None)."""
        if self._has("late"):
            tau = None
        self._answered.append(tau is not None)
        self._missed = self._missed + 1 if tau is None else 0
        if self._missed >= self._patience:
            self._abort(fci.COMMUNICATION_CONSTRAINTS, f"no answer in {self._missed} cycles in a row")
            return
        last = self._arm.read().tau_J_d
        tau = last if tau is None else tau
        if self._has("discontinuity"):
            tau = np.where(np.arange(7) == 0, last + 2 * self._arm.robot.dtau_max * SIM_DT, tau)
        self._hold_link()
        try:
            self._arm.command(tau)
        except ArmStopped as reason:
            error = next((place for word, place in _ERRORS if word in str(reason)), fci.JOINT_REFLEX)
            self._abort(error, str(reason))
            return
        seen = self._arm.read()
        if self._version == 10 and (outside := fci.outside_fr3(seen.q, seen.dq)) is not None:
            self._abort(*outside)
        elif (np.abs(felt := self._felt(seen)) > self._collision).any():
            i = int(np.argmax(np.abs(felt) / self._collision))
            self._abort(
                fci.JOINT_REFLEX,
                f"joint {i + 1}: external torque {felt[i]:.1f} Nm, the threshold is {self._collision[i]:g} Nm",
            )
        elif self._has("joint_limit"):
            self._abort(fci.JOINT_POSITION_LIMITS, "a joint limit was injected")
        elif self._has("estop") or self._has("press"):
            self._pressed = next((f.cycles for f in self._faults if f.kind == "press" and self._concerns(f)), 0)
            self._stop("the stop button was pressed", fci.USER_STOPPED)
        else:
            self._cycle += 1
            self._sense()

    def end(self) -> None:
        """End a running motion as the client asked; the arm holds where it is."""
        if self.running:
            self.running = False
            self._arm.stop()
            self._hold(self._arm.read().q)

    def idle(self, ms: int) -> None:
        """Let time pass between motions: a stop button that is released leaves an idle arm, as on a Franka."""
        if self._mode == fci.USER_STOPPED and self._pressed > 0:
            self._pressed -= ms
            if self._pressed <= 0:
                self._mode = fci.IDLE
                self._hold(self._arm.read().q)

    def watch_for(self, torque: np.ndarray) -> None:
        """Stop where the external torque of a joint is estimated above torque (7,) Nm."""
        self._collision = torque

    def recover(self) -> bool:
        """Clear a reflex; return whether the arm can move again. A pressed stop button stays pressed.

        A real arm beyond a joint limit has to be opened by hand first; here that happens by itself.
        """
        if self._mode == fci.USER_STOPPED:
            return False
        if self._mode == fci.REFLEX:
            low, high = self._arm.robot.q_min, self._arm.robot.q_max
            if self._version == 10:
                low, high = np.maximum(low, fci.FR3_Q_MIN), np.minimum(high, fci.FR3_Q_MAX)
            self._mode = fci.IDLE
            self.state["errors"] = 0
            self._hold(np.clip(self._arm.read().q, low + INSIDE, high - INSIDE))
        return True

    def _hold(self, q: np.ndarray) -> None:
        self._arm.move_to(q)
        self._sense()

    def _abort(self, error: int, reason: str) -> None:
        self.state["errors"][error] = self.state["reflex_reason"][error] = 1
        self._stop(reason, fci.REFLEX)

    def _stop(self, reason: str, mode: int) -> None:
        self.running, self.stopped_by, self._mode = False, reason, mode
        self._arm.stop()
        self._sense()

    def _has(self, kind: str) -> bool:
        """Whether a fault of this kind concerns the current cycle."""
        return any(f.kind == kind and self._concerns(f) for f in self._faults)

    def _concerns(self, fault: Fault) -> bool:
        return fault.motion == self._motion and fault.cycle <= self._cycle < fault.cycle + fault.cycles

    def _hold_link(self) -> None:
        """Let what holds the first link act on an arm that can be pushed."""
        if not self._has("hold"):
            self._held_at = np.zeros(0)
            if hasattr(self._arm, "external"):
                self._arm.external = np.zeros(7)
            return
        s = self._arm.read()
        if not len(self._held_at):
            self._held_at = s.q.copy()
        push = HOLD[0] * (self._held_at - s.q) - HOLD[1] * s.dq
        self._arm.external = np.where(np.arange(7) == 0, push, 0.0)  # type: ignore[attr-defined]

    def _sense(self) -> None:
        seen, s, version = self._arm.read(), self.state, self._version
        s["q"] = s["q_d"] = s["theta"] = seen.q
        s["dq"] = s["dtheta"] = seen.dq
        s["tau_J"] = seen.tau_J
        s["tau_J_d"] = seen.tau_J_d
        s["tau_ext_hat_filtered"] = self._felt.torque
        s["O_T_EE"] = s["O_T_EE_d"] = s["O_T_EE_c"] = self._forward(seen.q)
        s["robot_mode"] = fci.MOVE_MODE if self.running else self._mode
        s["controller_mode"] = fci.EXTERNAL_CONTROLLER if self.running else fci.OTHER_CONTROLLER
        s["motion_generator_mode"] = fci.GENERATOR_RUNNING[version] if self.running else fci.NO_GENERATOR
        s["control_command_success_rate"] = np.mean(self._answered) if self.running and self._answered else 0.0


class Felt:
    """An estimate of the torque that the world exerts on a moving arm: what its motion needs beyond its commands.

    Franka's arms have torque sensors behind their gears; this arm may have none that knows gravity, so friction and
    the errors of the nominal model are felt too, which makes it stop rather sooner.

    Attributes:
        torque: (n,) Nm, filtered.
    """

    def __init__(self, robot: Robot):
        self._model = robot.model(gravity=False)
        self._model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
        self._data = mujoco.MjData(self._model)
        self._share = -np.expm1(-2 * np.pi * FELT_HZ * SIM_DT)
        self.torque, self._before = np.zeros(robot.n), np.zeros(robot.n)

    def begin(self, state: ArmState) -> None:
        """Begin a motion at rest."""
        self.torque, self._before = np.zeros(len(state.q)), state.dq.copy()

    def __call__(self, state: ArmState) -> np.ndarray:
        """Return `torque` after another cycle."""
        d = self._data
        d.qpos[:], d.qvel[:], d.qacc[:] = state.q, state.dq, (state.dq - self._before) / SIM_DT
        mujoco.mj_inverse(self._model, d)
        self._before = state.dq.copy()
        self.torque = self.torque + self._share * (d.qfrc_inverse - state.tau_J_d - self.torque)
        return self.torque
