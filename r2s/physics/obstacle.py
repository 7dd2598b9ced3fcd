"""Obstacles: boxes that the links of an arm must not touch."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from r2s.errors import UserError, instead_of

PREFIX = "obstacle "  # prefix of the geoms' names in a model
KEYS = ("center", "size", "yaw")


@dataclass(frozen=True)
class Box:
    """A box in the base frame: center (3,) m, size (3,) m along its edges, yaw rad about the vertical."""

    center: tuple[float, float, float]
    size: tuple[float, float, float]
    yaw: float = 0.0

    def add_to(self, spec: mujoco.MjSpec, number: int) -> None:
        """Add the box as obstacle number `number` to the world body of the MuJoCo model `spec`."""
        axes = [np.cos(0.5 * self.yaw), 0.0, 0.0, np.sin(0.5 * self.yaw)]
        half = 0.5 * np.array(self.size)
        kind = mujoco.mjtGeom.mjGEOM_BOX
        spec.worldbody.add_geom(name=f"{PREFIX}{number}", type=kind, pos=list(self.center), size=half, quat=axes)


def boxes(where: str, given: Sequence[Mapping[str, Any]]) -> list[Box]:
    """Return the boxes that a setting describes, [{center: [x, y, z], size: [x, y, z], yaw: rad}, ...].

    Raises:
        UserError: a key is unknown or missing, or a value is not a valid number.
    """
    out = []
    for k, one in enumerate(given):
        name = f"{where}[{k}]"
        if not isinstance(one, Mapping):
            raise UserError(f"{name}: expected {{center: [x, y, z], size: [x, y, z]}}, got {one!r}")
        for key in one:
            if key not in KEYS:
                raise UserError(f"{name}: unknown key '{key}'; {instead_of(key, KEYS)}")
        for key in ("center", "size"):
            _check_numbers(f"{name}.{key}", one.get(key), 3)
        _check_numbers(f"{name}.yaw", [one.get("yaw", 0.0)], 1)
        if min(one["size"]) <= 0:
            raise UserError(f"{name}.size: expected edges above 0 m, got {list(one['size'])}")
        out.append(Box(tuple(one["center"]), tuple(one["size"]), one.get("yaw", 0.0)))
    return out


def _check_numbers(name: str, value: Any, count: int) -> None:
    right = isinstance(value, Sequence) and not isinstance(value, str) and len(value) == count
    if not right or any(isinstance(x, bool) or not isinstance(x, int | float) or not np.isfinite(x) for x in value):
        raise UserError(f"{name}: expected {count} number{'s' * (count > 1)}, got {value!r}")
