"""Demonstrations: a model-based controller with noise fills the replay buffer before the first update.

Off-policy learners can learn from any good transitions in their buffer (Ball et al. 2023, arXiv:2302.02948). Random
torques hardly ever stop an arm at the goal. A controller reaches the goal, and noise on its actions varies the
motion.
"""

import math

import torch
from torch import Tensor

from r2s.learning.model_based import Oracle, ZeroAction, hybrid_force
from r2s.learning.pusher import Pusher, sets_targets
from r2s.physics.dynamics import Dynamics
from r2s.physics.robot import Robot
from r2s.tasks.reach import ReachTask
from r2s.tasks.task import Task

NOISE = 0.3  # standard deviation of the last arm's noise; the first value tried, with seeds 0 to 2 of task=reach
KEPT = 0.9  # correlation of the noise between successive steps; white noise hardly moves an arm


class Demonstrator:
    """A model-based controller with action noise; the standard deviation rises from 0 (first arm) to NOISE (last).

    Attributes:
        at_zero: whether all actions of `reference` are zero, so that a policy with zero actions acts like
            `reference`.

    Args:
        reference: the controller, with the interface of `r2s.learning.networks.Policy`.
    """

    def __init__(self, reference: Oracle | Pusher | ZeroAction):
        self._reference, self._noise = reference, torch.zeros(())
        self.at_zero = isinstance(reference, ZeroAction)

    def action(self, observation: Tensor) -> Tensor:
        """Return actions (B, a) in [-1, 1] for observations (B, d) in SI units."""
        action = self._reference.action(observation)
        self._noise = KEPT * self._noise + math.sqrt(1.0 - KEPT**2) * torch.randn_like(action)
        return (action + torch.linspace(0.0, NOISE, len(action))[:, None] * self._noise).clamp(-1.0, 1.0)


def make_demonstrator(robot: Robot, task: Task, dynamics: Dynamics) -> Demonstrator | None:
    """Return the demonstrator for reaching, pushing or hybrid control; None if no baseline supports the task.

    Args:
        robot, task: the arm and its task. dynamics: model of one arm, at the center of the domain randomization.
    """
    control = task.control(robot)
    if isinstance(task, ReachTask) and control.name == "torque":
        return Demonstrator(Oracle(robot, task, dynamics))
    if sets_targets(task, control):
        return Demonstrator(Pusher(robot, task, dynamics))  # type: ignore[arg-type]
    if control.name == "hybrid" and hasattr(task, "contact"):
        return Demonstrator(hybrid_force(robot, task, dynamics))
    return None
