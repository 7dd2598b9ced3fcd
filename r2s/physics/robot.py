"""The arm: kinematics and inertia from an MJCF file, limits from the config.

r2s commands joint torques, so a file's actuators, sensors, keyframes and contacts are dropped; its joints,
links, armature and damping stay. Any serial arm of hinge joints works: `robot.mjcf=FILE`.
"""

from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from r2s.errors import UserError, choices, nearest

PANDA_XML = Path(__file__).parent.parent / "models" / "panda.xml"
SIM_DT = 1e-3  # s, the arm's own cycle


@dataclass(frozen=True)
class Robot:
    """A serial arm of n hinge joints.

    Attributes:
        name: the model's name.
        mjcf: its file.
        q_min, q_max: (n,) rad. dq_max: (n,) rad/s. ddq_max: (n,) rad/s^2.
        tau_max: (n,) Nm. dtau_max: (n,) Nm/s.
        q_home: (n,) rad, where episodes and excitations start.
        ee_site: the site that reaches for goals.
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
    mass: np.ndarray
    com: np.ndarray
    inertia: np.ndarray
    armature: np.ndarray
    slowing: tuple[np.ndarray, np.ndarray] | None = None

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.q_min)

    def model(self, *, gravity: bool, user: int = 0, dt: float = SIM_DT) -> mujoco.MjModel:
        """Compile the arm.

        Args:
            gravity: False is libfranka's convention (the arm compensates it); True is for link-side torque.
            user: width of `jnt_user`, where the friction law keeps its parameters (r2s/physics/friction.py).
            dt: time step, s.
        """
        spec = mujoco.MjSpec.from_file(str(self.mjcf))
        spec.compile()  # gives the joints their ids
        for item in [*spec.actuators, *spec.sensors, *spec.keys]:
            spec.delete(item)
        unit = np.degrees(1.0) if spec.compiler.degree else 1.0
        for joint in spec.joints:
            joint.range = unit * np.array([self.q_min[joint.id], self.q_max[joint.id]])
            joint.limited = mujoco.mjtLimited.mjLIMITED_TRUE
            joint.actfrclimited = mujoco.mjtLimited.mjLIMITED_FALSE
        spec.nuser_jnt = user
        spec.nuserdata = self.n if user else 0  # what friction remembers
        spec.option.timestep = dt
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
        if not gravity:
            spec.option.gravity = np.zeros(3)
        return spec.compile()


def per_joint(name: str, value: ArrayLike, n: int, joints: str) -> np.ndarray:
    """Return (n,) floats: a value per joint, or one for all.

    Raises:
        UserError: `name` has another number of values, or none; `joints` says of what, as in "the 7 joints of panda".
    """
    try:
        array = np.array(value, dtype=float)
    except (TypeError, ValueError):
        raise UserError(f"{name} is not a number, nor one for each of {joints}") from None
    array = np.full(n, float(array)) if array.ndim == 0 else array
    if array.shape != (n,):
        raise UserError(f"{name}: {array.size} values for {joints}")
    return array


def load_robot(
    mjcf: str | None = None,
    *,
    ee_site: str | None = None,
    q_home: list[float] | None = None,
    q_min: list[float] | None = None,
    q_max: list[float] | None = None,
    dq_max: list[float] | float = 2.0,
    ddq_max: list[float] | float = 10.0,
    tau_max: list[float] | None = None,
    dtau_max: list[float] | float = 1000.0,
) -> Robot:
    """Read an arm from an MJCF file; None is the embedded Panda. What is given here goes over the file's.

    Joint ranges and torque limits (`actuatorfrcrange` of the joint, or `forcerange`/`ctrlrange` of its motor) are
    read from the file; velocity, acceleration and torque-rate limits are not part of MJCF.

    Raises:
        UserError: missing or broken file, not a serial arm of hinge joints, limits or site that cannot be found.
    """
    path = Path(mjcf) if mjcf else PANDA_XML
    if not path.is_file():
        others = [p.name for p in path.parent.glob("*.xml")] if path.parent.is_dir() else []
        raise UserError(f"robot.mjcf: no such file: {path}{nearest(path.name, others)}")
    try:
        spec = mujoco.MjSpec.from_file(str(path))
        model = spec.compile()
    except ValueError as error:
        raise UserError(f"robot.mjcf: {path} is not a valid MJCF: {' '.join(str(error).split())}") from None
    _check_serial(model, path)
    n = model.njnt
    site = _end_effector(model, ee_site, path)

    def each(name: str, value: list[float] | float | None, fallback: np.ndarray) -> np.ndarray:
        return per_joint(f"robot.{name}", fallback if value is None else value, n, f"the {n} joints of {path.name}")

    limited = model.jnt_limited.astype(bool)
    low = each("q_min", q_min, np.where(limited, model.jnt_range[:, 0], -np.pi))
    high = each("q_max", q_max, np.where(limited, model.jnt_range[:, 1], np.pi))
    torque = each("tau_max", tau_max, _torque_limits(model))
    if not np.all(torque > 0):
        joints = [model.joint(i).name or f"joint {i + 1}" for i in np.flatnonzero(~(torque > 0))]
        raise UserError(
            f"robot.tau_max: {path.name} gives no torque limit for {choices(joints)}; set robot.tau_max=[...]"
        )
    home = each("q_home", q_home, np.clip(model.qpos0, 0.9 * low + 0.1 * high, 0.1 * low + 0.9 * high))
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
        dq_max=each("dq_max", dq_max, np.ones(n)),
        ddq_max=each("ddq_max", ddq_max, np.ones(n)),
        tau_max=torque,
        dtau_max=each("dtau_max", dtau_max, np.ones(n)),
        q_home=home,
        ee_site=site,
        mass=model.body_mass[model.jnt_bodyid].copy(),
        com=model.body_ipos[model.jnt_bodyid].copy(),
        inertia=rotation * principal[:, None, :] @ rotation.transpose(0, 2, 1),
        armature=model.dof_armature.copy(),
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
    sites = [model.site(i).name for i in range(model.nsite)]
    if name is None:
        if len(sites) != 1:
            raise UserError(f"robot.ee_site: name one of the sites of {path.name}: {choices(sites) or 'it has none'}")
        return sites[0]
    if name not in sites:
        raise UserError(
            f"robot.ee_site: no site '{name}' in {path.name}; it has {choices(sites) or 'none'}{nearest(name, sites)}"
        )
    return name


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
