"""Model-based baselines: minimum-jerk joint motion, computed torque, friction compensation.

A baseline has the interface, observations and rate of a policy. A baseline's model of the arm is the center of the
domain randomization.
"""

import mujoco
import numpy as np
import torch
from torch import Tensor

from r2s.errors import UserError, check_number
from r2s.excitation.minimum_jerk import minimum_jerk
from r2s.physics.dynamics import Dynamics
from r2s.physics.rigid_body import set_links
from r2s.physics.robot import Robot
from r2s.physics.safety_filter import ALLOWED
from r2s.tasks.reach import ReachTask
from r2s.tasks.task import Task

STIFF = 12.0  # rad/s, bandwidth of critically damped feedback; the highest that 50 Hz and an arm's latency allow
POSTURE = 1e-3  # m^2, weight of the start posture in the inverse kinematics
FAST = 0.9 * ALLOWED  # largest planned speed / speed limit of a joint; the safety filter allows ALLOWED
PEAK = 1.875  # peak speed / mean speed of a minimum-jerk motion (15 / 8)


class Oracle:
    """A baseline for B arms, with the interface of `Policy`: computed torque tracks a minimum-jerk joint motion.

    Args:
        robot, task: the arm and its task with control=torque. dynamics: dynamics of one arm, for computed torque.
        move_s: s, shortest duration of a motion; a motion lasts longer if a joint would exceed FAST x its speed
            limit.
    """

    def __init__(self, robot: Robot, task: ReachTask, dynamics: Dynamics, move_s: float = 0.6):
        check_number("move_s", move_s, "(0, inf)")
        if task.control(robot).name != "torque":
            raise UserError(f"algo: oracle needs control=torque, got control={task.control(robot).name}")
        self.robot, self.task, self.dynamics, self.move_s = robot, task, dynamics, move_s
        self._model = robot.model(gravity=False)
        set_links(self._model, dynamics.mass, dynamics.com, dynamics.inertia, dynamics.armature)
        self._data = mujoco.MjData(self._model)
        self._site = self._model.site(robot.ee_site).id
        self._torque = task.torque_limit(robot)
        self._stuck = self._torque < dynamics.level
        self._plans: dict[int, tuple[np.ndarray, np.ndarray, float, int]] = {}

    @torch.no_grad()
    def action(self, observation: Tensor) -> Tensor:
        """Return actions (B, n) in [-1, 1] for observations (B, d); zero effort marks a new episode."""
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
        """Return the computed torque (n,) Nm at q, dq (n,), for the reference motion `to`, `dto`, `ddto` (n,)."""
        data = self._data
        data.qpos[:], data.qvel[:], data.qacc[:] = q, dq, ddto + 2 * STIFF * (dto - dq) + STIFF**2 * (to - q)
        rigid = np.zeros(self.robot.n)
        mujoco.mj_fwdPosition(self._model, data)
        mujoco.mj_fwdVelocity(self._model, data)
        mujoco.mj_rne(self._model, data, 1, rigid)
        return rigid + self.dynamics.friction(dto) - self.dynamics.offset

    def inverse_kinematics(self, start: np.ndarray, goal: np.ndarray, rounds: int = 60) -> np.ndarray:
        """Return joint angles (n,) rad near `start`, within limits, that bring the end effector to `goal` (3,) m.

        Damped least squares moves only the joints whose friction is below the torque limit.
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


class ZeroAction:
    """A policy with zero actions for a task that the controller performs alone; see `r2s.learning.networks.Policy`.

    Args:
        action_dim: number of values in an action.
    """

    def __init__(self, action_dim: int):
        self._action_dim = action_dim

    def action(self, observation: Tensor) -> Tensor:
        """Return zero actions (B, a)."""
        return torch.zeros(len(observation), self._action_dim)


def computed_torque(robot: Robot, task: Task, dynamics: Dynamics) -> Oracle | ZeroAction:
    """Return the baseline: an `Oracle` for reaching with control=torque, zero actions for control=computed_torque.

    Raises:
        UserError: the task or its controller is not supported.
    """
    if task.control(robot).name == "computed_torque":
        return ZeroAction(robot.n)
    if isinstance(task, ReachTask) and task.control(robot).name == "torque":
        return Oracle(robot, task, dynamics)
    raise UserError(
        f"algo: computed_torque cannot do {type(task).__name__} under control={task.control(robot).name}; "
        "control=computed_torque is allowed"
    )


def hybrid_force(robot: Robot, task: Task, dynamics: Dynamics) -> ZeroAction:
    """Return the baseline `algo=hybrid_force`: zero actions under control=hybrid.

    With zero actions, the controller exerts the requested force f on the surface in open loop. The controller's
    torque for this force is J^T f plus the modeled friction torque.

    Raises:
        UserError: the controller is not control=hybrid, or the task has no contact.
    """
    control = task.control(robot)
    if control.name != "hybrid" or not hasattr(task, "contact"):
        raise UserError(
            f"algo: hybrid_force cannot do {type(task).__name__} under control={control.name}; task=press or "
            "wipe with control=hybrid is allowed"
        )
    return ZeroAction(control.action_dim)
