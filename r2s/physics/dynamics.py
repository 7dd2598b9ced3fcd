"""Dynamics parameters of an arm: friction, offsets, breakaway, links, rotors, delay and lag."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike

from r2s.errors import UserError, check_number, instead_of
from r2s.physics.friction import COULOMB, SIGMOID, Family
from r2s.physics.friction import family as friction_family
from r2s.physics.robot import Robot, per_joint
from r2s.physics.surface import Surface

STICTION_MODELS = ("command", "net")
CREEP = 2e-3  # rad/s, largest dq_min of "net": above the residual speed 1 ms after a stop, below that of any motion
PHI1 = 0.02  # ratio of `phi1` (twice the Coulomb torque) to tau_max for a joint without friction in the file
MAX_PARAMETER = 1e4  # Nm, s/rad, rad/s: largest allowed friction parameter, above that of any arm


@dataclass(frozen=True)
class Dynamics:
    """Parameters that identification estimates and domain randomization samples; arrays may have batch axes.

    Attributes:
        phi: (..., n, K), parameters of the friction law `family`; Nm, s/rad and rad/s for the sigmoid law.
        offset: (..., n) Nm, constant torque added to every command.
        breakaway: (..., n, 2) Nm, negative and positive breakaway torque.
        dq_min: rad/s, speed below which a joint can stick.
        mass: (..., n) kg, link masses. com: (..., n, 3) m, centers of mass, link frames.
        inertia: (..., n, 3, 3) kg m^2, inertia tensor of each link about its center of mass, link axes.
        armature: (..., n) kg m^2, rotor inertia reflected to the joint; link-side sensors do not measure its torque.
        load: (..., n) Nm/Nm, ratio of load-dependent friction to the gravity torque at the joint.
        drag: (..., n, 2) Nm, coefficients of sin q and cos q in an angle-dependent offset, such as a cable's torque.
        gain: (..., n), relative error of the link-side torque sensor or of the motor's torque constant; this error
            changes the recorded torque, but not the arm's motion.
        signal_delay: (...) s, delay of a recording's torque (measured or motor torque) behind its joint angles.
        late_alike: whether a recording's measured torque and dq have the same delay; identification then uses dq as
            logged.
        speed_noise: (..., n) rad/s, standard deviation of the velocity noise in a policy's observation.
        family: the friction law.
        stiction_model: "command" (the paper's equation (6)): on a joint at rest, command and offset have no effect
            while their sum is between the breakaway torques. "net": a joint sticks while the sum of all torques
            except friction, including the coupling to other joints, is between the breakaway torques
            (r2s/physics/stick_slip.py).
        delay, lag: (...) s, pure delay and first-order lag of the actuation. After `Simulator.drive`, the simulator
            applies delay and lag; otherwise, `Motors` (r2s/physics/actuation.py) applies them.
        declared_payload: (..., 4), the payload that is declared to gravity compensation (r2s/physics/payload.py):
            mass, kg, and first moment (3), kg m, in the last link's frame. The real payload is part of the last link.
        surface: surface that `Robot.tool` may touch (r2s/physics/contact.py), one or a batch; None: no surface.
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
    stiction_model: str = "command"
    delay: np.ndarray | float = 0.0
    lag: np.ndarray | float = 0.0
    signal_delay: np.ndarray | float = 0.0
    late_alike: bool = False
    declared_payload: np.ndarray = field(default_factory=lambda: np.zeros(4))
    surface: Surface | None = None

    def __post_init__(self) -> None:
        if self.stiction_model not in STICTION_MODELS:
            given = self.stiction_model
            raise UserError(f"friction.stiction_model: '{given}'; {instead_of(given, STICTION_MODELS)}")

    @staticmethod
    def of(robot: Robot, phi: np.ndarray, family: Family = SIGMOID, dq_min: float = 0.01) -> "Dynamics":
        """Return dynamics with nominal links, nominal rotors and friction phi (..., n, K); all other arrays are 0."""
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

    def holding_contact(self) -> "Dynamics":
        """Return the dynamics, with stiction_model="net" and dq_min <= CREEP if friction is discontinuous at rest.

        With stiction_model="command", any contact force would move a joint at rest.
        """
        if self.family.sharp is None:
            return self
        return replace(self, stiction_model="net", dq_min=min(self.dq_min, CREEP))

    def friction(self, dq: np.ndarray, bristle: np.ndarray | None = None) -> np.ndarray:
        """Return the load-independent friction (..., n) Nm at dq (..., n) rad/s; `bristle`: see Family.torque."""
        return self.family.torque(dq, self.phi, bristle)

    def onset_friction(self) -> np.ndarray:
        """Return the load-independent friction (..., n, 2) Nm at the onset of negative and of positive motion."""
        still = np.zeros(self.phi.shape[:-1])
        return np.stack([self.friction(still, still - 1.0), self.friction(still, still + 1.0)], -1)

    @property
    def level(self) -> np.ndarray:
        """Friction level (..., n) Nm: the smaller of the friction magnitudes at 1 rad/s and -1 rad/s."""
        n = self.phi.shape[-2]
        return np.minimum(self.friction(np.full(n, 1.0)), -self.friction(np.full(n, -1.0))).clip(0.0)

    def one(self, k: int) -> "Dynamics":
        """Return the dynamics of arm k of a batch (m, ...); fields without a batch axis stay unchanged."""
        values = {name: (getattr(self, name), axes) for name, axes in AXES.items()}
        single = {name: v[k] for name, (v, axes) in values.items() if np.ndim(v) > axes}
        return replace(self, **single, surface=None if self.surface is None else self.surface.one(k))


# Number of axes of each array for one arm.
AXES = {"phi": 2, "offset": 1, "breakaway": 2, "mass": 1, "com": 2, "inertia": 3, "armature": 1}
AXES |= {"load": 1, "drag": 2, "gain": 1, "delay": 0, "lag": 0, "signal_delay": 0}
AXES |= {"speed_noise": 1, "declared_payload": 1}


def nominal_dynamics(
    robot: Robot,
    *,
    family: str = "sigmoid",
    phi1: Sequence[float] | float | None,
    phi2: Sequence[float] | float,
    phi3: Sequence[float] | float,
    offset: Sequence[float] | float = 0.0,
    breakaway_positive: Sequence[float] | float | None = 0.0,
    breakaway_negative: Sequence[float] | float | None = 0.0,
    dq_min: float = 0.01,
    stiction_model: str = "command",
    inertia_scale: Sequence[float] | float = 1.0,
) -> Dynamics:
    """Return the dynamics that `conf/friction` and `conf/inertia` describe; a scalar value applies to all joints.

    phi1, phi2 and phi3 are the parameters of the sigmoid law. If phi1 is None, frictionloss and damping in the
    robot's file define Coulomb and viscous friction. If a joint has neither in the file, its phi1 is the
    constant PHI1 times tau_max. family="auto" selects the Coulomb law if the file has friction, else the sigmoid. Any
    other family receives parameters with the same friction at 1 rad/s. If a breakaway torque is None, its magnitude
    is the file's frictionloss.

    Raises:
        UserError: a list has the wrong length, or a value is out of its physical range.
    """

    def joints(name: str, value: ArrayLike) -> np.ndarray:
        array = per_joint(name, value, robot.n, f"the {robot.n} joints of {robot.name}")
        if not np.all(np.isfinite(array)):
            raise UserError(f"{name}: expected finite values, got {array.tolist()}")
        if np.abs(array).max() > MAX_PARAMETER:
            raise UserError(f"{name}: expected values of at most {MAX_PARAMETER:g}, got {array.tolist()}")
        return array

    declared = phi1 is None and bool(robot.damping.any() or robot.frictionloss.any())
    slow, fast = robot.frictionloss, robot.damping
    guess = np.where(slow + fast > 0, 2.0 * (slow + fast), PHI1 * robot.tau_max)  # phi1 from the file's friction
    phi = np.stack([joints("friction.phi1", guess if phi1 is None else phi1), joints("friction.phi2", phi2)], -1)
    scale = joints("inertia.scale", inertia_scale)
    for name, values in (("friction.phi1", phi[:, 0]), ("friction.phi2", phi[:, 1])):
        if np.any(values < 0):
            raise UserError(f"{name}: expected values of 0 or more (friction dissipates), got {values.min():g}")
    if np.any(scale <= 0):
        raise UserError(f"inertia.scale: expected positive values, got {scale.min():g}")
    low = joints("friction.breakaway_negative", -slow if breakaway_negative is None else breakaway_negative)
    high = joints("friction.breakaway_positive", slow if breakaway_positive is None else breakaway_positive)
    if np.any(low > 0) or np.any(high < 0):
        raise UserError("friction.breakaway: expected negative edges <= 0 and positive edges >= 0")
    check_number("friction.dq_min", dq_min, "[0, 10]")
    phi, law = np.concatenate([phi, joints("friction.phi3", phi3)[:, None]], -1), SIGMOID
    if declared:
        phi, law = np.stack([np.where(slow + fast > 0, slow, phi[:, 0] / 2), 0 * fast, fast], -1), COULOMB
    named = law if family == "auto" else friction_family(family)
    return replace(
        Dynamics.of(robot, named.matched_to(law, phi), named, float(dq_min)),
        offset=joints("friction.offset", offset),
        breakaway=np.stack([low, high], -1),
        inertia=robot.inertia * scale[:, None, None],
        stiction_model=stiction_model,
    )


def with_family(dynamics: Dynamics, name: str) -> Dynamics:
    """Return the dynamics with the friction family `name`; friction at 1 rad/s stays the same."""
    named = friction_family(name)
    return replace(dynamics, family=named, phi=named.matched_to(dynamics.family, dynamics.phi))
