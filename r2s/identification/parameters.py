"""The parameter vector of an identification: blocks, bounds, map to the unit cube, and conversion to dynamics.

A block contains the values of one parameter: a value per joint or link (friction coefficient, offset, inertia), or a
single value for the whole arm (delay, lag, payload). Searches work on the unit cube; positive parameters that span
decades are mapped by their logarithm. Link inertia has two parametrizations: `inertia_scale` is one factor per link
(paper, Table III), and `link_...` are the ten log-Cholesky parameters of a link (link_inertia.py).
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from r2s.errors import UserError, choices, instead_of
from r2s.identification.link_inertia import LINK, PAYLOAD, add_point_mass, inertia_scale, links, log_cholesky
from r2s.physics.dynamics import Dynamics
from r2s.physics.friction import known_families
from r2s.physics.robot import Robot

OTHER_UNITS = {"offset": "Nm", "armature": "kg m^2", "load": "1", "drag_sin": "Nm", "drag_cos": "Nm", "gain": "1"}
OTHER_UNITS |= {name: "1" for name in ("inertia_scale", *LINK)}
OTHER_UNITS |= {"breakaway_positive": "Nm", "breakaway_negative": "Nm", "delay": "s", "lag": "s", "signal_delay": "s"}
OTHER_UNITS |= {name: "kg" if name == "payload_mass" else "m" for name in PAYLOAD}
TIMING = ("delay", "lag", "signal_delay")
# standard deviation of parameters among arms, by unit. Torque-like parameters: per Nm of tau_max. Logarithms: 1
USUAL = {"Nm": 0.02, "Nm s/rad": 0.02, "kg m^2": 0.002, "kg": 0.02, "1": 0.1, "rad/s": 0.03, "m": 0.1, "s": 2e-3}
WHOLE_ARM = (*TIMING, *PAYLOAD)
OF_LINKS = ("inertia_scale", *LINK)
PER_JOINT = ("offset", "armature", "load", "gain")  # blocks that are fields of Dynamics


def units() -> dict[str, str]:
    """Return {parameter: unit} for all parameters, including those of every known friction family."""
    friction = (zip(f.names, f.units, strict=True) for f in known_families())
    return {name: unit for pairs in friction for name, unit in pairs} | OTHER_UNITS


def logarithmic() -> set[str]:
    """Return the parameters whose coordinate on the unit cube is logarithmic; they are positive."""
    return {"inertia_scale"}.union(*(f.logarithmic for f in known_families()))


def torque_like() -> set[str]:
    """Return the joint parameters that grow with an arm's size: parameters in Nm or Nm s/rad, and armature."""
    return {name for name, unit in units().items() if unit.startswith("Nm")} | {"armature"}


def sizes(largest: np.ndarray) -> dict[str, Any]:
    """Return {parameter: scale}: `largest` (n,) Nm for torque-like parameters, max(largest) for the payload mass."""
    return dict.fromkeys(torque_like(), largest) | {PAYLOAD[0]: largest.max()}


