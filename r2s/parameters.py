"""The parameters that identification searches, as one vector, and the file that carries them to the other stages.

A vector is made of blocks: one value per joint or link (friction of one family, offsets, inertia), or one for the
whole arm (delay, lag). A search sees only the unit cube; where a value spans decades its coordinate is logarithmic.

Inertia has two parametrisations. `inertia_scale`, one per link, is the paper's (Table III NEW is an exact multiple of
OLD). The full one is ten numbers per link, the log-Cholesky parameters of Rucker and Wensing (IEEE RA-L 7(2), 2022)
of the pseudo-inertia relative to the nominal one: J = U0 V V^T U0^T, V = exp(alpha) [[e^d1, s12, s13, t1],
[0, e^d2, s23, t2], [0, 0, e^d3, t3], [0, 0, 0, 1]]. All zero is the nominal link, and every value is physical.
"""

import zipfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from r2s.errors import UserError, choices, nearest
from r2s.friction import FAMILIES, SIGMOID
from r2s.friction import family as friction_family
from r2s.robot import Robot
from r2s.simulator import Dynamics

CHOLESKY = ("alpha", "d1", "d2", "d3", "s12", "s13", "s23", "t1", "t2", "t3")
LINK = tuple(f"link_{name}" for name in CHOLESKY)
UNITS = {name: unit for f in FAMILIES for name, unit in zip(f.names, f.units, strict=True)}
UNITS |= {"offset": "Nm", "load": "1", "drag_sin": "Nm", "drag_cos": "Nm", "gain": "1", "inertia_scale": "1"}
UNITS |= {name: "1" for name in LINK}
UNITS |= {"breakaway_positive": "Nm", "breakaway_negative": "Nm", "delay": "s", "lag": "s"}
LOGARITHMIC = ("phi1", "phi2", "coulomb", "stribeck_velocity", "presliding", "inertia_scale")
WHOLE_ARM = ("delay", "lag")
OF_LINKS = ("inertia_scale", *LINK)


