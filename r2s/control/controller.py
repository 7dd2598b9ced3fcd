"""The interface of a controller: an action space, and a compiled law that maps a command to torque at 1 kHz."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from r2s.physics.control_laws import run_law
from r2s.physics.robot import Robot


class ControlledTask(Protocol):
    """Interface through which a controller uses a task.

    Attributes:
        ctrl_hz: policy rate, Hz. cutoff_hz: cutoff of the low-pass on the torque, Hz.
    """

    @property
    def ctrl_hz(self) -> int: ...  # noqa: D102 (see the class)
    @property
    def cutoff_hz(self) -> float: ...  # noqa: D102

    def torque_limit(self, robot: Robot) -> np.ndarray:
        """Return the task's limit (n,) Nm on the target torque of each joint."""
        ...


@dataclass(frozen=True)
class Controller:
    """Action space and control law of a robot, for one arm or a batch; `control=` selects the kind of controller.

    A policy's action lies in [-1, 1]. The controller scales the action to SI units: action_offset + action_scale *
    action. A command consists of the scaled action and of the setpoint, which the controller computes from the task.

    Attributes:
        name: the controller's name.
        law: the compiled law; see r2s/physics/control_laws.py.
        action_scale, action_offset: (a,) in `unit`. action: name of the quantity that an action sets.
        parameters: (p,), the law's parameters. memory_size: number of values that the law stores between cycles.
        torque_limit: (n,) Nm, the largest target torque; None: the task's limit.
        cpp: C++17 body of the law for contract.hpp; empty: bundles with this controller have no contract.hpp.
    """

    name: str
    law: Callable
    action_scale: np.ndarray
    action_offset: np.ndarray
    action: str = "torque"
    unit: str = "Nm"
    parameters: np.ndarray = field(default_factory=lambda: np.zeros(0))
    memory_size: int = 0
    cpp: str = ""
    torque_limit: np.ndarray | None = None

    @property
    def action_dim(self) -> int:
        """Number of values in an action."""
        return len(self.action_scale)

    @property
    def setpoint_size(self) -> int:
        """Number of values in a setpoint."""
        return 0

    @property
    def command_size(self) -> int:
        """Number of values in a command."""
        return self.action_dim + self.setpoint_size

    @property
    def observes_torque(self) -> bool:
        """Whether the policy observes the control law's torque for an action of zero."""
        return False

    def setpoint(self, task: Any, t: np.ndarray, goals: np.ndarray) -> np.ndarray:
        """Return the setpoints (m, `setpoint_size`) of m episodes with `goals` at the times t (m,), in seconds."""
        return np.empty((len(t), 0))

    def holding_torque(self, q: np.ndarray) -> np.ndarray:
        """Return the torque (n,) Nm that holds the control law's model of the arm with payload at rest at q (n,) rad.

        While the driver brings the arm to rest, the driver applies this holding torque.
        """
        return np.zeros(len(q))

    def command(self, action: np.ndarray, task: Any, t: np.ndarray, goals: np.ndarray) -> np.ndarray:
        """Return the commands (m, c) of the control period that begins at t (m,) s.

        Args:
            action: (m, a) in [-1, 1]. task, goals: the task and the goals of the episodes.
        """
        scaled = action * self.action_scale
        if self.action_offset.any():
            scaled = self.action_offset + scaled
        if not self.setpoint_size:
            return scaled
        return np.concatenate([scaled, self.setpoint(task, t, goals)], axis=1)

    def torque(self, q: np.ndarray, dq: np.ndarray, command: np.ndarray) -> np.ndarray:
        """Return the torque (m, n) Nm in the first cycle of a command (m, c) at q, dq (m, n) rad, rad/s."""
        return run_law(self.law, q, dq, command, self.parameters, self.memory_size)
