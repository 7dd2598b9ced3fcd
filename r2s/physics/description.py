"""The arm in one description and three formats: MJCF, URDF and SDF of the same links, limits and friction.

The MJCF that came with the robot is the source; identified masses, centres, tensors and rotors go over it. Each
link's frame in URDF and SDF is that of its joint at angle zero, so every tensor is written in link axes without a
rotation (a rotated inertial frame is read wrongly by ignition-physics 5.1, the physics of Gazebo Fortress).
"""

from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree as ET

import mujoco
import numpy as np

from r2s.errors import UserError
from r2s.physics.dynamics import Dynamics
from r2s.physics.robot import SIM_DT, Robot
from r2s.physics.urdf import GEAR, ROTOR

ENDLESS = 1e16  # rad: SDF's word for no limit
HAND = 1e-12, 1e-13  # kg, kg m^2 of the link `ee` of a URDF: a link without inertia gets 1 kg and 1 kg m^2 from DART


@dataclass(frozen=True)
class Link:
    """One moving link and the joint that moves it, as URDF and SDF want them.

    Attributes:
        name, joint: of the link, of its joint.
        origin: (4, 4) pose of the joint in the frame of the link before it, at angle zero.
        axis: (3,) in the joint's frame.
        mass: kg. com: (3,) m, in the link's frame. inertia: (3, 3) kg m^2 about it, link axes.
        damping: Nm s/rad. friction: Nm, Coulomb. armature: kg m^2.
    """

    name: str
    joint: str
    origin: np.ndarray
    axis: np.ndarray
    mass: float
    com: np.ndarray
    inertia: np.ndarray
    damping: float
    friction: float
    armature: float


def chain(robot: Robot, dynamics: Dynamics, *, friction: bool = True) -> tuple[list[Link], np.ndarray]:
    """Return the arm's links from base to hand, and the pose (4, 4) of the end effector in the last one.

    Args:
        robot: the arm. dynamics: masses, centres, tensors, rotors, friction.
        friction: add it as Coulomb and viscous terms that match it at 30 % and 100 % of the largest velocities.
    """
    model = robot.model(gravity=True)
    bodies, moving = Bodies(model), model.jnt_bodyid
    bodies.override(moving, dynamics.mass, dynamics.com, dynamics.inertia, robot.n)
    coulomb, viscous = coulomb_viscous(robot, dynamics) if friction else np.zeros((2, robot.n))
    out, before = [], np.eye(4)
    for i, body in enumerate(moving):
        _, fixed = bodies.moving_parent(model.body_parentid[body])
        joint = make_pose(model.jnt_pos[i], None)
        zero = make_pose(None, about(model.jnt_axis[i], -model.qpos0[i]))
        mass, com, inertia = bodies.lumped(body)
        out.append(
            Link(
                name=model.body(body).name or f"link{i + 1}",
                joint=model.joint(i).name or f"joint{i + 1}",
                origin=np.linalg.inv(before) @ fixed @ bodies.local[body] @ joint @ zero,
                axis=model.jnt_axis[i],
                mass=mass,
                com=com - model.jnt_pos[i],
                inertia=inertia,
                damping=float(model.dof_damping[i] + viscous[i]),
                friction=float(model.dof_frictionloss[i] + coulomb[i]),
                armature=float(dynamics.armature[i]),
            )
        )
        before = joint
    site = model.site(robot.ee_site).id
    _, fixed = bodies.moving_parent(model.site_bodyid[site])
    hand = fixed @ make_pose(model.site_pos[site], rotation(model.site_quat[site]))
    return out, np.linalg.inv(before) @ hand


def coulomb_viscous(robot: Robot, dynamics: Dynamics) -> tuple[np.ndarray, np.ndarray]:
    """Return (n,) Nm and (n,) Nm s/rad: the straight line through the friction at 0.3 and 1 times dq_max."""
    fast, slow = (dynamics.family.level(dynamics.phi, share * robot.dq_max) for share in (1.0, 0.3))
    viscous = np.maximum((fast - slow) / (0.7 * robot.dq_max), 0.0)
    return np.maximum(fast - viscous * robot.dq_max, 0.0), viscous


def write_description(folder: Path, robot: Robot, dynamics: Dynamics) -> None:
    """Write arm.xml (MJCF), arm.urdf and arm.sdf into `folder`; arms with armature get no SDF."""
    folder.mkdir(exist_ok=True)
    write_mjcf(folder / "arm.xml", robot, dynamics)
    write_urdf(folder / "arm.urdf", robot, dynamics)
    if not dynamics.armature.any():
        write_sdf(folder / "arm.sdf", robot, dynamics)


