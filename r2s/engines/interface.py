"""The interface of a physics engine: set the joint state, apply a torque for 1 ms, return the new joint state.

An engine simulates rigid bodies only. `FrictionTorque` computes friction, breakaway, offsets and the contact with a
surface as an additional joint torque in each step. Friction and contact are therefore the same in every engine.
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
    """Interface of an engine that simulates one arm without gravity, because a Franka arm compensates gravity."""

    def reset(self, q: np.ndarray, dq: np.ndarray) -> None:
        """Set the joint positions q (n,) rad and velocities dq (n,) rad/s."""
        ...

    def step(self, tau: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Apply the joint torque tau (n,) Nm for 1 ms; return the new (q, dq), (n,) rad, rad/s."""
        ...


class FrictionTorque:
    """Joint torque of friction and contact (r2s/physics/friction.py, contact.py), for engines with torque input.

    MuJoCo integrates friction implicitly: with the friction torque P, its slope D at the present velocity and the
    time step h, MuJoCo solves (M + h D) a = tau + P - bias. An engine that solves M a = tau + F - bias computes the
    same acceleration a if F = P - h D a. Without the term h D a, wrist joints chatter at h = 1 ms.

    Args:
        robot, dynamics: the arm and its dynamics.

    Attributes:
        contact: (COLUMNS,), contact state with the last step's force, see contact.py; None if there is no surface.
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
        """Return the torque F (n,) Nm that friction and contact add to tau (n,) Nm at q, dq (n,) rad, rad/s."""
        m, d = self._model, self._data
        d.qpos[:], d.qvel[:], d.qfrc_applied[:] = q, dq, tau
        mujoco.mj_forward(m, d)
        mujoco.mj_fullM(m, d, self._mass)
        slope = m.opt.timestep * m.dof_damping
        drive = d.qfrc_applied + d.qfrc_passive - d.qfrc_bias
        ddq = np.linalg.solve(self._mass + np.diag(slope), drive)
        return d.qfrc_passive - slope * ddq
