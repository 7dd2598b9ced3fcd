"""A tool's tip and the surface it touches: what a contact needs to be computed, simulated or identified.

Normal force (Hunt and Crossley, ASME J. Appl. Mech. 1975): F = K d^e (1 + c d') >= 0, of the penetration d of the
tip, with K = k / (1 mm)^(e - 1), so that k d is the force at 1 mm for every exponent. Tangential force: mu F in
sliding, against the velocity.
"""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from r2s.compiled import njit
from r2s.errors import UserError, nearest
from r2s.files import located

UNIT_DEPTH = 1e-3  # m, the penetration at which stiffness is stated
TOOL_KEYS = ("tip_in_flange_m", "radius_m", "mass_kg", "frame")


@dataclass(frozen=True)
class Tool:
    """A spherical tip at the end effector.

    Attributes:
        tip: (3,) m, centre of the sphere in the frame of the end effector's site.
        radius: m. mass: kg, at the centre.
    """

    tip: np.ndarray
    radius: float
    mass: float = 0.0


@dataclass(frozen=True)
class Surface:
    """A compliant plane in the base frame.

    Attributes:
        point: (3,) m, on the plane. normal: (3,) unit vector, out of the material.
        stiffness: N/m, k: force per penetration at 1 mm. exponent: e, 1 (linear) to 1.5 (Hertz).
        damping: s/m, c. friction: mu. bristle: m, tangential deflection at which friction reaches mu F; 0: rigid.
    """

    point: np.ndarray
    normal: np.ndarray
    stiffness: float
    exponent: float = 1.5
    damping: float = 0.0
    friction: float = 0.3
    bristle: float = 0.0

    @property
    def coefficient(self) -> float:
        """K, N/m^e, factor of the normal force."""
        return self.stiffness / UNIT_DEPTH ** (self.exponent - 1.0)

    def depth(self, centre: np.ndarray, radius: float) -> np.ndarray:
        """Return the penetration (...,) m of a sphere at centre (..., 3) m; negative: its distance."""
        return radius - (centre - self.point) @ self.normal


@njit(cache=True, error_model="numpy")
def normal_force(K, exponent, damping, depth, rate):
    """Return the normal force, N, at a penetration (m) and its rate (m/s); see the module."""
    if depth <= 0.0:
        return 0.0
    return max(K * depth**exponent * (1.0 + damping * rate), 0.0)


def load_tool(path: str | Path) -> Tool:
    """Read a tool file, JSON: `tip_in_flange_m` (3 numbers), `radius_m`, optional `mass_kg`.

    Raises:
        UserError: no such file, no valid JSON, an unknown or missing key, a value out of range.
    """
    if not isinstance(path, str | Path):
        raise UserError(f"robot.tool: expected a JSON file, got {path!r}")
    file = located(path)
    try:
        values = json.loads(file.read_text())
    except FileNotFoundError:
        others = [p.name for p in file.parent.glob("*.json")]
        raise UserError(f"robot.tool: no such file: {file}{nearest(file.name, others)}") from None
    except OSError as error:
        raise UserError(f"robot.tool: {file}: {error.strerror}") from None
    except ValueError as error:
        raise UserError(f"robot.tool: {file} is not valid JSON: {error}") from None
    if not isinstance(values, dict):
        raise UserError(f"robot.tool: {file}: expected an object with tip_in_flange_m and radius_m")
    for key in values:
        if key not in TOOL_KEYS:
            raise UserError(f"robot.tool: {file.name}: unknown key '{key}'{nearest(key, TOOL_KEYS)}")
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
