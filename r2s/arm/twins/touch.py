"""Draw a twin's random surface from the twin's seed, and compute the tool's contact with this surface.

The surface may be a box on a table. In each episode, the box has a new random pose.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from r2s.errors import UserError, instead_of
from r2s.physics import box
from r2s.physics.box import TableFrame, check_size, standing_box, table_frame
from r2s.physics.contact import near
from r2s.physics.contact_layout import (
    AXES,
    COLUMNS,
    DEFLECTION,
    DEPTH,
    FORCE,
    NORMAL,
    POINT,
    RADIUS,
    ROWS,
    TIP,
    box_pose,
    contact_columns,
)
from r2s.physics.kinematics import POSE, link_frames
from r2s.physics.newton_euler import links_of
from r2s.physics.payload import ee_pose
from r2s.physics.robot import SIM_DT, Robot
from r2s.physics.surface import Surface
from r2s.physics.tip import Tip, default_plane, tilted

PLACE, TILT = 5e-3, np.radians(5.0)  # m, rad, largest distance and tilt of the surface from its nominal place
STIFFNESS = 2e3, 1e5  # N/m, from foam to wood under a tip of 10 mm
CAMERA = 33, 1e-3, np.radians(0.5)  # cycles between two camera images; noise of a box's measured pose, m and rad


@dataclass(frozen=True)
class BoxSurface:
    """A random box on a table: frame of the table, and surface of the box at its nominal pose."""

    frame: TableFrame
    surface: Surface


class Touch:
    """The contact of a tool's tip with a surface, stored in arrays for the compiled code of a twin.

    Attributes:
        contact, jacobian: (COLUMNS,) and (ROWS, n), state and Jacobian of the contact, see contact_layout.py.
        frames, axes: (n, POSE), (n, 3), link frames and joint axes. links: nominal links.
        there: whether a surface exists.

    Args:
        robot: the arm. surface: surface from `draw_surface`; None: no surface.
    """

    def __init__(self, robot: Robot, surface: Surface | BoxSurface | None):
        n = robot.n
        self._table = surface.frame if isinstance(surface, BoxSurface) else None
        surface = surface.surface if isinstance(surface, BoxSurface) else surface
        self.there, self.contact = surface is not None, np.zeros(COLUMNS)
        self.jacobian, self.frames, self.axes = np.zeros((ROWS, n)), np.zeros((n, POSE)), np.zeros((n, 3))
        self.links = links_of(robot, robot.mass, robot.com, robot.inertia)
        self._ee = ee_pose(robot)[0]
        if surface is not None:
            self.contact[:] = contact_columns(robot, surface)
        self._first = self.contact.copy()

    def start(self, q: np.ndarray, seed: list[int]) -> float:
        """Reset the contact, draw a box's random pose, and return the tip's penetration depth (m) at q (n,) rad.

        `seed` is the episode's seed. Far from the surface the depth is -inf. The friction bristle starts undeflected.
        """
        self.contact[DEFLECTION:] = self._first[DEFLECTION:]
        if self._table is not None:
            self._camera = np.random.default_rng([*seed, 1])
            most = np.array([[box.SPREAD, box.SPREAD, np.radians(box.YAW)]])  # uniform about the nominal place
            planar = np.random.default_rng(seed).uniform(-most, most)
            pose = self._table.moved(box_pose(self._first)[None], planar)[0]
            up = self._table.axes[2]
            axes = np.stack([pose[3:], np.cross(up, pose[3:]), up], axis=1)
            self.contact[POINT : POINT + 3], self.contact[AXES : AXES + 9] = pose[:3], axes.ravel()
            self._image = -1
        return float(self.contact[DEPTH]) if self.near(q, np.zeros_like(q)) else -np.inf

    def near(self, q: np.ndarray, dq: np.ndarray) -> bool:
        """Return whether the tip at q, dq (n,) rad, rad/s may touch the surface in one cycle; update `jacobian`."""
        if not self.there:
            return False
        link_frames(self.links, q, self.frames, self.axes)
        last = self.frames[-1]
        return near(self.contact, (last[:3], last[3:]), self.frames[:, :3], self.axes, dq, SIM_DT, self.jacobian)

    def perceived(self, cycle: int) -> np.ndarray | None:
        """Return the pose (6,) of the box in the camera's last image; None without a box."""
        if self._table is None:
            return None
        every, m, rad = CAMERA
        if cycle // every != self._image:
            noise = np.array([[m, m, rad]]) * self._camera.standard_normal(3)
            self._seen = self._table.moved(box_pose(self.contact)[None], noise)[0]
            self._image = cycle // every
        return self._seen

    def wrench(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return joint torque (n,) Nm and end effector wrench (6,) N, Nm that the arm exerts on the surface."""
        link_frames(self.links, q, self.frames, self.axes)
        last, force = self.frames[-1], -self.contact[FORCE : FORCE + 3]
        R, normal = last[3:].reshape(3, 3), self.contact[NORMAL : NORMAL + 3]
        place = last[:3] + R @ self.contact[TIP : TIP + 3] - self.contact[RADIUS] * normal
        torque = (self.axes * np.cross(place - self.frames[:, :3], force)).sum(1)
        arm = place - last[:3] - R @ self._ee
        return torque, np.concatenate([force, np.cross(arm, force)])


def draw_surface(robot: Robot, surface: Any, rng: np.random.Generator) -> Surface | BoxSurface | None:
    """Draw a random surface near a nominal pose; `surface` is a setting that describes the nominal pose.

    False means no surface. True means a work table below the tip in the home posture. {point: (3,) m, normal: (3,)}
    means a plane through the point. `box` means a box with edges `r2s.physics.box.SIZE` on a work table ahead of the
    tip. {box: (3,) m} means a box with the given edges; if point and normal are also given, the box stands at the
    point.

    Raises:
        UserError: `surface` is invalid, the robot has no tool, or in the home posture the tip is inside the surface.
    """
    if surface is False or surface is None:
        return None
    if robot.tool is None:
        raise UserError(f"arm.surface: {robot.name} has no tool that could touch it; give robot.tool=FILE")
    if surface == "box" or (isinstance(surface, Mapping) and "box" in surface):
        return _draw_box(robot, {"box": list(box.SIZE)} if surface == "box" else dict(surface), rng)
    point, normal = default_plane(robot) if surface is True else _place(surface)
    # uniform: shift of -5 to 5 mm along the normal, tilt of 0 to 5 degrees; log-uniform: stiffness, 2e3 to 1e5 N/m
    about, tilt = rng.uniform(0, 2 * np.pi), rng.uniform(0, TILT)
    tip = Tip(robot)(robot.q_home)[0]
    inside = float(robot.tool.radius - normal @ (tip - point))
    if inside > 0:
        raise UserError(
            f"arm.surface: the tip at home would be {1e3 * inside:.1f} mm inside it; choose a point below the tip, "
            "and a normal towards it"
        )
    return Surface(
        point=point + rng.uniform(-PLACE, PLACE) * normal,
        normal=tilted(normal, about, tilt),
        stiffness=float(np.exp(rng.uniform(*np.log(STIFFNESS)))),
        exponent=float(rng.choice([1.0, 1.5])),
        damping=float(rng.uniform(0.5, 3.0)),  # s/m
        friction=float(rng.uniform(0.1, 0.5)),
        bristle=float(rng.uniform(1e-4, 3e-4)),  # m
    )


def _draw_box(robot: Robot, settings: dict[str, Any], rng: np.random.Generator) -> BoxSurface:
    """Draw a random mass and random contact parameters of a box from the ranges in r2s/physics/box.py."""
    size = settings.pop("box")
    point, normal = _place(settings) if settings else (None, None)
    edges, frame = check_size("arm.surface.box", size, box.TABLE[1]), table_frame(robot, point, normal)
    mass, stiffness = (float(np.exp(rng.uniform(*np.log(pair)))) for pair in (box.MASS, box.STIFFNESS))  # log-uniform
    pairs = {"table": box.TABLE, "friction": box.TIP, "damping": box.DAMPING, "bristle": box.BRISTLE}
    law = {name: float(rng.uniform(*pair)) for name, pair in pairs.items()}
    return BoxSurface(frame, standing_box(frame, np.zeros(3), edges, mass=mass, stiffness=stiffness, **law))


def _place(surface: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return point (3,) m and unit normal (3,) of the nominal plane in the setting `surface`."""
    if not isinstance(surface, Mapping):
        raise UserError(f"arm.surface: expected false, true, box or {{point: [3], normal: [3]}}, got {surface!r}")
    for key in (values := dict(surface)):
        if key not in ("point", "normal"):
            raise UserError(f"arm.surface: unknown key '{key}'; {instead_of(key, ('point', 'normal'))}")
    try:
        point, normal = (np.array(values[key], dtype=float).reshape(3) for key in ("point", "normal"))
        length = float(np.linalg.norm(normal))
    except (KeyError, TypeError, ValueError):
        length = 0.0
    if not 0 < length < np.inf or not np.isfinite(point).all():
        raise UserError(f"arm.surface: expected {{point: 3 numbers in m, normal: 3 numbers}}, got {values}")
    return point, normal / length