def write_mjcf(path: Path, robot: Robot, dynamics: Dynamics) -> None:
    """Write the arm as MJCF, without meshes; the site `ee` is the end effector, a motor per joint takes torque."""
    links, hand = chain(robot, dynamics)
    root = ET.Element("mujoco", model=robot.name)
    ET.SubElement(root, "compiler", angle="radian")
    ET.SubElement(root, "option", timestep=repr(SIM_DT), integrator="implicitfast", gravity=_words(robot.gravity))
    parent, actuator = ET.SubElement(root, "worldbody"), ET.SubElement(root, "actuator")
    for i, link in enumerate(links):
        parent = ET.SubElement(parent, "body", {"name": link.name} | _place(link.origin))
        x = link.inertia
        tensor = np.array([x[0, 0], x[1, 1], x[2, 2], x[0, 1], x[0, 2], x[1, 2]])
        ET.SubElement(parent, "inertial", pos=_words(link.com), mass=repr(link.mass), fullinertia=_words(tensor))
        own = {"damping": link.damping, "frictionloss": link.friction, "armature": link.armature}
        torque = _words(np.array([-robot.tau_max[i], robot.tau_max[i]]))
        joint = {"name": link.joint, "axis": _words(link.axis), "actuatorfrcrange": torque}
        if np.isfinite(robot.q_max[i]):
            joint["range"] = _words(np.array([robot.q_min[i], robot.q_max[i]]))
        ET.SubElement(parent, "joint", joint | {k: repr(v) for k, v in own.items()})
        ET.SubElement(actuator, "motor", name=link.joint, joint=link.joint, ctrlrange=torque)
    ET.SubElement(parent, "site", {"name": "ee"} | _place(hand))
    _write(path, root)


def write_urdf(path: Path, robot: Robot, dynamics: Dynamics) -> None:
    """Write the arm as URDF; a link `ee` sits at the end effector. Arguments as `chain`.

    URDF has no armature: it is written as Drake's rotor inertia, which r2s and Drake read, and other readers lack.
    """
    links, hand = chain(robot, dynamics)
    root = urdf(robot, links)
    for link in links:
        if link.armature:
            transmission = ET.SubElement(root, "transmission", name=f"{link.joint}_rotor")
            _text(transmission, type="transmission_interface/SimpleTransmission")
            ET.SubElement(transmission, "joint", name=link.joint)
            actuator = ET.SubElement(transmission, "actuator", name=f"{link.joint}_motor")
            ET.SubElement(actuator, ROTOR, value=repr(link.armature))
            ET.SubElement(actuator, GEAR, value="1")
    mass, moment = HAND
    inertial = ET.SubElement(ET.SubElement(root, "link", name="ee"), "inertial")
    ET.SubElement(inertial, "mass", value=repr(mass))
    ET.SubElement(inertial, "inertia", {k: repr(v) for k, v in _moments(moment * np.eye(3)).items()})
    _urdf_joint(root, "ee_fixed", "fixed", links[-1].name, "ee", hand)
    _write(path, root)


def urdf(robot: Robot, links: list[Link]) -> ET.Element:
    """Return URDF's root of the arm made of `links` (`chain`), with the limits of `robot`."""
    root = ET.Element("robot", name=robot.name)
    ET.SubElement(root, "link", name="base")
    parent = "base"
    for i, link in enumerate(links):
        inertial = ET.SubElement(ET.SubElement(root, "link", name=link.name), "inertial")
        ET.SubElement(inertial, "origin", xyz=_words(link.com), rpy="0 0 0")
        ET.SubElement(inertial, "mass", value=repr(link.mass))
        ET.SubElement(inertial, "inertia", {k: repr(v) for k, v in _moments(link.inertia).items()})
        endless = not np.isfinite(robot.q_max[i])
        kind = "continuous" if endless else "revolute"
        joint = _urdf_joint(root, link.joint, kind, parent, link.name, link.origin)
        ET.SubElement(joint, "axis", xyz=_words(link.axis))
        limit = {} if endless else {"lower": robot.q_min[i], "upper": robot.q_max[i]}
        limit |= {"velocity": robot.dq_max[i], "effort": robot.tau_max[i]}
        ET.SubElement(joint, "limit", {k: repr(float(v)) for k, v in limit.items()})
        ET.SubElement(joint, "dynamics", damping=repr(link.damping), friction=repr(link.friction))
        if robot.slowing is not None:  # Franka's own: not URDF, but libfranka does not connect without it
            deceleration, offset = (repr(float(x[i])) for x in robot.slowing)
            own = {"velocity_offset": offset, "deceleration_limit": deceleration}
            ET.SubElement(joint, "position_based_velocity_limits", own)
        parent = link.name
    return root


