"""Emulate how a Franka control box controls its arm: modes, cycles, missed answers, reflexes, injected faults.

This model of the control box (Franka's Control) has no sockets and no clock: each call of `cycle` simulates 1 ms.
"""

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from r2s.arm.clients import fci, fr3_limits
from r2s.arm.emulator.robot_model import BoxModel
from r2s.arm.interface import Arm, ArmStopped, Reflexes
from r2s.errors import UserError, instead_of
from r2s.physics.robot import SIM_DT

FAULT_KINDS = ("late", "drop", "discontinuity", "joint_limit", "estop", "press", "hold")
MAX_MISSED = 20  # consecutive cycles without an answer, after which Franka's arms stop themselves
SUCCESS_WINDOW = 100  # commands over which control_command_success_rate is computed
HOLD = 5e3, 100.0  # Nm/rad, Nm s/rad: stiffness and damping of 'hold'; stiffer than a hand, stable at 1 kHz
CUTOFF_HZ = 15.0  # low-pass of the external torque; our choice, because Franka publishes no value
FRAMES = ("F_T_EE", "EE_T_K", "F_T_NE", "NE_T_EE")
DESK = ("F_T_EE", "m_ee", "F_x_Cee", "m_load", "F_x_Cload", "O_ddP_O")  # settings of the web interface Desk
INSIDE = 0.02  # rad, distance from a position limit to which recovery moves a joint that is beyond this limit
_ERRORS = (  # parts of the messages of `Reflexes`, and libfranka's index of the same error
    ("steps", fci.TORQUE_DISCONTINUITY),
    ("torque", fci.TORQUE_RANGE),
    ("position", fci.JOINT_POSITION_LIMITS),
    ("velocity", fci.JOINT_VELOCITY),
)


@dataclass(frozen=True)
class Fault:
    """A fault that begins at a fixed cycle of a motion.

    Attributes:
        kind: 'late': the client's answers arrive too late, and the arm repeats its last torque. 'drop': the arm's
            states do not reach the client. 'discontinuity': the first joint's torque steps by twice the allowed size.
            'joint_limit': the arm stops and reports a position limit. 'estop': the stop button is pressed and stays
            pressed. 'press': the stop button is pressed for `cycles` ms. 'hold': an external force stops the first
            link; the arm needs the attribute `external`.
        cycle: index (from 0) of the control cycle in which the fault begins.
        motion: index (from 0) of the motion with the fault; `move_to` makes one motion per straight path segment.
        cycles: number of consecutive cycles with the fault; 20 late or dropped cycles stop the arm.

    """

    kind: str
    cycle: int
    motion: int = 0
    cycles: int = 1

    def __post_init__(self):
        if self.kind not in FAULT_KINDS:
            raise UserError(f"fault: '{self.kind}'; {instead_of(self.kind, FAULT_KINDS)}")
        if self.cycle < 0 or self.motion < 0 or self.cycles < 1:
            raise UserError(
                f"fault '{self.kind}': expected cycle and motion from 0 and cycles from 1, got cycle={self.cycle}, "
                f"motion={self.motion}, cycles={self.cycles}"
            )