@dataclass(frozen=True)
class ParameterSpace:
    """The searched vector x of P values.

    Attributes:
        blocks: names in order; each is n values long, or one where it is of the whole arm.
        n: joints.
        lower, upper: (P,) bounds in SI units.
        nominal: the dynamics that fixed blocks keep and that a search starts from.
        robot: the arm; its links are what the inertia blocks are relative to.
        break_command: (n, 2) Nm, the commands at which resting joints were seen to let go. With them the dead zone's
            edges move along with the offset (edge = command + offset). None: edges are nominal, or blocks.
    """

    blocks: tuple[str, ...]
    n: int
    lower: np.ndarray
    upper: np.ndarray
    nominal: Dynamics
    robot: Robot
    break_command: np.ndarray | None = None

    def size(self, name: str) -> int:
        """Return how many values a block has."""
        return 1 if name in WHOLE_ARM else self.n

    @property
    def names(self) -> list[str]:
        """P names such as phi1[3] (joints count from 1)."""
        return [b if b in WHOLE_ARM else f"{b}[{j + 1}]" for b in self.blocks for j in range(self.size(b))]

    @property
    def start(self) -> np.ndarray:
        """(P,) the nominal dynamics as a vector, clipped into the bounds."""
        d = self.nominal
        values = dict(zip(d.family.names, d.phi.T, strict=False))
        values |= {"offset": d.offset} | {k: v for k in ("load", "gain") if (v := getattr(d, k)) is not None}
        drag = np.zeros((self.n, 2)) if d.drag is None else d.drag
        values |= {"drag_sin": drag[:, 0], "drag_cos": drag[:, 1]}
        values |= {"breakaway_negative": d.breakaway[:, 0], "breakaway_positive": d.breakaway[:, 1]}
        values |= {"delay": np.array([d.delay]), "lag": np.array([d.lag])}
        values |= {"inertia_scale": inertia_scale(d.inertia, self.robot.inertia)}
        if any(b in LINK for b in self.blocks):
            values |= dict(zip(LINK, log_cholesky(self.robot, d).T, strict=True))
        zero = np.zeros(self.n)
        return np.clip(np.concatenate([values.get(b, zero) for b in self.blocks]), self.lower, self.upper)

    def block(self, x: np.ndarray, name: str) -> np.ndarray:
        """Return the (..., n) values of one block of x (..., P); (..., 1) where it is of the whole arm."""
        return x[..., self.where(name)]

    def where(self, name: str) -> np.ndarray:
        """Return the indices of a block in x."""
        at = sum(self.size(b) for b in self.blocks[: self.blocks.index(name)])
        return np.arange(at, at + self.size(name))

    def spread_out(self, values: Mapping[str, Any], default: Any) -> np.ndarray:
        """Return (P,): one value per block, repeated over it; `default` for blocks without one."""
        return np.concatenate([np.full(self.size(b), values.get(b, default)) for b in self.blocks])

    def of_joints(self, joints: np.ndarray) -> np.ndarray:
        """Return (P,) bool: friction and offset of the joints (n,) bool; inertia and delay belong to no joint."""
        none = np.zeros(1, dtype=bool)
        return np.concatenate([none if b in WHOLE_ARM else joints & (b not in OF_LINKS) for b in self.blocks])

    @property
    def _log(self) -> np.ndarray:
        return self.spread_out({b: True for b in LOGARITHMIC}, False)

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
        d, blocks = self.nominal, set(self.blocks)
        lead = x.shape[:-1]

        def value(name: str, nominal: np.ndarray) -> np.ndarray:
            found = self.block(x, name) if name in blocks else np.broadcast_to(nominal, (*lead, self.n))
            return np.asarray(found)

        zero = np.zeros(self.n)
        columns = [d.phi[..., k] for k in range(d.phi.shape[-1])]
        columns += [zero] * (max([0, *(k + 1 for k, f in enumerate(d.family.names) if f in blocks)]) - len(columns))
        phi = [value(name, column) for name, column in zip(d.family.names, columns, strict=False)]
        out = replace(d, phi=np.stack(phi, -1), offset=value("offset", d.offset))
        edges = d.breakaway
        if self.break_command is not None:
            edges = self.break_command + out.offset[..., None]
            edges = np.stack([np.minimum(edges[..., 0], 0.0), np.maximum(edges[..., 1], 0.0)], -1)
        pair = [value(f"breakaway_{side}", edges[..., i]) for i, side in enumerate(("negative", "positive"))]
        out = replace(out, breakaway=np.stack(pair, -1))
        if "load" in blocks:
            out = replace(out, load=self.block(x, "load"))
        if "gain" in blocks:
            out = replace(out, gain=self.block(x, "gain"))
        if blocks & {"drag_sin", "drag_cos"}:
            drag = np.zeros((self.n, 2)) if d.drag is None else d.drag
            out = replace(out, drag=np.stack([value("drag_sin", drag[:, 0]), value("drag_cos", drag[:, 1])], -1))
        if "delay" in blocks:
            out = replace(out, delay=self.block(x, "delay")[..., 0])
        if "lag" in blocks:
            out = replace(out, lag=self.block(x, "lag")[..., 0])
        if "inertia_scale" in blocks:
            return replace(out, inertia=self.robot.inertia * self.block(x, "inertia_scale")[..., None, None])
        if blocks & set(LINK):
            start = log_cholesky(self.robot, d).T if set(LINK) - blocks else np.zeros((len(LINK), self.n))
            theta = np.stack([value(name, own) for name, own in zip(LINK, start, strict=True)], -1)
            mass, com, inertia = links(self.robot, theta)
            return replace(out, mass=mass, com=com, inertia=inertia)
        return out


def pseudo_inertia(mass: np.ndarray, com: np.ndarray, inertia: np.ndarray) -> np.ndarray:
    """Return (..., 4, 4) [[Sigma, h], [h^T, m]] about the link's origin (Wensing, Kim and Slotine, RA-L 3(1), 2018).

    Sigma is the second moment of the mass; positive definite is the same as a tensor of positive moments that keep
    the triangle inequality. A tensor that does not is given the nearest flat one and a little thickness.
    """
    second = 0.5 * np.trace(inertia, axis1=-2, axis2=-1)[..., None, None] * np.eye(3) - inertia
    moments, axes = np.linalg.eigh(second)
    moments = np.maximum(moments, 1e-6 * moments.max(-1, keepdims=True))
    second = axes * moments[..., None, :] @ np.swapaxes(axes, -1, -2)
    out = np.empty((*mass.shape, 4, 4))
    h = mass[..., None] * com
    out[..., :3, :3] = second + mass[..., None, None] * com[..., :, None] * com[..., None, :]
    out[..., :3, 3] = out[..., 3, :3] = h
    out[..., 3, 3] = mass
    return out


