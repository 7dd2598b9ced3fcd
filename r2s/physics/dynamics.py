"""What an arm's dynamics are: friction, offsets, breakaway, links, delay and lag."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from r2s.errors import UserError
from r2s.physics.friction import SIGMOID, Family
from r2s.physics.friction import family as friction_family
from r2s.physics.robot import Robot


@dataclass(frozen=True)
class Dynamics:
    """What identification finds and domain randomization draws; any leading batch shape, each field its own.

    Attributes:
        phi: (..., n, K), the parameters of `family`; the paper's are Nm, s/rad, rad/s of eq. (5).
        offset: (..., n) Nm, added to every command.
        breakaway: (..., n, 2) Nm, negative and positive edge of the dead zone, of command and offset together.
        dq_min: rad/s, speed below which the dead zone may hold.
        inertia: (..., n, 3, 3) kg m^2 about each link's centre of mass, link axes.
        mass: (..., n) kg, com: (..., n, 3) m, link frame; None: the robot's.
        family: of the friction.
        load: (..., n), friction per torque that gravity loads the joint with; None: 0.
        drag: (..., n, 2) Nm, offset that goes with the joint's own sin q and cos q, as a cable's; None: 0.
        gain: (..., n), relative error of the link-side torque sensor; None: 0. Only a measured torque knows it.
        delay, lag: (...) s, of the actuation: pure, and first order. The simulator does not apply them: whoever
            makes the commands does (`Motors` of r2s/physics/actuation.py).
    """

    phi: np.ndarray
    offset: np.ndarray
    breakaway: np.ndarray
    dq_min: float
    inertia: np.ndarray
    mass: np.ndarray | None = None
    com: np.ndarray | None = None
    family: Family = SIGMOID
    load: np.ndarray | None = None
    drag: np.ndarray | None = None
    gain: np.ndarray | None = None
    delay: np.ndarray | float = 0.0
    lag: np.ndarray | float = 0.0

    def friction(self, dq: np.ndarray, turn: np.ndarray | None = None) -> np.ndarray:
        """Return (..., n) Nm at dq (..., n) rad/s; what goes with the load is not in it. `turn`: Family.torque."""
        return self.family.torque(dq, self.phi, turn)

    def one(self, k: int) -> "Dynamics":
        """Return the k-th of a batch (m, ...); fields that all arms share stay as they are."""
        single = {
            "phi": 2,
            "offset": 1,
            "breakaway": 2,
            "inertia": 3,
            "mass": 1,
            "com": 2,
            "load": 1,
            "drag": 2,
            "gain": 1,
        }
        single |= {"delay": 0, "lag": 0}
        values = {name: getattr(self, name) for name in single}
        return replace(self, **{n: v[k] for n, v in values.items() if v is not None and np.ndim(v) > single[n]})

    def scaled(self, scale: np.ndarray) -> "Dynamics":
        """Return these dynamics with link tensors times `scale` (..., n): the paper's inertia genes."""
        return replace(self, inertia=self.inertia * np.asarray(scale)[..., None, None])


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
