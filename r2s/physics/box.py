"""Poses and properties of a box on a table, for the push task, domain randomization and twins."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from r2s.errors import UserError, check_number
from r2s.physics.robot import Robot
from r2s.physics.surface import Surface
from r2s.physics.tip import default_plane, nominal_plane

SIZE = 0.12, 0.12, 0.08  # m, edges along the box's axes; the hand stays above a box of this height
PUSHED_AT = 0.4  # height at which the tip pushes / height of the box
SPREAD, YAW = 0.02, 20.0  # m, degrees: largest deviations of a box from its nominal pose, to either side
# nominal distance of the box ahead of the tip at home / distance from the base to the table point below the tip
FORWARD = 0.25
# Ranges for a box: mass kg, friction coefficients with table and tip, stiffness N/m, damping s/m and bristle m of the
# contact with the tip; from a carton on a smooth table to a block of wood on a dry table
MASS, TABLE, TIP = (0.3, 1.5), (0.2, 0.5), (0.1, 0.5)
STIFFNESS, DAMPING, BRISTLE = (5e3, 1e5), (0.5, 3.0), (1e-4, 3e-4)
EXPECTED = {"mass": 0.8, "table": 0.35, "friction": 0.3, "stiffness": 2.5e4, "damping": 1.5, "bristle": 2e-4}


@dataclass(frozen=True)
class TableFrame:
    """Coordinate frame on a table, at the nominal position of a box.

    Attributes:
        origin: (3,) m, in the base frame. axes: (3, 3), whose rows point ahead (away from the base), left and up.
    """

    origin: np.ndarray
    axes: np.ndarray

    def inside(self, points: np.ndarray) -> np.ndarray:
        """Transform points (..., 3) m from the base frame to the table frame."""
        return (points - self.origin) @ self.axes.T

    def outside(self, points: np.ndarray) -> np.ndarray:
        """Transform points (..., 3) m from the table frame to the base frame."""
        return self.origin + points @ self.axes

    def planar(self, pose: np.ndarray) -> np.ndarray:
        """Return x m, y m and yaw rad (..., 3) of a box from its pose (..., 6): center, m, and first axis."""
        x = self.inside(pose[..., :3])
        first = pose[..., 3:] @ self.axes.T
        return np.concatenate([x[..., :2], np.arctan2(first[..., 1:2], first[..., :1])], axis=-1)

    def pose(self, planar: np.ndarray, height: float) -> np.ndarray:
        """Return the pose (..., 6) of a box from x, y and yaw (..., 3) and the height of its center, m."""
        x, y, yaw = np.moveaxis(planar, -1, 0)
        centre = self.outside(np.stack([x, y, np.full_like(x, height)], axis=-1))
        return np.concatenate([centre, np.stack([np.cos(yaw), np.sin(yaw), 0 * yaw], axis=-1) @ self.axes], axis=-1)

    def moved(self, pose: np.ndarray, by: np.ndarray) -> np.ndarray:
        """Return poses (m, 6) of boxes after a displacement `by` (m, 3): x m, y m, yaw rad in the table frame."""
        c, s = np.cos(by[:, 2:]), np.sin(by[:, 2:])
        first, up = pose[:, 3:], self.axes[2]
        turned = c * first + s * np.cross(up, first)  # `first` is perpendicular to `up`
        return np.concatenate([pose[:, :3] + by[:, :2] @ self.axes[:2], turned], axis=1)


def table_frame(robot: Robot, point: Any = None, normal: Any = None) -> TableFrame:
    """Return the frame of a table at `point` (3,) m with `normal` (3,).

    If `point` is None, the origin is below and ahead of the tip at home. If `normal` is None, the table is
    horizontal.
    """
    place, up = nominal_plane(robot, point, normal)
    across = place - (place @ up) * up
    size = float(np.linalg.norm(across))
    ahead = across / size if size > 1e-6 else np.cross(np.eye(3)[np.abs(up).argmin()], up)
    if point is None:
        place = place + FORWARD * float(np.linalg.norm(default_plane(robot)[0])) * ahead
    return TableFrame(place, np.stack([ahead, np.cross(up, ahead), up]))


def standing_box(frame: TableFrame, planar: np.ndarray, size: Any, **law: Any) -> Surface:
    """Return boxes that stand on a table.

    Args:
        frame: frame of the table. planar: (..., 3), x m, y m and yaw rad of boxes in `frame`. size: (3,) m, edges.
        law: fields mass, table, friction, stiffness, damping, bristle and exponent of `Surface`.
    """
    half = 0.5 * np.array(size, dtype=float)
    pose, up = frame.pose(planar, half[2]), frame.axes[2]
    first = pose[..., 3:]
    axes = np.stack([first, np.cross(up, first), np.broadcast_to(up, first.shape)], axis=-1)
    return Surface(pose[..., :3], up, **{"exponent": 1.0} | law, half=half, axes=axes)


def check_size(name: str, size: Any, table: float) -> np.ndarray:
    """Return a box's edges (3,) m; raise UserError for invalid edges, or if a push at PUSHED_AT would tilt the box.

    A push must overcome the table friction mu m g, so a push at height h tilts a box with half edge a if mu h > a.
    """
    if not isinstance(size, list | tuple | np.ndarray) or len(size) != 3:
        raise UserError(f"{name}: expected three edges in m, got {size!r}")
    for edge in size:
        check_number(name, edge, "(0, 1]")
    edges = np.array(size, dtype=float)
    if table * PUSHED_AT * edges[2] >= 0.5 * edges[:2].min():
        most = 0.5 * edges[:2].min() / (PUSHED_AT * table)
        raise UserError(
            f"{name}: a box of {edges[2]:g} m on its edge of {edges[:2].min():g} m tilts when it is pushed on a "
            f"table with friction {table:g}; up to {most:.3g} m high does not"
        )
    return edges
