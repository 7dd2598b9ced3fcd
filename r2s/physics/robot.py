"""The arm: kinematics, inertia and gravity from an MJCF or URDF file, limits from it or from the config.

r2s commands joint torques, so a file's actuators, sensors, keyframes and contacts are dropped; its joints,
links, armature and damping stay. Any serial arm of hinge joints works: `robot.mjcf=FILE`.
"""

from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from r2s.errors import UserError, choices, nearest
from r2s.files import located
from r2s.physics.urdf import is_urdf, read_urdf

PANDA = "r2s:models/panda.xml"
SIM_DT = 1e-3  # s, the arm's own cycle
DQ_MAX = 2.0  # rad/s, where nobody says how fast a joint may be
OF_TASKS = ("torque_fraction", "tracking_fraction", "reach")  # what conf/robot says beside `load_robot`'s arguments


@dataclass(frozen=True)
class Robot:
    """A serial arm of n hinge joints.

    Attributes:
        name: the model's name.
        mjcf: its file, MJCF or URDF.
        q_min, q_max: (n,) rad; -inf and inf where a joint turns without end.
        dq_max: (n,) rad/s. ddq_max: (n,) rad/s^2.
        tau_max: (n,) Nm. dtau_max: (n,) Nm/s.
        q_home: (n,) rad, where episodes and excitations start.
        ee_site: the site of `model` that reaches for goals.
        gravity: (3,) m/s^2 in the base frame.
        mass: (n,) kg and com: (n, 3) m of each moving link, nominal, link frame.
        inertia: (n, 3, 3) kg m^2, nominal tensor of each moving link about its centre of mass, link axes.
        armature: (n,) kg m^2, nominal inertia of each joint's rotor, as the joint feels it through the gear.
        slowing: where an arm allows less speed the closer a joint is to a position limit: deceleration (n,) rad/s^2
            and offset (n,) rad/s, of sqrt(2 deceleration way + offset^2) - offset. None: it does not.
    """

    name: str
    mjcf: Path
    q_min: np.ndarray
    q_max: np.ndarray
    dq_max: np.ndarray
    ddq_max: np.ndarray
    tau_max: np.ndarray
    dtau_max: np.ndarray
    q_home: np.ndarray
    ee_site: str
    gravity: np.ndarray
    mass: np.ndarray
    com: np.ndarray
    inertia: np.ndarray
    armature: np.ndarray
    slowing: tuple[np.ndarray, np.ndarray] | None = None

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.q_min)

    @property
    def q_range(self) -> tuple[np.ndarray, np.ndarray]:
        """(low, high) (n,) rad to take angles from: the limits; where they leave more than a turn, one about home."""
        more = self.q_max - self.q_min > 2 * np.pi
        low = np.where(more, np.maximum(self.q_min, self.q_home - np.pi), self.q_min)
        return low, np.where(more, np.minimum(self.q_max, self.q_home + np.pi), self.q_max)

    def model(self, *, gravity: bool, user: int = 0, memory: int = 0, dt: float = SIM_DT) -> mujoco.MjModel:
        """Compile the arm.

        Args:
            gravity: False is libfranka's convention (the arm compensates it); True is for link-side torque.
            user: width of `jnt_user`, where the friction law keeps its parameters (r2s/physics/native_friction.py).
            memory: doubles that it remembers from step to step.
            dt: time step, s.
        """
        spec, _ = read_spec(self.mjcf)
        spec.compile()  # gives the joints their ids, and what is changed below takes them away
        joints = sorted(spec.joints, key=lambda joint: joint.id)
        for item in [*spec.actuators, *spec.sensors, *spec.keys]:
            spec.delete(item)
        if self.ee_site not in [site.name for site in spec.sites]:
            spec.body(self.ee_site).add_site(name=self.ee_site)
        unit = np.degrees(1.0) if spec.compiler.degree else 1.0
        for joint, limits, rotor in zip(joints, np.stack([self.q_min, self.q_max], -1), self.armature, strict=True):
            joint.armature = rotor
            joint.limited = int(np.isfinite(limits).all())
            joint.range = unit * limits if joint.limited else np.zeros(2)
            joint.actfrclimited = mujoco.mjtLimited.mjLIMITED_FALSE
            joint.parent.simple = False  # its centre and tensor may become others
        spec.nuser_jnt = user
        spec.nuserdata = memory
        spec.option.timestep = dt
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
        spec.option.gravity = self.gravity if gravity else np.zeros(3)
        return spec.compile()


