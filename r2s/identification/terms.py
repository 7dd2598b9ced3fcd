"""Model terms besides friction: the parameters of each term, and their bounds and prior in SI units."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from r2s.errors import UserError, choices, instead_of
from r2s.identification.link_inertia import LINK, PAYLOAD
from r2s.identification.parameters import ParameterSpace, check_parameters, logarithmic, parameter_space, sizes
from r2s.identification.stated import Stated, fixed_in
from r2s.physics.dynamics import Dynamics
from r2s.physics.friction import VISCOUS, known_families
from r2s.physics.robot import Robot
from r2s.recordings.recording import Recording

TERMS = (
    *("offset", "inertia_scale", "link", "payload", "armature", "delay", "lag", "signal_delay", "load", "gain"),
    *("drag", "drag_sin", "drag_cos"),
)
# Terms that do not affect a kind of torque. Delay and lag act between command and motion; gain and signal delay act
# in the measurement. A link-side sensor does not measure the torque on the rotors.
NO_EFFECT = {
    "commanded": ("gain", "signal_delay"),
    "measured": ("delay", "lag", "armature"),
    "motor": ("delay", "lag"),
}


NOTHING: Stated = {}


def optional_friction() -> list[str]:
    """Return the optional parameters of all friction families; r2s estimates only those that `terms` contains."""
    return list(dict.fromkeys(name for f in known_families() for name in f.optional))


def check_terms(where: str, terms: Sequence[str]) -> None:
    """Raise UserError for an unknown term."""
    known = (*optional_friction(), *TERMS)
    for name in terms:
        if name not in known:
            raise UserError(f"{where}: unknown term '{name}'; {instead_of(name, known)}")


def check_prior(prior: Mapping[str, ArrayLike | None]) -> None:
    """Raise UserError for an unknown parameter or a standard deviation that is not positive."""
    check_parameters("prior", prior)
    for name, sigma in prior.items():
        if sigma is not None and (isinstance(sigma, str) or not np.all(np.greater(sigma, 0))):
            raise UserError(f"prior.{name}: {sigma!s} is not a positive standard deviation, nor null for none")


def blocks_of(term: str) -> tuple[str, ...]:
    """Return the names of a term's parameters."""
    return {"link": tuple(LINK), "payload": PAYLOAD, "drag": ("drag_sin", "drag_cos")}.get(term, (term,))


def add_terms(terms: Sequence[str], more: Sequence[str]) -> list[str]:
    """Return `terms` plus `more`; `link` replaces `inertia_scale`, because `link` includes the inertia tensor."""
    return [name for name in terms if not (name == "inertia_scale" and "link" in more)] + list(more)


def search_space(
    robot: Robot,
    nominal: Dynamics,
    bounds: Mapping[str, Sequence[ArrayLike]],
    terms: Sequence[str],
    recording: Recording,
    stated: Stated = NOTHING,
) -> ParameterSpace:
    """Return the parameter space of the friction family and of the terms that affect the recorded kind of torque.

    bounds: see `scaled_bounds`; friction parameters without an entry have their friction law's bounds, in SI units.
    stated: the user's values (stated.py), of which the function uses only fixed values.

    Raises:
        UserError: a parameter of a term, or every parameter of the friction family, lacks bounds.
    """
    left_out = set(nominal.family.optional) - set(terms)
    own = [name for name in nominal.family.names if name not in left_out]
    given = scaled_bounds(bounds, robot, recording)
    given = dict(zip(nominal.family.names, nominal.family.bounds, strict=False)) | given
    if not set(own) & set(given):
        raise UserError(f"identify.bounds: none for {choices(own)} of friction family '{nominal.family.name}'")
    names = [name for name in own if name in given]
    for term in terms:
        if term not in NO_EFFECT[recording.torque] and term not in optional_friction():
            names += blocks_of(term)
    if missing := [name for name in names if name not in given]:
        raise UserError(f"identify.bounds: none for {choices(missing)}")
    return fixed_in(parameter_space(robot, nominal, {name: given[name] for name in names}), stated)


def scaled_bounds(
    bounds: Mapping[str, Sequence[ArrayLike]], robot: Robot, recording: Recording
) -> dict[str, Sequence[ArrayLike]]:
    """Convert `bounds` to SI units: multiply the bounds of torque-like parameters by the largest torque.

    Motor torque contains all gear friction: 0.5 Nm in a small wrist, 50 Nm in an axis of an industrial arm. For motor
    torque, the bounds of torque-like parameters therefore extend at least to the largest torque.
    """
    out = dict(bounds)
    for name, size in _sizes(robot, recording).items():
        if name in out:
            low, high = (np.asarray(end, dtype=float) for end in out[name])
            if recording.torque == "motor":
                low, high = np.where(low < 0.0, np.minimum(low, -1.0), low), np.maximum(high, 1.0)
            out[name] = [low * size, high * size]
    return out


def scaled_prior(
    prior: Mapping[str, ArrayLike | None], robot: Robot, recording: Recording, nominal: Dynamics | None = None
) -> dict[str, ArrayLike]:
    """Convert the standard deviations in `prior` to SI units, and omit flat priors (None).

    In `prior`, values for torque-like parameters are relative to the largest torque; values for logarithmic
    parameters have no unit. Viscous friction in the arm's file is a guess, so the standard deviation of viscous
    friction is at least as large as this guess.
    """
    out = {name: sigma for name, sigma in prior.items() if sigma is not None}
    for name, size in _sizes(robot, recording).items():
        if recording.torque == "measured":  # a Panda's wrist has as large sensor offsets as its shoulder
            size = np.max(size)
        if name in out and name not in logarithmic():
            out[name] = np.asarray(out[name], dtype=float) * size
    if nominal is not None and VISCOUS in out and VISCOUS in nominal.family.names[: nominal.phi.shape[-1]]:
        out[VISCOUS] = np.maximum(out[VISCOUS], nominal.phi[:, nominal.family.names.index(VISCOUS)])
    return out


def _sizes(robot: Robot, recording: Recording) -> dict[str, Any]:
    """Return `sizes` for each joint's torque limit, or for its largest recorded torque where this is larger."""
    return sizes(np.maximum(robot.tau_max, np.maximum(recording.tau.max(0), -recording.tau.min(0))))
