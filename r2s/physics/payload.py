"""What an arm has in its hand: mass, centre and tensor, when it is put on and taken off, and what the arm was told.

A payload is rigid and fixed to the last link: arm and payload are one body. So a link with another mass, centre and
tensor is exact, in every engine; a force that stood for it would need the acceleration that it causes.

The hand's frame is that of `robot.ee_site`, on a Panda its flange: libfranka's setLoad has the same frame there.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from r2s.errors import UserError, check_number, choices, nearest
from r2s.physics.description import Bodies, rotation
from r2s.physics.dynamics import Dynamics
from r2s.physics.robot import Robot

Links = tuple[np.ndarray, np.ndarray, np.ndarray]  # masses (..., n) kg, centres (..., n, 3) m, tensors (..., n, 3, 3)
MOST_KG, FARTHEST_M = 1.5, 0.075
MOST_TENSOR = 0.05  # kg m^2: a rod of 1.5 kg and 0.6 m
WATER = 1000.0  # kg/m^3


@dataclass(frozen=True)
class Payload:
    """A rigid body in the hand; mass, centre and inertia may have any leading batch shape.

    Attributes:
        mass: (...) kg. centre: (..., 3) m, in the hand's frame.
        inertia: (..., 3, 3) kg m^2 about its centre, axes of the hand.
        on_s, off_s: s of a motion's clock, (...): it is there from on_s until off_s.
    """

    mass: np.ndarray
    centre: np.ndarray
    inertia: np.ndarray
    on_s: np.ndarray | float = 0.0
    off_s: np.ndarray | float = np.inf

    def there(self, t: np.ndarray | float) -> Any:
        """Return (...), whether it is in the hand at t s."""
        return (self.on_s <= t) & (t < self.off_s)


def payload_of(value: Any, name: str = "arm.payload") -> Payload | None:
    """Return the payload that a setting describes: a number of kg, or a mapping; None of 0 kg.

    A number is a point mass at the hand. A mapping has `mass`, and may have `centre` (3,) m, `inertia` (3 principal
    moments or xx, yy, zz, xy, xz, yz, kg m^2 about the centre; without it that of a ball of water), `on_s`, `off_s`.

    Raises:
        UserError: a mass below 0 or above 1.5 kg, a centre farther than 7.5 cm from the hand, a tensor that no body
            has, or times that are none; messages begin with `name`.
    """
    if value is None:
        return None
    if not isinstance(value, Mapping):
        check_number(name, value, f"[0, {MOST_KG}]")
        return Payload(np.array(float(value)), np.zeros(3), np.zeros((3, 3))) if value else None
    allowed = ("mass", "centre", "inertia", "on_s", "off_s")
    for key in value:
        if key not in allowed:
            near = nearest(str(key), allowed)
            raise UserError(f"{name}.{key}: a payload has no '{key}'; allowed: {choices(allowed)}{near}")
    if "mass" not in value:
        raise UserError(f"{name}: it has no mass; a payload is a number of kg or {{mass: ..., centre: [...], ...}}")
    check_number(f"{name}.mass", value["mass"], f"[0, {MOST_KG}]")
    mass = float(value["mass"])
    centre = _numbers(f"{name}.centre", value.get("centre"), (3,), np.zeros(3))
    if np.linalg.norm(centre) > FARTHEST_M:
        raise UserError(
            f"{name}.centre: {centre.tolist()} is {np.linalg.norm(centre):.3g} m from the hand; allowed are "
            f"{FARTHEST_M:g} m"
        )
    inertia = _tensor(f"{name}.inertia", value.get("inertia"), mass)
    on, off = value.get("on_s"), value.get("off_s")
    on, off = 0.0 if on is None else on, np.inf if off is None else off
    check_number(f"{name}.on_s", on, "[0, inf)")
    check_number(f"{name}.off_s", off, "[0, inf]")
    if not on < off:
        raise UserError(f"{name}.off_s: {off:g} is not after on_s, {on:g} s")
    return Payload(np.array(mass), centre, inertia, float(on), float(off)) if mass else None


def _numbers(name: str, value: Any, shape: tuple[int, ...], default: np.ndarray) -> np.ndarray:
    if value is None:
        return default
    try:
        array = np.array(value, dtype=float)
    except (TypeError, ValueError):
        array = np.array(np.nan)
    if array.shape != shape or not np.isfinite(array).all():
        raise UserError(f"{name}: {value!r} is not allowed; {' x '.join(map(str, shape))} finite numbers are")
    return array


def _tensor(name: str, value: Any, mass: float) -> np.ndarray:
    """Return (3, 3) kg m^2 of 3 moments or 6 elements; the default is the ball's."""
    if value is None:
        return ball(np.array(mass))
    count = 6 if isinstance(value, list | tuple) and len(value) == 6 else 3
    x = _numbers(name, value, (count,), np.zeros(0))
    tensor = np.diag(x[:3])
    if count == 6:
        for (i, j), element in zip(((0, 1), (0, 2), (1, 2)), x[3:], strict=True):
            tensor[i, j] = tensor[j, i] = element
    moments = np.linalg.eigvalsh(tensor)
    if moments[0] <= 0:
        raise UserError(f"{name}: the least of its moments is {moments[0]:.3g} kg m^2; all must be above 0")
    if moments[0] + moments[1] < moments[2] * (1 - 1e-9):  # round-off of a flat one
        raise UserError(
            f"{name}: moments {', '.join(f'{m:.3g}' for m in moments)} kg m^2 are of no body: none may be above the "
            "sum of the others"
        )
    if moments[2] > MOST_TENSOR:
        raise UserError(f"{name}: a moment of {moments[2]:.3g} kg m^2 is too much; allowed are {MOST_TENSOR:g}")
    return tensor