def per_joint(name: str, value: ArrayLike, n: int, joints: str) -> np.ndarray:
    """Return (n,) floats: a value per joint, or one for all.

    Raises:
        UserError: `name` has another number of values, or none; `joints` says of what, as in "the 7 joints of panda".
    """
    try:
        array = np.array(value, dtype=float)
        if any(isinstance(x, bool | np.bool_) for x in np.ravel(np.array(value, dtype=object))):
            raise ValueError  # yaml's true is no 1
    except (TypeError, ValueError):
        raise UserError(f"{name} is not a number, nor one for each of {joints}") from None
    array = np.full(n, float(array)) if array.ndim == 0 else array
    if array.shape != (n,):
        raise UserError(f"{name}: {array.size} values for {joints}")
    return array


def read_spec(path: Path) -> tuple[mujoco.MjSpec, np.ndarray]:
    """Return what an MJCF or URDF file describes, and the joints' speed limits, (n,) or one, rad/s; nan: none.

    Raises:
        UserError: the file is not valid.
    """
    if is_urdf(path):
        return read_urdf(path)
    try:
        return mujoco.MjSpec.from_file(str(path)), np.array(np.nan)
    except ValueError as error:
        raise UserError(f"robot.mjcf: {path} is not a valid MJCF: {' '.join(str(error).split())}") from None


def load_robot(
    mjcf: str | None = None,
    *,
    ee: str | None = None,
    q_home: list[float] | None = None,
    q_min: list[float] | None = None,
    q_max: list[float] | None = None,
    dq_max: list[float] | float | None = None,
    ddq_max: list[float] | float = 10.0,
    tau_max: list[float] | None = None,
    dtau_max: list[float] | float = 1000.0,
    gravity: list[float] | None = None,
    armature: list[float] | float | None = None,
) -> Robot:
    """Read an arm from an MJCF or URDF file; None is the embedded Panda. What is given here goes over the file's.

    Joint ranges and torque limits are read from the file (of MJCF: `actuatorfrcrange` of the joint, or
    `forcerange`/`ctrlrange` of its motor), and of URDF speed limits. Acceleration and torque-rate limits are part of
    neither.

    Args:
        mjcf: the file; `r2s:models/panda.xml` is one of the package.
        ee: the site, body or link that is the end effector; None: the only site, or the last link of a URDF.
        q_home, q_min, q_max: rad. dq_max: rad/s. ddq_max: rad/s^2. tau_max: Nm. dtau_max: Nm/s.
        gravity: (3,) m/s^2 in the base frame; None: the file's, which in a URDF is an upright base's.
        armature: kg m^2, of the rotors at the joints; None: the file's.

    Raises:
        UserError: missing or broken file, not a serial arm of hinge joints, limits or end effector that cannot be
            found.
    """
    path = located(mjcf or PANDA)
    if not path.is_file():
        others = [p.name for p in path.parent.glob("*.*")] if path.parent.is_dir() else []
        raise UserError(f"robot.mjcf: no such file: {path}{nearest(path.name, others)}")
    spec, fastest = read_spec(path)
    try:
        model = spec.compile()
    except ValueError as error:
        raise UserError(f"robot.mjcf: {path} is not a valid model: {' '.join(str(error).split())}") from None
    _check_serial(model, path)
    n = model.njnt
    site = _end_effector(model, ee, path)

    def each(name: str, value: list[float] | float | None, fallback: np.ndarray) -> np.ndarray:
        return per_joint(f"robot.{name}", fallback if value is None else value, n, f"the {n} joints of {path.name}")

    limited = model.jnt_limited.astype(bool)
    low = each("q_min", q_min, np.where(limited, model.jnt_range[:, 0], -np.inf))
    high = each("q_max", q_max, np.where(limited, model.jnt_range[:, 1], np.inf))
    if not np.all(ranges := (low < high) & (np.isfinite(low) == np.isfinite(high))):
        joint = int(np.argmin(ranges))
        raise UserError(
            f"robot.q_min: joint {joint + 1} from {low[joint]:g} to {high[joint]:g} rad is no range; allowed: q_min "
            "below q_max, or neither"
        )
    torque = each("tau_max", tau_max, _torque_limits(model))
    if not np.all(torque > 0):
        joints = [model.joint(i).name or f"joint {i + 1}" for i in np.flatnonzero(~(torque > 0))]
        raise UserError(
            f"robot.tau_max: {path.name} gives no torque limit for {choices(joints)}; set robot.tau_max=[...]"
        )
    tenth = 0.1 * np.where(np.isfinite(high - low), high - low, 0.0)
    home = each("q_home", q_home, np.clip(model.qpos0, low + tenth, high - tenth))
    if np.any(home < low) or np.any(home > high):
        joint = int(np.argmax(np.maximum(low - home, home - high)))
        raise UserError(
            f"robot.q_home: joint {joint + 1} at {home[joint]:.3f} rad, allowed {low[joint]:.3f} to {high[joint]:.3f}"
        )
    rotation = np.zeros((n, 3, 3))
    for i, body in enumerate(model.jnt_bodyid):
        mujoco.mju_quat2Mat(rotation[i].reshape(9), model.body_iquat[body])
    principal = model.body_inertia[model.jnt_bodyid]
    return Robot(
        name=spec.modelname or path.stem,
        mjcf=path.resolve(),
        q_min=low,
        q_max=high,
        dq_max=each("dq_max", dq_max, np.where(np.isfinite(fastest), fastest, DQ_MAX)),
        ddq_max=each("ddq_max", ddq_max, np.ones(n)),
        tau_max=torque,
        dtau_max=each("dtau_max", dtau_max, np.ones(n)),
        q_home=home,
        ee_site=site,
        gravity=per_joint("robot.gravity", model.opt.gravity if gravity is None else gravity, 3, "x, y and z"),
        mass=model.body_mass[model.jnt_bodyid].copy(),
        com=model.body_ipos[model.jnt_bodyid].copy(),
        inertia=rotation * principal[:, None, :] @ rotation.transpose(0, 2, 1),
        armature=each("armature", armature, model.dof_armature),
    )


