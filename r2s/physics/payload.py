"""Payload of an arm: a rigid body fixed to the last link, with times of attachment and removal.

r2s adds a payload to mass, center and inertia tensor of the last link; this method is exact in every simulator. An
external force could not represent a payload, because the force would depend on the acceleration that it causes. The
payload's frame is the frame of `robot.ee_site`; on a Panda, this frame is the flange, as in libfranka's setLoad.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import yaml

from r2s.errors import UserError, check_number, choices, nearest
from r2s.files import run_file
from r2s.physics.dynamics import Dynamics
from r2s.physics.robot import Robot
from r2s.physics.welds import Bodies, rotation

Links = tuple[np.ndarray, np.ndarray, np.ndarray]  # masses (..., n) kg, centers (..., n, 3) m, tensors (..., n, 3, 3)
USUAL = 0.5  # usual payload mass / largest allowed mass, and usual distance / largest allowed distance
WATER = 1000.0  # kg/m^3


@dataclass(frozen=True)
class Payload:
    """Payload of one arm, or of many arms with any leading batch shape.

    Attributes:
        mass: (...) kg. centre: (..., 3) m, center of mass in the end-effector frame.
        inertia: (..., 3, 3) kg m^2, inertia tensor about `centre`, axes of the end-effector frame.
        on_s, off_s: (...) s, times of attachment and removal within a motion.
    """

    mass: np.ndarray
    centre: np.ndarray
    inertia: np.ndarray
    on_s: np.ndarray | float = 0.0
    off_s: np.ndarray | float = np.inf

    def attached(self, t: np.ndarray | float) -> Any:
        """Return whether the payload is attached at the time t, s."""
        return (self.on_s <= t) & (t < self.off_s)


def payload_of(value: Any, most: tuple[float, float], name: str = "arm.payload") -> Payload | None:
    """Return the payload that a setting describes: a mass in kg, a mapping or a file; None for null or 0 kg.

    A number is the mass, kg, of a point mass at the end effector. A mapping contains `mass` and optionally `centre`
    (3,) m, `inertia` (xx, yy, zz or xx, yy, zz, xy, xz, yz, kg m^2 about `centre`; default: a sphere of water),
    `on_s` and `off_s`. A string is the path of an identification's payload.yaml or run folder.

    Args:
        value: the setting. name: the setting's name in error messages. most: largest mass, kg, and distance, m, as in
            `Robot.payload_max`.

    Raises:
        UserError: mass, centre, tensor or time is out of range, or a file is missing; the message begins with `name`.
    """
    if value is None:
        return None
    if isinstance(value, str):
        value = _of_file(name, Path(value))
    if not isinstance(value, Mapping):
        check_number(name, value, f"[0, {most[0]:g}]")
        return Payload(np.array(float(value)), np.zeros(3), np.zeros((3, 3))) if value else None
    allowed = ("mass", "centre", "inertia", "on_s", "off_s")
    for key in value:
        if key not in allowed:
            raise UserError(f"{name}: expected the keys {choices(allowed)}, got '{key}'{nearest(key, allowed)}")
    if "mass" not in value:
        raise UserError(f"{name}: expected a number of kg or {{mass: ..., centre: [...], ...}}, got no mass")
    check_number(f"{name}.mass", value["mass"], f"[0, {most[0]:g}]")
    mass = float(value["mass"])
    centre = _numbers(f"{name}.centre", value.get("centre"), (3,), np.zeros(3))
    if (distance := np.linalg.norm(centre)) > most[1]:
        raise UserError(
            f"{name}.centre: expected at most {most[1]:g} m from the end effector, got {distance:.3g} m "
            f"({centre.tolist()})"
        )
    inertia = _tensor(f"{name}.inertia", value.get("inertia"), mass, most)
    on, off = value.get("on_s"), value.get("off_s")
    on, off = 0.0 if on is None else on, np.inf if off is None else off
    check_number(f"{name}.on_s", on, "[0, inf)")
    check_number(f"{name}.off_s", off, "[0, inf]")
    if not on < off:
        raise UserError(f"{name}.off_s: expected a time after on_s, {on:g} s, got {off:g} s")
    return Payload(np.array(mass), centre, inertia, float(on), float(off)) if mass else None


def _numbers(name: str, value: Any, shape: tuple[int, ...], default: np.ndarray) -> np.ndarray:
    if value is None:
        return default
    try:
        array = np.array(value, dtype=float)
    except (TypeError, ValueError):
        array = np.array(np.nan)
    if array.shape != shape or not np.isfinite(array).all():
        raise UserError(f"{name}: expected {' x '.join(map(str, shape))} finite numbers, got {value!r}")
    return array


def _of_file(name: str, path: Path) -> Any:
    """Return the mapping in a payload.yaml; path: the file or its run folder."""
    file = run_file(path, "payload.yaml", name)
    try:
        return yaml.safe_load(file.read_text())["payload"]
    except (OSError, ValueError, KeyError, TypeError, yaml.YAMLError) as error:
        seen = " ".join(str(error).split())
        raise UserError(f"{name}: {file} is not a payload.yaml of r2s ({seen})") from None


def _tensor(name: str, value: Any, mass: float, most: tuple[float, float]) -> np.ndarray:
    """Return the inertia tensor (3, 3) kg m^2 from 3 moments or 6 elements or, for None, of a sphere of water.

    A principal moment may be at most m (2 d)^2, with the largest allowed mass m and distance d in `most`.
    """
    if value is None:
        return sphere_inertia(np.array(mass))
    count = 6 if isinstance(value, list | tuple) and len(value) == 6 else 3
    x = _numbers(name, value, (count,), np.zeros(0))
    tensor = np.diag(x[:3])
    if count == 6:
        for (i, j), element in zip(((0, 1), (0, 2), (1, 2)), x[3:], strict=True):
            tensor[i, j] = tensor[j, i] = element
    moments = np.linalg.eigvalsh(tensor)
    if moments[0] <= 0:
        raise UserError(f"{name}: expected positive moments, got {moments[0]:.3g} kg m^2")
    if moments[0] + moments[1] < moments[2] * (1 - 1e-9):  # tolerance for a flat body's round-off
        listed = ", ".join(f"{m:.3g}" for m in moments)
        raise UserError(f"{name}: expected no moment above the sum of the others, got {listed} kg m^2")
    if moments[2] > (largest := 4.0 * most[0] * most[1] ** 2):
        raise UserError(f"{name}: expected moments of at most {largest:.3g} kg m^2, got {moments[2]:.3g}")
    return tensor


def sphere_inertia(mass: np.ndarray) -> np.ndarray:
    """Return the tensors (..., 3, 3) kg m^2 of spheres of water with the masses `mass` (...) kg."""
    radius = (3 * mass / (4 * np.pi * WATER)) ** (1 / 3)
    return (0.4 * mass * radius**2)[..., None, None] * np.eye(3)


_ee_poses: dict[tuple, tuple[np.ndarray, np.ndarray]] = {}  # compiling a model takes some 10 ms


def ee_pose(robot: Robot) -> tuple[np.ndarray, np.ndarray]:
    """Return the end effector's position (3,) m and rotation (3, 3) in the last link's frame."""
    key = robot.mjcf, robot.ee_site, *robot.lock.items()
    if key not in _ee_poses:
        model = robot.model(gravity=False)
        site = model.site(robot.ee_site).id
        _, pose = Bodies(model).moving_parent(model.site_bodyid[site])
        own = rotation(model.site_quat[site])
        _ee_poses[key] = pose[:3, :3] @ model.site_pos[site] + pose[:3, 3], pose[:3, :3] @ own
    return _ee_poses[key]


def with_payload(robot: Robot, payload: Payload | None, links: Links) -> Links:
    """Return the links with the payload added to the last link; all arrays may have any leading batch shape."""
    if payload is None:
        return links
    place, axes = ee_pose(robot)
    mass, com, inertia = links
    centre = place + payload.centre @ axes.T
    own, load = mass[..., -1], payload.mass
    total = own + load
    middle = (own[..., None] * com[..., -1, :] + load[..., None] * centre) / total[..., None]
    added = axes @ payload.inertia @ axes.T
    for m, c in ((own, com[..., -1, :]), (load, centre)):
        r = c - middle
        square = (r**2).sum(-1)[..., None, None] * np.eye(3) - r[..., :, None] * r[..., None, :]
        added = added + m[..., None, None] * square
    lead = np.broadcast_shapes(total.shape, added.shape[:-2], com.shape[:-2], inertia.shape[:-3])
    out = [np.broadcast_to(a, (*lead, *a.shape[k:])).copy() for a, k in ((mass, -1), (com, -2), (inertia, -3))]
    out[0][..., -1], out[1][..., -1, :] = total, middle
    out[2][..., -1, :, :] += added
    return out[0], out[1], out[2]


def dynamics_with_payload(
    robot: Robot, dynamics: Dynamics, payload: Payload | None, declared: Payload | None = None
) -> Dynamics:
    """Return the dynamics of an arm with a payload attached, regardless of the payload's on_s and off_s.

    declared: payload declared to gravity compensation (libfranka's setLoad), which may differ from `payload`.
    """
    mass, com, inertia = with_payload(robot, payload, (dynamics.mass, dynamics.com, dynamics.inertia))
    return replace(dynamics, mass=mass, com=com, inertia=inertia, declared_payload=mass_and_moment(robot, declared))


def mass_and_moment(robot: Robot, payload: Payload | None) -> np.ndarray:
    """Return (..., 4): the payload's mass, kg, and first moment, kg m, in the last link's frame."""
    if payload is None:
        return np.zeros(4)
    place, axes = ee_pose(robot)
    mass = np.asarray(payload.mass)[..., None]
    return np.concatenate([mass, mass * (place + payload.centre @ axes.T)], -1)


class LoadTorque:
    """Joint torque that holds the weight of a body fixed to an arm's last link."""

    def __init__(self, robot: Robot):
        self._robot = robot

    @cached_property
    def _data(self) -> mujoco.MjData:
        return mujoco.MjData(self._robot.model(gravity=False))

    def __call__(self, q: np.ndarray, load: np.ndarray, gravity: np.ndarray | None = None) -> np.ndarray:
        """Return the joint torque (n,) Nm that holds the body at q (n,) rad.

        Args:
            load: (4,) kg, kg m, result of `mass_and_moment`. gravity: (3,) m/s^2, base frame; None: `Robot.gravity`.
        """
        if not load.any():
            return np.zeros(len(q))
        d, last = self._data, self._data.model.jnt_bodyid[-1]
        d.qpos[:] = q
        mujoco.mj_kinematics(d.model, d)
        moment = load[0] * (d.xpos[last] - d.xanchor) + d.xmat[last].reshape(3, 3) @ load[1:]
        return -(d.xaxis * np.cross(moment, self._robot.gravity if gravity is None else gravity)).sum(1)
