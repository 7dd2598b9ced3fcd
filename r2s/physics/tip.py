"""Forward and inverse kinematics of a tool's tip, and the nominal plane of a surface."""

import mujoco
import numpy as np

from r2s.errors import UserError
from r2s.physics.robot import Robot

BELOW = 0.15  # gap between nominal surface and tip in the home posture / distance from base to end effector
POSTURE = 1e-3  # m^2, damping in the least-squares steps of inverse kinematics
MARGIN = 0.1  # rad, smallest distance of a solution of inverse kinematics from the position limits
CLOSE = 1e-4  # m, position error at which inverse kinematics ends
ROUNDS = 60


class Tip:
    """Kinematics of the center of a tool's spherical tip, with nominal link geometry.

    Raises:
        UserError: the robot has no tool.
    """

    def __init__(self, robot: Robot):
        if robot.tool is None:
            raise UserError(f"robot.tool: {robot.name} has no tool that could touch a surface; give robot.tool=FILE")
        self._robot, self._tip = robot, robot.tool.tip
        self._model = robot.model(gravity=False)
        self._data = mujoco.MjData(self._model)
        self._site = self._model.site(robot.ee_site).id

    def __call__(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the tip's position (3,) m and Jacobian (3, n) m/rad at q (n,) rad."""
        d = self._data
        d.qpos = q
        mujoco.mj_kinematics(self._model, d)
        place = d.site_xpos[self._site] + d.site_xmat[self._site].reshape(3, 3) @ self._tip
        return place, np.cross(d.xaxis, place - d.xanchor).T

    def posture(self, place: np.ndarray) -> np.ndarray | None:
        """Return q (n,) rad near home for the tip position `place` (3,) m, or None if `place` is out of reach."""
        r = self._robot
        low, high = r.q_range[0] + MARGIN, r.q_range[1] - MARGIN
        q = r.q_home.copy()
        for _ in range(ROUNDS):
            at, jacobian = self(q)
            if np.linalg.norm(place - at) < CLOSE:
                return q
            step = np.linalg.solve(jacobian.T @ jacobian + POSTURE * np.eye(r.n), jacobian.T @ (place - at))
            q = np.clip(q + step * min(1.0, 0.3 / np.abs(step).max()), low, high)
        return None


def tilted(normal: np.ndarray, about: np.ndarray | float, tilt: np.ndarray | float) -> np.ndarray:
    """Tilt `normal` (3,) by `tilt` rad toward the azimuth `about` rad; return (3,), or (m, 3) for angles (m, 1)."""
    across = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
    across /= np.linalg.norm(across)
    aside = np.cos(about) * across + np.sin(about) * np.cross(normal, across)
    return np.cos(tilt) * normal + np.sin(tilt) * aside


def default_plane(robot: Robot) -> tuple[np.ndarray, np.ndarray]:
    """Return point (3,) m and normal (3,) of a work table below the tip in the home posture."""
    down = robot.gravity / np.linalg.norm(robot.gravity) if robot.gravity.any() else np.array([0.0, 0.0, -1.0])
    tip = Tip(robot)
    place, _ = tip(robot.q_home)
    ee = tip._data.site_xpos[tip._site]
    return place + (robot.tool.radius + BELOW * np.linalg.norm(ee)) * down, -down  # type: ignore[union-attr]


def nominal_plane(robot: Robot, point: object = None, normal: object = None) -> tuple[np.ndarray, np.ndarray]:
    """Return point (3,) m and unit normal (3,) of a plane; `default_plane` replaces an argument that is None."""
    default = default_plane(robot)
    values = [e if x is None else np.array(x, dtype=float) for x, e in zip((point, normal), default, strict=True)]
    for name, value in zip(("point", "normal"), values, strict=True):
        if value.shape != (3,) or not np.isfinite(value).all() or (name == "normal" and not value.any()):
            not_zero = ", not all 0" if name == "normal" else ""
            raise UserError(f"{name}: expected 3 numbers{not_zero}, got {value.tolist()}")
    return values[0], values[1] / np.linalg.norm(values[1])
