"""What r2s needs of an arm, real or not: be placed, be read, take one torque per 1 kHz cycle, stop.

The convention is libfranka's: a command excludes gravity and the arm adds its own compensation of it. A
panda_py `control(callback)` loop and pylibfranka's readOnce/writeOnce both fit: `read` is the state the cycle
came with, `command` ends the cycle and waits for the next.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from r2s.compiled import njit
from r2s.physics.robot import SIM_DT, Robot
from r2s.recordings.recording import Recording

RATE_TOLERANCE = 1e-3  # Nm: a command that was limited to the allowed step in another precision still passes


class ArmStopped(RuntimeError):  # noqa: N818 (an arm that stops is not a bug)
    """The arm ended the motion, for the reason in the message; it moves again after the next `move_to`.

    Attributes:
        recording: what was recorded until then, where a recording was made that is worth keeping.
    """

    recording: Recording | None = None


class NotCleared(ArmStopped):
    """The arm had stopped, and no operator has said that it may move again: what was to be done with it ends here."""


@dataclass(frozen=True, slots=True)
class ArmState:
    """One 1 kHz sample of n joints.

    Attributes:
        t: s, since the motion began.
        q, dq: (n,) rad, rad/s, as the arm measures them.
        tau_J: (n,) Nm, link-side torque sensor: contains gravity, hides most motor friction.
        tau_J_d: (n,) Nm, the last command: without gravity.

    """

    t: float
    q: np.ndarray
    dq: np.ndarray
    tau_J: np.ndarray  # noqa: N815 (libfranka's name)
    tau_J_d: np.ndarray  # noqa: N815


class Arm(Protocol):
    """A torque-controlled arm. One motion is `move_to`, then `read` and `command` in turn, then `stop`."""

    robot: Robot

    def move_to(self, q: np.ndarray) -> ArmState:
        """Bring the arm to rest at q (n,) rad before a motion, clear a stop, and return its state."""
        ...

    def read(self) -> ArmState:
        """Return the state of the current cycle; the same one until the next `command`."""
        ...

    def command(self, tau: np.ndarray) -> None:
        """Send tau (n,) Nm WITHOUT gravity for one cycle, and wait for the next.

        Raises:
            ArmStopped: not finite, beyond tau_max, a step of more than dtau_max * 1 ms from tau_J_d, or a
            joint that
                left its position or velocity limits; or the arm has stopped before.

        """
        ...

    def stop(self) -> None:
        """End the motion; harmless when it has already ended."""
        ...


@runtime_checkable
class Operated(Protocol):
    """An `Arm` beside which somebody stands: after any stop he is asked before it moves again.

    Attributes:
        operator: asked with the reason, returns whether he agrees; None: nobody is there, and nobody agrees.
        blocked: why `move_to` has to ask him; None: it has not. Who stops the motion of an arm says so here.
    """

    operator: Callable[[str], bool] | None
    blocked: str | None


class Reflexes:
    """The checks by which an arm stops itself, for arms that are not hardware; messages name the joint."""

    def __init__(self, robot: Robot, dt: float = SIM_DT):
        self.robot = robot
        self._step = robot.dtau_max * dt + RATE_TOLERANCE
        still = np.zeros((1, robot.n))  # to compile while no arm waits
        self.takes(still, still)
        Reflexes.inside(self, still, still)

    def takes(self, tau: np.ndarray, tau_J_d: np.ndarray) -> np.ndarray:
        """Return (m,), whether arms would take tau (m, n) Nm after the commands tau_J_d (m, n) Nm."""
        return _takes(tau, tau_J_d, self.robot.tau_max, self._step)

    def inside(self, q: np.ndarray, dq: np.ndarray) -> np.ndarray:
        """Return (m,), whether q, dq (m, n) rad, rad/s are within the arm's limits."""
        return _inside(q, dq, self.robot.q_min, self.robot.q_max, self.robot.dq_max)

    def command(self, tau: np.ndarray, tau_J_d: np.ndarray) -> None:
        """Raise ArmStopped if the arm would not take tau (n,) Nm after the command tau_J_d (n,) Nm."""
        r = self.robot
        if tau.shape != r.tau_max.shape:
            raise ArmStopped(f"the command has shape {tau.shape}, the arm has {r.n} joints")
        if self.takes(tau[None], tau_J_d[None])[0]:
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
        if self.inside(q[None], dq[None])[0]:
            return
        out = np.maximum(r.q_min - q, q - r.q_max)
        if not (out <= 0).all():
            i = int(np.argmax(out))
            raise ArmStopped(f"joint {i + 1}: position {q[i]:.4f} rad, allowed {r.q_min[i]:g} to {r.q_max[i]:g} rad")
        i = int(np.argmax(np.abs(dq) / r.dq_max))
        raise ArmStopped(f"joint {i + 1}: velocity {dq[i]:.3f} rad/s, allowed +-{r.dq_max[i]:g} rad/s")


@njit(cache=True)
def _takes(tau, tau_J_d, most, step):
    good = np.ones(len(tau), np.bool_)
    for i in range(len(tau)):
        for j in range(tau.shape[1]):  # NaN fails both
            good[i] &= abs(tau[i, j]) <= most[j] and abs(tau[i, j] - tau_J_d[i, j]) <= step[j]
    return good


@njit(cache=True)
def _inside(q, dq, low, high, fast):
    good = np.ones(len(q), np.bool_)
    for i in range(len(q)):
        for j in range(q.shape[1]):
            good[i] &= low[j] <= q[i, j] <= high[j] and abs(dq[i, j]) <= fast[j]
    return good
