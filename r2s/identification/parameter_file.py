"""parameters.yaml and posterior.npz: what carries an identification to the other stages."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from r2s.errors import UserError, check_number, nearest
from r2s.files import DAMAGED, whole
from r2s.identification.parameters import (
    TIMING,
    WHOLE_ARM,
    Estimate,
    ParameterSpace,
    logarithmic,
    parameter_space,
    units,
)
from r2s.physics.dynamics import Dynamics
from r2s.physics.friction import family as friction_family
from r2s.physics.friction import spelled
from r2s.physics.robot import Robot
from r2s.recordings.speed_noise import MOST_NOISE


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
    document["friction_family"] = spelled(fixed.family)
    document["parameters"] = {}
    for name in space.blocks:
        entry: dict[str, Any] = {"unit": units()[name]}
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
        "hold": fixed.hold,
        "inertia": fixed.inertia.tolist(),
    }
    document["fixed"] |= {k: getattr(fixed, k).tolist() for k in LATER}
    document["fixed"] |= {k: float(getattr(fixed, k)) for k in TIMING}
    d = space.dynamics(found.x)
    rounded = (np.round(a, 6).tolist() for a in (d.mass, d.com, d.inertia))  # for the reader; parameters are loaded
    document["links"] = dict(zip(("mass_kg", "com_m", "inertia_about_com_kg_m2"), rounded, strict=True))
    document |= dict(note or {})
    with whole(path.with_name("posterior.npz")) as part:  # first: parameters.yaml says that both are there
        np.savez_compressed(part, names=np.array(space.names), samples=found.samples)
    with whole(path) as part:
        part.write_text(yaml.safe_dump(document, sort_keys=False, default_flow_style=None, width=110))


MOST_NM, FARTHEST_M = 1e4, 10.0  # of friction and offsets; of a link's centre from its joint
FIXED = ("phi", "offset", "inertia")
# files of before may lack them: then they are the robot's, or 0
LATER = ("mass", "com", "armature", "load", "drag", "gain", "speed_noise")


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

    rows = [k for k in (*FIXED, *LATER) if k in FIXED or k in fixed]
    own = {k: numbers(k, fixed[k], robot.n) for k in rows}
    edges = [numbers(k, fixed[k], robot.n) for k in ("breakaway_negative", "breakaway_positive")]
    family = friction_family(document["friction_family"])
    nominal = replace(
        Dynamics.of(robot, own["phi"], family, float(fixed["dq_min"])),
        **own,  # type: ignore[arg-type]
        breakaway=np.stack(edges, -1),
        delay=float(fixed["delay"]),
        lag=float(fixed["lag"]),
        hold=fixed.get("hold", "command"),  # files of before know of no other
    )
    everything = {k: [1e-12 if k in logarithmic() else -np.inf, np.inf] for k in found}
    space = parameter_space(robot, nominal, everything)
    x = np.concatenate([numbers(k, found[k]["value"], space.size(k)) for k in space.blocks])
    _check_physical(space.dynamics(x))
    return space, x


def _check_physical(d: Dynamics) -> None:
    """Raise ValueError where these are the dynamics of no arm: a damaged file may hold any number."""
    for name in ("dq_min", "delay", "lag"):
        check_number(name, float(getattr(d, name)), "[0, 10]" if name == "dq_min" else "[0, 1]")
    fast = np.ones(d.phi.shape[:-1])
    gives = (d.friction(fast) < 0) | (d.friction(-fast) > 0) | (d.load < 0) | (d.armature < 0)
    edges = (d.breakaway[..., 0] > 0) | (d.breakaway[..., 1] < 0)
    no_body = (d.mass <= 0) | (np.linalg.eigvalsh(d.inertia)[..., 0] <= 0) | (np.abs(d.com).max(-1) > FARTHEST_M)
    beyond = (np.abs(d.offset) > MOST_NM) | (np.abs(d.friction(fast)) > MOST_NM) | (np.abs(d.gain) >= 1)
    noisy = (d.speed_noise < 0) | (d.speed_noise > MOST_NOISE)
    reasons = {"friction or a rotor that gives energy": gives, "edges of breakaway on one side": edges}
    reasons |= {f"a noise of its speed outside [0, {MOST_NOISE:g}] rad/s": noisy}
    reasons |= {"a link that no body can be": no_body, "an offset, friction or a gain beyond any arm": beyond}
    for reason, joints in reasons.items():
        if joints.any():
            raise ValueError(f"joint {int(joints.argmax()) + 1} has {reason}")


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
        with np.load(path, allow_pickle=False) as file:
            names, samples = file["names"].tolist(), file["samples"]
        if samples.shape != (len(samples), len(names)):
            raise ValueError(f"samples of shape {samples.shape} for {len(names)} names")
    except DAMAGED as error:
        seen = " ".join(str(error).split())
        raise UserError(f"dr=identified: {path} is not a posterior.npz of r2s ({seen})") from None
    if names != space.names:
        raise UserError(f"dr=identified: {path} has other parameters than the parameters.yaml beside it")
    return samples
