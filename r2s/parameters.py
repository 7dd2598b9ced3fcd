"""The parameters that identification searches, as one vector, and the file that carries them to the other stages.

One number per joint or link in each block: phi1, phi2, phi3 (eq. 5), inertia_scale (the paper's Table III NEW is an
exact multiple of OLD per link) and offset (Table I). A search sees only the unit cube; where a value spans decades
its coordinate is logarithmic.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from r2s.errors import UserError, choices, nearest
from r2s.robot import Robot
from r2s.simulator import Dynamics

UNITS = {
    "phi1": "Nm",
    "phi2": "s/rad",
    "phi3": "rad/s",
    "inertia_scale": "1",
    "offset": "Nm",
    "breakaway_positive": "Nm",
    "breakaway_negative": "Nm",
}
LOGARITHMIC = ("phi1", "phi2", "inertia_scale")


@dataclass(frozen=True)
class ParameterSpace:
    """The searched vector x of P = blocks x n values.

    Attributes:
        blocks: names in order, each n values long.
        n: joints.
        lower, upper: (P,) bounds in SI units.
        nominal: the dynamics that fixed blocks keep and that a search starts from.
        inertia: (n, 3, 3) kg m^2, the robot's tensors, which inertia_scale multiplies.
    """

    blocks: tuple[str, ...]
    n: int
    lower: np.ndarray
    upper: np.ndarray
    nominal: Dynamics
    inertia: np.ndarray

    @property
    def names(self) -> list[str]:
        """P names such as phi1[3] (joints count from 1)."""
        return [f"{block}[{j + 1}]" for block in self.blocks for j in range(self.n)]

    @property
    def start(self) -> np.ndarray:
        """(P,) the nominal dynamics as a vector, clipped into the bounds."""
        d = self.nominal
        values = {"phi1": d.phi[:, 0], "phi2": d.phi[:, 1], "phi3": d.phi[:, 2], "offset": d.offset}
        values["inertia_scale"] = inertia_scale(d.inertia, self.inertia)
        values |= {"breakaway_negative": d.breakaway[:, 0], "breakaway_positive": d.breakaway[:, 1]}
        return np.clip(np.concatenate([values[b] for b in self.blocks]), self.lower, self.upper)

    def block(self, x: np.ndarray, name: str) -> np.ndarray:
        """Return the (..., n) values of one block of x (..., P)."""
        i = self.blocks.index(name)
        return x[..., i * self.n : (i + 1) * self.n]

    def of_joints(self, joints: np.ndarray) -> np.ndarray:
        """Return (P,) bool: friction and offset of the joints (n,) bool; inertia belongs to links, not joints."""
        return np.concatenate([joints & (b != "inertia_scale") for b in self.blocks])

    @property
    def _log(self) -> np.ndarray:
        return np.repeat([b in LOGARITHMIC for b in self.blocks], self.n)

    def to_unit(self, x: np.ndarray) -> np.ndarray:
        """Map x (..., P) in SI units into the unit cube."""
        low, high = self._warp(self.lower), self._warp(self.upper)
        return (self._warp(x) - low) / (high - low)

    def from_unit(self, u: np.ndarray) -> np.ndarray:
        """Map unit-cube points u (..., P) to SI units."""
        low, high = self._warp(self.lower), self._warp(self.upper)
        w = low + np.clip(u, 0.0, 1.0) * (high - low)
        return np.where(self._log, np.exp(np.where(self._log, w, 0.0)), w)

    @property
    def spread(self) -> np.ndarray:
        """(P,) the width of the bounds: of the logarithm where the coordinate is logarithmic, else in SI units."""
        return self._warp(self.upper) - self._warp(self.lower)

    def _warp(self, x: np.ndarray) -> np.ndarray:
        return np.where(self._log, np.log(np.where(self._log, x, 1.0)), x)

    def dynamics(self, x: np.ndarray) -> Dynamics:
        """Return the dynamics of x (..., P); blocks that are not searched keep their nominal values."""
        d = self.nominal
        phi = np.broadcast_to(d.phi, (*x.shape[:-1], self.n, 3)).copy()
        for i, name in enumerate(("phi1", "phi2", "phi3")):
            if name in self.blocks:
                phi[..., i] = self.block(x, name)
        offset = self.block(x, "offset") if "offset" in self.blocks else d.offset
        breakaway = np.broadcast_to(d.breakaway, (*x.shape[:-1], self.n, 2)).copy()
        for i, name in enumerate(("breakaway_negative", "breakaway_positive")):
            if name in self.blocks:
                breakaway[..., i] = self.block(x, name)
        out = replace(d, phi=phi, offset=offset, breakaway=breakaway)
        if "inertia_scale" not in self.blocks:
            return out
        return replace(out, inertia=self.inertia * self.block(x, "inertia_scale")[..., None, None])


def inertia_scale(inertia: np.ndarray, nominal: np.ndarray) -> np.ndarray:
    """Return (..., n): the scale of tensors (..., n, 3, 3) over the nominal ones, by their traces."""
    return np.trace(inertia, axis1=-2, axis2=-1) / np.trace(nominal, axis1=-2, axis2=-1)


def parameter_space(robot: Robot, nominal: Dynamics, bounds: Mapping[str, Sequence[float]]) -> ParameterSpace:
    """Make the space from {"phi1": [low, high], ...}; a block that is not named is not searched.

    Raises:
        UserError: unknown block, or bounds that are not two rising numbers (positive where logarithmic).
    """
    for name, pair in bounds.items():
        if name not in UNITS:
            raise UserError(f"bounds: unknown parameter '{name}'; allowed: {choices(UNITS)}{nearest(name, UNITS)}")
        if len(pair) != 2 or not pair[0] < pair[1] or (name in LOGARITHMIC and pair[0] <= 0):
            raise UserError(f"bounds.{name}: {list(pair)} is not [low, high] with low < high (low > 0 for {name})")
    pairs = np.array([bounds[b] for b in bounds], dtype=float)
    lower, upper = np.repeat(pairs[:, 0], robot.n), np.repeat(pairs[:, 1], robot.n)
    return ParameterSpace(tuple(bounds), robot.n, lower, upper, nominal, robot.inertia)


def nominal_dynamics(
    robot: Robot,
    *,
    phi1: Sequence[float] | float,
    phi2: Sequence[float] | float,
    phi3: Sequence[float] | float,
    offset: Sequence[float] | float = 0.0,
    breakaway_positive: Sequence[float] | float = 0.0,
    breakaway_negative: Sequence[float] | float = 0.0,
    dq_min: float = 0.01,
    inertia_scale: Sequence[float] | float = 1.0,
) -> Dynamics:
    """Return the dynamics that `conf/friction` and `conf/inertia` describe: a number per joint, or one for all.

    Raises:
        UserError: a list that does not fit the arm's joints, or a value out of its physical range.
    """

    def per_joint(name: str, value: Sequence[float] | float) -> np.ndarray:
        array = np.array(value, dtype=float)
        array = np.full(robot.n, float(array)) if array.ndim == 0 else array
        if array.shape != (robot.n,):
            raise UserError(f"{name}: {array.size} values for the {robot.n} joints of {robot.name}")
        if not np.all(np.isfinite(array)):
            raise UserError(f"{name}: {array.tolist()} has a value that is not finite")
        return array

    phi = np.stack([per_joint("friction.phi1", phi1), per_joint("friction.phi2", phi2)], -1)
    scale = per_joint("inertia.scale", inertia_scale)
    for name, values in (("friction.phi1", phi[:, 0]), ("friction.phi2", phi[:, 1])):
        if np.any(values < 0):
            raise UserError(f"{name}: {values.min():g} is negative; friction must take energy out")
    if np.any(scale <= 0):
        raise UserError(f"inertia.scale: {scale.min():g} is not positive")
    low = per_joint("friction.breakaway_negative", breakaway_negative)
    high = per_joint("friction.breakaway_positive", breakaway_positive)
    if np.any(low > 0) or np.any(high < 0):
        raise UserError("friction.breakaway: the negative edges must be <= 0 and the positive ones >= 0")
    return Dynamics(
        phi=np.concatenate([phi, per_joint("friction.phi3", phi3)[:, None]], -1),
        offset=per_joint("friction.offset", offset),
        breakaway=np.stack([low, high], -1),
        dq_min=float(dq_min),
        inertia=robot.inertia * scale[:, None, None],
    )


def save_parameters(
    path: Path,
    robot: Robot,
    space: ParameterSpace,
    x: np.ndarray,
    interval: tuple[np.ndarray, np.ndarray],
    identifiable: np.ndarray,
    source: Mapping[str, Any],
) -> None:
    """Write parameters.yaml: value, unit, nominal, bounds, 95 % interval and whether the data could tell, per joint.

    Args:
        path: the file.
        robot: the arm.
        space: what was searched.
        x: (P,) the result. interval: its (P,) lower and upper ends. identifiable: (P,) bool.
        source: where it came from (recording, search, run), kept as it is.
    """
    fixed = space.nominal
    document: dict[str, Any] = {
        "robot": robot.name,
        "joints": robot.n,
        "source": dict(source),
        "parameters": {},
    }
    for name in space.blocks:
        rows = {
            "value": space.block(x, name),
            "nominal": space.block(space.start, name),
            "lower_bound": space.block(space.lower, name),
            "upper_bound": space.block(space.upper, name),
            "interval95_low": space.block(interval[0], name),
            "interval95_high": space.block(interval[1], name),
        }
        entry: dict[str, Any] = {"unit": UNITS[name]}
        entry |= {k: [float(f"{v:.6g}") for v in values] for k, values in rows.items()}
        document["parameters"][name] = entry | {"identifiable": space.block(identifiable, name).tolist()}
    document["fixed"] = {
        "phi": fixed.phi.tolist(),
        "offset": fixed.offset.tolist(),
        "breakaway_negative": fixed.breakaway[:, 0].tolist(),
        "breakaway_positive": fixed.breakaway[:, 1].tolist(),
        "dq_min": fixed.dq_min,
        "inertia_scale": inertia_scale(fixed.inertia, robot.inertia).tolist(),
    }
    path.write_text(yaml.safe_dump(document, sort_keys=False, default_flow_style=None, width=110))


def load_parameters(folder: str | Path, robot: Robot) -> Dynamics:
    """Return the identified dynamics of `calibration=RUN_FOLDER` (or of a parameters.yaml itself).

    Raises:
        UserError: no such run or file, another robot's parameters, or a file that does not hold them.
    """
    path = Path(folder)
    path = path / "parameters.yaml" if path.is_dir() else path
    if not path.is_file():
        siblings = [p.name for p in Path(folder).parent.glob("*")] if Path(folder).parent.is_dir() else []
        raise UserError(f"calibration: no parameters.yaml at {folder}{nearest(Path(folder).name, siblings)}")
    try:
        document = yaml.safe_load(path.read_text())
        found, fixed, joints = document["parameters"], document["fixed"], document["joints"]
        values = {name: np.array(found[name]["value"], dtype=float) for name in found}
        phi = np.array(fixed["phi"], dtype=float)
        for i, name in enumerate(("phi1", "phi2", "phi3")):
            phi[:, i] = values.get(name, phi[:, i])
        dynamics = Dynamics(
            phi=phi,
            offset=values.get("offset", np.array(fixed["offset"], dtype=float)),
            breakaway=np.stack([values.get(k, fixed[k]) for k in ("breakaway_negative", "breakaway_positive")], -1),
            dq_min=float(fixed["dq_min"]),
            inertia=robot.inertia,
        ).scaled(values.get("inertia_scale", np.array(fixed["inertia_scale"], dtype=float)))
    except (KeyError, TypeError, ValueError, IndexError, yaml.YAMLError) as error:
        seen = " ".join(str(error).split())
        raise UserError(f"calibration: {path} is not a parameters.yaml of r2s ({seen})") from None
    if document["robot"] != robot.name or joints != robot.n:
        raise UserError(
            f"calibration: {path} is of '{document['robot']}' with {joints} joints; this arm is '{robot.name}' with "
            f"{robot.n}"
        )
    return dynamics
