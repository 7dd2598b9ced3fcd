"""Push a box without learning: the model-based baseline `algo=pusher` for `task=push`.

The pusher's model is quasi-static and independent of the box's mass and friction. Let a frictionless push of length s
act at a face point p along the inward normal n. In the model, the push moves the box by s n / (1 + h^2) and turns it
by s h / (r (1 + h^2)), with h = (p x n) / r. Here r is the largest friction moment divided by the largest friction
force (limit surface, r2s/physics/sliding.py). The pusher divides the errors of position and yaw by their tolerances.
In every control period, the pusher selects the face point whose best push reduces the error fastest. The time of a
push includes the tip's travel to the face point.
"""

import numpy as np
import torch
from torch import Tensor

from r2s.control.controller import Controller
from r2s.errors import UserError
from r2s.physics.box import EXPECTED
from r2s.physics.dynamics import Dynamics
from r2s.physics.impedance import K_DEFAULT, RATIO
from r2s.physics.inverse_dynamics import InverseDynamics
from r2s.physics.robot import Robot
from r2s.physics.surface import Surface
from r2s.tasks.push import BOX, ERROR, TIP, TIP_RATE, PushTask
from r2s.tasks.push_measures import GOOD_M, GOOD_RAD
from r2s.tasks.task import Task

POINTS, EDGE = 9, 0.75  # number of face points per face, and the share of the edge that they span
CLEAR = 0.02  # m, clearance between tip and box while the tip moves around the box
NEAR = 0.012  # m, the tip pushes if its lateral distance from the face point is smaller than this
TOLERANCE = np.array([GOOD_M, GOOD_M, GOOD_RAD])  # m, m, rad: unit in which the pusher measures pose errors
DONE = 0.3  # error, in tolerances, at which the pusher stops: 9 mm or 3 degrees; pose noise alone causes 0.06
SPEED, TRAVEL, SLOW_M = 0.15, 0.2, 0.02  # m/s, tip speed in and between pushes; m, shorter pushes are slower
GAIN = 0.25  # feedback gain on the tip speed / damping of the impedance; 25 Hz and the latency allow little more


