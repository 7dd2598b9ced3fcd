"""The interface of an arm, real or simulated: move to a posture, read, send one torque per 1 kHz cycle, stop.

As in libfranka, commands exclude gravity, and the arm adds its own gravity compensation. `read`
returns the state of the current cycle; `command` ends this cycle and waits for the next cycle. Both panda_py's
`control(callback)` loop and pylibfranka's readOnce/writeOnce can implement `read` and `command`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any, Protocol, runtime_checkable

import numpy as np

from r2s.physics.robot import SIM_DT, Robot
from r2s.recordings.recording import SIGNALS, Recording


class ArmStopped(RuntimeError):  # noqa: N818 (a stop is not a bug)
    """Error: the motion has ended, for the reason in the message; the next `move_to` begins a new motion.

    Attributes:
        recording: the motion recorded before the stop; None if nothing, or too little, was recorded.
    """

    recording: Recording | None = None


class NotCleared(ArmStopped):
    """Error: no operator allowed the arm to move again after an earlier stop; no further motion follows."""


class StopRequested(ArmStopped):
    """Error: a signal ended the motion, or the commanding process has ended; no further motion follows."""


@dataclass(frozen=True, slots=True)
class ArmState:
    """State of an arm with n joints in one 1 kHz cycle.

    Attributes:
        t: s, time since the motion began.
        q, dq: (n,) rad, rad/s, as measured by the arm.
        tau_J: (n,) Nm, measured link-side torque; it includes gravity, but little of the motor friction.
        tau_J_d: (n,) Nm, the last command, without gravity.
        tau_ext_hat_filtered: (n,) Nm, torque that the joints exert on the surroundings: tau_J minus the torque
            of the arm's own model (gravity, load, dynamics). This attribute and all attributes below may be None.
        O_F_ext_hat_K: (6,) N, Nm, wrench that the end effector exerts on the surroundings, in the base frame.
        joint_contact, joint_collision, cartesian_contact, cartesian_collision: (n,) for joints, (6,) for the end
            effector; above 0 where the external torque or force exceeds the contact or collision threshold.
        control_command_success_rate: share of the last 100 commands that reached the arm; 0 while no motion runs.
        O_T_EE: (16,), pose matrix of the end effector in the base frame, column by column.
        m_ee, m_load: kg, masses of end effector and load that the arm's gravity compensation assumes.
        box: (6,), pose of a box in the base frame, measured by a camera: center (m), and direction of the box's first
            axis.
    """

    t: float
    q: np.ndarray
    dq: np.ndarray
    tau_J: np.ndarray  # noqa: N815 (libfranka's name)
    tau_J_d: np.ndarray  # noqa: N815
    tau_ext_hat_filtered: np.ndarray | None = None
    O_F_ext_hat_K: np.ndarray | None = None
    joint_contact: np.ndarray | None = None
    cartesian_contact: np.ndarray | None = None
    joint_collision: np.ndarray | None = None
    cartesian_collision: np.ndarray | None = None
    control_command_success_rate: float | None = None
    O_T_EE: np.ndarray | None = None
    m_ee: float | None = None
    m_load: float | None = None
    box: np.ndarray | None = None

    @property
    def in_contact(self) -> bool:
        """Whether the arm reports a contact or a collision."""
        flags = self.joint_contact, self.cartesian_contact, self.joint_collision, self.cartesian_collision
        return any(flag is not None and flag.any() for flag in flags)

    @property
    def signals(self) -> np.ndarray:
        """(sum of `signal_sizes`,), the values of all `SIGNALS` in one array; nan where the arm reports no value."""
        sizes = signal_sizes(len(self.q)).items()
        values = ((getattr(self, name), size) for name, size in sizes)
        return np.concatenate([np.full(size, np.nan) if x is None else np.reshape(x, size) for x, size in values])


@cache
def signal_sizes(n: int) -> dict[str, int]:
    """Return the number of values of each signal in `SIGNALS`, for an arm of n joints."""
    return dict(zip(SIGNALS, (n, 6, n, 6, n, 6, 1, 16, 1, 1), strict=True))


def named_signals(values: np.ndarray, n: int) -> dict[str, Any]:
    """Split `ArmState.signals` (..., k) into named arrays (..., size), or (...) if size is 1; omit all-nan arrays."""
    sizes = signal_sizes(n)
    parts = zip(sizes, np.split(values, np.cumsum([*sizes.values()])[:-1], axis=-1), strict=True)
    return {name: x[..., 0] if x.shape[-1] == 1 else x for name, x in parts if not np.isnan(x).all()}


class Arm(Protocol):
    """A torque-controlled arm. A motion consists of `move_to`, then alternating `read` and `command`, then `stop`."""

    robot: Robot

    def move_to(self, q: np.ndarray) -> ArmState:
        """Bring the arm to rest at q (n,) rad before a motion, clear an earlier stop, and return the state."""
        ...

    def read(self) -> ArmState:
        """Return the state of the current cycle; only `command` advances to the next cycle."""
        ...

    def command(self, tau: np.ndarray) -> None:
        """Send tau (n,) Nm WITHOUT gravity for one cycle, and wait for the next cycle.

        Raises:
            ArmStopped: tau is not finite, |tau| > tau_max, |tau - tau_J_d| > dtau_max * 1 ms, a joint has left its
                position or velocity limits, or the arm had already stopped.

        """
        ...

    def stop(self) -> None:
        """End the motion; do nothing if the motion has already ended."""
        ...


@runtime_checkable
class Operated(Protocol):
    """An `Arm` with an operator, who must agree before the arm moves again after any stop.

    Attributes:
        operator: function that receives a stop's reason, asks the operator, and returns whether the arm may move.
            Without an operator (None), the arm may not move again after a stop.
        blocked: reason of a stop that the operator has not cleared; None: no such stop. Code that
            stops the arm's motion must write the reason to `blocked`.
    """

    operator: Callable[[str], bool] | None
    blocked: str | None


@runtime_checkable
class Holds(Protocol):
    """An `Arm` whose `stop` damps the motion.

    Attributes:
        hold: (n,) Nm, torque that the next `stop` adds to the damping torque, for example to carry a payload.
    """

    hold: np.ndarray


def speed_share(arm: Arm) -> float:
    """Return the factor by which the arm's settings scale all allowed speeds; 1 if the arm has no such setting."""
    return float(getattr(arm, "speed_share", 1.0))


