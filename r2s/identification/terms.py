"""Terms of the model beside friction: which parameters they estimate, with which bounds and prior."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike

from r2s.errors import UserError, choices, nearest
from r2s.identification.link_inertia import LINK, PAYLOAD
from r2s.identification.parameters import ParameterSpace, check_parameters, logarithmic, parameter_space, torque_like
from r2s.physics.dynamics import Dynamics
from r2s.physics.friction import known_families
from r2s.physics.robot import Robot
from r2s.recordings.recording import Recording

TERMS = (
    *("offset", "inertia_scale", "link", "payload", "armature", "delay", "lag", "load", "gain"),
    *("drag", "drag_sin", "drag_cos"),
)
# terms without effect on the recorded torque: delay and lag lie between command and motion, gain in the sensor, and a
# link-side sensor does not measure rotors
NO_EFFECT = {"commanded": ("gain",), "measured": ("delay", "lag", "armature"), "motor": ("delay", "lag")}


def optional_friction() -> list[str]:
    """Return the friction parameters, of any family, that are estimated only if a term names them."""
    return list(dict.fromkeys(name for f in known_families() for name in f.optional))


def check_terms(where: str, terms: Sequence[str]) -> None:
    """Raise UserError for an unknown term."""
    known = (*optional_friction(), *TERMS)
    for name in terms:
        if name not in known:
            raise UserError(f"{where}: unknown term '{name}'; allowed: {choices(known)}{nearest(str(name), known)}")


def check_prior(prior: Mapping[str, ArrayLike]) -> None:
    """Raise UserError for an unknown parameter or a standard deviation that is not positive."""
    check_parameters("prior", prior)
    for name, sigma in prior.items():
        if isinstance(sigma, str) or not np.all(np.greater(sigma, 0)):
            raise UserError(f"prior.{name}: {sigma!s} is not a positive standard deviation")


def blocks_of(term: str) -> tuple[str, ...]:
    """Return the parameter blocks of a term."""
    return {"link": tuple(LINK), "payload": PAYLOAD, "drag": ("drag_sin", "drag_cos")}.get(term, (term,))


def add_terms(terms: Sequence[str], more: Sequence[str]) -> list[str]:
    """Return the terms and `more`; `link` replaces `inertia_scale`, because it includes the tensor."""
    return [name for name in terms if not (name == "inertia_scale" and "link" in more)] + list(more)


def search_space(
    robot: Robot,
    nominal: Dynamics,
    bounds: Mapping[str, Sequence[ArrayLike]],
    terms: Sequence[str],
    recording: Recording,
) -> ParameterSpace:
    """Return the space of the friction family's parameters and of the terms that act on the recorded torque.

    The family's own bounds fill in for parameters without `bounds`.

    Raises:
        UserError: a term without bounds.
    """
    left_out = set(nominal.family.optional) - set(terms)
    own = [name for name in nominal.family.names if name not in left_out]
    bounds = dict(zip(nominal.family.names, nominal.family.bounds, strict=False)) | dict(bounds)
    if not set(own) & set(bounds):
        raise UserError(f"identify.bounds: none for {choices(own)} of friction family '{nominal.family.name}'")
    bounds = _scaled_bounds(bounds, robot, recording)
    names = [name for name in own if name in bounds]
    for term in terms:
        if term not in NO_EFFECT[recording.torque] and term not in optional_friction():
            names += blocks_of(term)
    if missing := [name for name in names if name not in bounds]:
        raise UserError(f"identify.bounds: none for {choices(missing)}")
    return parameter_space(robot, nominal, {name: bounds[name] for name in names})


def _scaled_bounds(
    bounds: Mapping[str, Sequence[ArrayLike]], robot: Robot, recording: Recording
) -> dict[str, Sequence[ArrayLike]]:
    """Return bounds that fit an arm of any size: for motor torque those in Nm reach up to the joint's torque limit.

    Motor torque contains all gear friction: 0.5 Nm in a small wrist, 50 Nm in an axis of an industrial arm.
    """
    out = dict(bounds)
    if recording.torque == "motor":
        reach = _largest_torque(robot, recording)
        for name in out.keys() & torque_like():
            low, high = (np.asarray(end, dtype=float) for end in out[name])
            out[name] = [np.where(low < 0.0, np.minimum(low, -reach), low), np.maximum(high, reach)]
    return out


def scaled_prior(prior: Mapping[str, ArrayLike], robot: Robot, recording: Recording) -> dict[str, ArrayLike]:
    """Return standard deviations in SI units.

    The prior of rotors, and for motor torque of every parameter in Nm, is a share of each joint's torque limit.
    """
    shares = torque_like() - logarithmic() if recording.torque == "motor" else {"armature"}
    reach = _largest_torque(robot, recording)
    return {name: sigma * reach if name in shares else sigma for name, sigma in prior.items()}


def _largest_torque(robot: Robot, recording: Recording) -> np.ndarray:
    """Return (n,) Nm: the torque limit, or the recorded torque if that is larger."""
    return np.maximum(robot.tau_max, np.abs(recording.tau).max(0))