def _upper(j: np.ndarray) -> np.ndarray:
    """Return the upper triangular U (..., 4, 4) with U U^T = j."""
    return np.linalg.cholesky(j[..., ::-1, ::-1])[..., ::-1, ::-1]


def links(robot: Robot, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return mass (..., n) kg, com (..., n, 3) m and tensor about it (..., n, 3, 3) for theta (..., n, 10)."""
    v = np.zeros((*theta.shape[:-1], 4, 4))
    for i in range(3):
        v[..., i, i] = np.exp(theta[..., 1 + i])
    v[..., 0, 1], v[..., 0, 2], v[..., 1, 2] = theta[..., 4], theta[..., 5], theta[..., 6]
    v[..., :3, 3], v[..., 3, 3] = theta[..., 7:], 1.0
    u = _upper(pseudo_inertia(robot.mass, robot.com, robot.inertia)) @ (np.exp(theta[..., :1])[..., None] * v)
    j = u @ np.swapaxes(u, -1, -2)
    mass = j[..., 3, 3]
    com = j[..., :3, 3] / mass[..., None]
    second = j[..., :3, :3] - mass[..., None, None] * com[..., :, None] * com[..., None, :]
    return mass, com, np.trace(second, axis1=-2, axis2=-1)[..., None, None] * np.eye(3) - second


def log_cholesky(robot: Robot, dynamics: Dynamics) -> np.ndarray:
    """Return theta (n, 10) of the links of `dynamics`: the inverse of `links`."""
    mass = robot.mass if dynamics.mass is None else dynamics.mass
    com = robot.com if dynamics.com is None else dynamics.com
    base = _upper(pseudo_inertia(robot.mass, robot.com, robot.inertia))
    v = np.linalg.solve(base, _upper(pseudo_inertia(mass, com, dynamics.inertia)))
    scale, v = v[..., 3, 3], v / v[..., 3:, 3:]
    diagonal = [np.log(v[..., i, i]) for i in range(3)]
    rest = [v[..., 0, 1], v[..., 0, 2], v[..., 1, 2], v[..., 0, 3], v[..., 1, 3], v[..., 2, 3]]
    return np.stack([np.log(scale), *diagonal, *rest], -1)


def inertia_scale(inertia: np.ndarray, nominal: np.ndarray) -> np.ndarray:
    """Return (..., n): the scale of tensors (..., n, 3, 3) over the nominal ones, by their traces."""
    return np.trace(inertia, axis1=-2, axis2=-1) / np.trace(nominal, axis1=-2, axis2=-1)


def check_parameters(where: str, names: Iterable[str]) -> None:
    """Raise UserError if one of the names is no parameter."""
    for name in names:
        if name not in UNITS:
            raise UserError(f"{where}: unknown parameter '{name}'; allowed: {choices(UNITS)}{nearest(name, UNITS)}")


def parameter_space(
    robot: Robot,
    nominal: Dynamics,
    bounds: Mapping[str, Sequence[float]],
    break_command: np.ndarray | None = None,
) -> ParameterSpace:
    """Make the space from {"phi1": [low, high], ...}; a block that is not named is not searched.

    Raises:
        UserError: no block at all, an unknown one, one of another friction family or both kinds of inertia, or bounds
            that are not two rising numbers (positive where logarithmic).
    """
    if not bounds:
        raise UserError(f"bounds: no parameter is named; allowed: {choices(UNITS)}")
    check_parameters("bounds", bounds)
    for name, pair in bounds.items():
        if len(pair) != 2 or not pair[0] < pair[1] or (name in LOGARITHMIC and pair[0] <= 0):
            raise UserError(f"bounds.{name}: {list(pair)} is not [low, high] with low < high (low > 0 for {name})")
        others = {k for f in FAMILIES for k in f.names} - set(nominal.family.names)
        if name in others:
            raise UserError(
                f"bounds.{name}: friction family '{nominal.family.name}' has {choices(nominal.family.names)}"
            )
    if "inertia_scale" in bounds and set(bounds) & set(LINK):
        raise UserError("bounds: inertia_scale and link_... describe the same tensors: name one of the two")
    space = ParameterSpace(tuple(bounds), robot.n, np.zeros(0), np.zeros(0), nominal, robot, break_command)
    sides = [space.spread_out({k: float(pair[i]) for k, pair in bounds.items()}, 0.0) for i in (0, 1)]
    return replace(space, lower=sides[0], upper=sides[1])


def nominal_dynamics(
    robot: Robot,
    *,
    family: str = "sigmoid",
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

    A family other than the sigmoid gets the sigmoid's level at 1 rad/s; auto is the sigmoid, until data choose.

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
    named = SIGMOID if family == "auto" else friction_family(family)
    phi = np.concatenate([phi, per_joint("friction.phi3", phi3)[:, None]], -1)
    return Dynamics(
        phi=named.like(SIGMOID, phi),
        offset=per_joint("friction.offset", offset),
        breakaway=np.stack([low, high], -1),
        dq_min=float(dq_min),
        inertia=robot.inertia * scale[:, None, None],
        family=named,
    )


def of_family(dynamics: Dynamics, name: str) -> Dynamics:
    """Return the dynamics with friction of another family, of the same level at 1 rad/s."""
    named = friction_family(name)
    return replace(dynamics, family=named, phi=named.like(dynamics.family, dynamics.phi))


@dataclass(frozen=True)
class Estimate:
    """What was found of a space: every array (P,) but `samples` (S, P), draws of the joint distribution.

    Attributes:
        x: values, SI units. low, high: 95 % interval. identifiable: whether the data could tell.
    """

    x: np.ndarray
    low: np.ndarray
    high: np.ndarray
    identifiable: np.ndarray
    samples: np.ndarray


def save_parameters(
    path: Path,
    space: ParameterSpace,
    found: Estimate,
    source: Mapping[str, Any],
    note: Mapping[str, Any] | None = None,
) -> None:
    """Write parameters.yaml: value, unit, nominal, bounds, 95 % interval and whether the data could tell, per joint.

    The draws of the joint distribution go to posterior.npz beside it: what dr=identified draws from.

    Args:
        path: the file.
        space: what was searched.
        found: the result.
        source: where it came from (recording, search, run), kept as it is. note: further entries, kept as they are.
    """
    robot, fixed = space.robot, space.nominal

    def numbers(values: np.ndarray) -> Any:
        return float(f"{values[0]:.6g}") if len(values) == 1 else [float(f"{v:.6g}") for v in values]

    document: dict[str, Any] = {"robot": robot.name, "joints": robot.n, "source": dict(source)}
    document["friction_family"] = fixed.family.name
    document["parameters"] = {}
    for name in space.blocks:
        entry: dict[str, Any] = {"unit": UNITS[name]}
        rows = (found.x, space.start, space.lower, space.upper, found.low, found.high)
        keys = ("value", "nominal", "lower_bound", "upper_bound", "interval95_low", "interval95_high")
        entry |= {key: numbers(space.block(row, name)) for key, row in zip(keys, rows, strict=True)}
        seen = space.block(found.identifiable, name).tolist()
        document["parameters"][name] = entry | {"identifiable": seen[0] if name in WHOLE_ARM else seen}
    document["fixed"] = {
        "phi": fixed.phi.tolist(),
        "offset": fixed.offset.tolist(),
        "breakaway_negative": fixed.breakaway[:, 0].tolist(),
        "breakaway_positive": fixed.breakaway[:, 1].tolist(),
        "dq_min": fixed.dq_min,
        "inertia": fixed.inertia.tolist(),
    }
    document["fixed"] |= {k: getattr(fixed, k).tolist() for k in OPTIONAL if getattr(fixed, k) is not None}
    document["fixed"] |= {k: float(getattr(fixed, k)) for k in WHOLE_ARM}
    d = space.dynamics(found.x)
    if d.mass is not None and d.com is not None:  # for the reader: what loads are the parameters
        rounded = (np.round(a, 6).tolist() for a in (d.mass, d.com, d.inertia))
        document["links"] = dict(zip(("mass_kg", "com_m", "inertia_about_com_kg_m2"), rounded, strict=True))
    document |= dict(note or {})
    path.write_text(yaml.safe_dump(document, sort_keys=False, default_flow_style=None, width=110))
    np.savez_compressed(path.with_name("posterior.npz"), names=np.array(space.names), samples=found.samples)


FIXED = ("phi", "offset", "inertia")
OPTIONAL = ("mass", "com", "load", "drag", "gain")


def load_parameters(folder: str | Path, robot: Robot) -> tuple[ParameterSpace, np.ndarray]:
    """Return the searched space and the values found of `calibration=RUN_FOLDER` (or of a parameters.yaml itself).

    `space.dynamics(x)` is the identified arm.

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
        named, joints = document["robot"], document["joints"]
        if (named, joints) == (robot.name, robot.n):
            return _parse(document, robot)
    except (AttributeError, KeyError, TypeError, ValueError, IndexError, yaml.YAMLError) as error:
        seen = " ".join(str(error).split())
        raise UserError(f"calibration: {path} is not a parameters.yaml of r2s ({seen})") from None
    raise UserError(
        f"calibration: {path} is of '{named}' with {joints} joints; this arm is '{robot.name}' with {robot.n}"
    )


def _parse(document: dict[str, Any], robot: Robot) -> tuple[ParameterSpace, np.ndarray]:
    """Return what `load_parameters` does; raises whatever a document that is none of ours leads to."""
    found, fixed = document["parameters"], document["fixed"]

    def numbers(name: str, value: Any, count: int) -> np.ndarray:
        array = np.atleast_1d(np.array(value, dtype=float))
        if len(array) != count or not np.isfinite(array).all():
            raise ValueError(f"{name}: not {count} finite value{'s' * (count > 1)}")
        return array

    rows = [k for k in (*FIXED, *OPTIONAL) if k in FIXED or k in fixed]
    own = {k: numbers(k, fixed[k], robot.n) for k in rows}
    edges = [numbers(k, fixed[k], robot.n) for k in ("breakaway_negative", "breakaway_positive")]
    nominal = Dynamics(
        **own,  # type: ignore[arg-type]
        breakaway=np.stack(edges, -1),
        dq_min=float(fixed["dq_min"]),
        family=friction_family(document["friction_family"]),
        delay=float(fixed["delay"]),
        lag=float(fixed["lag"]),
    )
    everything = {k: [1e-12 if k in LOGARITHMIC else -np.inf, np.inf] for k in found}
    space = parameter_space(robot, nominal, everything)
    return space, np.concatenate([numbers(k, found[k]["value"], space.size(k)) for k in space.blocks])


def load_posterior(folder: str | Path, space: ParameterSpace) -> np.ndarray:
    """Return the draws (S, P) of the joint distribution that `save_parameters` wrote beside `space`'s values.

    Raises:
        UserError: there are none, they are of other parameters, or the file does not hold them.
    """
    path = Path(folder)
    path = (path if path.is_dir() else path.parent) / "posterior.npz"
    if not path.is_file():
        raise UserError(
            f"dr=identified: no posterior.npz at {path.parent}; calibration= must be a run of stage=identify"
        )
    try:
        with np.load(path) as file:
            names, samples = file["names"].tolist(), file["samples"]
        if samples.shape != (len(samples), len(names)):
            raise ValueError(f"samples of shape {samples.shape} for {len(names)} names")
    except (KeyError, TypeError, ValueError, OSError, EOFError, zipfile.BadZipFile) as error:
        seen = " ".join(str(error).split())
        raise UserError(f"dr=identified: {path} is not a posterior.npz of r2s ({seen})") from None
    if names != space.names:
        raise UserError(f"dr=identified: {path} has other parameters than the parameters.yaml beside it")
    return samples