@dataclass(frozen=True)
class ParameterSpace:
    """The space of the parameter vector x (P,) that an identification estimates.

    Attributes:
        blocks: parameter names in the order of x; a parameter has n values, or one value for the whole arm.
        n: number of joints.
        lower, upper: (P,) bounds in SI units.
        nominal: dynamics at which a search starts; parameters that are not in x have their nominal value.
        robot: the arm; link inertia parameters are relative to the arm's links.
        breakaway_command: (n, 2) Nm, commands in ramps at which resting joints broke away. A breakaway torque is a
            breakaway command plus the offset; if the command is unknown (NaN or None), the breakaway torque is
            nominal.
        fixed: names of values that the user fixed, with bounds so narrow that no search changes them (stated.py).
    """

    blocks: tuple[str, ...]
    n: int
    lower: np.ndarray
    upper: np.ndarray
    nominal: Dynamics
    robot: Robot
    breakaway_command: np.ndarray | None = None
    fixed: frozenset[str] = frozenset()

    def size(self, name: str) -> int:
        """Return the number of values of a block."""
        return 1 if name in WHOLE_ARM else self.n

    @property
    def names(self) -> list[str]:
        """The P names of the values, such as phi1[3]; the first joint is 1."""
        return [b if b in WHOLE_ARM else f"{b}[{j + 1}]" for b in self.blocks for j in range(self.size(b))]

    @property
    def start(self) -> np.ndarray:
        """(P,) the nominal dynamics as a parameter vector, clipped to the bounds."""
        d = self.nominal
        values = dict(zip(d.family.names, d.phi.T, strict=False)) | {name: getattr(d, name) for name in PER_JOINT}
        values |= {"drag_sin": d.drag[:, 0], "drag_cos": d.drag[:, 1]}
        values |= {"breakaway_negative": d.breakaway[:, 0], "breakaway_positive": d.breakaway[:, 1]}
        values |= {"delay": np.array([d.delay]), "lag": np.array([d.lag])}
        values |= {"signal_delay": np.array([d.signal_delay])}
        values |= {"inertia_scale": inertia_scale(d.inertia, self.robot.inertia)}
        if any(b in LINK for b in self.blocks):
            values |= dict(zip(LINK, log_cholesky(self.robot, d).T, strict=True))
        x = np.concatenate([values.get(b, np.zeros(self.size(b))) for b in self.blocks])
        return np.clip(x, self.lower, self.upper)

    def block(self, x: np.ndarray, name: str) -> np.ndarray:
        """Return the values of a parameter in x (..., P): (..., n), or (..., 1) for a parameter of the whole arm."""
        return x[..., self.where(name)]

    def where(self, name: str) -> np.ndarray:
        """Return the indices of a block in the parameter vector x."""
        at = sum(self.size(b) for b in self.blocks[: self.blocks.index(name)])
        return np.arange(at, at + self.size(name))

    def expand(self, values: Mapping[str, Any], default: Any) -> np.ndarray:
        """Return a vector (P,) with `values`, {block: one value or (n,)}, and with `default` in all other blocks."""
        return np.concatenate([np.broadcast_to(values.get(b, default), self.size(b)) for b in self.blocks])

    @cached_property
    def _log(self) -> np.ndarray:
        return self.expand(dict.fromkeys(logarithmic(), True), False)

    def to_unit(self, x: np.ndarray) -> np.ndarray:
        """Map parameter vectors x (..., P) from SI units into the unit cube."""
        low, high = self._warp(self.lower), self._warp(self.upper)
        return (self._warp(x) - low) / (high - low)

    def from_unit(self, u: np.ndarray) -> np.ndarray:
        """Map points u (..., P) of the unit cube to SI units; coordinates outside [0, 1] are clipped."""
        low, high = self._warp(self.lower), self._warp(self.upper)
        w = low + np.clip(u, 0.0, 1.0) * (high - low)
        return np.where(self._log, np.exp(np.where(self._log, w, 0.0)), w)

    @property
    def width(self) -> np.ndarray:
        """(P,) upper minus lower bound in SI units; for logarithmic coordinates, log(upper) minus log(lower)."""
        return self._warp(self.upper) - self._warp(self.lower)

    @property
    def usual(self) -> np.ndarray:
        """(P,) standard deviation of each value among arms, in the units of `width`; inf for units not in USUAL."""
        unit, size = units(), sizes(self.robot.tau_max)
        usual = {b: USUAL.get(unit[b], np.inf) * size.get(b, 1.0) for b in self.blocks}
        return np.where(self._log, 1.0, self.expand(usual, np.inf))

    def _warp(self, x: np.ndarray) -> np.ndarray:
        return np.where(self._log, np.log(np.where(self._log, x, 1.0)), x)

    def dynamics(self, x: np.ndarray) -> Dynamics:
        """Return the dynamics that parameter vectors x (..., P) describe."""
        d, blocks = self.nominal, set(self.blocks)

        def value(name: str, nominal: np.ndarray) -> np.ndarray:
            return self.block(x, name) if name in blocks else np.broadcast_to(nominal, (*x.shape[:-1], self.n))

        columns = [d.phi[..., k] for k in range(d.phi.shape[-1])]
        count = max([0, *(k + 1 for k, name in enumerate(d.family.names) if name in blocks)])
        columns += [np.zeros(self.n)] * (count - len(columns))  # optional friction parameters start at 0
        phi = [value(name, column) for name, column in zip(d.family.names, columns, strict=False)]
        drag = [value(name, d.drag[:, i]) for i, name in enumerate(("drag_sin", "drag_cos"))]
        own: dict[str, Any] = {name: value(name, getattr(d, name)) for name in PER_JOINT}
        edges = d.breakaway
        if self.breakaway_command is not None:
            edges = self.breakaway_command + own["offset"][..., None]
            edges = np.where(np.isnan(edges), d.breakaway, edges)
            edges = np.stack([np.minimum(edges[..., 0], 0.0), np.maximum(edges[..., 1], 0.0)], -1)
        pair = [value(f"breakaway_{side}", edges[..., i]) for i, side in enumerate(("negative", "positive"))]
        own |= {"phi": np.stack(phi, -1), "drag": np.stack(drag, -1), "breakaway": np.stack(pair, -1)}
        own |= {name: self.block(x, name)[..., 0] for name in TIMING if name in blocks}
        return self._with_links(replace(d, **own), x)

    def _with_links(self, d: Dynamics, x: np.ndarray) -> Dynamics:
        """Return the dynamics `d` with the links and the payload that parameter vectors x (..., P) describe."""
        blocks, lead = set(self.blocks), x.shape[:-1]
        if "inertia_scale" in blocks:
            d = replace(d, inertia=self.robot.inertia * self.block(x, "inertia_scale")[..., None, None])
        if blocks & set(LINK):
            nominal = np.zeros((len(LINK), self.n))
            if set(LINK) - blocks:
                nominal = log_cholesky(self.robot, self.nominal).T
            theta = [
                self.block(x, name) if name in blocks else np.broadcast_to(own, (*lead, self.n))
                for name, own in zip(LINK, nominal, strict=True)
            ]
            mass, com, inertia = links(self.robot, np.stack(theta, -1))
            d = replace(d, mass=mass, com=com, inertia=inertia)
        if "payload_mass" in blocks:
            place = [self.block(x, b)[..., 0] if b in blocks else np.zeros(lead) for b in PAYLOAD[1:]]
            payload = self.block(x, "payload_mass")[..., 0]
            mass, com, inertia = add_point_mass(d.mass, d.com, d.inertia, payload, np.stack(place, -1))
            d = replace(d, mass=mass, com=com, inertia=inertia)
        return d


