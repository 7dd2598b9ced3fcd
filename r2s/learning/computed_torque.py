"""What a roboticist would do without learning: minimum-jerk joint motion, computed torque, friction compensation.

It has a policy's interface and sees what a policy sees, at a policy's rate; the model is the one that policies train
in. Every learned result is read against it (`algo=oracle`).
"""

import mujoco
import numpy as np
import torch
from torch import Tensor

from r2s.errors import UserError, check_number
from r2s.excitation.minimum_jerk import minimum_jerk
from r2s.physics.dynamics import Dynamics
from r2s.physics.limits import ALLOWED
from r2s.physics.rigid_body import put_links
from r2s.physics.robot import Robot
from r2s.tasks.reach import ReachTask
from r2s.tasks.task import Task
from r2s.tasks.track import TrackTask

STIFF = 12.0  # rad/s, bandwidth of the feedback, critically damped: 50 Hz and the delays of an arm bear no more
POSTURE = 1e-3  # weight of staying near the start in the inverse kinematics, against metres of the end effector
FAST = 0.9 * ALLOWED  # of a joint's velocity limit: below what the driver's law lets be
PEAK = 1.875  # of a minimum-jerk motion's speed, over its mean


class Oracle:
    """The reference controller of B arms; `action` as of r2s.learning.networks.Policy.

    Args:
        robot, task: the arm and what is asked of it.
        dynamics: of one arm, what the controller believes.
        move_s: s, shortest duration of a motion; no joint gets faster than FAST of its limit.
    """

    def __init__(self, robot: Robot, task: ReachTask, dynamics: Dynamics, move_s: float = 0.6):
        check_number("move_s", move_s, "(0, inf)")
        self.robot, self.task, self.dynamics, self.move_s = robot, task, dynamics, move_s
        self._model = robot.model(gravity=False)
        put_links(self._model, dynamics.mass, dynamics.com, dynamics.inertia, dynamics.armature)
        self._data = mujoco.MjData(self._model)
        self._site = self._model.site(robot.ee_site).id
        self._torque = task.torque(robot)
        self._stuck = self._torque < dynamics.level
        self._plans: dict[int, tuple[np.ndarray, np.ndarray, float, int]] = {}

    @torch.no_grad()
    def action(self, observation: Tensor) -> Tensor:
        """Return actions (B, n) in [-1, 1] for observations (B, d); no effort yet means that an episode begins."""
        rows, n = observation.numpy().astype(np.float64), self.robot.n
        out = np.empty((len(rows), n))
        for i, row in enumerate(rows):
            q, dq, goal, effort = row[:n], row[n : 2 * n], row[2 * n + 3 : 2 * n + 6], row[2 * n + 9 : 3 * n + 9]
            if i not in self._plans or not effort.any():
                end = self.inverse_kinematics(q, goal)
                fastest = np.max(PEAK * np.abs(end - q) / (FAST * self.robot.dq_max))
                self._plans[i] = q, end, max(self.move_s, float(fastest)), 0
            start, end, seconds, k = self._plans[i]
            self._plans[i] = start, end, seconds, k + 1
            out[i] = self.torque(q, dq, *minimum_jerk(start, end, seconds, (k + 0.5) / self.task.ctrl_hz))
        return torch.from_numpy(np.clip(out / self._torque, -1.0, 1.0).astype(np.float32))

    def torque(self, q: np.ndarray, dq: np.ndarray, to: np.ndarray, dto: np.ndarray, ddto: np.ndarray) -> np.ndarray:
        """Return (n,) Nm that follows the reference `to`, `dto`, `ddto` (n,) from q, dq (n,)."""
        data = self._data
        data.qpos[:], data.qvel[:], data.qacc[:] = q, dq, ddto + 2 * STIFF * (dto - dq) + STIFF**2 * (to - q)
        rigid = np.zeros(self.robot.n)
        mujoco.mj_fwdPosition(self._model, data)
        mujoco.mj_fwdVelocity(self._model, data)
        mujoco.mj_rne(self._model, data, 1, rigid)
        return rigid + self.dynamics.friction(dto) - self.dynamics.offset

    def inverse_kinematics(self, start: np.ndarray, goal: np.ndarray, rounds: int = 60) -> np.ndarray:
        """Return q (n,) within the limits whose end effector is at `goal` (3,) m, near `start`; damped steps.

        Joints whose friction is more than an action stay where they are.
        """
        q, jacobian = start.copy(), np.empty((3, self.robot.n))
        low, high = self.robot.q_min + 0.15, self.robot.q_max - 0.15
        for _ in range(rounds):
            self._data.qpos[:] = q
            mujoco.mj_kinematics(self._model, self._data)
            mujoco.mj_comPos(self._model, self._data)
            mujoco.mj_jacSite(self._model, self._data, jacobian, None, self._site)
            jacobian[:, self._stuck] = 0.0
            error = goal - self._data.site_xpos[self._site]
            if np.linalg.norm(error) < 2e-4:
                break
            h = jacobian.T @ jacobian + POSTURE * np.eye(self.robot.n)
            step = np.linalg.solve(h, jacobian.T @ error)
            q = np.clip(q + step * min(1.0, 0.3 / np.abs(step).max()), low, high)
        return q


class Still:
    """Asks for nothing beyond a task's base; `action` as of r2s.learning.networks.Policy.

    Args:
        joints: how many an action has.
    """

    def __init__(self, joints: int):
        self._joints = joints

    def action(self, observation: Tensor) -> Tensor:
        """Return actions (B, n) of zero."""
        return torch.zeros(len(observation), self._joints)


def computed_torque(robot: Robot, task: Task, dynamics: Dynamics) -> Oracle | Still:
    """Return what follows a plan by inverse dynamics with feedback, no learning: `algo=computed_torque`.

    A task that has such a base needs nothing more. Of reaching the plan is a minimum-jerk motion, which is `Oracle`.

    Raises:
        UserError: the task has neither.
    """
    if isinstance(task, TrackTask):
        if task.base != "model":
            raise UserError(f"task.base: {task.base} leaves algo=computed_torque nothing to do; model is allowed")
        return Still(robot.n)
    if isinstance(task, ReachTask):
        return Oracle(robot, task, dynamics)
    raise UserError(f"algo=computed_torque: it knows of no plan for {type(task).__name__}; reach and track have one")
