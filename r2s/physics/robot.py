"""Load a `Robot`: kinematics, inertia and gravity from an MJCF or URDF file, limits from the file or the config.

`Robot.model` has the file's joints and links, but no sensors, keyframes, free objects, gravity compensation or
contacts, and no actuators, because r2s commands joint torques. The file's damping and frictionloss are nominal values
of the friction law (dynamics.py), so `Robot.model` sets both to 0. Nonlinear damping stays in `Robot.model`. The
file's armature is the nominal rotor inertia. `robot.mjcf=FILE` loads any serial arm of hinge joints.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from r2s.errors import UserError, check_number, choices, nearest, nearest_file
from r2s.files import located
from r2s.physics.obstacle import Box
from r2s.physics.robot_checks import check_arm, check_limits, check_masses, gravity_of, torque_limits
from r2s.physics.robot_file import read_spec, rotors, strip
from r2s.physics.surface import Tool, load_tool
from r2s.physics.urdf import NO_RANGE, is_urdf

PANDA = "r2s:models/panda.xml"
# Share of an arm's torque rate limit that commands use. libfranka's own limiter stays 1e-3 Nm/s below the limit; an
# FR3 reports its last torque as float32, which changes a torque step by up to 8e-6 Nm.
RATE_SHARE = 0.99
SIM_DT = 1e-3  # s, control cycle of the arm, and physics step
DQ_MAX = 2.0  # rad/s, default velocity limit, conservative for an arm of the Panda's size
# Ratios that define default payload limits, from a Panda (3 kg, 0.15 m, 87 Nm): payload weight * reach / largest
# torque limit, and distance from the end effector to the payload's center / reach.
PAYLOAD_SHARE, PAYLOAD_FAR = 0.33, 0.15
OF_TASKS = ("torque_fraction", "tracking_fraction", "reach")  # keys of conf/robot for tasks, not for `load_robot`


@dataclass(frozen=True)
class Robot:
    """A serial arm of n hinge joints.

    Attributes:
        name: the model's name.
        mjcf: the model's file, MJCF or URDF.
        q_min, q_max: (n,) rad, position limits; -inf and inf for a continuous joint.
        dq_max, ddq_max: (n,) rad/s and rad/s^2, velocity and acceleration limits.
        tau_max, dtau_max: (n,) Nm and Nm/s, limits of torque and torque rate.
        q_home: (n,) rad, home posture, in which episodes and excitations start.
        ee_site: name of the end effector's site in `model`.
        gravity: (3,) m/s^2 in the base frame.
        mass, com: (n,) kg and (n, 3) m, nominal mass and center of mass of each moving link, link frame.
        inertia: (n, 3, 3) kg m^2, nominal tensor of each moving link about its center of mass, link axes.
        armature: (n,) kg m^2, nominal rotor inertia reflected to the joint.
        damping, frictionloss: (n,) Nm s/rad and (n,) Nm, viscous and Coulomb friction in the file, 0 by default.
        velocity_envelope: deceleration (n,) rad/s^2 and offset (n,) rad/s of an FR3. At a distance, rad, from a
            position limit, an FR3's velocity limit is sqrt(2 deceleration distance + offset^2) - offset. None: the
            velocity limit does not depend on position.
        tool: the spherical tip that touches surfaces; None: no tool.
        lock: {joint: rad or m}, positions of the welded joints.
        payload_max: (2,) largest payload mass, kg, and largest distance, m, from end effector to payload center.
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
    damping: np.ndarray
    frictionloss: np.ndarray
    velocity_envelope: tuple[np.ndarray, np.ndarray] | None = None
    tool: Tool | None = None
    lock: Mapping[str, float] = field(default_factory=dict)
    payload_max: tuple[float, float] = (3.0, 0.15)

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.q_min)

    @property
    def step_max(self) -> np.ndarray:
        """Largest change (n,) Nm of a command in one cycle of 1 ms."""
        return RATE_SHARE * self.dtau_max * SIM_DT

    @property
    def q_range(self) -> tuple[np.ndarray, np.ndarray]:
        """Position limits (low, high), (n,) rad; a range above 2 pi is cut to at most pi on either side of home."""
        more = self.q_max - self.q_min > 2 * np.pi
        low = np.where(more, np.maximum(self.q_min, self.q_home - np.pi), self.q_min)
        return low, np.where(more, np.minimum(self.q_max, self.q_home + np.pi), self.q_max)

    def model(
        self, *, gravity: bool, user: int = 0, memory: int = 0, dt: float = SIM_DT, obstacles: Sequence[Box] = ()
    ) -> mujoco.MjModel:
        """Compile the MuJoCo model.

        Args:
            gravity: whether gravity acts; True for link-side torque, False for torque without gravity (libfranka).
            user: number of columns of `jnt_user`, which stores parameters of the callback (mujoco_callback.py).
            memory: number of doubles in `userdata`, the state of the callback.
            dt: time step, s.
            obstacles: boxes around the arm, used only to compute distances.
        """
        spec, _ = read_spec(self.mjcf, self.lock)
        spec.compile()  # assigns joint ids, which the changes below invalidate
        joints = sorted(spec.joints, key=lambda joint: joint.id)
        strip(spec)
        if self.ee_site not in [site.name for site in spec.sites]:
            spec.body(self.ee_site).add_site(name=self.ee_site)
        unit = np.degrees(1.0) if spec.compiler.degree else 1.0
        for joint, limits, rotor in zip(joints, np.stack([self.q_min, self.q_max], -1), self.armature, strict=True):
            joint.armature, joint.frictionloss = rotor, 0.0
            joint.damping = [0.0, *np.atleast_1d(joint.damping)[1:]]  # polynomial damping stays
            joint.limited = int(np.isfinite(limits).all())
            joint.range = unit * limits if joint.limited else np.zeros(2)
            joint.actfrclimited = mujoco.mjtLimited.mjLIMITED_FALSE
            joint.parent.simple = False  # MuJoCo simplifies `simple` bodies, but a body's inertia may change
        for number, box in enumerate(obstacles, 1):
            box.add_to(spec, number)
        spec.nuser_jnt = user
        spec.nuserdata = memory
        spec.option.timestep = dt
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        spec.option.gravity = self.gravity if gravity else np.zeros(3)
        return spec.compile()


