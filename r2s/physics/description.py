"""Robot descriptions in three formats: MJCF, URDF and SDF with the same links, limits and friction.

All values come from the robot's file, except identified masses, centres, tensors and rotors. The frame of a link in
URDF and SDF is that of its joint at angle zero, so tensors need no rotation (ignition-physics 5.1 of Gazebo Fortress
misreads a rotated inertial frame).
"""

from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree as ET

import mujoco
import numpy as np

from r2s.errors import UserError
from r2s.physics.dynamics import Dynamics
from r2s.physics.robot import SIM_DT, Robot
from r2s.physics.urdf import GEAR, ROTOR, Inertia, combined

ENDLESS = 1e16  # rad, SDF's value for no limit
HAND = 1e-12, 1e-13  # kg, kg m^2 of the link `ee` in URDF: DART gives a link without inertia 1 kg and 1 kg m^2


@dataclass(frozen=True)
class Link:
    """A moving link and its joint, in the form of URDF and SDF.

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
    """Return the arm's links, from the base outwards, and the pose (4, 4) of the end effector in the last link.

    Args:
        robot: the arm. dynamics: masses, centres, tensors, rotors, friction.
        friction: approximate friction by Coulomb and viscous terms that match it at 30 % and 100 % of dq_max.
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
    tip = fixed @ make_pose(model.site_pos[site], rotation(model.site_quat[site]))
    return out, np.linalg.inv(before) @ tip


def coulomb_viscous(robot: Robot, dynamics: Dynamics) -> tuple[np.ndarray, np.ndarray]:
    """Return (n,) Nm and (n,) Nm s/rad of the straight line through the friction at 0.3 and 1 times dq_max."""
    fast, slow = (dynamics.family.level(dynamics.phi, share * robot.dq_max) for share in (1.0, 0.3))
    viscous = np.maximum((fast - slow) / (0.7 * robot.dq_max), 0.0)
    return np.maximum(fast - viscous * robot.dq_max, 0.0), viscous


def write_description(folder: Path, robot: Robot, dynamics: Dynamics) -> None:
    """Write arm.xml (MJCF), arm.urdf and, for an arm without armature, arm.sdf into `folder`."""
    folder.mkdir(exist_ok=True)
    write_mjcf(folder / "arm.xml", robot, dynamics)
    write_urdf(folder / "arm.urdf", robot, dynamics)
    if not dynamics.armature.any():
        write_sdf(folder / "arm.sdf", robot, dynamics)


def write_mjcf(path: Path, robot: Robot, dynamics: Dynamics) -> None:
    """Write the arm as MJCF without meshes, with a torque motor per joint and the end effector as site `ee`."""
    links, tip = chain(robot, dynamics)
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
    ET.SubElement(parent, "site", {"name": "ee"} | _place(tip))
    _write(path, root)


def write_urdf(path: Path, robot: Robot, dynamics: Dynamics) -> None:
    """Write the arm as URDF with a link `ee` at the end effector; armature becomes Drake's rotor inertia.

    URDF itself has no armature: r2s and Drake read this element, other readers ignore it.
    """
    links, tip = chain(robot, dynamics)
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
    _urdf_joint(root, "ee_fixed", "fixed", links[-1].name, "ee", tip)
    _write(path, root)


def urdf(robot: Robot, links: list[Link]) -> ET.Element:
    """Return the root element of a URDF with `links` (of `chain`) and the limits of `robot`."""
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
        if robot.velocity_envelope is not None:  # Franka's extension of URDF, which libfranka requires
            deceleration, offset = (repr(float(x[i])) for x in robot.velocity_envelope)
            own = {"velocity_offset": offset, "deceleration_limit": deceleration}
            ET.SubElement(joint, "position_based_velocity_limits", own)
        parent = link.name
    return root


def write_sdf(path: Path, robot: Robot, dynamics: Dynamics, *, world: bool = False) -> None:
    """Write the arm as SDF 1.9, fixed to the world, with a frame `ee` at the end effector.

    With `world` the file contains the world of r2s/engines/gazebo.py: physics in 1 ms steps without a real-time
    limit, no gravity (libfranka's convention), no limits of velocity or torque (the driver has them), and no friction
    (r2s applies it as a torque). A rotor becomes damping, armature / 1 ms; gazebo.py compensates that torque.

    Raises:
        UserError: without `world`, the joints have armature, which SDF cannot represent.
    """
    links, tip = chain(robot, dynamics, friction=not world)
    if not world and any(link.armature for link in links):
        raise UserError("robot.armature: expected 0, as SDF has no rotor inertia; add it to the links")
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
    _text(frame, pose=_pose_words(tip))
    _write(path, root)


class Bodies:
    """Masses, centres and tensors of all bodies, and the poses of welded bodies on the moving ones."""

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
        """Replace mass (n,), centre (n, 3) and tensor (n, 3, 3) of these bodies, unless None."""
        if masses is not None:
            self.mass[bodies] = masses
        if coms is not None:
            self.com[bodies] = coms
        if (inertias := shaped("inertias", inertias, (n, 3, 3))) is not None:
            self.inertia[bodies] = inertias

    def moving_parent(self, body: int) -> tuple[int, np.ndarray]:
        """Return the nearest body with a joint at or above `body` (0: the world), and the pose of `body` in it."""
        pose = np.eye(4)
        while body and self.model.body_dofnum[body] == 0:
            pose = self.local[body] @ pose
            body = int(self.model.body_parentid[body])
        return body, pose

    def lumped(self, body: int) -> Inertia:
        """Return mass, centre and tensor about the centre of `body` with all bodies welded to it."""
        parts = [(self.mass[body], self.com[body], self.inertia[body])]
        for other in range(1, self.model.nbody):
            anchor, pose = self.moving_parent(other)
            if other != body and anchor == body and self.mass[other] > 0:
                r = pose[:3, :3]
                parts.append((self.mass[other], r @ self.com[other] + pose[:3, 3], r @ self.inertia[other] @ r.T))
        return combined(parts)


def shaped(name: str, value: np.ndarray | None, shape: tuple[int, ...]) -> np.ndarray | None:
    """Return value; raise UserError unless it is None or has this shape."""
    if value is not None and np.shape(value) != shape:
        raise UserError(f"{name}: expected shape {shape}, got {np.shape(value)}")
    return value


def rotation(quat: np.ndarray) -> np.ndarray:
    """Return the rotation matrix (3, 3) of a quaternion w x y z."""
    matrix = np.empty(9)
    mujoco.mju_quat2Mat(matrix, quat)
    return matrix.reshape(3, 3)


def about(axis: np.ndarray, angle: float) -> np.ndarray:
    """Return the rotation matrix (3, 3) about an axis by an angle, rad."""
    quat = np.empty(4)
    mujoco.mju_axisAngle2Quat(quat, axis, angle)
    return rotation(quat)


def make_pose(position: np.ndarray | None, rotation: np.ndarray | None) -> np.ndarray:
    """Return the pose (4, 4) with this position and rotation; None is zero or the identity."""
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
    """Return roll, pitch, yaw (3,) rad with Rz(yaw) Ry(pitch) Rx(roll) = r; any yaw at gimbal lock."""
    yaw = np.arctan2(r[1, 0], r[0, 0])
    c, s = np.cos(yaw), np.sin(yaw)
    # from Rz(-yaw) r, whose elements are well conditioned for any yaw
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
