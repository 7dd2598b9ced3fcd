"""`control=torque`: an action is a joint torque as a fraction of the task's torque limit."""

import numpy as np

from r2s.control.controller import ControlledTask, Controller
from r2s.physics.control_laws import torque_law
from r2s.physics.dynamics import Dynamics
from r2s.physics.robot import Robot

CPP = "for (int j = 0; j < n; ++j) out[j] = command[j];"


def torque(robot: Robot, task: ControlledTask, dynamics: Dynamics | None = None) -> Controller:
    """Return the torque controller; an action of 1 commands the task's torque limit."""
    limit = task.torque_limit(robot)
    return Controller("torque", torque_law, limit, np.zeros(robot.n), cpp=CPP, torque_limit=limit)
