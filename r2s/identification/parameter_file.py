"""Write and read parameters.yaml and posterior.npz, which pass the result of an identification to other stages."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from r2s.errors import UserError, check_number
from r2s.files import DAMAGED, atomic_write, run_file
from r2s.identification.parameters import (
    TIMING,
    WHOLE_ARM,
    ParameterEstimate,
    ParameterSpace,
    logarithmic,
    parameter_space,
    units,
)
from r2s.physics.dynamics import Dynamics
from r2s.physics.friction import check_trusted, family_path
from r2s.physics.friction import family as friction_family
from r2s.physics.robot import Robot
from r2s.recordings.speed_noise import MAX_NOISE

SIDES = ("negative", "positive")
FIXED = ("phi", "offset", "inertia", "mass", "com", "armature", "load", "drag", "gain", "speed_noise")
# limits that no arm exceeds: friction and offsets, Nm; distance of a link's center of mass from its joint, m
MOST_NM, FARTHEST_M = 1e4, 10.0


def save_parameters(
    path: Path,
    space: ParameterSpace,
    found: ParameterEstimate,
    source: Mapping[str, Any],
    note: Mapping[str, Any] | None = None,
) -> None:
    """Write parameters.yaml (value, unit, nominal, bounds, 95 % interval and identifiability) and posterior.npz.

    Args:
        path: the parameters.yaml to write; posterior.npz, which dr=identified reads, is written to the same folder.
        space: the parameters. found: estimated values, intervals and posterior draws of the parameters.
        source: origin of the estimate (recording, search, run). note: further entries of parameters.yaml.
    """
    robot, fixed = space.robot, space.nominal

    def numbers(values: np.ndarray) -> Any:
        return float(f"{values[0]:.6g}") if len(values) == 1 else [float(f"{v:.6g}") for v in values]

    document: dict[str, Any] = {"robot": robot.name, "joints": robot.n, "source": dict(source)}
    document["friction_family"] = family_path(fixed.family)
    document["parameters"] = {}
    for name in space.blocks:
        entry: dict[str, Any] = {"unit": units()[name]}
        rows = (found.x, space.start, space.lower, space.upper, found.low, found.high)
        keys = ("value", "nominal", "lower_bound", "upper_bound", "interval95_low", "interval95_high")
        entry |= {key: numbers(space.block(row, name)) for key, row in zip(keys, rows, strict=True)}
        seen = space.block(found.identifiable, name).tolist()
        document["parameters"][name] = entry | {"identifiable": seen[0] if name in WHOLE_ARM else seen}
    document["fixed"] = {f"breakaway_{side}": fixed.breakaway[:, i].tolist() for i, side in enumerate(SIDES)}
    document["fixed"] |= {"stiction_model": fixed.stiction_model, "late_alike": fixed.late_alike}
    document["fixed"] |= {k: getattr(fixed, k).tolist() for k in FIXED}
    document["fixed"] |= {k: float(getattr(fixed, k)) for k in ("dq_min", *TIMING)}
    d = space.dynamics(found.x)
    rounded = (np.round(a, 6).tolist() for a in (d.mass, d.com, d.inertia))  # for human readers only
    document["links"] = dict(zip(("mass_kg", "com_m", "inertia_about_com_kg_m2"), rounded, strict=True))
    document |= dict(note or {})
    with atomic_write(path.with_name("posterior.npz")) as part:  # first, as parameters.yaml needs it
        np.savez_compressed(part, names=np.array(space.names), samples=found.samples)
    with atomic_write(path) as part:
        part.write_text(yaml.safe_dump(document, sort_keys=False, default_flow_style=None, width=110))


def load_parameters(
    folder: str | Path, robot: Robot, trust: Sequence[str] = (), option: str = "calibration"
) -> tuple[ParameterSpace, np.ndarray]:
    """Return the parameter space and its values x (P,) from a run folder or a parameters.yaml.

    trust: modules that r2s may import to find a friction family, besides already imported modules. option: the user's
    option that names the folder, for error messages.

    Raises:
        UserError: the file is missing or damaged, belongs to another robot, or names an untrusted friction family.
    """
    if Path(folder).is_dir() and not (Path(folder) / "parameters.yaml").is_file():
        raise UserError(f"{option}: {folder} has no parameters.yaml; is it a finished identification?")
    path = run_file(folder, "parameters.yaml", option)
    try:
        document = yaml.safe_load(path.read_text())
        named, joints = document["robot"], document["joints"]
        if (named, joints) == (robot.name, robot.n):
            check_trusted(str(document["friction_family"]), trust, str(path))
            return _parse(document, robot)
    except (AttributeError, KeyError, TypeError, ValueError, IndexError, yaml.YAMLError) as error:
        seen = " ".join(str(error).split())
        raise UserError(f"{option}: {path} is not a parameters.yaml of r2s ({seen})") from None
    raise UserError(
        f"{option}: {path} is of '{named}' with {joints} joints; this arm is '{robot.name}' with {robot.n}"
    )


def _parse(document: dict[str, Any], robot: Robot) -> tuple[ParameterSpace, np.ndarray]:
    """Parse parameters.yaml; a malformed document raises an error that `load_parameters` catches."""
    found, fixed = document["parameters"], document["fixed"]

    def numbers(name: str, value: Any, count: int) -> np.ndarray:
        array = np.atleast_1d(np.array(value, dtype=float))
        if len(array) != count or not np.isfinite(array).all():
            raise ValueError(f"{name}: not {count} finite value{'s' * (count > 1)}")
        return array

    own: dict[str, Any] = {k: numbers(k, fixed[k], robot.n) for k in FIXED}
    own["breakaway"] = np.stack([numbers(k, fixed[k], robot.n) for k in map("breakaway_{}".format, SIDES)], -1)
    own |= {k: float(fixed[k]) for k in TIMING}
    own["stiction_model"], own["late_alike"] = fixed["stiction_model"], bool(fixed.get("late_alike", False))
    family = friction_family(document["friction_family"])
    nominal = replace(Dynamics.of(robot, own["phi"], family, float(fixed["dq_min"])), **own)
    everything = {k: [1e-12 if k in logarithmic() else -np.inf, np.inf] for k in found}
    space = parameter_space(robot, nominal, everything)
    x = np.concatenate([numbers(k, found[k]["value"], space.size(k)) for k in space.blocks])
    _check_physical(space.dynamics(x))
    return space, x


def _check_physical(d: Dynamics) -> None:
    """Raise ValueError if no arm can have these dynamics."""
    for name in ("dq_min", "delay", "lag"):
        check_number(name, float(getattr(d, name)), "[0, 10]" if name == "dq_min" else "[0, 1]")
    fast = np.ones(d.phi.shape[:-1])
    forth, back = d.friction(fast), d.friction(-fast)
    gains_energy = (forth < 0) | (back > 0) | (d.load < 0) | (d.armature < 0)
    edges = (d.breakaway[..., 0] > 0) | (d.breakaway[..., 1] < 0)
    link = (d.mass <= 0) | (np.linalg.eigvalsh(d.inertia)[..., 0] <= 0) | (np.abs(d.com).max(-1) > FARTHEST_M)
    large = (np.abs(d.offset) > MOST_NM) | (np.abs(forth) > MOST_NM) | (np.abs(d.gain) >= 1)
    noise = (d.speed_noise < 0) | (d.speed_noise > MAX_NOISE)
    reasons = {"friction or a rotor that adds energy": gains_energy, "breakaway torques of one sign": edges}
    reasons |= {"an unphysical link": link, "an offset, friction or gain beyond any arm": large}
    reasons |= {f"a velocity noise outside [0, {MAX_NOISE:g}] rad/s": noise}
    for reason, joints in reasons.items():
        if joints.any():
            raise ValueError(f"joint {int(joints.argmax()) + 1} has {reason}")


def load_posterior(folder: str | Path, space: ParameterSpace, option: str = "dr=identified") -> np.ndarray:
    """Return the posterior draws (S, P) of the parameters in `space` from posterior.npz beside parameters.yaml.

    Raises:
        UserError: posterior.npz is missing or damaged, or its parameters differ from those of `space`.
    """
    path = Path(folder)
    path = (path if path.is_dir() else path.parent) / "posterior.npz"
    if not path.is_file():
        raise UserError(f"{option}: no posterior.npz at {path.parent}; it must be a run of stage=identify")
    try:
        with np.load(path, allow_pickle=False) as file:
            names, samples = file["names"].tolist(), file["samples"]
        if samples.shape != (len(samples), len(names)):
            raise ValueError(f"samples of shape {samples.shape} for {len(names)} names")
    except DAMAGED as error:
        seen = " ".join(str(error).split())
        raise UserError(f"{option}: {path} is not a posterior.npz of r2s ({seen})") from None
    if names != space.names:
        raise UserError(f"{option}: {path} has other parameters than the parameters.yaml beside it")
    return samples