def ball(mass: np.ndarray) -> np.ndarray:
    """Return (..., 3, 3) kg m^2 of balls of water of mass (...) kg."""
    radius = (3 * mass / (4 * np.pi * WATER)) ** (1 / 3)
    return (0.4 * mass * radius**2)[..., None, None] * np.eye(3)


_hands: dict[tuple[Path, str], tuple[np.ndarray, np.ndarray]] = {}  # compiling a model takes its time


def hand(robot: Robot) -> tuple[np.ndarray, np.ndarray]:
    """Return where the hand is in the last link's frame: (3,) m and (3, 3), its axes in columns."""
    key = robot.mjcf, robot.ee_site
    if key not in _hands:
        model = robot.model(gravity=False)
        site = model.site(robot.ee_site).id
        _, pose = Bodies(model).moving_parent(model.site_bodyid[site])
        turn = rotation(model.site_quat[site])
        _hands[key] = pose[:3, :3] @ model.site_pos[site] + pose[:3, 3], pose[:3, :3] @ turn
    return _hands[key]


def carrying(robot: Robot, payload: Payload | None, links: Links) -> Links:
    """Return the links, the last of them with the payload; any leading batch shape."""
    if payload is None:
        return links
    place, axes = hand(robot)
    mass, com, inertia = links
    centre = place + payload.centre @ axes.T
    own, there = mass[..., -1], payload.mass
    total = own + there
    middle = (own[..., None] * com[..., -1, :] + there[..., None] * centre) / total[..., None]
    added = axes @ payload.inertia @ axes.T
    for m, c in ((own, com[..., -1, :]), (there, centre)):
        r = c - middle
        square = (r**2).sum(-1)[..., None, None] * np.eye(3) - r[..., :, None] * r[..., None, :]
        added = added + m[..., None, None] * square
    lead = np.broadcast_shapes(total.shape, added.shape[:-2])
    out = [np.broadcast_to(a, (*lead, *a.shape[k:])).copy() for a, k in ((mass, -1), (com, -2), (inertia, -3))]
    out[0][..., -1], out[1][..., -1, :] = total, middle
    out[2][..., -1, :, :] += added
    return out[0], out[1], out[2]


def loaded(robot: Robot, dynamics: Dynamics, payload: Payload | None, told: Payload | None = None) -> Dynamics:
    """Return the dynamics of an arm with this payload in its hand, whatever the times.

    Args:
        robot, dynamics: the arm without it.
        payload: what is in the hand.
        told: what the arm's own gravity compensation was told of it (libfranka's setLoad), right or wrong.
    """
    mass, com, inertia = carrying(robot, payload, (dynamics.mass, dynamics.com, dynamics.inertia))
    return replace(dynamics, mass=mass, com=com, inertia=inertia, told=moment(robot, told))


def moment(robot: Robot, payload: Payload | None) -> np.ndarray:
    """Return (..., 4): kg, and kg m of the first moment in the last link's frame."""
    if payload is None:
        return np.zeros(4)
    place, axes = hand(robot)
    mass = np.asarray(payload.mass)[..., None]
    return np.concatenate([mass, mass * (place + payload.centre @ axes.T)], -1)
