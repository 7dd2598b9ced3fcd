"""Domain randomization: random dynamics around a center, with physically valid inertia tensors of all links."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np

from r2s.errors import UserError, check_number
from r2s.identification.contact.contact_file import load_contact
from r2s.identification.parameter_file import load_parameters, load_posterior
from r2s.identification.parameters import ParameterSpace
from r2s.physics.dynamics import Dynamics
from r2s.physics.payload import USUAL, Payload, dynamics_with_payload, sphere_inertia
from r2s.physics.robot import Robot
from r2s.physics.surface import Surface
from r2s.physics.tip import nominal_plane, tilted

Draw = Callable[[np.random.Generator, int], Dynamics]  # (generator, m) -> dynamics of m arms, or of one arm for all

DRAWN = "point", "normal", "stiffness", "exponent", "damping", "friction", "bristle"  # random fields of a `Surface`
TRIES = 64  # largest number of draws per tensor; if all are rejected, the link gets the tensor of the center


@dataclass(frozen=True)
class UniformRandomization:
    """Draw friction parameters and inertia tensors uniformly around a center, as the paper does.

    Each friction parameter is its center times U(1 - phi_relative, 1 + phi_relative); the paper uses phi_relative =
    0.10. Each tensor element is its center times U(1 - inertia_relative, 1 + inertia_relative); the paper uses 0.05.
    All draws are independent, so some tensors, mainly of slender links, are physically impossible (see `physical`).
    r2s redraws such tensors. With inertia_relative = 0.05, the share of valid draws is 100 % for the Panda's links 4
    and 7, 47 to 63 % for links 2, 3, 5 and 6, and 22 % for link 1, a rod (I_zz is 0.013 I_xx). Because of the
    redraws, I_xx and I_yy of link 1 have the correlation 0.97; tensor elements of links 2 to 7 have correlations up
    to 0.6. Even with redraws, each element varies over its full range of +-5 %.

    Attributes:
        robot: the arm.
        center: dynamics at the center of the ranges, without a batch dimension.
        phi_relative, inertia_relative: half widths of the ranges, relative to the center; 0: no variation.
        payload: [least, most] kg, range of each arm's payload, see `with_payloads`; if None, arms carry no payload.

    Raises:
        UserError: a half width is outside [0, 1), or the payload is not allowed.
    """

    robot: Robot
    center: Dynamics
    phi_relative: float
    inertia_relative: float
    payload: Sequence[float] | None = None

    def __post_init__(self):
        check_number("dr.phi_relative", self.phi_relative, "[0, 1)")
        check_number("dr.inertia_relative", self.inertia_relative, "[0, 1)")
        check_payload(self.payload, self.robot)

    def __call__(self, rng: np.random.Generator, m: int) -> Dynamics:
        """Return random dynamics of m arms."""
        center, width, n = self.center, self.inertia_relative, self.robot.n
        phi = center.phi * rng.uniform(1 - self.phi_relative, 1 + self.phi_relative, (m, *center.phi.shape))
        inertia = np.broadcast_to(center.inertia, (m, n, 3, 3)).copy()
        todo = np.ones((m, n), dtype=bool) if width else np.zeros((m, n), dtype=bool)
        for _ in range(TRIES):
            if not todo.any():
                break
            arm, link = np.nonzero(todo)
            factor = rng.uniform(1 - width, 1 + width, (len(arm), 3, 3))
            upper = np.triu(factor)
            tensor = center.inertia[link] * (upper + np.triu(factor, 1).transpose(0, 2, 1))
            inertia[arm, link] = tensor
            todo[arm, link] = ~physical(tensor)
        inertia[todo] = np.broadcast_to(center.inertia, (m, n, 3, 3))[todo]
        return with_payloads(self.robot, replace(center, phi=phi, inertia=inertia), self.payload, rng, m)


@dataclass(frozen=True)
class PosteriorRandomization:
    """Draw each arm's dynamics from a posterior: a random row of `samples` (S, P), parameters of `space`.

    Whole rows preserve the correlations between parameters. Every row is physically valid: tensor scales are
    positive, and the full inertia parametrization admits only valid bodies. payload: see `UniformRandomization`.

    """

    space: ParameterSpace
    samples: np.ndarray
    payload: Sequence[float] | None = None

    def __post_init__(self):
        check_payload(self.payload, self.space.robot)

    def __call__(self, rng: np.random.Generator, m: int) -> Dynamics:
        """Return random dynamics of m arms."""
        drawn = self.space.dynamics(self.samples[rng.integers(len(self.samples), size=m)])
        return with_payloads(self.space.robot, drawn, self.payload, rng, m)


@runtime_checkable
class Pushes(Protocol):
    """Randomization that applies random joint torques at every control step in training, but not in evaluation."""

    def forces(self, rng: np.random.Generator, m: int) -> np.ndarray:
        """Draw the torques (m, n) Nm for the next control step of m arms."""
        ...


@dataclass(frozen=True)
class ForceRandomization:
    """Apply random joint torques instead of random dynamics (Valassakis et al. 2020, arXiv 2008.06686).

    At every control step, each joint receives a torque U(-1, 1) * share * friction level of the joint. The random
    torque acts on the joint itself, as friction does, so the safety filter does not change this torque.

    Attributes:
        robot: the arm. center: dynamics of the arm, without a batch dimension.
        share: largest torque, relative to the joint's friction level `Dynamics.level`.

    Raises:
        UserError: the share is negative.
    """

    robot: Robot
    center: Dynamics
    share: float

    def __post_init__(self):
        check_number("dr.share", self.share, "[0, inf)")

    def __call__(self, rng: np.random.Generator, m: int) -> Dynamics:
        """Return the dynamics `center`, which all arms share."""
        return self.center

    def forces(self, rng: np.random.Generator, m: int) -> np.ndarray:
        """Draw the torques (m, n) Nm for one control step of m arms."""
        return self.share * self.center.level * rng.uniform(-1.0, 1.0, (m, self.robot.n))


def check_pair(name: str, pair: Any, allowed: str) -> None:
    """Raise UserError unless the option dr.NAME is a range [least, most] within `allowed`, such as "[0, inf)"."""
    if not isinstance(pair, list | tuple) or len(pair) != 2:
        raise UserError(f"dr.{name}: expected [least, most], got {pair!r}")
    for value in pair:
        check_number(f"dr.{name}", value, allowed)
    if pair[0] > pair[1]:
        raise UserError(f"dr.{name}: expected [least, most], got {list(pair)}")


@dataclass(frozen=True, kw_only=True)
class ContactRandomization(UniformRandomization):
    """Draw arms as `UniformRandomization` does, and for each arm a random surface near a nominal plane.

    The exponent is one end of its range; both ends have equal probability. Stiffness is log-uniform; damping,
    friction and bristle are uniform. The plane is shifted along its normal by U(-place, place), and tilted about a
    random axis by U(0, tilt).

    Attributes:
        point, normal: point (3,) m and normal (3,) of the nominal plane; if None, those of a work table below the tip
            in home posture.
        stiffness (N/m), exponent, damping (s/m), friction, bristle (m): ranges [least, most], see `Surface`.
        place: m, largest displacement of the plane along its normal. tilt: degrees, largest tilt of the plane.
        surface: run folder of an identified surface, whose posterior replaces the ranges; if None, the ranges apply.

    Raises:
        UserError: a range is malformed or contains values that a surface cannot have, or the robot has no tool.
    """

    stiffness: Sequence[float]
    exponent: Sequence[float]
    damping: Sequence[float]
    friction: Sequence[float]
    bristle: Sequence[float]
    place: float
    tilt: float
    point: Sequence[float] | None = None
    normal: Sequence[float] | None = None
    surface: str | None = None

    @cached_property
    def _identified(self) -> Surface | None:
        """All posterior samples of the identified surface, as a batch of surfaces; None without `surface`."""
        if not self.surface:
            return None
        draws = load_contact(self.surface, "dr.surface").simulated.draws
        return Surface(**{k: np.array([getattr(s, k) for s in draws]) for k in DRAWN})

    @cached_property
    def _plane(self) -> tuple[np.ndarray, np.ndarray]:
        return nominal_plane(self.robot, self.point, self.normal)

    def __post_init__(self):
        super().__post_init__()
        _ = self._plane, self._identified  # raises UserError for wrong settings
        for name in ("stiffness", "exponent", "damping", "friction", "bristle"):
            low = {"stiffness": "(0, inf)", "exponent": "[1, 2]"}.get(name, "[0, inf)")
            check_pair(name, getattr(self, name), low)
        check_number("dr.place", self.place, "[0, inf)")
        check_number("dr.tilt", self.tilt, "[0, 45]")

    def __call__(self, rng: np.random.Generator, m: int) -> Dynamics:
        """Return random dynamics of m arms, each with a random surface."""
        if (known := self._identified) is not None:
            row = rng.integers(len(known.stiffness), size=m)  # type: ignore[arg-type]
            drawn = Surface(**{k: getattr(known, k)[row] for k in DRAWN})
            return replace(super().__call__(rng, m), surface=drawn)
        (point, n), (least, most) = self._plane, np.log(self.stiffness)
        about, tilt = rng.uniform(0, 2 * np.pi, (m, 1)), np.radians(rng.uniform(0, self.tilt, (m, 1)))
        surface = Surface(
            point=point + rng.uniform(-self.place, self.place, (m, 1)) * n,
            normal=tilted(n, about, tilt),
            stiffness=np.exp(rng.uniform(least, most, m)),
            exponent=rng.choice(np.array(self.exponent, dtype=float), m),
            damping=rng.uniform(self.damping[0], self.damping[1], m),
            friction=rng.uniform(self.friction[0], self.friction[1], m),
            bristle=rng.uniform(self.bristle[0], self.bristle[1], m),
        )
        return replace(super().__call__(rng, m), surface=surface)


def posterior_randomization(
    robot: Robot, center: Dynamics, calibration: str | Path | None, payload: Sequence[float] | None = None
) -> PosteriorRandomization:
    """Return a randomization that draws from the posterior in the run folder `calibration`, and ignores `center`.

    Raises:
        UserError: `calibration` is empty, or the folder does not exist or contains no posterior draws.
    """
    if not calibration:
        raise UserError("dr: identified draws from a posterior; give calibration=RUN_FOLDER as well")
    space, _ = load_parameters(calibration, robot)
    return PosteriorRandomization(space, load_posterior(calibration, space), payload)


def check_payload(payload: Sequence[float] | None, robot: Robot) -> None:
    """Raise UserError unless the payload is None or a range [least, most] of masses, kg, that the arm may carry."""
    if payload is None:
        return
    if not isinstance(payload, list | tuple) or len(payload) != 2:
        raise UserError(f"dr.payload: expected [least, most] kg, got {payload!r}")
    for value in payload:
        check_number("dr.payload", value, f"[0, {robot.payload_max[0]:g}]")
    if payload[0] > payload[1]:
        raise UserError(f"dr.payload: expected [least, most] kg, got {list(payload)}")


def with_payloads(
    robot: Robot, dynamics: Dynamics, payload: Sequence[float] | None, rng: np.random.Generator, m: int
) -> Dynamics:
    """Return the dynamics of m arms with random payloads of [least, most] kg; if payload=None, return `dynamics`.

    The mass of a payload is uniform. The center of mass is uniform in a ball about the end effector, with half the
    radius that `payload_max` allows. The inertia tensor is that of a ball of water. Gravity compensation ignores the
    payload.
    """
    if payload is None:
        return dynamics
    least, most = payload
    mass, direction = rng.uniform(least, most, m), rng.normal(size=(m, 3))
    radius = rng.uniform(size=(m, 1)) ** (1 / 3)
    center = USUAL * robot.payload_max[1] * direction / np.linalg.norm(direction, axis=1, keepdims=True) * radius
    return dynamics_with_payload(robot, dynamics, Payload(mass, center, sphere_inertia(mass)))


def physical(tensor: np.ndarray) -> np.ndarray:
    """Return (...) bool: whether tensors (..., 3, 3) are positive definite and obey the triangle inequality."""
    moments = np.linalg.eigvalsh(tensor)
    return (moments[..., 0] > 0) & (moments[..., 0] + moments[..., 1] >= moments[..., 2])
