"""Define a tool's tip and the surface that the tip touches, with contact parameters.

The normal force at the tip's penetration depth d and rate d' is F = K d^e (1 + c d') >= 0 (Hunt and Crossley, ASME
Journal of Applied Mechanics 1975). The stiffness k is the undamped force per depth at d = 1 mm, so K = k / (1 mm)^(e
- 1). While the tip slides, the tangential force is mu F, opposite to the sliding velocity.
"""

import json
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np

from r2s.compiled import njit
from r2s.errors import UserError, instead_of, nearest_file
from r2s.files import located

TINY = np.finfo(float).tiny
UNIT_DEPTH = 1e-3  # m, penetration depth at which the elastic force is `stiffness` * depth
TOOL_KEYS = ("tip_in_flange_m", "radius_m", "mass_kg", "frame")


@dataclass(frozen=True)
class Tool:
    """A spherical tip at the end effector.

    Attributes:
        tip: (3,) m, center of the sphere in the frame of the end effector's site. radius: m, radius of the sphere.
        mass: kg, at the sphere's center; r2s simulates this mass only as a payload (r2s/physics/payload.py).
    """

    tip: np.ndarray
    radius: float
    mass: float = 0.0


@dataclass(frozen=True)
class Surface:
    """A compliant plane or box in the base frame; fields may have batch axes, for many arms at once.

    Attributes:
        point: (3,) m, a point on the plane, or the center of the box.
        normal: (3,), unit vector out of the material; for a box, the box's third axis.
        stiffness: k, N/m, force per depth at a depth of 1 mm. exponent: e, from 1 (linear) to 2; 1.5: Hertz.
        damping: c, s/m. friction: coefficient mu. bristle: m, tangential deflection at friction mu F; 0: no
            deflection.
        half: (3,) m, half edges of a box; None: the surface is a plane. axes: (3, 3), the box's axes as columns.
        mass: kg, mass of a box that slides on a table when pushed (sliding.py); None: the surface is fixed.
        table: friction coefficient between a sliding box and its table.
    """

    point: np.ndarray
    normal: np.ndarray
    stiffness: np.ndarray | float
    exponent: np.ndarray | float = 1.5
    damping: np.ndarray | float = 0.0
    friction: np.ndarray | float = 0.3
    bristle: np.ndarray | float = 0.0
    half: np.ndarray | None = None
    axes: np.ndarray | None = None
    mass: np.ndarray | float | None = None
    table: np.ndarray | float = 0.0

    @property
    def reach(self) -> np.ndarray:
        """Mean distance, m, of the points of a box's base from the base's center."""
        a, b = np.moveaxis(np.asarray(self.half), -1, 0)[:2]
        return np.hypot(a, b) / 3 + a**2 / (6 * b) * np.arcsinh(b / a) + b**2 / (6 * a) * np.arcsinh(a / b)

    @property
    def coefficient(self) -> np.ndarray | float:
        """Factor K, N/m^e, in the normal force K d^e (1 + c d')."""
        return self.stiffness / UNIT_DEPTH ** (self.exponent - 1.0)

    def depth(self, centre: np.ndarray, radius: float) -> np.ndarray:
        """Return the penetration (...,) m of a sphere at `centre` (..., 3) m, negative outside the surface."""
        if self.half is None:
            return radius - ((centre - self.point) * self.normal).sum(-1)
        beyond = np.abs(((centre - self.point)[..., None] * self.axes).sum(-2)) - self.half
        return radius - np.linalg.norm(beyond.clip(0.0), axis=-1) - np.minimum(beyond.max(-1), 0.0)

    def one(self, k: int) -> "Surface":
        """Return the k-th surface of a batch (m, ...); all surfaces share the fields without a batch axis."""
        values = {f.name: np.asarray(v) for f in fields(self) if (v := getattr(self, f.name)) is not None}
        one = {"point": 1, "normal": 1, "half": 1, "axes": 2}  # number of axes for one arm
        return replace(self, **{name: v[k] for name, v in values.items() if v.ndim > one.get(name, 0)})

    def check(self) -> None:
        """Raise UserError unless all values are in their ranges."""
        for name, low, high in (
            ("stiffness", TINY, np.inf), ("exponent", 1.0, 2.0), ("damping", 0.0, np.inf), ("friction", 0.0, np.inf),
            ("bristle", 0.0, np.inf), ("mass", TINY, np.inf), ("table", 0.0, np.inf),
        ):  # fmt: skip
            if getattr(self, name) is None:
                continue
            value = np.asarray(getattr(self, name), dtype=float)
            if not ((value >= low) & (value <= high) & np.isfinite(value)).all():
                ranges = {"stiffness": "above 0 N/m", "exponent": "from 1 to 2", "mass": "above 0 kg"}
                allowed = ranges.get(name, "of 0 or more")
                raise UserError(f"surface.{name}: expected a value {allowed}, got {value.min():g} to {value.max():g}")
        if not np.isfinite(self.point).all() or np.abs(np.linalg.norm(self.normal, axis=-1) - 1.0).max() > 1e-6:
            raise UserError(
                f"surface: expected a finite point and a normal of length 1, got {self.point}, {self.normal}"
            )
        if self.mass is not None and self.half is None:
            raise UserError("surface.mass: only a box moves, and this surface has no half edges")
        if self.half is not None:
            half, axes = np.asarray(self.half), np.asarray(self.axes)
            if not (np.isfinite(half) & (half > 0)).all():
                raise UserError(f"surface.half: expected 3 half edges above 0 m, got {half.tolist()}")
            gram = np.swapaxes(axes, -1, -2) @ axes if axes.shape[-2:] == (3, 3) else np.zeros((3, 3))
            if np.abs(gram - np.eye(3)).max() > 1e-6 or np.abs(axes[..., 2] - self.normal).max() > 1e-6:
                raise UserError("surface.axes: expected 3 perpendicular unit vectors, the third of them the normal")