def per_joint(name: str, value: ArrayLike, n: int, joints: str) -> np.ndarray:
    """Return an array (n,) from one value per joint or one for all joints; joints: name of the joints in messages.

    Raises:
        UserError: the number of values is wrong, or a value is not a number.
    """
    try:
        array = np.array(value, dtype=float)
        if any(isinstance(x, bool | np.bool_) for x in np.ravel(np.array(value, dtype=object))):
            raise ValueError  # YAML's true would become 1.0
    except (TypeError, ValueError):
        raise UserError(f"{name}: expected a number, or one for each of {joints}, got {value!r}") from None
    array = np.full(n, float(array)) if array.ndim == 0 else array
    if array.shape != (n,):
        raise UserError(f"{name}: expected {n} values, for {joints}, got {array.size}")
    return array


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
    tool: str | None = None,
    lock: Mapping[str, float] | None = None,
    payload_max: float | None = None,
    payload_far: float | None = None,
) -> Robot:
    """Read an arm from an MJCF or URDF file; arguments except `mjcf` override values of the file.

    r2s reads position limits, torque limits (MJCF: `actuatorfrcrange` of the joint, or `forcerange`/`ctrlrange` of
    its motor), q_home (a keyframe named home) and, from a URDF, velocity limits. MJCF and URDF have no limits of
    acceleration or torque rate. r2s ignores `gravcomp`, gravity flags and objects on free joints in the file.

    Args:
        mjcf: path of the file; `r2s:` is the package's folder, as in `r2s:models/panda.xml`; if None, load the Panda.
        ee: site, body or link of the end effector; if None, use the only site, or the last link of a URDF.
        q_home, q_min, q_max, dq_max, ddq_max, tau_max, dtau_max: see `Robot`; if None, from the file or a default.
        gravity: (3,) m/s^2 in the base frame; None: the file's gravity or, for a URDF, gravity of an upright base.
        armature: kg m^2, rotor inertia reflected to the joints; None: the file's armature.
        tool: JSON file of the tool's tip (r2s/physics/surface.py); None: no tool.
        lock: {joint: rad or m}, positions at which to weld joints, such as a gripper's; None: weld no joint.
        payload_max, payload_far: kg and m, for `Robot.payload_max`; if None, from torque limits and reach.

    Raises:
        UserError: the file is missing or invalid, is no serial arm of hinges, or lacks limits or the end effector.
    """
    path = located(mjcf or PANDA)
    spec, model, fastest = _read(path, lock)
    down = gravity_of(model, path) if gravity is None else per_joint("robot.gravity", gravity, 3, "x, y and z")
    n, site = model.njnt, _end_effector(model, ee, path)

    def each(name: str, value: list[float] | float | None, fallback: np.ndarray) -> np.ndarray:
        return per_joint(f"robot.{name}", fallback if value is None else value, n, f"the {n} joints of {path.name}")

    low, high, home, torque = _limits(spec, model, path, each, q_min, q_max, q_home, tau_max)
    check_masses(model, path, down, home, torque)
    own_armature, damping = rotors(model)
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
        gravity=down,
        mass=model.body_mass[model.jnt_bodyid].copy(),
        com=model.body_ipos[model.jnt_bodyid].copy(),
        inertia=_tensors(model),
        armature=each("armature", armature, own_armature),
        damping=damping,
        frictionloss=model.dof_frictionloss.copy(),
        tool=None if tool is None else load_tool(tool),
        lock=dict(lock or {}),
        payload_max=_payload_max(model, site, torque, payload_max, payload_far),
    )


