"""The emulated control box's model of its arm: URDF, poses, gravity torque and external wrench."""

from dataclasses import replace
from xml.etree import ElementTree as ET

import mujoco
import numpy as np

from r2s.arm.clients import fr3_limits
from r2s.physics import description
from r2s.physics.dynamics import Dynamics
from r2s.physics.payload import LoadTorque, ee_pose
from r2s.physics.robot import Robot

SINGULAR = 0.03  # smallest singular value of a regular Jacobian (rows in m and 1); our choice; 0.22 in the ready pose


def urdf(robot: Robot) -> str:
    """Return a URDF of the arm, without geometry and with an FR3's joint limits, to answer GetRobotModel."""
    envelope = fr3_limits.DECELERATION, fr3_limits.VELOCITY_OFFSET
    q_min, q_max, dq_max = fr3_limits.Q_MIN, fr3_limits.Q_MAX, fr3_limits.DQ_MAX
    fr3 = replace(robot, q_min=q_min, q_max=q_max, dq_max=dq_max, velocity_envelope=envelope)
    links, _ = description.chain(robot, Dynamics.of(robot, np.zeros((robot.n, 3))), friction=False)
    return ET.tostring(description.urdf(fr3, links), encoding="unicode")


class BoxModel:
    """The control box's model of its arm: poses, wrenches, and the gravity torque with the declared load."""

    def __init__(self, robot: Robot):
        self._model = robot.model(gravity=True)
        self._data, self._jacobian = mujoco.MjData(self._model), np.zeros((6, robot.n))
        self._site, self._load = self._model.site(robot.ee_site).id, LoadTorque(robot)
        self._place, self._axes = ee_pose(robot)

    def pose(self, q: np.ndarray, tool: np.ndarray) -> np.ndarray:
        """Return the pose (4, 4) of a tool frame in the base frame at q (n,) rad.

        tool: (4, 4), pose of the tool frame in the flange frame.
        """
        self._data.qpos[:] = q
        mujoco.mj_kinematics(self._model, self._data)
        flange = np.eye(4)
        flange[:3, :3] = self._data.site_xmat[self._site].reshape(3, 3)
        flange[:3, 3] = self._data.site_xpos[self._site]
        return flange @ tool

    def wrench(self, q: np.ndarray, tool: np.ndarray, torque: np.ndarray) -> np.ndarray:
        """Return the wrench F (6,) N, Nm in base axes that best explains the joint torque (n,) Nm.

        F acts at the origin of the tool frame (see `pose`). With the Jacobian J of this origin, F minimizes
        |J^T F - torque|. Near a singularity, F is zero, as in libfranka.
        """
        place, j = self.pose(q, tool)[:3, 3], self._jacobian
        mujoco.mj_comPos(self._model, self._data)
        mujoco.mj_jac(self._model, self._data, j[:3], j[3:], place, self._model.jnt_bodyid[-1])
        u, size, v = np.linalg.svd(j, full_matrices=False)
        return np.zeros(6) if size[-1] < SINGULAR else u @ ((v @ torque) / size)

    def compensation(self, q: np.ndarray, s: np.ndarray) -> np.ndarray:
        """Return the gravity torque (n,) Nm at q (n,) rad with end effector, load and gravity of RobotState `s`."""
        self._model.opt.gravity[:] = s["O_ddP_O"]
        self._data.qpos[:] = q
        mujoco.mj_forward(self._model, self._data)
        return self._data.qfrc_bias + self._load(q, self._carried(s), s["O_ddP_O"])

    def _carried(self, s: np.ndarray) -> np.ndarray:
        """Return (4,): mass, kg, and first moment (3,), kg m, of end effector plus load, in the last link's frame."""
        parts = ((s["m_ee"], s["F_x_Cee"]), (s["m_load"], s["F_x_Cload"]))
        return np.sum([np.append(m, m * (self._place + self._axes @ x)) for m, x in parts], axis=0)