class Reflexes:
    """Checks commands and states against the limits at which a real arm stops itself; errors name the joint."""

    def __init__(self, robot: Robot, dt: float = SIM_DT):
        self.robot = robot
        self._step = robot.dtau_max * dt

    def accepts(self, tau: np.ndarray, tau_J_d: np.ndarray) -> np.ndarray:
        """Return (...) bool: whether the arm accepts tau (..., n) Nm after the command tau_J_d (..., n) Nm."""
        # NaN fails both comparisons
        return ((np.abs(tau) <= self.robot.tau_max) & (np.abs(tau - tau_J_d) <= self._step)).all(-1)

    def within_limits(self, q: np.ndarray, dq: np.ndarray) -> np.ndarray:
        """Return (...) bool: whether q, dq (..., n) rad, rad/s are within the arm's limits."""
        r = self.robot
        return ((r.q_min <= q) & (q <= r.q_max) & (np.abs(dq) <= r.dq_max)).all(-1)

    def command(self, tau: np.ndarray, tau_J_d: np.ndarray) -> None:
        """Raise ArmStopped unless the arm accepts tau (n,) Nm after the command tau_J_d (n,) Nm."""
        r = self.robot
        if tau.shape != r.tau_max.shape:
            raise ArmStopped(f"expected a command of shape ({r.n},), got {tau.shape}")
        if self.accepts(tau, tau_J_d):
            return
        if not np.isfinite(tau).all():
            i = int(np.argmin(np.isfinite(tau)))
            raise ArmStopped(f"joint {i + 1}: commanded torque is {tau[i]}, must be finite")
        if (np.abs(tau) > r.tau_max).any():
            i = int(np.argmax(np.abs(tau) / r.tau_max))
            raise ArmStopped(f"joint {i + 1}: commanded torque {tau[i]:.3f} Nm, allowed +-{r.tau_max[i]:g} Nm")
        i = int(np.argmax(np.abs(tau - tau_J_d) / self._step))
        raise ArmStopped(
            f"joint {i + 1}: commanded torque steps by {tau[i] - tau_J_d[i]:+.3f} Nm in one cycle, allowed "
            f"+-{r.dtau_max[i] * SIM_DT:g} Nm (dtau_max {r.dtau_max[i]:g} Nm/s)"
        )

    def state(self, q: np.ndarray, dq: np.ndarray) -> None:
        """Raise ArmStopped if q, dq (n,) rad, rad/s are outside the arm's limits."""
        r = self.robot
        if self.within_limits(q, dq):
            return
        outside = np.maximum(r.q_min - q, q - r.q_max)
        if not (outside <= 0).all():
            i = int(np.argmax(outside))
            raise ArmStopped(f"joint {i + 1}: position {q[i]:.4f} rad, allowed {r.q_min[i]:g} to {r.q_max[i]:g} rad")
        i = int(np.argmax(np.abs(dq) / r.dq_max))
        raise ArmStopped(f"joint {i + 1}: velocity {dq[i]:.3f} rad/s, allowed +-{r.dq_max[i]:g} rad/s")