def _read(path: Path, lock: Mapping[str, float] | None) -> tuple[mujoco.MjSpec, mujoco.MjModel, np.ndarray]:
    """Return the MjSpec, the checked model and the velocity limits, rad/s, of a file; nan: no velocity limit."""
    if not path.is_file():
        raise UserError(f"robot.mjcf: no such file: {path}{nearest_file(path, '*.*')}")
    spec, fastest = read_spec(path, lock)
    try:
        model = spec.compile()
    except ValueError as error:
        raise UserError(f"robot.mjcf: {path} is not a valid model: {' '.join(str(error).split())}") from None
    check_arm(model, path)
    return spec, model, fastest


def _limits(
    spec: mujoco.MjSpec,
    model: mujoco.MjModel,
    path: Path,
    each: Callable[[str, list[float] | None, np.ndarray], np.ndarray],
    q_min: list[float] | None,
    q_max: list[float] | None,
    q_home: list[float] | None,
    tau_max: list[float] | None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return checked q_min, q_max, q_home (n,) rad and tau_max (n,) Nm; replace None by the file's value."""
    limited = model.jnt_limited.astype(bool)
    low = each("q_min", q_min, np.where(limited, model.jnt_range[:, 0], -np.inf))
    high = each("q_max", q_max, np.where(limited, model.jnt_range[:, 1], np.inf))
    tenth = 0.1 * np.where(np.isfinite(high - low), high - low, 0.0)
    keys = {model.key(i).name: model.key_qpos[i] for i in range(model.nkey)}
    home = each("q_home", q_home, keys.get("home", np.clip(model.qpos0, low + tenth, high - tenth)))
    torque = each("tau_max", tau_max, torque_limits(model))
    unset = [joint.name for joint in spec.joints if joint.info == NO_RANGE and (q_min is None or q_max is None)]
    check_limits(model, path, low, high, home, torque, unset)
    return low, high, home, torque


def _payload_max(
    model: mujoco.MjModel, ee: str, torque: np.ndarray, mass: float | None, far: float | None
) -> tuple[float, float]:
    """Return `Robot.payload_max`; estimate `mass` or `far`, if None, from torque limits and reach beyond joint 2."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    sites = [model.site(i).name for i in range(model.nsite)]
    end = data.site(ee).xpos if ee in sites else data.body(ee).xpos
    reach = np.linalg.norm(np.diff(np.concatenate([data.xanchor[1:], end[None]]), axis=0), axis=1).sum()
    reach = max(float(reach), 1e-3)
    for name, value in (("payload_max", mass), ("payload_far", far)):
        if value is not None:
            check_number(f"robot.{name}", value, "(0, inf)")
    own = PAYLOAD_SHARE * float(torque.max()) / (9.81 * reach)
    return float(own if mass is None else mass), float(PAYLOAD_FAR * reach if far is None else far)


def _tensors(model: mujoco.MjModel) -> np.ndarray:
    """Return the inertia tensors (n, 3, 3) kg m^2 of the moving links about their centers of mass, link axes."""
    rotation = np.zeros((model.njnt, 3, 3))
    for i, body in enumerate(model.jnt_bodyid):
        mujoco.mju_quat2Mat(rotation[i].reshape(9), model.body_iquat[body])
    principal = model.body_inertia[model.jnt_bodyid]
    return rotation * principal[:, None, :] @ rotation.transpose(0, 2, 1)


def _end_effector(model: mujoco.MjModel, name: str | None, path: Path) -> str:
    """Return the name of the end effector, a site or a body of the model."""
    sites = [model.site(i).name for i in range(model.nsite)]
    bodies = [model.body(i).name for i in range(1, model.nbody) if model.body(i).name]
    if name is None:
        # a URDF has no sites: use its last links
        ends = _ends(model) if is_urdf(path) else sites
        if len(ends) != 1:
            raise UserError(f"robot.ee: choose the end effector of {path.name}: {choices(ends or bodies)}")
        return ends[0]
    if name not in [*sites, *bodies]:
        raise UserError(
            f"robot.ee: expected one of {choices([*sites, *bodies])} in {path.name}, got '{name}'"
            f"{nearest(name, [*sites, *bodies])}"
        )
    return name


def _ends(model: mujoco.MjModel) -> list[str]:
    """Return the names of the bodies that move with the last joint and have no child body."""
    last = model.jnt_bodyid[-1]
    parents = set(model.body_parentid.tolist())
    return [model.body(i).name for i in np.flatnonzero(model.body_weldid == last) if i not in parents]
