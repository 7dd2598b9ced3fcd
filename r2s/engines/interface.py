"""What r2s needs of a physics engine: be put somewhere, take one torque per millisecond, say where the joints are.

An engine knows rigid bodies. Friction, breakaway and offsets are no engine's own law: `Law` works them out, and they
enter as one more joint torque each step. So the same arm moves in every engine.
"""

from typing import Protocol

import mujoco
import numpy as np

from r2s.physics.dynamics import Dynamics
from r2s.physics.robot import Robot
from r2s.physics.simulator import single_arm


class Engine(Protocol):
    """One arm, without gravity, as libfranka has it: the arm compensates it."""

    def reset(self, q: np.ndarray, dq: np.ndarray) -> None:
        """Put the arm at q, dq (n,) rad, rad/s."""
        ...

    def step(self, tau: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Apply the joint torque tau (n,) Nm for 1 ms; return the new (q, dq), (n,) rad, rad/s."""
        ...


class Law:
    """The joint torque of r2s/physics/friction.py beside a command, for engines that take nothing but torque.

    That law is implicit: with P its torque and D its slope at the present velocity, MuJoCo solves
    (M + h D) a = tau + P - bias. An engine that solves M a = tau + F - bias does the same with F = P - h D a, where a
    is what the implicit step will come to. Without that term real wrist joints chatter at 1 ms.

    Args:
        robot, dynamics: the arm.
    """

    def __init__(self, robot: Robot, dynamics: Dynamics):
        self._model = single_arm(robot, dynamics)
        self._model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)  # stops are the engine's
        self._file_damping = robot.model(gravity=False).dof_damping
        self._data = mujoco.MjData(self._model)
        self._mass = np.empty((robot.n, robot.n))

    def __call__(self, q: np.ndarray, dq: np.ndarray, tau: np.ndarray) -> np.ndarray:
        """Return F (n,) Nm, to be added to the torque tau (n,) Nm of the coming step from q, dq (n,)."""
        m, d = self._model, self._data
        d.qpos[:], d.qvel[:], d.qfrc_applied[:] = q, dq, tau
        mujoco.mj_forward(m, d)
        mujoco.mj_fullM(m, d, self._mass)
        slope = m.opt.timestep * m.dof_damping
        drive = d.qfrc_applied + d.qfrc_passive - d.qfrc_bias
        coming = np.linalg.solve(self._mass + np.diag(slope), drive)
        # the file's own damping is the engine's: it does the same with it
        own = m.opt.timestep * self._file_damping
        return d.qfrc_passive + self._file_damping * dq - (slope - own) * coming


class MujocoEngine:
    """MuJoCo without the law: what the other engines are held against."""

    def __init__(self, robot: Robot, dynamics: Dynamics):
        self._model = single_arm(robot, dynamics)
        self._model.jnt_user[:] = 0.0  # no friction of ours
        self._data = mujoco.MjData(self._model)

    def reset(self, q: np.ndarray, dq: np.ndarray) -> None:
        """Put the arm at q, dq (n,) rad, rad/s."""
        mujoco.mj_resetData(self._model, self._data)
        self._data.qpos[:], self._data.qvel[:] = q, dq

    def step(self, tau: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Apply tau (n,) Nm for 1 ms; return the new (q, dq)."""
        self._data.qfrc_applied[:] = tau
        mujoco.mj_step(self._model, self._data)
        return self._data.qpos.copy(), self._data.qvel.copy()
