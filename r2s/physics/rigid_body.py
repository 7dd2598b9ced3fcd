"""Rigid-body functions of the nominal arm: regressor, inverse dynamics, mass matrix and end-effector kinematics.

The regressor is the matrix in torque = regressor @ standard inertial parameters. A link has ten standard parameters,
in the axes and about the origin of the link's frame (Khalil and Dombre 2002, ch. 9): mass m, first moments h = m c,
and the tensor elements xx, yy, zz, xy, xz, yz.
"""

from dataclasses import dataclass

import mujoco
import mujoco.batch
import numpy as np

from r2s.physics.robot import Robot

_PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))


@dataclass(frozen=True)
class LinkInertia:
    """Inertial parameters of n links, with any leading batch shape.

    Attributes:
        mass: (..., n) kg, link masses. com: (..., n, 3) m, centers of mass, link frames.
        inertia: (..., n, 3, 3) kg m^2, inertia tensor of each link about its center of mass, link axes.
    """

    mass: np.ndarray
    com: np.ndarray
    inertia: np.ndarray

    def standard(self) -> np.ndarray:
        """Return each link's standard parameters (..., n, 10): mass, first moments, tensor about the origin."""
        m, c = self.mass[..., None], self.com
        square = (c**2).sum(-1)[..., None, None] * np.eye(3) - c[..., :, None] * c[..., None, :]
        tensor = tensor_elements(self.inertia + m[..., None] * square)
        lead = tensor.shape[:-1]  # each field may have its own batch shape
        return np.concatenate([np.broadcast_to(m, (*lead, 1)), np.broadcast_to(m * c, (*lead, 3)), tensor], -1)


def tensor_elements(tensor: np.ndarray) -> np.ndarray:
    """Return the elements xx, yy, zz, xy, xz, yz (..., 6) of symmetric tensors (..., 3, 3)."""
    rows, columns = zip(*_PAIRS, strict=True)
    return tensor[..., rows, columns]


def regressor(
    robot: Robot, q: np.ndarray, dq: np.ndarray, ddq: np.ndarray, gravity: np.ndarray | None = None
) -> np.ndarray:
    """Return the regressor (T, n, n, 10): derivatives of joint torques with respect to standard parameters.

    Args:
        robot: the arm, for its kinematics.
        q, dq, ddq: (T, n) rad, rad/s, rad/s^2, joint motion.
        gravity: (3,) m/s^2, base frame; None: the regressor excludes gravity, because the arm compensates gravity.
    """
    place, frame, anchor, axis = joint_kinematics(robot, q)
    samples, n = q.shape
    out = np.zeros((samples, n, n, 10))
    omega, alpha = np.zeros((samples, 3)), np.zeros((samples, 3))
    origin = np.zeros((samples, 3))
    a = np.zeros((samples, 3)) - (0.0 if gravity is None else np.asarray(gravity))  # gravity as a base acceleration

    def at(a, omega, alpha, arm):
        """Return the acceleration, m/s^2, of a point at the offset `arm`, m, from a point with acceleration `a`."""
        return a + np.cross(alpha, arm) + np.cross(omega, np.cross(omega, arm))

    basis = np.zeros((6, 3, 3))
    for c, (i, j) in enumerate(_PAIRS):
        basis[c, i, j] = basis[c, j, i] = 1.0
    for k in range(n):
        a = at(a, omega, alpha, anchor[:, k] - origin)
        spin = axis[:, k] * dq[:, k, None]
        alpha = alpha + axis[:, k] * ddq[:, k, None] + np.cross(omega, spin)
        omega = omega + spin
        a, origin = at(a, omega, alpha, place[:, k] - anchor[:, k]), place[:, k]
        R = frame[:, k]
        force, moment = np.zeros((samples, 10, 3)), np.zeros((samples, 10, 3))
        force[:, 0] = a
        for i in range(3):
            h = R[:, :, i]
            force[:, 1 + i] = np.cross(alpha, h) + np.cross(omega, np.cross(omega, h))
            moment[:, 1 + i] = np.cross(h, a)
        own_omega, own_alpha = np.einsum("tji,tj->ti", R, omega), np.einsum("tji,tj->ti", R, alpha)
        rotated = np.einsum("cij,tj->tci", basis, own_alpha)
        rotated += np.cross(own_omega[:, None], np.einsum("cij,tj->tci", basis, own_omega))
        moment[:, 4:] = np.einsum("tij,tcj->tci", R, rotated)
        for j in range(k + 1):  # joints 0 to k move link k
            about = moment + np.cross((place[:, k] - anchor[:, j])[:, None], force)
            out[:, j, k] = np.einsum("ti,tci->tc", axis[:, j], about)
    return out


