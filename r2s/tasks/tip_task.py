"""Base class of tasks for a tool's tip: a default controller, a torque limit, and goals with start postures."""

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
    """A task for the tip of a tool, with a Cartesian impedance as its default controller.

    Attributes:
        torque_fraction: largest torque of the default controller and of control=torque, as a share of tau_max.
        cutoff_hz, speed_noise: see `ReachTask`.
        own: the default controller; None before `with_model` is called.
    """

    torque_fraction: float | tuple[float, ...]
    cutoff_hz: float
    own: Impedance | None

    def as_reach(self) -> ReachTask:
        """Return a reach task with this task's timing, torque limit and noise; raise UserError for invalid values."""
        return ReachTask(
            self.ctrl_hz, self.episode_s, self.torque_fraction, self.cutoff_hz, speed_noise=self.speed_noise
        )

    def noise_for(self, dynamics: Dynamics) -> float:
        """Return `speed_noise`, rad/s; if None, return the default for an arm with these dynamics."""
        if self.speed_noise is not None:
            return self.speed_noise
        return SPEED_NOISE if np.any(dynamics.speed_noise) else 0.0

    def of_model(self, name: str) -> Any:
        """Return an attribute that `with_model` sets; raise UserError if the attribute is None."""
        value = getattr(self, name)
        if value is None:
            raise UserError(f"task: {type(self).__name__} needs a model of the arm; call with_model first")
        return value

    def control(self, robot: Robot) -> Controller:
        """Return the controller that `controlled_by` set, else the default controller."""
        return self.controller or self.own or super().control(robot)

    def torque_limit(self, robot: Robot) -> np.ndarray:
        """Return (n,) Nm, the largest target torque."""
        limit = self.control(robot).torque_limit if self.controller or self.own else None
        return self.as_reach().torque_limit(robot) if limit is None else limit

    def starts(self, robot: Robot, rng: np.random.Generator, count: int) -> np.ndarray:
        """Return home postures (count, n) rad; `begin` returns the start postures in the goals instead."""
        return np.tile(robot.q_home, (count, 1))

    def distance_scale(self, state: State, goals: np.ndarray) -> np.ndarray:
        """Return (m,) ones, because the rewards of tip tasks need no initial distance as a scale."""
        return np.ones(len(goals))
