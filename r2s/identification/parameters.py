"""The parameters that identification searches, as one vector, and the file that carries them to the other stages.

A vector is made of blocks: one value per joint or link (friction of one family, offsets, inertia), or one for the
whole arm (delay, lag, payload). A search sees only the unit cube; where a value spans decades its coordinate is
logarithmic.

Inertia has two parametrisations. `inertia_scale`, one per link, is the paper's (Table III NEW is an exact multiple of
OLD). The full one is ten numbers per link, the log-Cholesky parameters of Rucker and Wensing (IEEE RA-L 7(2), 2022)
of the pseudo-inertia relative to the nominal one: J = U0 V V^T U0^T, V = exp(alpha) [[e^d1, s12, s13, t1],
[0, e^d2, s23, t2], [0, 0, e^d3, t3], [0, 0, 0, 1]]. All zero is the nominal link, and every value is physical.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from r2s.errors import UserError, choices, nearest
from r2s.identification.link_inertia import LINK, PAYLOAD, carrying, inertia_scale, links, log_cholesky
from r2s.physics.dynamics import Dynamics
from r2s.physics.friction import known_families
from r2s.physics.robot import Robot

OTHER_UNITS = {"offset": "Nm", "armature": "kg m^2", "load": "1", "drag_sin": "Nm", "drag_cos": "Nm", "gain": "1"}
OTHER_UNITS |= {name: "1" for name in ("inertia_scale", *LINK)}
OTHER_UNITS |= {"breakaway_positive": "Nm", "breakaway_negative": "Nm", "delay": "s", "lag": "s"}
OTHER_UNITS |= {name: "kg" if name == "payload_mass" else "m" for name in PAYLOAD}
TIMING = ("delay", "lag")
WHOLE_ARM = (*TIMING, *PAYLOAD)
OF_LINKS = ("inertia_scale", *LINK)


def units() -> dict[str, str]:
    """Return {parameter: unit} of everything that may be searched, whichever friction family is known."""
    friction = (zip(f.names, f.units, strict=True) for f in known_families())
    return {name: unit for pairs in friction for name, unit in pairs} | OTHER_UNITS


def logarithmic() -> set[str]:
    """Return the parameters that are searched by their logarithm: they are positive."""
    return {"inertia_scale"}.union(*(f.logarithmic for f in known_families()))


def of_torque() -> set[str]:
    """Return the parameters that grow with an arm's torque: those in Nm, Nm s/rad, and kg m^2 of rotors."""
    return {name for name, unit in units().items() if unit.startswith("Nm")} | {"armature"}


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
            edges move along with the offset (edge = command + offset); NaN where none was seen: there the edge is
            nominal. None: edges are nominal, or blocks.
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
        values |= {"offset": d.offset, "armature": d.armature, "load": d.load, "gain": d.gain}
        values |= {"drag_sin": d.drag[:, 0], "drag_cos": d.drag[:, 1]}
        values |= {"breakaway_negative": d.breakaway[:, 0], "breakaway_positive": d.breakaway[:, 1]}
        values |= {"delay": np.array([d.delay]), "lag": np.array([d.lag])}
        values |= {"inertia_scale": inertia_scale(d.inertia, self.robot.inertia)}
        if any(b in LINK for b in self.blocks):
            values |= dict(zip(LINK, log_cholesky(self.robot, d).T, strict=True))
        parts = [values.get(b, np.zeros(self.size(b))) for b in self.blocks]
        return np.clip(np.concatenate(parts), self.lower, self.upper)

    def block(self, x: np.ndarray, name: str) -> np.ndarray:
        """Return the (..., n) values of one block of x (..., P); (..., 1) where it is of the whole arm."""
        return x[..., self.where(name)]

    def where(self, name: str) -> np.ndarray:
        """Return the indices of a block in x."""
        at = sum(self.size(b) for b in self.blocks[: self.blocks.index(name)])
        return np.arange(at, at + self.size(name))

    def spread_out(self, values: Mapping[str, Any], default: Any) -> np.ndarray:
        """Return (P,): of each block its value, or its values per joint (n,); `default` for blocks without one."""
        return np.concatenate([np.broadcast_to(values.get(b, default), self.size(b)) for b in self.blocks])

    def of_joints(self, joints: np.ndarray) -> np.ndarray:
        """Return (P,) bool: friction, offset and rotor of the joints (n,) bool; links and delay are of no joint."""
        none = np.zeros(1, dtype=bool)
        return np.concatenate([none if b in WHOLE_ARM else joints & (b not in OF_LINKS) for b in self.blocks])

    @property
    def _log(self) -> np.ndarray:
        return self.spread_out(dict.fromkeys(logarithmic(), True), False)

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
        drag = [value(name, d.drag[:, i]) for i, name in enumerate(("drag_sin", "drag_cos"))]
        out = replace(d, phi=np.stack(phi, -1), drag=np.stack(drag, -1))
        out = replace(out, offset=value("offset", d.offset), armature=value("armature", d.armature))
        out = replace(out, load=value("load", d.load), gain=value("gain", d.gain))
        edges = d.breakaway
        if self.break_command is not None:
            edges = self.break_command + out.offset[..., None]
            edges = np.where(np.isnan(edges), d.breakaway, edges)
            edges = np.stack([np.minimum(edges[..., 0], 0.0), np.maximum(edges[..., 1], 0.0)], -1)
        pair = [value(f"breakaway_{side}", edges[..., i]) for i, side in enumerate(("negative", "positive"))]
        out = replace(out, breakaway=np.stack(pair, -1))
        if "delay" in blocks:
            out = replace(out, delay=self.block(x, "delay")[..., 0])
        if "lag" in blocks:
            out = replace(out, lag=self.block(x, "lag")[..., 0])
        if "inertia_scale" in blocks:
            out = replace(out, inertia=self.robot.inertia * self.block(x, "inertia_scale")[..., None, None])
        if blocks & set(LINK):
            start = log_cholesky(self.robot, d).T if set(LINK) - blocks else np.zeros((len(LINK), self.n))
            theta = np.stack([value(name, own) for name, own in zip(LINK, start, strict=True)], -1)
            mass, com, inertia = links(self.robot, theta)
            out = replace(out, mass=mass, com=com, inertia=inertia)
        if "payload_mass" in blocks:
            place = [self.block(x, b)[..., 0] if b in blocks else np.zeros(lead) for b in PAYLOAD[1:]]
            payload = self.block(x, "payload_mass")[..., 0]
            mass, com, inertia = carrying(out.mass, out.com, out.inertia, payload, np.stack(place, -1))
            out = replace(out, mass=mass, com=com, inertia=inertia)
        return out