def joint_kinematics(robot: Robot, q: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return link origins (T, n, 3) m and axes (T, n, 3, 3), joint anchors and axes (T, n, 3), in the base frame."""
    model = robot.model(gravity=False)
    data = mujoco.MjData(model)
    bodies = model.jnt_bodyid
    samples, n = q.shape
    place, anchor, axis = (np.empty((samples, n, 3)) for _ in range(3))
    frame = np.empty((samples, n, 3, 3))
    for t in range(samples):
        data.qpos = q[t]
        mujoco.mj_kinematics(model, data)
        place[t], frame[t] = data.xpos[bodies], data.xmat[bodies].reshape(n, 3, 3)
        anchor[t], axis[t] = data.xanchor, data.xaxis
    return place, frame, anchor, axis


def rigid_body(
    robot: Robot, q: np.ndarray, dq: np.ndarray, ddq: np.ndarray, gravity: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return rest (T, n) Nm and regressor (T, n, n, 10) of torque = rest + regressor @ standard parameters.

    `rest` is the torque due to armature and to welded bodies in the robot's file. `regressor` explains the arguments.
    """
    total = nominal_torque(robot, q, dq, ddq, False if gravity is None else gravity)
    y = regressor(robot, q, dq, ddq, gravity)
    return total - np.einsum("tjkc,kc->tj", y, LinkInertia(robot.mass, robot.com, robot.inertia).standard()), y


def nominal_torque(
    robot: Robot, q: np.ndarray, dq: np.ndarray, ddq: np.ndarray, gravity: bool | np.ndarray = True
) -> np.ndarray:
    """Return the torque (T, n) Nm of the nominal links and rotors, without MuJoCo's forces at joint limits.

    q, dq, ddq: (T, n) rad, rad/s, rad/s^2, joint motion. gravity: True (the robot's), False (none), or (3,) m/s^2.
    """
    model = robot.model(gravity=bool(np.any(gravity)))
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    if isinstance(gravity, np.ndarray):
        model.opt.gravity = gravity
    return mujoco_inverse_dynamics(model, q, dq, ddq)


def mujoco_inverse_dynamics(model: mujoco.MjModel, q: np.ndarray, dq: np.ndarray, ddq: np.ndarray) -> np.ndarray:
    """Return the torque (T, n) Nm that a MuJoCo model needs for q, dq, ddq (T, n) rad, rad/s, rad/s^2."""
    data, out = mujoco.MjData(model), np.empty_like(q)
    for t in range(len(q)):
        data.qpos[:], data.qvel[:], data.qacc[:] = q[t], dq[t], ddq[t]
        mujoco.mj_inverse(model, data)
        out[t] = data.qfrc_inverse
    return out


def mass_matrix(robot: Robot, q: np.ndarray) -> np.ndarray:
    """Return the mass matrix (T, n, n) kg m^2 of the nominal links and rotors at q (T, n) rad."""
    model = robot.model(gravity=False)
    data, out = mujoco.MjData(model), np.empty((*q.shape, robot.n))
    for t in range(len(q)):
        data.qpos = q[t]
        mujoco.mj_fwdPosition(model, data)
        mujoco.mj_fullM(model, data, out[t])
    return out


def principal_axes(inertia: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return principal moments (..., 3) kg m^2 and axes, as quaternions (..., 4) w x y z, of tensors (..., 3, 3)."""
    from scipy.spatial.transform import Rotation

    moments, axes = np.linalg.eigh(inertia)
    axes[..., 0] *= np.sign(np.linalg.det(axes))[..., None]  # a rotation, not a reflection
    quaternions = Rotation.from_matrix(axes.reshape(-1, 3, 3)).as_quat(scalar_first=True)
    return moments, quaternions.reshape(*axes.shape[:-2], 4)


def set_links(
    model: mujoco.MjModel, mass: np.ndarray, com: np.ndarray, inertia: np.ndarray, armature: np.ndarray
) -> None:
    """Set the inertial parameters of a model's n links and rotors.

    mass: (n,) kg. com: (n, 3) m, centers of mass. inertia: (n, 3, 3) kg m^2, tensors about the centers.
    armature: (n,) kg m^2.
    """
    at = model.jnt_bodyid
    model.dof_armature[:] = armature
    model.body_mass[at], model.body_ipos[at] = mass, com
    model.body_inertia[at], model.body_iquat[at] = principal_axes(inertia)
    mujoco.mj_setConst(model, mujoco.MjData(model))


class Kinematics:
    """Compute end-effector position and Jacobian from measured joint angles, with nominal link geometry."""

    def __init__(self, robot: Robot):
        self._model = robot.model(gravity=False)
        self._data = mujoco.MjData(self._model)
        self._site = self._model.site(robot.ee_site).id

    def __call__(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the end-effector position (3,) m and its Jacobian (3, n) m/rad at q (n,) rad."""
        self._data.qpos = q
        mujoco.mj_kinematics(self._model, self._data)
        ee = self._data.site_xpos[self._site].copy()
        return ee, np.cross(self._data.xaxis, ee - self._data.xanchor).T


class InverseInertia:
    """Inverse mass matrices H of m nominal arms; if all joints can move, the inertia at joint j is 1 / H[j, j]."""

    def __init__(self, robot: Robot, m: int = 1):
        model = robot.model(gravity=False)
        self._batch = mujoco.batch.Batch(model, m, 1)
        self._q, self._sparse = self._batch.bind("qpos"), self._batch.bind("M")
        self._columns = model.M_colind
        self._rows = np.repeat(np.arange(robot.n), model.M_rownnz)

    def __call__(self, q: np.ndarray, ids: np.ndarray | None = None) -> np.ndarray:
        """Return inverse mass matrices (m, n, n), 1/(kg m^2), of the arms `ids` (all by default) at q (m, n) rad."""
        at = slice(None) if ids is None else ids
        self._q[at] = q
        self._batch.forward(ids, stage=mujoco.mjtStage.mjSTAGE_POS)
        mass = np.empty((*q.shape, q.shape[1]))
        mass[:, self._rows, self._columns] = mass[:, self._columns, self._rows] = self._sparse[at]
        return np.linalg.inv(mass)