def _check_serial(model: mujoco.MjModel, path: Path) -> None:
    """Raise UserError unless every joint is a hinge and each moves a link on one chain."""
    for i in range(model.njnt):
        if model.jnt_type[i] != mujoco.mjtJoint.mjJNT_HINGE:
            kind = mujoco.mjtJoint(int(model.jnt_type[i])).name
            raise UserError(
                f"robot.mjcf: {path.name}: joint '{model.joint(i).name}' is {kind}; only hinges are allowed"
            )
    if model.njnt == 0:
        raise UserError(f"robot.mjcf: {path.name} has no joints")
    for previous, body in zip(model.jnt_bodyid[:-1], model.jnt_bodyid[1:], strict=True):
        ancestors, at = [], body
        while at:
            at = model.body_parentid[at]
            ancestors.append(at)
        if previous not in ancestors:
            raise UserError(
                f"robot.mjcf: {path.name} is not a serial arm: link '{model.body(body).name}' does not follow "
                f"'{model.body(previous).name}'"
            )


def _end_effector(model: mujoco.MjModel, name: str | None, path: Path) -> str:
    """Return the name of a site, or of a body whose frame is to be one; None: the only candidate."""
    sites = [model.site(i).name for i in range(model.nsite)]
    bodies = [model.body(i).name for i in range(1, model.nbody) if model.body(i).name]
    if name is None:
        # of a URDF, which has no sites: links at the arm's end that carry no other
        ends = _ends(model) if is_urdf(path) else sites
        if len(ends) != 1:
            raise UserError(f"robot.ee: name one of {path.name}: {choices(ends or bodies)}")
        return ends[0]
    if name not in [*sites, *bodies]:
        raise UserError(
            f"robot.ee: no site, body or link '{name}' in {path.name}; it has {choices([*sites, *bodies])}"
            f"{nearest(name, [*sites, *bodies])}"
        )
    return name


def _ends(model: mujoco.MjModel) -> list[str]:
    """Return the names of the bodies that move with the last joint and carry no other."""
    last = model.jnt_bodyid[-1]
    carrying = set(model.body_parentid.tolist())
    return [model.body(i).name for i in np.flatnonzero(model.body_weldid == last) if i not in carrying]


def _torque_limits(model: mujoco.MjModel) -> np.ndarray:
    """Return (n,) Nm from the joints' actuatorfrcrange or their motors' ranges; nan where the file has none."""
    limit = np.where(model.jnt_actfrclimited.astype(bool), np.abs(model.jnt_actfrcrange).min(1), np.nan)
    for i in range(model.nu):
        joint = model.actuator_trnid[i, 0]
        if model.actuator_trntype[i] != mujoco.mjtTrn.mjTRN_JOINT or not np.isnan(limit[joint]):
            continue
        if model.actuator_forcelimited[i]:
            limit[joint] = np.abs(model.actuator_forcerange[i]).min() * abs(model.actuator_gear[i, 0])
        elif model.actuator_ctrllimited[i] and model.actuator_biastype[i] == mujoco.mjtBias.mjBIAS_NONE:
            limit[joint] = np.abs(model.actuator_ctrlrange[i]).min() * abs(model.actuator_gear[i, 0])
    return limit
