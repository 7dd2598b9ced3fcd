"""The interface of a physics engine: set joint positions and velocities, apply one torque per millisecond, read them.

An engine simulates rigid bodies only. `FrictionTorque` computes friction, breakaway, offsets and the contact with a
surface as an additional joint torque in each step, so that the arm moves and touches alike in every engine.
"""

from typing import Protocol

import mujoco
import numpy as np

from r2s.physics import mujoco_callback as native
from r2s.physics.contact_layout import contact_columns
from r2s.physics.dynamics import Dynamics
from r2s.physics.robot import Robot
from r2s.physics.simulator import single_arm


class Engine(Protocol):
    """One arm without gravity, which the arm compensates, as a Franka does."""

    def reset(self, q: np.ndarray, dq: np.ndarray) -> None:
        """Set q, dq (n,) rad, rad/s."""
        ...

    def step(self, tau: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Apply the joint torque tau (n,) Nm for 1 ms; return the new (q, dq), (n,) rad, rad/s."""
        ...


class FrictionTorque:
    """The joint torque of r2s/physics/friction.py and contact.py, for engines whose only input is torque.

    This friction is implicit: with its torque P and its slope D at the present velocity, MuJoCo solves (M + h D) a =
    tau + P - bias. An engine that solves M a = tau + F - bias computes the same a with F = P - h D a, where a is
    the result of the implicit step. Without the term h D a, real wrist joints chatter at 1 ms.

    Args:
        robot, dynamics: the arm.

    Attributes:
        contact: (COLUMNS,), state of r2s/physics/contact.py, with the last step's force; None without a surface.
    """

    def __init__(self, robot: Robot, dynamics: Dynamics):
        self._model = single_arm(robot, dynamics)
        self._model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)  # the engine has its own stops
        self._data = mujoco.MjData(self._model)
        self._mass = np.empty((robot.n, robot.n))
        self.contact = None
        if dynamics.surface is not None:
            self._model.jnt_user[:, native.CONTACT] = at = native.KEPT * robot.n
            self.contact = self._data.userdata[at:]
            self.contact[:] = contact_columns(robot, dynamics.surface)

    def __call__(self, q: np.ndarray, dq: np.ndarray, tau: np.ndarray) -> np.ndarray:
        """Return F (n,) Nm to add to the torque tau (n,) Nm in the step that begins at q, dq (n,)."""
        m, d = self._model, self._data
        d.qpos[:], d.qvel[:], d.qfrc_applied[:] = q, dq, tau
        mujoco.mj_forward(m, d)
        mujoco.mj_fullM(m, d, self._mass)
        slope = m.opt.timestep * m.dof_damping
        drive = d.qfrc_applied + d.qfrc_passive - d.qfrc_bias
        ddq = np.linalg.solve(self._mass + np.diag(slope), drive)
        return d.qfrc_passive - slope * ddq