def check_parameters(where: str, names: Iterable[str]) -> None:
    """Raise UserError if a name is not a parameter."""
    known = units()
    for name in names:
        if name not in known:
            raise UserError(f"{where}: unknown parameter '{name}'; {instead_of(name, known)}")


def check_bounds(where: str, bounds: Mapping[str, Sequence[ArrayLike]]) -> None:
    """Raise UserError for an unknown parameter, for low >= high, or for low <= 0 of a logarithmic parameter."""
    check_parameters(where, bounds)
    for name, pair in bounds.items():
        words = isinstance(pair, str) or any(isinstance(end, str) for end in pair)
        wrong = words or len(pair) != 2 or not np.all(np.less(pair[0], pair[1]))
        if wrong or (name in logarithmic() and np.any(np.less_equal(pair[0], 0))):
            raise UserError(f"{where}.{name}: {list(pair)} is not [low, high] with low < high (low > 0 for {name})")


def parameter_space(robot: Robot, nominal: Dynamics, bounds: Mapping[str, Sequence[ArrayLike]]) -> ParameterSpace:
    """Return the space of the parameters in `bounds`, {"phi1": [low, high], ...}; a bound is a number or (n,).

    Raises:
        UserError: `bounds` is empty, has low >= high, names both parametrizations of inertia, or names a parameter
            that is unknown or of a different friction family.
    """
    family = nominal.family
    if clash := [name for name in family.names if name in OTHER_UNITS]:
        raise UserError(f"friction.family: {choices(clash)} of '{family.name}' is taken; give it another name")
    if not bounds:
        raise UserError(f"bounds: no parameter is named; allowed: {choices(units())}")
    check_bounds("bounds", bounds)
    others = {k for f in known_families() for k in f.names} - set(family.names)
    if wrong := [name for name in bounds if name in others]:
        raise UserError(f"bounds.{wrong[0]}: friction family '{family.name}' has {choices(family.names)}")
    if "inertia_scale" in bounds and set(bounds) & set(LINK):
        raise UserError("bounds: inertia_scale and link_... describe the same tensors: name one of the two")
    space = ParameterSpace(tuple(bounds), robot.n, np.zeros(0), np.zeros(0), nominal, robot)
    ends = ({k: np.asarray(pair[i], dtype=float) for k, pair in bounds.items()} for i in (0, 1))
    lower, upper = (space.expand(end, 0.0) for end in ends)
    return replace(space, lower=lower, upper=upper)


@dataclass(frozen=True)
class ParameterEstimate:
    """Estimated parameters in SI units; each array but `samples` is (P,).

    Attributes:
        x: estimated values. identifiable: whether the data determine each value.
        low, high: ends of 95 % intervals of the values. For measured and motor torque, the intervals also use draws
            from a second model (`draw_full_model`); `samples` excludes these draws.
        samples: (S, P) random draws from the posterior.
    """

    x: np.ndarray
    low: np.ndarray
    high: np.ndarray
    identifiable: np.ndarray
    samples: np.ndarray
