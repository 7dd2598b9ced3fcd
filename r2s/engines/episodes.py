"""Run episodes one by one in an engine other than MuJoCo, with the goals, starts and random arms of MuJoCo."""

from collections.abc import Callable

import numpy as np

from r2s.engines.interface import Engine, FrictionTorque
from r2s.learning.evaluate import fixed_draws
from r2s.physics.actuation import Actuation, Motors
from r2s.physics.contact_layout import FORCE, box_pose
from r2s.physics.dynamics import Dynamics
from r2s.physics.rigid_body import Kinematics
from r2s.physics.robot import Robot
from r2s.physics.safety_filter import SafetyFilter
from r2s.physics.simulator import single_arm
from r2s.tasks.task import State, Task

NONE = np.zeros(1, dtype=bool)  # no arm has stopped


class EngineArms:
    """The arms of `count` successive episodes, with the interface `Arms` of `r2s.tasks.rollout.rollout`.

    Episode e uses the e-th random arm of `r2s.learning.evaluate.make_evaluation` and the seed e for sensor noise.

    Args:
        make: function that returns the engine of an arm with given dynamics.
        robot, task, draw: robot, task and domain randomization of the training.
        count: number of episodes.
    """

    width = 1
    speeds = None

    def __init__(
        self,
        make: Callable[[Dynamics], Engine],
        robot: Robot,
        task: Task,
        draw: Callable[[np.random.Generator, int], Dynamics],
        count: int,
    ):
        self.robot, self._make, self._torque = robot, make, task.torque_limit(robot)
        self._control, self._moves_box = task.control(robot), task.moves_box
        self._substeps, self._period = task.substeps, 1 / task.ctrl_hz
        self._drawn = fixed_draws(draw, count)
        self._kinematics, self._command = Kinematics(robot), np.zeros(robot.n)
        self._actuation = Actuation(robot, 1, cutoff_hz=task.cutoff_hz)

    def place(self, starts: np.ndarray, first: int) -> State:
        """Create the arm of episode `first`, at rest at the joint angles `starts` (1, n) rad."""
        dynamics = self._drawn.one(first)
        self._engine, self._law = self._make(dynamics), FrictionTorque(self.robot, dynamics)
        self._guard = SafetyFilter(single_arm(self.robot, dynamics), self.robot, self._torque, dynamics.level)
        self._motors = Motors(1, self.robot.n, dynamics.delay, dynamics.lag)
        self._sigma, self._rng = dynamics.speed_noise, np.random.default_rng(first)
        self._actuation.reset()
        self._limited, self._memory = 0, np.zeros(self._control.memory_size)
        self._command = np.zeros(self.robot.n)
        self._now, self._steps = (starts[0], np.zeros(self.robot.n)), 0
        self._engine.reset(*self._now)
        return self._read()

    def step(self, command: np.ndarray) -> State:
        """Simulate one control period under the controller's command (1, c)."""
        self._limited = self._guard.changed
        control, target = self._control, np.empty(self.robot.n)
        for _ in range(self._substeps):
            q, dq = self._now
            control.law(q, dq + self._noise, command[0], control.parameters, self._memory, target)
            ((effort,),) = self._actuation(np.clip(target, -self._torque, self._torque)[None], 1)
            self._command = self._guard(*self._now, effort, self._command)
            applied = self._motors(self._command[None, None])[0, 0]
            self._now = self._engine.step(applied + self._law(*self._now, applied))
        self._steps += 1
        return self._read()

    def end(self) -> np.ndarray:
        """Return an array (1,) with the value False, because an engine simulates no reflexes that stop the arm."""
        return NONE

    def _read(self) -> State:
        q, dq = self._now
        ee, jacobian = self._kinematics(q)
        tau, effort, t = self._command[None], self._actuation.last, np.array([self._steps * self._period])
        limited = np.array([(self._guard.changed - self._limited) / self._substeps])
        noise = self._sigma * self._rng.standard_normal((1, self.robot.n))
        self._noise = noise[0]
        contact = self._law.contact
        force = None if contact is None else -contact[None, FORCE : FORCE + 3]
        box = box_pose(contact)[None] if self._moves_box and contact is not None else None
        joints = q[None], dq[None]
        return State(t, *joints, ee[None], jacobian[None], tau, effort, NONE, limited, noise, force, box)
