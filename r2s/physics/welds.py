"""Inertia of moving bodies together with the bodies welded to them, and helpers for poses."""

import mujoco
import numpy as np

Inertia = tuple[float, np.ndarray, np.ndarray]  # mass, kg; center (3,), m; tensor (3, 3) about the center, kg m^2


def combined(parts: list[Inertia]) -> Inertia:
    """Return the inertia of several bodies with parallel axes (Steiner's theorem)."""
    mass = sum(m for m, _, _ in parts)
    if len(parts) == 1 or mass == 0:
        return float(mass), parts[0][1], parts[0][2]
    com = sum((m * c for m, c, _ in parts), np.zeros(3)) / mass
    arms = [(m, c - com) for m, c, _ in parts]
    steiner = sum((m * (r @ r * np.eye(3) - np.outer(r, r)) for m, r in arms), np.zeros((3, 3)))
    return float(mass), com, sum((i for _, _, i in parts), np.zeros((3, 3))) + steiner


class Bodies:
    """Masses, centers of mass and tensors of all bodies, and poses of welded bodies relative to moving bodies."""

    def __init__(self, model: mujoco.MjModel):
        self.model = model
        self.mass, self.com = model.body_mass.copy(), model.body_ipos.copy()
        axes = [rotation(quat) for quat in model.body_iquat]
        self.inertia = np.array([r * d @ r.T for r, d in zip(axes, model.body_inertia, strict=True)])
        poses = zip(model.body_pos, model.body_quat, strict=True)
        self.local = [make_pose(position, rotation(quat)) for position, quat in poses]

    def moving_parent(self, body: int) -> tuple[int, np.ndarray]:
        """Return b (`body` or its nearest ancestor with a joint; 0: world) and the pose of `body` in b's frame."""
        pose = np.eye(4)
        while body and self.model.body_dofnum[body] == 0:
            pose = self.local[body] @ pose
            body = int(self.model.body_parentid[body])
        return body, pose

    def lumped(self, body: int) -> Inertia:
        """Return mass, center of mass and tensor about this center, of `body` with all bodies welded to it."""
        parts = [(self.mass[body], self.com[body], self.inertia[body])]
        for other in range(1, self.model.nbody):
            anchor, pose = self.moving_parent(other)
            if other != body and anchor == body and self.mass[other] > 0:
                r = pose[:3, :3]
                parts.append((self.mass[other], r @ self.com[other] + pose[:3, 3], r @ self.inertia[other] @ r.T))
        return combined(parts)


def rotation(quat: np.ndarray) -> np.ndarray:
    """Return the rotation matrix (3, 3) of a quaternion w x y z."""
    matrix = np.empty(9)
    mujoco.mju_quat2Mat(matrix, quat)
    return matrix.reshape(3, 3)


def about(axis: np.ndarray, angle: float) -> np.ndarray:
    """Return the rotation matrix (3, 3) about an axis by an angle, rad."""
    quat = np.empty(4)
    mujoco.mju_axisAngle2Quat(quat, axis, angle)
    return rotation(quat)


def make_pose(position: np.ndarray | None, rotation: np.ndarray | None) -> np.ndarray:
    """Return the pose (4, 4) of a position (3,), zero by default, and a rotation (3, 3), the identity if None."""
    pose = np.eye(4)
    if position is not None:
        pose[:3, 3] = position
    if rotation is not None:
        pose[:3, :3] = rotation
    return pose
