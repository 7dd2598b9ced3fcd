"""Train what `adapt=rma` says: arms that differ from the identified one are moved by the policy that is told a latent
of the truth; a network learns to tell the latent from what is heard of them.

Kumar, Fu, Pathak and Malik, RSS 2021, arXiv 2107.04034. There the student moves the arm while it learns; here the
truth does, all of it, a part or nothing, as of history.py.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch

from r2s.adaptation.history import Network
from r2s.adaptation.telling import truth
from r2s.learning.history import Answer, Lessons, learn
from r2s.learning.networks import Policy
from r2s.learning.randomization import Draw
from r2s.physics.dynamics import Dynamics
from r2s.physics.robot import Robot
from r2s.tasks.task import State, Task, observed


@dataclass(frozen=True)
class Latents:
    """The `Lesson` of the latent: the policy moves the arm, told what is answered.

    Attributes:
        robot, task: what the policy was trained for. center: what is believed of the arm.
        teacher: the policy that is told the truth. policy: the same that is told the latent.
    """

    robot: Robot
    task: Task
    center: Dynamics
    teacher: Policy
    policy: Policy

    @property
    def count(self) -> int:
        """Numbers of the latent."""
        assert self.policy.told is not None
        return self.policy.told.numbers

    def answer(self, arm: Dynamics) -> Answer:
        """Return the latent of this arm, whatever its motion."""
        right = torch.from_numpy(truth(self.robot, self.center, arm)).float()
        latent = self.teacher.latent(right)[0].numpy().astype(float)
        return lambda *motion: latent

    @torch.no_grad()
    def target(self, state: State, goals: np.ndarray, torque: np.ndarray, answers: np.ndarray) -> np.ndarray:
        """Return (m, n) Nm, what the policy asks for."""
        shown = observed(self.task, replace(state, told=answers), goals, torque)
        action = self.policy.action(torch.from_numpy(shown)).numpy().astype(np.float64)
        return np.clip(self.task.target(action, state, goals, torque), -torque, torque)


def teach_latent(
    robot: Robot,
    task: Task,
    center: Dynamics,
    draw: Draw,
    teacher: Policy,
    lessons: Lessons,
    seed: int,
    progress: Callable[[int, int], None],
) -> tuple[Network, float]:
    """Return what says the latent of `teacher`, and which share of it, of arms that it was not taught with.

    Args:
        robot, task: what the teacher was trained for. center: what is believed of the arm. draw: arms about it.
        teacher: a policy with a latent. lessons: with which changes, and how. seed, progress: as of `learn`.
    """
    lesson = Latents(robot, task, center, teacher, teacher.by_latent())
    return learn(robot, task, center, draw, lessons, seed, progress, lesson)
