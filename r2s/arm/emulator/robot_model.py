"""The emulated control box's model of its arm: URDF, end-effector pose and external torque."""

from dataclasses import replace
from xml.etree import ElementTree as ET

import mujoco
import numpy as np

from r2s.arm.clients import fr3_limits
from r2s.arm.interface import ArmState
from r2s.physics import description
from r2s.physics.dynamics import Dynamics
from r2s.physics.robot import SIM_DT, Robot

CUTOFF_HZ = 15.0  # first-order low-pass; our choice, needed because dq is differentiated at 1 kHz


def urdf(robot: Robot) -> str:
    """Return the arm as URDF, without geometry and with an FR3's joint limits: the answer to GetRobotModel."""
    envelope = fr3_limits.DECELERATION, fr3_limits.VELOCITY_OFFSET
    q_min, q_max, dq_max = fr3_limits.Q_MIN, fr3_limits.Q_MAX, fr3_limits.DQ_MAX
    fr3 = replace(robot, q_min=q_min, q_max=q_max, dq_max=dq_max, velocity_envelope=envelope)
    links, _ = description.chain(robot, Dynamics.of(robot, np.zeros((robot.n, 3))), friction=False)
    return ET.tostring(description.urdf(fr3, links), encoding="unicode")


class EndEffectorPose:
    """Forward kinematics in RobotState's format."""

    def __init__(self, robot: Robot):
        self._model = robot.model(gravity=False)
        self._data = mujoco.MjData(self._model)
        self._site = self._model.site(robot.ee_site).id

    def __call__(self, q: np.ndarray) -> np.ndarray:
        """Return the homogeneous transform (16,), column by column, at q (n,) rad."""
        self._data.qpos[:] = q
        mujoco.mj_kinematics(self._model, self._data)
        pose = np.eye(4)
        pose[:3, :3] = self._data.site_xmat[self._site].reshape(3, 3)
        pose[:3, 3] = self._data.site_xpos[self._site]
        return pose.T.ravel()


class ExternalTorque:
    """Estimate of the external joint torque: inverse dynamics of the measured motion minus the command, filtered.

    A Franka arm has link-side torque sensors; the emulated arm may have none that include gravity. The estimate
    therefore contains friction and model errors, so that this arm stops itself earlier than a real one.

    Attributes:
        torque: (n,) Nm, filtered.
    """

    def __init__(self, robot: Robot):
        self._model = robot.model(gravity=False)
        self._model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
        self._data = mujoco.MjData(self._model)
        self._gain = -np.expm1(-2 * np.pi * CUTOFF_HZ * SIM_DT)
        self.torque, self._previous_dq = np.zeros(robot.n), np.zeros(robot.n)

    def begin(self, state: ArmState) -> None:
        """Begin a motion at rest."""
        self.torque, self._previous_dq = np.zeros(len(state.q)), state.dq.copy()

    def __call__(self, state: ArmState) -> np.ndarray:
        """Return `torque` after another cycle."""
        d = self._data
        d.qpos[:], d.qvel[:], d.qacc[:] = state.q, state.dq, (state.dq - self._previous_dq) / SIM_DT
        mujoco.mj_inverse(self._model, d)
        self._previous_dq = state.dq.copy()
        self.torque = self.torque + self._gain * (d.qfrc_inverse - state.tau_J_d - self.torque)
        return self.torque
