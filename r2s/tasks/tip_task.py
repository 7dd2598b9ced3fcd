"""What tasks of a robot's tool share: their own controller, its torque limit, and starts that goals replace."""

from typing import Any

import numpy as np

from r2s.control.controller import Controller
from r2s.control.impedance import Impedance
from r2s.errors import UserError
from r2s.physics.dynamics import Dynamics
from r2s.physics.robot import Robot
from r2s.tasks.reach import SPEED_NOISE, ReachTask
from r2s.tasks.task import BaseTask, State


class TipTask(BaseTask):
    """A task of a tool's tip, whose own controller is a Cartesian impedance.

    Attributes:
        torque_fraction: share of tau_max, the largest torque of the task's own controller and of control=torque.
        cutoff_hz, speed_noise: see `ReachTask`.
        own: the task's own controller, of `with_model`; None before.
    """

    torque_fraction: float | tuple[float, ...]
    cutoff_hz: float
    own: Impedance | None

    def as_reach(self) -> ReachTask:
        """Return a reach task with the same rates and torques; raise UserError for wrong ones."""
        return ReachTask(
            self.ctrl_hz, self.episode_s, self.torque_fraction, self.cutoff_hz, speed_noise=self.speed_noise
        )

    def noise_for(self, dynamics: Dynamics) -> float:
        """Return the speed noise of a training for an arm with these dynamics, rad/s."""
        if self.speed_noise is not None:
            return self.speed_noise
        return SPEED_NOISE if np.any(dynamics.speed_noise) else 0.0

    def of_model(self, name: str) -> Any:
        """Return an attribute that `with_model` sets; raise UserError before."""
        value = getattr(self, name)
        if value is None:
            raise UserError(f"task: {type(self).__name__} needs a model of the arm; call with_model first")
        return value

    def control(self, robot: Robot) -> Controller:
        """Return the controller: by default the task's own one."""
        return self.controller or self.own or super().control(robot)

    def torque_limit(self, robot: Robot) -> np.ndarray:
        """Return (n,) Nm, the largest target torque."""
        limit = self.control(robot).torque_limit if self.controller or self.own else None
        return self.as_reach().torque_limit(robot) if limit is None else limit

    def starts(self, robot: Robot, rng: np.random.Generator, count: int) -> np.ndarray:
        """Return (count, n) rad, home: `begin` replaces it by the goals' start postures."""
        return np.tile(robot.q_home, (count, 1))

    def distance_scale(self, state: State, goals: np.ndarray) -> np.ndarray:
        """Return (m,) ones: the reward takes forces in N and distances in m."""
        return np.ones(len(goals))