@njit(cache=True, error_model="numpy")
def normal_force(K, exponent, damping, depth, rate):
    """Return Hunt and Crossley's normal force, N, for penetration `depth`, m, and penetration `rate`, m/s."""
    if depth <= 0.0:
        return 0.0
    return max(K * depth**exponent * (1.0 + damping * rate), 0.0)


def load_tool(path: str | Path) -> Tool:
    """Read a tool file, JSON: `tip_in_flange_m` (3 numbers), `radius_m`, optional `mass_kg`; ignore `frame`.

    Raises:
        UserError: the file is missing or not valid JSON, a key is unknown or missing, or a value is out of range.
    """
    if not isinstance(path, str | Path):
        raise UserError(f"robot.tool: expected a JSON file, got {path!r}")
    file = located(path)
    try:
        values = json.loads(file.read_text())
    except FileNotFoundError:
        raise UserError(f"robot.tool: no such file: {file}{nearest_file(file, '*.json')}") from None
    except OSError as error:
        raise UserError(f"robot.tool: {file}: {error.strerror}") from None
    except ValueError as error:
        raise UserError(f"robot.tool: {file} is not valid JSON: {error}") from None
    if not isinstance(values, dict):
        raise UserError(f"robot.tool: {file}: expected an object with tip_in_flange_m and radius_m")
    for key in values:
        if key not in TOOL_KEYS:
            raise UserError(f"robot.tool: {file.name}: unknown key '{key}'; {instead_of(key, TOOL_KEYS)}")
    try:
        tip = np.array(values["tip_in_flange_m"], dtype=float)
        radius, mass = float(values["radius_m"]), float(values.get("mass_kg", 0.0))
    except KeyError as missing:
        raise UserError(f"robot.tool: {file.name} has no {missing}") from None
    except (TypeError, ValueError) as error:
        raise UserError(f"robot.tool: {file.name}: {error}") from None
    if tip.shape != (3,) or not np.isfinite(tip).all():
        raise UserError(f"robot.tool: {file.name}: tip_in_flange_m: expected 3 numbers in m, got {tip.tolist()}")
    if not (0 < radius < np.inf and 0 <= mass < np.inf):
        raise UserError(f"robot.tool: {file.name}: expected radius_m > 0 and mass_kg >= 0, got {radius:g}, {mass:g}")
    return Tool(tip, radius, mass)