class Pusher:
    """Push boxes with B arms, through the interface of `r2s.learning.networks.Policy`.

    Args:
        robot, task: the arm and its task with control=cartesian_impedance.
        dynamics: model of one arm; the pusher compensates the friction of this model.

    Raises:
        UserError: the task or its controller is not supported.
    """

    def __init__(self, robot: Robot, task: PushTask, dynamics: Dynamics):
        control = task.control(robot)
        if not sets_targets(task, control):
            raise UserError(
                f"algo: pusher cannot do {type(task).__name__} under control={control.name}; task=push with "
                "control=cartesian_impedance and its targets as actions is allowed"
            )
        self._task, self._dynamics, self._n = task, dynamics, robot.n
        self._axes, self._scale = task.table.axes, control.action_scale
        self._stiffness = float(control.parameters[K_DEFAULT])
        self._load = EXPECTED["mass"] * EXPECTED["table"] * np.linalg.norm(robot.gravity)
        jacobian = task.tip(robot.q_home[None])[1][0]
        mobility = jacobian @ np.linalg.solve(
            InverseDynamics(robot, dynamics).mass(robot.q_home[None])[0], jacobian.T
        )
        self._damping = control.parameters[RATIO] * np.sqrt(self._stiffness * 3.0 / np.trace(mobility))  # N s/m
        self._centre = task.table.inside(task.centre)
        half = 0.5 * np.array(task.size)
        self._half, self._clear = half[:2], half[:2] + task.tip_radius + CLEAR
        self._points, self._normals = p, n = _face_points(self._half)
        reach = float(Surface(half, half, 1.0, half=half).reach)
        h = (p[:, 0] * n[:, 1] - p[:, 1] * n[:, 0]) / reach
        self._twists = np.column_stack([n, h / reach]) / (1.0 + h[:, None] ** 2) / TOLERANCE  # tolerances per m
        self._squares = (self._twists**2).sum(axis=1)
        self._contacts = p - task.tip_radius * n
        self._places = self._along(self._contacts - CLEAR * n)

    @torch.no_grad()
    def action(self, observation: Tensor) -> Tensor:
        """Return actions (B, 3) in [-1, 1] for observations (B, d) in SI units."""
        rows, n = observation.numpy().astype(np.float64), self._n
        own = rows[:, 3 * n + 1 :]
        tip, rate, box, error = own[:, TIP], own[:, TIP_RATE], own[:, BOX], own[:, ERROR]
        plans = [self._plan(*row) for row in zip(tip, box, error, strict=True)]
        velocity, pushes = (np.array(each) for each in zip(*plans, strict=True))
        velocity[:, 2] = 4.0 * (self._centre[2] - tip[:, 2])
        force = self._damping * (velocity + GAIN * (velocity - rate)) + self._friction(rows[:, :n], velocity)
        force[:, :2] += self._load * pushes
        target = tip + force / self._stiffness - self._centre
        return torch.from_numpy(np.clip(target @ self._axes / self._scale, -1.0, 1.0).astype(np.float32))

    def _friction(self, q: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """Return the tip force (B, 3) N that overcomes the joints' friction at a tip velocity (B, 3) m/s."""
        jacobian = self._task.tip(q)[1]
        inverse = np.linalg.pinv(jacobian)
        torque = self._dynamics.friction(np.einsum("bnk,bk->bn", inverse, velocity))
        return np.einsum("bnk,bn->bk", inverse, torque)

    def _plan(self, tip: np.ndarray, box: np.ndarray, error: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the tip velocity (3,) m/s along the table, and the push direction (2,), or 0 without a push."""
        c, s = np.cos(box[2]), np.sin(box[2])
        rotation = np.array([[c, s], [-s, c]])  # from table axes to box axes
        at, e = rotation @ (tip[:2] - box[:2]), np.array([*(rotation @ error[:2]), error[2]]) / TOLERANCE
        if np.linalg.norm(e) < DONE:
            return np.zeros(3), np.zeros(2)
        k, length = self._best_push(at, e)
        point, normal, radius = self._points[k], self._normals[k], self._task.tip_radius
        across, push = np.array([-normal[1], normal[0]]), np.zeros(2)
        aside, gap = (at - point) @ across, (point - at) @ normal - radius
        if abs(aside) < NEAR and -radius < gap < 2 * CLEAR:  # no push if the tip is past the face
            push = rotation.T @ normal
            velocity = SPEED * min(1.0, (length + max(gap, 0.0)) / SLOW_M) * normal - 3.0 * aside * across
        else:
            towards = self._around(at, point - (radius + 0.3 * CLEAR) * normal) - at
            far = float(np.linalg.norm(towards))
            velocity = min(TRAVEL, 6.0 * far) * towards / max(far, 1e-9)
        return np.array([*(rotation.T @ velocity), 0.0]), push

    def _best_push(self, at: np.ndarray, e: np.ndarray) -> tuple[int, float]:
        """Return the index of the face point and the length, m, of the push that reduces the error e (3,) fastest.

        The error e, in tolerances, and the tip's position `at` (2,) m are in the box's frame. A push of length s
        changes the error to e - s w, where w is the box's twist per meter of push at the face point. The best s >= 0
        minimizes |e - s w|. The predicted time includes the tip's travel from `at` around the box, and neglects the
        tip's acceleration.
        """
        lengths = (self._twists @ e / self._squares).clip(0.0)
        remaining = np.linalg.norm(e - lengths[:, None] * self._twists, axis=1)
        around = np.abs(self._places - self._along(at[None]))
        around = np.minimum(around, 4.0 * self._clear.sum() - around)
        travel = np.maximum(around, np.linalg.norm(self._contacts - at, axis=1))
        rates = (np.linalg.norm(e) - remaining) / (travel / TRAVEL + lengths / SPEED + 1e-9)
        k = int(np.argmax(rates))
        return k, float(lengths[k])

    def _along(self, at: np.ndarray) -> np.ndarray:
        """Project points (k, 2) m onto the path around the box; return their arc lengths (k,) m, counterclockwise."""
        a, b = self._clear
        nearest, rows = np.clip(at, -self._clear, self._clear), np.arange(len(at))
        side = np.argmin(self._clear - np.abs(nearest), axis=1)  # 0: left or right, 1: above or below
        nearest[rows, side] = np.where(nearest[rows, side] < 0.0, -1.0, 1.0) * self._clear[side]
        x, y = nearest.T
        sides = [(side == 0) & (x > 0.0), (side == 1) & (y > 0.0), side == 0]
        return np.select(sides, [b + y, 2 * b + a - x, 3 * b + 2 * a - y], 4 * b + 3 * a + x)

    def _around(self, at: np.ndarray, to: np.ndarray) -> np.ndarray:
        """Return the first waypoint (2,) m of the tip's path from `at` around the box to `to`, in the box's frame."""
        clear, edge = self._clear, self._clear - CLEAR
        corners = clear * np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]])
        if not _crosses(at, to, edge + 0.2 * CLEAR):
            return to
        inside = edge + 0.2 * CLEAR - np.abs(at)
        if (inside > 0).all():  # the tip is at a face: first move away along the normal
            k = int(np.argmin(inside))
            out = at.copy()
            out[k] = np.sign(at[k]) * clear[k]
            return out
        seen = [k for k in range(4) if not _crosses(at, corners[k], edge + 0.2 * CLEAR)] or list(range(4))
        ways = [np.linalg.norm(corners[k] - at) + self._way_left(corners, k, to, edge) for k in seen]
        return corners[seen[int(np.argmin(ways))]]

    def _way_left(self, corners: np.ndarray, first: int, to: np.ndarray, edge: np.ndarray) -> float:
        """Return the length, m, of the shortest path from the corner `first` past other corners to the point `to`."""
        lengths = []
        for step in (1, -1):
            k, length = first, 0.0
            for _ in range(3):
                if not _crosses(corners[k], to, edge + 0.2 * CLEAR):
                    break
                after = (k + step) % 4
                length, k = length + float(np.linalg.norm(corners[after] - corners[k])), after
            lengths.append(length + float(np.linalg.norm(to - corners[k])))
        return min(lengths)


def sets_targets(task: Task, control: Controller) -> bool:
    """Return whether a `Pusher` supports the task: actions must displace the tip's target along three axes, in m."""
    impedes = control.name == "cartesian_impedance" and control.action == "target"
    return isinstance(task, PushTask) and impedes and control.action_dim == 3


def _face_points(half: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return points (k, 2) m on the edges of a rectangle with half edges (2,) m, and the inward normals (k, 2)."""
    points, normals = [], []
    for axis in range(2):
        for side in (-1.0, 1.0):
            for share in np.linspace(-EDGE, EDGE, POINTS):
                point, normal = np.empty(2), np.zeros(2)
                point[axis], point[1 - axis], normal[axis] = side * half[axis], share * half[1 - axis], -side
                points.append(point)
                normals.append(normal)
    return np.array(points), np.array(normals)


def _crosses(a: np.ndarray, b: np.ndarray, half: np.ndarray) -> bool:
    """Return whether the segment from a to b (2,) m crosses a rectangle centered at 0 with half edges (2,) m."""
    low, high = 0.0, 1.0
    for k in range(2):
        step = b[k] - a[k]
        if abs(step) < 1e-12:
            if abs(a[k]) >= half[k]:
                return False
            continue
        one, two = (-half[k] - a[k]) / step, (half[k] - a[k]) / step
        low, high = max(low, min(one, two)), min(high, max(one, two))
    return low < high - 1e-9