def check_parameters(where: str, names: Iterable[str]) -> None:
    """Raise UserError if one of the names is no parameter."""
    known = units()
    for name in names:
        if name not in known:
            raise UserError(f"{where}: unknown parameter '{name}'; allowed: {choices(known)}{nearest(name, known)}")


def check_bounds(where: str, bounds: Mapping[str, Sequence[ArrayLike]]) -> None:
    """Raise UserError where bounds are not two rising numbers (positive where the scale is logarithmic)."""
    for name, pair in bounds.items():
        words = isinstance(pair, str) or any(isinstance(end, str) for end in pair)
        wrong = words or len(pair) != 2 or not np.all(np.less(pair[0], pair[1]))
        if wrong or (name in logarithmic() and np.any(np.less_equal(pair[0], 0))):
            raise UserError(f"{where}.{name}: {list(pair)} is not [low, high] with low < high (low > 0 for {name})")


def parameter_space(
    robot: Robot,
    nominal: Dynamics,
    bounds: Mapping[str, Sequence[ArrayLike]],
    break_command: np.ndarray | None = None,
) -> ParameterSpace:
    """Make the space from {"phi1": [low, high], ...}; a block that is not named is not searched.

    An end is one number, or one per joint (n,).

    Raises:
        UserError: no block at all, an unknown one, one of another friction family or both kinds of inertia, or bounds
            that are not two rising numbers (positive where logarithmic).
    """
    if clash := [name for name in nominal.family.names if name in OTHER_UNITS]:
        raise UserError(
            f"friction.family: {choices(clash)} of '{nominal.family.name}' is taken; give it another name"
        )
    if not bounds:
        raise UserError(f"bounds: no parameter is named; allowed: {choices(units())}")
    check_parameters("bounds", bounds)
    check_bounds("bounds", bounds)
    for name in bounds:
        others = {k for f in known_families() for k in f.names} - set(nominal.family.names)
        if name in others:
            raise UserError(
                f"bounds.{name}: friction family '{nominal.family.name}' has {choices(nominal.family.names)}"
            )
    if "inertia_scale" in bounds and set(bounds) & set(LINK):
        raise UserError("bounds: inertia_scale and link_... describe the same tensors: name one of the two")
    space = ParameterSpace(tuple(bounds), robot.n, np.zeros(0), np.zeros(0), nominal, robot, break_command)
    sides = [
        space.spread_out({k: np.asarray(pair[i], dtype=float) for k, pair in bounds.items()}, 0.0) for i in (0, 1)
    ]
    return replace(space, lower=sides[0], upper=sides[1])


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