def write_sdf(path: Path, robot: Robot, dynamics: Dynamics, *, world: bool = False) -> None:
    """Write the arm as SDF 1.9, fixed to the world; a frame `ee` sits at the end effector. Arguments as `chain`.

    With `world` the model stands in a world of its own, as r2s/engines/gazebo.py runs it: 1 ms steps as fast as they
    go, physics and nothing else, no gravity (libfranka's convention: the arm compensates it), no limits of speed or
    torque (they are the driver's), and no friction (it comes as a torque). Rotors are there a damping, of armature
    over 1 ms: r2s/engines/gazebo.py puts that torque back.

    Raises:
        UserError: the joints have armature, which SDF cannot say; not with `world`.
    """
    links, hand = chain(robot, dynamics, friction=not world)
    if not world and any(link.armature for link in links):
        raise UserError("robot.armature: the joints have some, which SDF cannot say; write it into the links")
    root = ET.Element("sdf", version="1.9")
    place = root
    if world:
        place = ET.SubElement(root, "world", name="r2s")
        physics = ET.SubElement(place, "physics", name="1ms", type="ignored")
        _text(physics, max_step_size=SIM_DT, real_time_factor=0)
        _text(place, gravity="0 0 0")
        plugin = {"filename": "gz-sim-physics-system", "name": "gz::sim::systems::Physics"}
        ET.SubElement(place, "plugin", plugin)
    model = ET.SubElement(place, "model", name=robot.name)
    parent = "world"
    pose = np.eye(4)
    for i, link in enumerate(links):
        body = ET.SubElement(model, "link", name=link.name)
        pose = pose @ link.origin
        _text(body, pose=_pose_words(pose))
        inertial = ET.SubElement(body, "inertial")
        _text(inertial, pose=f"{_words(link.com)} 0 0 0", mass=repr(link.mass))
        _text(ET.SubElement(inertial, "inertia"), **{k: repr(v) for k, v in _moments(link.inertia).items()})
        joint = ET.SubElement(model, "joint", name=link.joint, type="revolute")
        _text(joint, parent=parent, child=link.name)
        axis = ET.SubElement(joint, "axis")
        _text(axis, xyz=_words(link.axis))
        low, high = np.nan_to_num([robot.q_min[i], robot.q_max[i]], posinf=ENDLESS, neginf=-ENDLESS)
        limit, damping = {"lower": low, "upper": high}, link.damping
        if world:
            damping += link.armature / SIM_DT
        else:
            limit |= {"effort": robot.tau_max[i], "velocity": robot.dq_max[i]}
        _text(ET.SubElement(axis, "limit"), **{k: repr(float(v)) for k, v in limit.items()})
        _text(ET.SubElement(axis, "dynamics"), damping=repr(damping), friction=repr(link.friction))
        parent = link.name
    frame = ET.SubElement(model, "frame", name="ee", attached_to=parent)
    _text(frame, pose=_pose_words(hand))
    _write(path, root)


class Bodies:
    """Masses, centres and tensors of all bodies, and where welded bodies sit on the moving ones."""

    def __init__(self, model: mujoco.MjModel):
        self.model = model
        self.mass, self.com = model.body_mass.copy(), model.body_ipos.copy()
        axes = [rotation(quat) for quat in model.body_iquat]
        self.inertia = np.array([r * d @ r.T for r, d in zip(axes, model.body_inertia, strict=True)])
        poses = zip(model.body_pos, model.body_quat, strict=True)
        self.local = [make_pose(position, rotation(quat)) for position, quat in poses]

    def override(
        self,
        bodies: np.ndarray,
        masses: np.ndarray | None,
        coms: np.ndarray | None,
        inertias: np.ndarray | None,
        n: int,
    ) -> None:
        """Replace mass (n,), centre (n, 3), tensor (n, 3, 3) of these bodies, where given."""
        if masses is not None:
            self.mass[bodies] = masses
        if coms is not None:
            self.com[bodies] = coms
        if (inertias := shaped("inertias", inertias, (n, 3, 3))) is not None:
            self.inertia[bodies] = inertias

    def moving_parent(self, body: int) -> tuple[int, np.ndarray]:
        """Return the nearest body with a joint at or above `body` (0: the world), body's pose in it."""
        pose = np.eye(4)
        while body and self.model.body_dofnum[body] == 0:
            pose = self.local[body] @ pose
            body = int(self.model.body_parentid[body])
        return body, pose

    def lumped(self, body: int) -> tuple[float, np.ndarray, np.ndarray]:
        """Return mass, centre and tensor about it of `body` with everything welded to it."""
        parts = [(self.mass[body], self.com[body], self.inertia[body])]
        for other in range(1, self.model.nbody):
            anchor, pose = self.moving_parent(other)
            if other != body and anchor == body and self.mass[other] > 0:
                r = pose[:3, :3]
                parts.append((self.mass[other], r @ self.com[other] + pose[:3, 3], r @ self.inertia[other] @ r.T))
        mass = sum(m for m, _, _ in parts)
        if len(parts) == 1 or mass == 0:
            return float(mass), parts[0][1], parts[0][2]
        com = sum(m * c for m, c, _ in parts) / mass
        steiner = [m * ((c - com) @ (c - com) * np.eye(3) - np.outer(c - com, c - com)) for m, c, _ in parts]
        return float(mass), com, sum(i for _, _, i in parts) + sum(steiner)


