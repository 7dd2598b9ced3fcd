"""Compiled forward kinematics of a serial arm, and inverse kinematics along a curve of end-effector positions."""

import numpy as np

from r2s.compiled import njit
from r2s.physics.description import chain
from r2s.physics.dynamics import Dynamics
from r2s.physics.newton_euler import joint_frame, links_of, rotate
from r2s.physics.robot import Robot

POSE = 12  # columns of a pose: position (3,), rotation matrix (3, 3) row by row
DAMPING = 1e-4  # m^2, damping of the least squares, (10 mm)^2; bounds the steps near a singularity
HOMEWARD = 0.02  # share of the distance to the home posture that a null-space motion covers per point
ITERATIONS = 8  # largest number of Newton steps per point
CLOSE = 1e-5  # m, position error at which the iteration ends
MAX_STEP = 0.3  # rad, largest motion of a joint in a Newton step


class HandKinematics:
    """Kinematics of the end effector with nominal link geometry."""

    def __init__(self, robot: Robot):
        self.links = links_of(robot, robot.mass, robot.com, robot.inertia)
        own = Dynamics.of(robot, np.zeros((robot.n, 3)))
        self._tip = np.ascontiguousarray(chain(robot, own, friction=False)[1][:3, 3])
        self._home = robot.q_home.copy()

    def place(self, q: np.ndarray) -> np.ndarray:
        """Return the end-effector positions (T, 3) m at q (T, n) rad."""
        out = np.empty((len(q), 3))
        _places(self.links, self._tip, np.ascontiguousarray(q), out)
        return out

    def follow(self, start: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, float]:
        """Return postures (T, n) rad with the end effector at points (T, 3) m, and the largest position error, m.

        The solver starts at `start` (n,) rad for the first point, and at the previous point's posture for every later
        point. In the null space of the end effector, the arm moves toward home. The solver ignores position limits.
        """
        out = np.empty((len(points), len(start)))
        return out, _follow(self.links, self._tip, self._home, start, np.ascontiguousarray(points), out)


@njit(cache=True, error_model="numpy")
def link_frames(links, q, frames, axes):
    """Write link poses (n, POSE) and joint axes (n, 3) in the base frame, at q (n,) rad."""
    R = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
    x, y, z = 0.0, 0.0, 0.0
    for i in range(len(q)):
        (dx, dy, dz), (a, b, c), R = joint_frame(R, links[i], q[i])
        x, y, z = x + dx, y + dy, z + dz
        axes[i, 0], axes[i, 1], axes[i, 2] = a, b, c
        write_pose(frames[i], x, y, z, R)


@njit(cache=True, inline="always")
def write_pose(pose, x, y, z, R):
    """Write a position and a rotation (9 numbers, row by row) into `pose` (POSE,)."""
    pose[0], pose[1], pose[2] = x, y, z
    pose[3], pose[4], pose[5], pose[6], pose[7], pose[8] = R[0], R[1], R[2], R[3], R[4], R[5]
    pose[9], pose[10], pose[11] = R[6], R[7], R[8]


@njit(cache=True, inline="always")
def pose_axes(pose):
    """Return the rotation of a pose as 9 numbers, row by row."""
    return pose[3], pose[4], pose[5], pose[6], pose[7], pose[8], pose[9], pose[10], pose[11]


@njit(cache=True, error_model="numpy")
def hand_kinematics(links, tip, q, frames, place, jacobian):
    """Write the end-effector position (3,) m and its Jacobian (3, n) m/rad at q (n,) rad.

    tip: (3,) m, end effector in the last link's frame. frames: (n, POSE), scratch array.
    """
    n = len(q)
    link_frames(links, q, frames, jacobian.T)
    x, y, z = rotate(pose_axes(frames[n - 1]), tip[0], tip[1], tip[2])
    place[0], place[1], place[2] = frames[n - 1, 0] + x, frames[n - 1, 1] + y, frames[n - 1, 2] + z
    for i in range(n):
        x, y, z = place[0] - frames[i, 0], place[1] - frames[i, 1], place[2] - frames[i, 2]
        a, b, c = jacobian[0, i], jacobian[1, i], jacobian[2, i]
        jacobian[0, i], jacobian[1, i], jacobian[2, i] = b * z - c * y, c * x - a * z, a * y - b * x


@njit(cache=True, error_model="numpy")
def _places(links, tip, q, out):
    frames, jacobian = np.empty((len(links), POSE)), np.empty((3, len(links)))
    for t in range(len(q)):
        hand_kinematics(links, tip, q[t], frames, out[t], jacobian)


@njit(cache=True, error_model="numpy")
def _follow(links, tip, home, start, points, out):
    """Write the posture (n,) rad for each point into `out`; return the largest end-effector position error, m."""
    n, worst = len(start), 0.0
    q, place, jacobian, error = start.copy(), np.empty(3), np.empty((3, n)), np.empty(3)
    gram, null_step, frames = np.empty((3, 3)), np.empty(n), np.empty((n, POSE))
    for t in range(len(points)):
        distance = 0.0
        for iteration in range(ITERATIONS):
            hand_kinematics(links, tip, q, frames, place, jacobian)
            distance = 0.0
            for k in range(3):
                error[k] = points[t, k] - place[k]
                distance += error[k] ** 2
            distance = np.sqrt(distance)
            if distance < CLOSE and iteration > 0:
                break
            for k in range(3):
                for c in range(3):
                    gram[k, c] = DAMPING if k == c else 0.0
                    for j in range(n):
                        gram[k, c] += jacobian[k, j] * jacobian[c, j]
            for j in range(n):  # only in the first step; later steps correct the end effector
                null_step[j] = HOMEWARD * (home[j] - q[j]) if iteration == 0 else 0.0
            for k in range(3):
                for j in range(n):
                    error[k] -= jacobian[k, j] * null_step[j]
            weight = np.linalg.solve(gram, error)
            for j in range(n):
                step = null_step[j]
                for k in range(3):
                    step += jacobian[k, j] * weight[k]
                q[j] += min(max(step, -MAX_STEP), MAX_STEP)
        worst = max(worst, distance)
        out[t] = q
    return worst
