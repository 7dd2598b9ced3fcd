"""Where a hand is and how an arm follows points with it, compiled: forward kinematics, and inverse along a curve."""

import numpy as np

from r2s.compiled import njit
from r2s.physics.description import chain
from r2s.physics.dynamics import Dynamics
from r2s.physics.newton_euler import AXIS, FRAME, links_of, product, spun, turned
from r2s.physics.robot import Robot

DAMPING = 1e-4  # m^2, of the inverse kinematics' least squares: what a singular posture is kept from
HOMEWARD = 0.02  # share of the way to the home posture that is taken at every point, as far as the hand allows
ROUNDS = 8  # of Newton's steps for a point, at most
CLOSE = 1e-5  # m, where they end


class Hand:
    """The nominal arm's end effector; all functions take and give arrays.

    Args:
        robot: the arm.
    """

    def __init__(self, robot: Robot):
        self.links = links_of(robot, robot.mass, robot.com, robot.inertia)
        own = Dynamics.of(robot, np.zeros((robot.n, 3)))
        self._tip = np.ascontiguousarray(chain(robot, own, friction=False)[1][:3, 3])
        self._home = robot.q_home.copy()

    def place(self, q: np.ndarray) -> np.ndarray:
        """Return (T, 3) m, the end effector at q (T, n) rad."""
        out, jacobian = np.empty((len(q), 3)), np.empty((3, q.shape[1]))
        _places(self.links, self._tip, np.ascontiguousarray(q), out, jacobian)
        return out

    def follow(self, start: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, float]:
        """Return postures (T, n) rad whose end effector goes through points (T, 3) m, and how far off one is, m.

        Each begins from the one before, the first from `start` (n,); what the hand leaves free goes home. Position
        limits are not looked at.
        """
        out = np.empty((len(points), len(start)))
        return out, _follow(self.links, self._tip, self._home, start, np.ascontiguousarray(points), out)


@njit(cache=True, error_model="numpy")
def hand(links, tip, q, place, jacobian):
    """Write the end effector (3,) m and its Jacobian (3, n) m/rad at q (n,) rad; `links` as of `links_of`."""
    n = len(q)
    R = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
    px, py, pz = 0.0, 0.0, 0.0
    anchor = np.empty((n, 3))
    for i in range(n):
        k = links[i]
        x, y, z = turned(R, k[0], k[1], k[2])
        px, py, pz = px + x, py + y, pz + z
        R = product(R, k, FRAME)
        a, b, c = turned(R, k[AXIS], k[AXIS + 1], k[AXIS + 2])
        jacobian[0, i], jacobian[1, i], jacobian[2, i] = a, b, c
        anchor[i, 0], anchor[i, 1], anchor[i, 2] = px, py, pz
        R = spun(R, k[AXIS], k[AXIS + 1], k[AXIS + 2], q[i])
    x, y, z = turned(R, tip[0], tip[1], tip[2])
    place[0], place[1], place[2] = px + x, py + y, pz + z
    for i in range(n):
        x, y, z = place[0] - anchor[i, 0], place[1] - anchor[i, 1], place[2] - anchor[i, 2]
        a, b, c = jacobian[0, i], jacobian[1, i], jacobian[2, i]
        jacobian[0, i], jacobian[1, i], jacobian[2, i] = b * z - c * y, c * x - a * z, a * y - b * x


@njit(cache=True, error_model="numpy")
def _places(links, tip, q, out, jacobian):
    for t in range(len(q)):
        hand(links, tip, q[t], out[t], jacobian)


@njit(cache=True, error_model="numpy")
def _follow(links, tip, home, start, points, out):
    """Write a posture for each point; return m, the farthest that a hand is from its point."""
    n, worst = len(start), 0.0
    q, place, jacobian, error = start.copy(), np.empty(3), np.empty((3, n)), np.empty(3)
    gram, pull = np.empty((3, 3)), np.empty(n)
    for t in range(len(points)):
        far = 0.0
        for turn in range(ROUNDS):
            hand(links, tip, q, place, jacobian)
            far = 0.0
            for k in range(3):
                error[k] = points[t, k] - place[k]
                far += error[k] ** 2
            far = np.sqrt(far)
            if far < CLOSE and turn > 0:
                break
            for k in range(3):
                for c in range(3):
                    gram[k, c] = DAMPING if k == c else 0.0
                    for j in range(n):
                        gram[k, c] += jacobian[k, j] * jacobian[c, j]
            for j in range(n):  # the way home comes once a point: the rounds after it put the hand right
                pull[j] = HOMEWARD * (home[j] - q[j]) if turn == 0 else 0.0
            for k in range(3):
                for j in range(n):
                    error[k] -= jacobian[k, j] * pull[j]
            weight = np.linalg.solve(gram, error)
            for j in range(n):
                step = pull[j]
                for k in range(3):
                    step += jacobian[k, j] * weight[k]
                q[j] += min(max(step, -0.3), 0.3)
        worst = max(worst, far)
        out[t] = q
    return worst