def shaped(name: str, value: np.ndarray | None, shape: tuple[int, ...]) -> np.ndarray | None:
    """Return value, which is None or has this shape; else raise UserError."""
    if value is not None and np.shape(value) != shape:
        raise UserError(f"{name} must be {shape}; it is {np.shape(value)}")
    return value


def rotation(quat: np.ndarray) -> np.ndarray:
    """Return (3, 3) of a quaternion w x y z."""
    matrix = np.empty(9)
    mujoco.mju_quat2Mat(matrix, quat)
    return matrix.reshape(3, 3)


def about(axis: np.ndarray, angle: float) -> np.ndarray:
    """Return (3, 3), the rotation about an axis by an angle, rad."""
    quat = np.empty(4)
    mujoco.mju_axisAngle2Quat(quat, axis, angle)
    return rotation(quat)


def make_pose(position: np.ndarray | None, rotation: np.ndarray | None) -> np.ndarray:
    """Return (4, 4) with this position and rotation; None is none."""
    pose = np.eye(4)
    if position is not None:
        pose[:3, 3] = position
    if rotation is not None:
        pose[:3, :3] = rotation
    return pose


def _place(pose: np.ndarray) -> dict[str, str]:
    quat = np.empty(4)
    mujoco.mju_mat2Quat(quat, pose[:3, :3].flatten())
    return {"pos": _words(pose[:3, 3]), "quat": _words(quat)}


def _moments(x: np.ndarray) -> dict[str, float]:
    at = {"ixx": (0, 0), "iyy": (1, 1), "izz": (2, 2), "ixy": (0, 1), "ixz": (0, 2), "iyz": (1, 2)}
    return {name: float(x[ij]) for name, ij in at.items()}


def _urdf_joint(root: ET.Element, name: str, kind: str, parent: str, child: str, origin: np.ndarray) -> ET.Element:
    joint = ET.SubElement(root, "joint", name=name, type=kind)
    ET.SubElement(joint, "origin", xyz=_words(origin[:3, 3]), rpy=_words(_roll_pitch_yaw(origin[:3, :3])))
    ET.SubElement(joint, "parent", link=parent)
    ET.SubElement(joint, "child", link=child)
    return joint


def _roll_pitch_yaw(r: np.ndarray) -> np.ndarray:
    """Return (3,) rad of Rz(yaw) Ry(pitch) Rx(roll) = r, as URDF and SDF have it; any yaw at upright pitch."""
    yaw = np.arctan2(r[1, 0], r[0, 0])
    c, s = np.cos(yaw), np.sin(yaw)
    # what Rz(-yaw) r leaves, from elements that are well-conditioned whatever that yaw is
    roll = np.arctan2(s * r[0, 2] - c * r[1, 2], c * r[1, 1] - s * r[0, 1])
    return np.array([roll, np.arctan2(-r[2, 0], c * r[0, 0] + s * r[1, 0]), yaw])


def _pose_words(pose: np.ndarray) -> str:
    return f"{_words(pose[:3, 3])} {_words(_roll_pitch_yaw(pose[:3, :3]))}"


def _words(values: np.ndarray) -> str:
    return " ".join(repr(float(v)) for v in values)


def _text(element: ET.Element, /, **children: object) -> None:
    for name, value in children.items():
        ET.SubElement(element, name).text = str(value)


def _write(path: Path, root: ET.Element) -> None:
    ET.indent(root)
    path.write_text(ET.tostring(root, encoding="unicode") + "\n")
