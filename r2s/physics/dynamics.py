"""What an arm's dynamics are: friction, offsets, breakaway, links, rotors, delay and lag."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from r2s.errors import UserError, check_number, choices, nearest
from r2s.physics.friction import SIGMOID, Family
from r2s.physics.friction import family as friction_family
from r2s.physics.robot import Robot, per_joint

HOLDS = ("command", "net")
BEYOND = 1e4  # Nm, s/rad, rad/s: what a friction parameter cannot be


@dataclass(frozen=True)
class Dynamics:
    """What identification finds and domain randomization draws; any leading batch shape, each field its own.

    Attributes:
        phi: (..., n, K), the parameters of `family`; the paper's are Nm, s/rad, rad/s of eq. (5).
        offset: (..., n) Nm, added to every command.
        breakaway: (..., n, 2) Nm, negative and positive edge of what a joint at rest is held between.
        dq_min: rad/s, speed below which it may be held.
        mass: (..., n) kg, com: (..., n, 3) m, link frame.
        inertia: (..., n, 3, 3) kg m^2 about each link's centre of mass, link axes.
        armature: (..., n) kg m^2, inertia of each joint's rotor, as the joint feels it through the gear. A link-side
            torque sensor does not.
        load: (..., n), friction per torque that gravity loads the joint with.
        drag: (..., n, 2) Nm, offset that goes with the joint's own sin q and cos q, as a cable's.
        gain: (..., n), relative error of the link-side torque sensor, or of the motor's torque constant: of what is
            recorded, not of the arm.
        speed_noise: (..., n) rad/s, standard deviation of what sensors add to a speed: of what a policy is shown, not
            of the arm.
        family: of the friction.
        hold: which torque the edges are of. "command" is the paper's eq. (6): command and offset are nullified while
            they are within the edges. "net" is stiction: a joint stays where it is while all that acts on it, the
            other joints' motion included, is within the edges (r2s/physics/stick_slip.py).
        delay, lag: (...) s, of the actuation: pure, and first order. The simulator does not apply them: whoever
            makes the commands does (`Motors` of r2s/physics/actuation.py).
        told: (..., 4) kg and kg m, mass and first moment in the last link's frame of the load that the arm's own
            gravity compensation was told of (r2s/physics/payload.py); what is there in truth is in the last link.
    """

    phi: np.ndarray
    offset: np.ndarray
    breakaway: np.ndarray
    dq_min: float
    mass: np.ndarray
    com: np.ndarray
    inertia: np.ndarray
    armature: np.ndarray
    load: np.ndarray
    drag: np.ndarray
    gain: np.ndarray
    speed_noise: np.ndarray
    family: Family = SIGMOID
    hold: str = "command"
    delay: np.ndarray | float = 0.0
    lag: np.ndarray | float = 0.0
    told: np.ndarray = field(default_factory=lambda: np.zeros(4))

    def __post_init__(self) -> None:
        if self.hold not in HOLDS:
            raise UserError(
                f"friction.hold: '{self.hold}'; allowed: {choices(HOLDS)}{nearest(str(self.hold), HOLDS)}"
            )

    @staticmethod
    def of(robot: Robot, phi: np.ndarray, family: Family = SIGMOID, dq_min: float = 0.01) -> "Dynamics":
        """Return the robot's own links and rotors with friction phi (..., n, K) of a family, and nothing else."""
        n = robot.n
        return Dynamics(
            phi=phi,
            offset=np.zeros(n),
            breakaway=np.zeros((n, 2)),
            dq_min=dq_min,
            mass=robot.mass,
            com=robot.com,
            inertia=robot.inertia,
            armature=robot.armature,
            load=np.zeros(n),
            drag=np.zeros((n, 2)),
            gain=np.zeros(n),
            speed_noise=np.zeros(n),
            family=family,
        )

    def friction(self, dq: np.ndarray, bristle: np.ndarray | None = None) -> np.ndarray:
        """Return (..., n) Nm at dq (..., n) rad/s; what goes with the load is not in it. `bristle`: Family.torque."""
        return self.family.torque(dq, self.phi, bristle)

    @property
    def level(self) -> np.ndarray:
        """(..., n) Nm, what friction surely holds a sliding joint with: the lesser of both ways at 1 rad/s."""
        n = self.phi.shape[-2]
        return np.minimum(self.friction(np.full(n, 1.0)), -self.friction(np.full(n, -1.0))).clip(0.0)

    def one(self, k: int) -> "Dynamics":
        """Return the k-th of a batch (m, ...); fields that all arms share stay as they are."""
        values = {name: (getattr(self, name), axes) for name, axes in AXES.items()}
        return replace(self, **{name: v[k] for name, (v, axes) in values.items() if np.ndim(v) > axes})


# of an array that one arm has
AXES = {"phi": 2, "offset": 1, "breakaway": 2, "mass": 1, "com": 2, "inertia": 3, "armature": 1}
AXES |= {"load": 1, "drag": 2, "gain": 1, "delay": 0, "lag": 0, "speed_noise": 1, "told": 1}


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
    hold: str = "command",
    inertia_scale: Sequence[float] | float = 1.0,
) -> Dynamics:
    """Return the dynamics that `conf/friction` and `conf/inertia` describe: a number per joint, or one for all.

    A family other than the sigmoid gets the sigmoid's level at 1 rad/s; auto is the sigmoid, until data choose.

    Raises:
        UserError: a list that does not fit the arm's joints, or a value out of its physical range.
    """

    def joints(name: str, value: Sequence[float] | float) -> np.ndarray:
        array = per_joint(name, value, robot.n, f"the {robot.n} joints of {robot.name}")
        if not np.all(np.isfinite(array)):
            raise UserError(f"{name}: {array.tolist()} has a value that is not finite")
        if np.abs(array).max() > BEYOND:
            raise UserError(f"{name}: {array.tolist()} has a value beyond any arm's; at most {BEYOND:g} is allowed")
        return array

    phi = np.stack([joints("friction.phi1", phi1), joints("friction.phi2", phi2)], -1)
    scale = joints("inertia.scale", inertia_scale)
    for name, values in (("friction.phi1", phi[:, 0]), ("friction.phi2", phi[:, 1])):
        if np.any(values < 0):
            raise UserError(f"{name}: {values.min():g} is negative; friction must take energy out")
    if np.any(scale <= 0):
        raise UserError(f"inertia.scale: {scale.min():g} is not positive")
    low = joints("friction.breakaway_negative", breakaway_negative)
    high = joints("friction.breakaway_positive", breakaway_positive)
    if np.any(low > 0) or np.any(high < 0):
        raise UserError("friction.breakaway: the negative edges must be <= 0 and the positive ones >= 0")
    check_number("friction.dq_min", dq_min, "[0, 10]")
    named = SIGMOID if family == "auto" else friction_family(family)
    phi = np.concatenate([phi, joints("friction.phi3", phi3)[:, None]], -1)
    return replace(
        Dynamics.of(robot, named.like(SIGMOID, phi), named, float(dq_min)),
        offset=joints("friction.offset", offset),
        breakaway=np.stack([low, high], -1),
        inertia=robot.inertia * scale[:, None, None],
        hold=hold,
    )


def of_family(dynamics: Dynamics, name: str) -> Dynamics:
    """Return the dynamics with friction of another family, of the same level at 1 rad/s."""
    named = friction_family(name)
    return replace(dynamics, family=named, phi=named.like(dynamics.family, dynamics.phi))