class Control:
    """Runs torque motions on an arm of 7 joints and maintains the arm's RobotState.

    Attributes:
        state: RobotState in the format of `version`; the server sets message_id.
        running: whether a motion is in progress.
        stopped_by: reason why the last motion was aborted; None: no abort.

    Args:
        arm: the arm. If the arm's state has no `tau_ext_hat_filtered`, the control box reports zero external torque.
        version: version of the FCI. faults, max_missed: see `Emulator`.
        desk: values of settings in `DESK`, such as {"m_ee": 0.73}; they change only the arm model in the control box.
    """

    def __init__(
        self,
        arm: Arm,
        version: int,
        faults: Sequence[Fault] = (),
        max_missed: int = MAX_MISSED,
        desk: Mapping[str, Any] | None = None,
    ):
        if arm.robot.n != 7:
            raise UserError(f"emulator: expected an arm of 7 joints, got {arm.robot.n} ({arm.robot.name})")
        if any(f.kind == "hold" for f in faults) and not hasattr(arm, "external"):
            raise UserError(f"fault 'hold': {type(arm).__name__} has no attribute 'external'; use a SimulatedArm")
        self.state = np.zeros((), dtype=fci.STATE[version])
        self.running = False
        self.stopped_by: str | None = None
        self._arm, self._version, self._faults, self._max_missed = arm, version, tuple(faults), max_missed
        self._model, self._reflexes = BoxModel(arm.robot), Reflexes(arm.robot)
        self._motion, self._cycle, self._missed = -1, 0, 0
        self._answered: deque[bool] = deque(maxlen=SUCCESS_WINDOW)
        self._mode, self._pressed_ms = fci.IDLE, 0
        self._external, self._held_at = np.zeros(7), np.zeros(0)
        self._thresholds = np.full((), np.inf, fci.COLLISION)
        for frame in FRAMES:
            self.state[frame] = np.eye(4).ravel()
        self.state["O_ddP_O"] = arm.robot.gravity
        if (declared := getattr(arm, "declared_payload", None)) is not None:
            self.state["m_load"], self.state["F_x_Cload"] = declared.mass, declared.centre
            self.state["I_load"] = declared.inertia.ravel()
        self._right = self.state.copy()  # the settings that the arm's own gravity compensation uses
        for name, value in (desk or {}).items():
            if name not in DESK:
                raise UserError(f"emulator: desk setting '{name}'; {instead_of(name, DESK)}")
            self.state[name] = value
        self.state["F_T_NE"] = self.state["F_T_EE"]
        self._place(arm.robot.q_home)

    @property
    def can_move(self) -> bool:
        """Whether a motion may begin."""
        return self._mode == fci.IDLE and not self.running

    @property
    def aborted_as(self) -> str:
        """Return the status that answers the Move request of an aborted motion."""
        return "EmergencyAborted" if self._mode == fci.USER_STOPPED else "ReflexAborted"

    @property
    def dropped(self) -> bool:
        """Whether a fault prevents the state of this cycle from reaching the client."""
        return self.running and self._has("drop")

    def begin(self) -> None:
        """Start a motion at the arm's present posture; call `first_answer` before the first `cycle`."""
        self.running, self.stopped_by = True, None
        self._motion, self._cycle, self._missed = self._motion + 1, 0, 0
        self._answered.clear()
        self._feel(1.0)
        self.state["errors"] = self.state["reflex_reason"] = 0
        self._sense()

    def first_answer(self) -> None:
        """Record the client's first answer, which raises control_command_success_rate above 0."""
        self._answered.append(True)
        self._sense()

    def cycle(self, tau: np.ndarray | None) -> None:
        """Advance the arm by 1 ms under tau (7,) Nm; if tau is None (no answer), the last torque continues to act."""
        if self._has("late"):
            tau = None
        self._answered.append(tau is not None)
        self._missed = self._missed + 1 if tau is None else 0
        if self._missed >= self._max_missed:
            self._abort(fci.COMMUNICATION_CONSTRAINTS, f"no answer in {self._missed} consecutive cycles")
            return
        last = self._arm.read().tau_J_d
        tau = last if tau is None else tau
        if self._has("discontinuity"):
            tau = np.where(np.arange(7) == 0, last + 2 * self._arm.robot.dtau_max * SIM_DT, tau)
        self._hold_link()
        try:
            self._reflexes.command(tau, last)
            self._arm.command(tau)
        except ArmStopped as reason:
            error = next((index for part, index in _ERRORS if part in str(reason)), fci.JOINT_REFLEX)
            self._abort(error, str(reason))
            return
        s = self._arm.read()
        if self._version == 10 and (outside := _outside_fr3(s.q, s.dq)) is not None:
            self._abort(*outside)
        elif (collision := self._feel()) is not None:
            self._abort(*collision)
        elif self._has("joint_limit"):
            self._abort(fci.JOINT_POSITION_LIMITS, "a joint limit was injected")
        elif self._has("estop") or self._has("press"):
            self._pressed_ms = next((f.cycles for f in self._faults if f.kind == "press" and self._is_now(f)), 0)
            self._stop("the stop button was pressed", fci.USER_STOPPED)
        else:
            self._cycle += 1
            self._sense()

    def end(self) -> None:
        """End an active motion at the client's request; the arm holds its posture."""
        if self.running:
            self.running = False
            self._release()
            self._arm.stop()
            self._place(self._arm.read().q)

    def idle(self, ms: int) -> None:
        """Let `ms` milliseconds pass between two motions; the arm becomes idle when the stop button is released."""
        if self._mode == fci.USER_STOPPED and self._pressed_ms > 0:
            self._pressed_ms -= ms
            if self._pressed_ms <= 0:
                self._mode = fci.IDLE
                self._place(self._arm.read().q)

    def set(self, request: str, settings: np.ndarray) -> None:
        """Apply a request of `fci.SETTINGS`: thresholds, load, or a frame of the end effector."""
        if request == "SetCollisionBehavior":
            self._thresholds = settings
        else:
            for name in settings.dtype.names or ():
                self.state[name] = settings[name]
            f = {name: self.state[name].reshape(4, 4) for name in FRAMES}
            self.state["F_T_EE"] = (f["NE_T_EE"] @ f["F_T_NE"]).ravel()  # by columns, so factors in reverse order
        self._feel(1.0)
        self._sense()

    def recover(self) -> bool:
        """Clear a reflex; return True if the arm can move again, False if the stop button is pressed.

        A person must guide a real arm back into its joint limits; `recover` moves the emulated arm back.
        """
        if self._mode == fci.USER_STOPPED:
            return False
        if self._mode == fci.REFLEX:
            low, high = self._arm.robot.q_min, self._arm.robot.q_max
            if self._version == 10:
                low, high = np.maximum(low, fr3_limits.Q_MIN), np.minimum(high, fr3_limits.Q_MAX)
            self._mode = fci.IDLE
            self.state["errors"] = 0
            self._place(np.clip(self._arm.read().q, low + INSIDE, high - INSIDE))
        return True

    def _place(self, q: np.ndarray) -> None:
        self._arm.move_to(q)
        self._feel(1.0)
        self._sense()

    def _abort(self, error: int, reason: str) -> None:
        self.state["errors"][error] = self.state["reflex_reason"][error] = 1
        self._stop(reason, fci.REFLEX)

    def _stop(self, reason: str, mode: int) -> None:
        self.running, self.stopped_by, self._mode = False, reason, mode
        self._release()
        self._arm.stop()
        self._sense()

    def _has(self, kind: str) -> bool:
        """Return whether a fault of the given kind is active in the current cycle."""
        return any(f.kind == kind and self._is_now(f) for f in self._faults)

    def _is_now(self, fault: Fault) -> bool:
        return fault.motion == self._motion and fault.cycle <= self._cycle < fault.cycle + fault.cycles

    def _hold_link(self) -> None:
        """Apply the external torque of the fault 'hold' to the first joint."""
        if not self._has("hold"):
            return self._release()
        s = self._arm.read()
        if not len(self._held_at):
            self._held_at = s.q.copy()
        torque = HOLD[0] * (self._held_at - s.q) - HOLD[1] * s.dq
        self._arm.external = np.where(np.arange(7) == 0, torque, 0.0)  # type: ignore[attr-defined]
        return None

    def _release(self) -> None:
        self._held_at = np.zeros(0)
        if hasattr(self._arm, "external"):
            self._arm.external = np.zeros(7)

    def _feel(self, gain: float = -np.expm1(-2 * np.pi * CUTOFF_HZ * SIM_DT)) -> tuple[int, str] | None:
        """Filter the external torque, and set the wrench and the contact flags.

        Return index and message of the error in a collision, else None.

        As in libfranka, external torque is tau_J minus the torque of the control box's arm model with the `DESK`
        settings. Unlike on a real arm, friction and model errors have no effect on the emulated external torque.

        Args:
            gain: gain of the low-pass; 1 (no filtering) for an arm at rest.
        """
        s, arm = self.state, self._arm.read()
        raw = np.zeros(7) if arm.tau_ext_hat_filtered is None else arm.tau_ext_hat_filtered
        if any((s[name] != self._right[name]).any() for name in DESK[1:]):
            raw = raw + self._model.compensation(arm.q, self._right) - self._model.compensation(arm.q, s)
        self._external = s["tau_ext_hat_filtered"] = self._external + gain * (raw - self._external)
        force = np.zeros(6)
        if self._external.any():
            at_k = s["EE_T_K"].reshape(4, 4) @ s["F_T_EE"].reshape(4, 4)  # by columns, so factors in reverse order
            force = self._model.wrench(arm.q, at_k.T, self._external)
            rotation = self._model.pose(arm.q, at_k.T)[:3, :3]
            s["K_F_ext_hat_K"] = np.concatenate([rotation.T @ force[:3], rotation.T @ force[3:]])
        s["O_F_ext_hat_K"] = force
        collision = None
        for kind, what, x, error in (
            ("cartesian", "force", force, fci.CARTESIAN_REFLEX),
            ("joint", "torque", self._external, fci.JOINT_REFLEX),
        ):
            upper = self._thresholds[f"upper_{what}"]
            s[f"{kind}_contact"] = np.abs(x) > self._thresholds[f"lower_{what}"]
            s[f"{kind}_collision"] = over = np.abs(x) > upper
            if over.any():
                i = int(over.argmax())
                collision = (
                    error,
                    f"{kind} {i + 1}: external {what} {x[i]:.1f} N or Nm, allowed {upper[i]:g}",
                )
        return collision

    def _sense(self) -> None:
        arm, s, version = self._arm.read(), self.state, self._version
        s["q"] = s["q_d"] = s["theta"] = arm.q
        s["dq"] = s["dtheta"] = arm.dq
        # at rest, the control box holds the arm, even where a simulated arm would sink
        s["tau_J"] = arm.tau_J if self.running else self._model.compensation(arm.q, s) + self._external
        s["tau_J_d"] = arm.tau_J_d
        pose = self._model.pose(arm.q, s["F_T_EE"].reshape(4, 4).T)
        s["O_T_EE"] = s["O_T_EE_d"] = s["O_T_EE_c"] = pose.T.ravel()
        s["robot_mode"] = fci.MOVE_MODE if self.running else self._mode
        s["controller_mode"] = fci.EXTERNAL_CONTROLLER if self.running else fci.OTHER_CONTROLLER
        s["motion_generator_mode"] = fci.GENERATOR_RUNNING[version] if self.running else fci.NO_GENERATOR
        s["control_command_success_rate"] = np.mean(self._answered) if self.running and self._answered else 0.0


def _outside_fr3(q: np.ndarray, dq: np.ndarray) -> tuple[int, str] | None:
    """Return error index and message if a joint at q, dq (7,) rad, rad/s exceeds an FR3's limits, else None."""
    q_min, q_max = fr3_limits.Q_MIN, fr3_limits.Q_MAX
    outside = np.maximum(q_min - q, q - q_max)
    i = int(outside.argmax())
    if outside[i] > 0:
        allowed = f"{q_min[i]:g} to {q_max[i]:g}"
        return fci.JOINT_POSITION_LIMITS, f"joint {i + 1}: position {q[i]:.4f} rad, an FR3 allows {allowed}"
    low, high = fr3_limits.velocity_bounds(q)
    over = np.maximum(low - dq, dq - high)
    i = int(over.argmax())
    if over[i] <= 0:
        return None
    allowed = f"{low[i]:.3f} to {high[i]:.3f}"
    return fci.JOINT_VELOCITY, f"joint {i + 1}: velocity {dq[i]:.3f} rad/s, at {q[i]:.4f} rad an FR3 allows {allowed}"
