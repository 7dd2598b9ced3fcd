"""Write an arm as MJCF, URDF or SDF, with the same links, limits and friction.

Masses, centers of mass, inertia tensors, rotor inertias and friction come from `dynamics`; all other values come from
`robot`. In the URDF and SDF files, a link's frame is the joint's frame at angle zero, so inertia tensors need no
rotated inertial frame. Ignition-physics 5.1 of Gazebo Fortress misreads rotated inertial frames.
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
from r2s.physics.welds import Bodies, about, make_pose, rotation

ENDLESS = 1e16  # rad, position limit in SDF for a joint without limits
HAND = 1e-12, 1e-13  # kg, kg m^2 of the URDF link `ee`: for a link without inertia, DART assumes 1 kg and 1 kg m^2


@dataclass(frozen=True)
class Link:
    """A moving link and its joint, in the frames of URDF and SDF.

    Attributes:
        name, joint: names of the link and of its joint.
        origin: (4, 4) pose of the joint in the parent link's frame, at angle zero.
        axis: (3,) joint axis, in the joint's frame.
        mass: kg, of the link. com: (3,) m, center of mass, link frame. inertia: (3, 3) kg m^2 about `com`, link axes.
        damping, stiffness: (3,) polynomial coefficients, the linear coefficient first, Nm s/rad and Nm/rad. friction:
            Nm, Coulomb friction. armature: kg m^2, rotor inertia. springref: rad, joint angle without spring torque.
    """

    name: str
    joint: str
    origin: np.ndarray
    axis: np.ndarray
    mass: float
    com: np.ndarray
    inertia: np.ndarray
    damping: np.ndarray
    friction: float
    armature: float
    stiffness: np.ndarray
    springref: float


def chain(robot: Robot, dynamics: Dynamics, *, friction: bool = True) -> tuple[list[Link], np.ndarray]:
    """Return the arm's links, from the base outwards, and the end effector's pose (4, 4) in the last link's frame.

    Args:
        robot: the arm. dynamics: source of masses, centers of mass, inertia tensors, rotor inertias and friction.
        friction: whether the joints have Coulomb and viscous friction (`coulomb_viscous`) or no friction.
    """
    model = robot.model(gravity=True)
    bodies, moving = Bodies(model), model.jnt_bodyid
    bodies.mass[moving], bodies.com[moving], bodies.inertia[moving] = dynamics.mass, dynamics.com, dynamics.inertia
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
                damping=np.array([viscous[i], *model.dof_dampingpoly[i]]),
                friction=float(coulomb[i]),
                armature=float(dynamics.armature[i]),
                stiffness=np.array([model.jnt_stiffness[i], *model.jnt_stiffnesspoly[i]]),
                springref=float(model.qpos_spring[i]),
            )
        )
        before = joint
    site = model.site(robot.ee_site).id
    _, fixed = bodies.moving_parent(model.site_bodyid[site])
    tip = fixed @ make_pose(model.site_pos[site], rotation(model.site_quat[site]))
    return out, np.linalg.inv(before) @ tip


def coulomb_viscous(robot: Robot, dynamics: Dynamics) -> tuple[np.ndarray, np.ndarray]:
    """Return Coulomb (n,) Nm and viscous friction (n,) Nm s/rad that match the friction at 0.3 and 1 times dq_max."""
    fast, slow = (dynamics.family.level(dynamics.phi, share * robot.dq_max) for share in (1.0, 0.3))
    viscous = np.maximum((fast - slow) / (0.7 * robot.dq_max), 0.0)
    return np.maximum(fast - viscous * robot.dq_max, 0.0), viscous


def write_description(folder: Path, robot: Robot, dynamics: Dynamics) -> list[str]:
    """Write arm.xml (MJCF), arm.urdf and arm.sdf; return a message for each format that cannot represent the arm.

    SDF has no rotors: for an arm with armature, as most arms have, write no arm.sdf and return no message about it.
    """
    folder.mkdir(exist_ok=True)
    write_mjcf(folder / "arm.xml", robot, dynamics)
    left_out = []
    for write, name in ((write_urdf, "arm.urdf"), (write_sdf, "arm.sdf")):
        if name == "arm.sdf" and dynamics.armature.any():
            continue
        try:
            write(folder / name, robot, dynamics)
        except UserError as error:
            left_out.append(f"not written: {name}: {error}")
    return left_out


def write_mjcf(path: Path, robot: Robot, dynamics: Dynamics) -> None:
    """Write the arm as MJCF without meshes, with a torque motor per joint and the end effector as site `ee`."""
    links, tip = chain(robot, dynamics)
    root = ET.Element("mujoco", model=robot.name)
    ET.SubElement(root, "compiler", angle="radian")
    ET.SubElement(root, "option", timestep=repr(SIM_DT), integrator="implicitfast", gravity=words(robot.gravity))
    parent, actuator = ET.SubElement(root, "worldbody"), ET.SubElement(root, "actuator")
    for i, link in enumerate(links):
        parent = ET.SubElement(parent, "body", {"name": link.name} | _place(link.origin))
        x = link.inertia
        tensor = np.array([x[0, 0], x[1, 1], x[2, 2], x[0, 1], x[0, 2], x[1, 2]])
        ET.SubElement(parent, "inertial", pos=words(link.com), mass=repr(link.mass), fullinertia=words(tensor))
        own = {"frictionloss": repr(link.friction), "armature": repr(link.armature)}
        own |= {"damping": _polynomial(link.damping)}
        if link.stiffness.any():
            own |= {"stiffness": _polynomial(link.stiffness), "springref": repr(link.springref)}
        torque = words(np.array([-robot.tau_max[i], robot.tau_max[i]]))
        joint = {"name": link.joint, "axis": words(link.axis), "actuatorfrcrange": torque}
        if np.isfinite(robot.q_max[i]):
            joint["range"] = words(np.array([robot.q_min[i], robot.q_max[i]]))
        ET.SubElement(parent, "joint", joint | own)
        ET.SubElement(actuator, "motor", name=link.joint, joint=link.joint, ctrlrange=torque)
    ET.SubElement(parent, "site", {"name": "ee"} | _place(tip))
    write_xml(path, root)


def write_urdf(path: Path, robot: Robot, dynamics: Dynamics) -> None:
    """Write the arm as URDF, with a link `ee` at the end effector and armature in Drake's rotor_inertia element.

    URDF itself has no element for armature. r2s and Drake read the element rotor_inertia; other readers ignore it.

    Raises:
        UserError: a joint has a spring or nonlinear damping, which URDF cannot represent.
    """
    links, tip = chain(robot, dynamics)
    _check_linear(links, "URDF", springs=False)
    root = urdf(robot, links)
    for link in links:
        if link.armature:
            transmission = ET.SubElement(root, "transmission", name=f"{link.joint}_rotor")
            add_text(transmission, type="transmission_interface/SimpleTransmission")
            ET.SubElement(transmission, "joint", name=link.joint)
            actuator = ET.SubElement(transmission, "actuator", name=f"{link.joint}_motor")
            ET.SubElement(actuator, ROTOR, value=repr(link.armature))
            ET.SubElement(actuator, GEAR, value="1")
    mass, moment = HAND
    inertial = ET.SubElement(ET.SubElement(root, "link", name="ee"), "inertial")
    ET.SubElement(inertial, "mass", value=repr(mass))
    ET.SubElement(inertial, "inertia", {k: repr(v) for k, v in _moments(moment * np.eye(3)).items()})
    _urdf_joint(root, "ee_fixed", "fixed", links[-1].name, "ee", tip)
    write_xml(path, root)


def urdf(robot: Robot, links: list[Link]) -> ET.Element:
    """Return the root element of a URDF with `links` from `chain` and the limits of `robot`."""
    root = ET.Element("robot", name=robot.name)
    ET.SubElement(root, "link", name="base")
    parent = "base"
    for i, link in enumerate(links):
        inertial = ET.SubElement(ET.SubElement(root, "link", name=link.name), "inertial")
        ET.SubElement(inertial, "origin", xyz=words(link.com), rpy="0 0 0")
        ET.SubElement(inertial, "mass", value=repr(link.mass))
        ET.SubElement(inertial, "inertia", {k: repr(v) for k, v in _moments(link.inertia).items()})
        endless = not np.isfinite(robot.q_max[i])
        kind = "continuous" if endless else "revolute"
        joint = _urdf_joint(root, link.joint, kind, parent, link.name, link.origin)
        ET.SubElement(joint, "axis", xyz=words(link.axis))
        limit = {} if endless else {"lower": robot.q_min[i], "upper": robot.q_max[i]}
        limit |= {"velocity": robot.dq_max[i], "effort": robot.tau_max[i]}
        ET.SubElement(joint, "limit", {k: repr(float(v)) for k, v in limit.items()})
        ET.SubElement(joint, "dynamics", damping=repr(float(link.damping[0])), friction=repr(link.friction))
        if robot.velocity_envelope is not None:  # Franka's extension of URDF, which libfranka requires
            deceleration, offset = (repr(float(x[i])) for x in robot.velocity_envelope)
            own = {"velocity_offset": offset, "deceleration_limit": deceleration}
            ET.SubElement(joint, "position_based_velocity_limits", own)
        parent = link.name
    return root


def write_sdf(path: Path, robot: Robot, dynamics: Dynamics) -> None:
    """Write the arm as SDF 1.9, fixed to the world, with a frame `ee` at the end effector.

    Raises:
        UserError: the joints have armature, or a nonlinear spring or damping, which SDF cannot represent.
    """
    links, tip = chain(robot, dynamics)
    if any(link.armature for link in links):
        raise UserError("robot.armature: expected 0, as SDF has no rotor inertia; add it to the links")
    _check_linear(links, "SDF", springs=True)
    root = ET.Element("sdf", version="1.9")
    _sdf_model(root, robot, links, tip, world=False)
    write_xml(path, root)


def write_world(
    path: Path,
    robot: Robot,
    dynamics: Dynamics,
    plugin: ET.Element,
    *,
    version: str = "1.9",
    physics: str = "ignored",
) -> None:
    """Write the SDF world that r2s/engines/gazebo.py and gazebo_classic.py simulate.

    The physics step is 1 ms; simulated time runs as fast as possible. The world has no gravity (libfranka's
    convention), no limits of velocity or torque (r2s enforces both), and no friction (r2s applies friction torque).
    SDF has no rotor inertia (armature). Each joint therefore gets a damping of its armature divided by 1 ms, and the
    engine cancels the torque of this damping.

    Args:
        path: file to write. robot, dynamics: the arm. plugin: the world's plugin element. version: SDF version.
        physics: type of the physics engine; gz-sim ignores this type.
    """
    links, tip = chain(robot, dynamics, friction=False)
    root = ET.Element("sdf", version=version)
    place = ET.SubElement(root, "world", name="r2s")
    add_text(
        ET.SubElement(place, "physics", name="1ms", type=physics),
        max_step_size=SIM_DT,
        real_time_factor=0,
        real_time_update_rate=0,
    )
    add_text(place, gravity="0 0 0")
    place.append(plugin)
    _sdf_model(place, robot, links, tip, world=True)
    write_xml(path, root)


def _sdf_model(place: ET.Element, robot: Robot, links: list[Link], tip: np.ndarray, *, world: bool) -> None:
    """Append the arm's model to the element `place`; world: True for `write_world`, False for `write_sdf`."""
    model = ET.SubElement(place, "model", name=robot.name)
    parent = "world"
    pose = np.eye(4)
    for i, link in enumerate(links):
        body = ET.SubElement(model, "link", name=link.name)
        pose = pose @ link.origin
        add_text(body, pose=pose_words(pose))
        inertial = ET.SubElement(body, "inertial")
        add_text(inertial, pose=f"{words(link.com)} 0 0 0", mass=repr(link.mass))
        add_text(ET.SubElement(inertial, "inertia"), **{k: repr(v) for k, v in _moments(link.inertia).items()})
        joint = ET.SubElement(model, "joint", name=link.joint, type="revolute")
        add_text(joint, parent=parent, child=link.name)
        axis = ET.SubElement(joint, "axis")
        add_text(axis, xyz=words(link.axis))
        low, high = np.nan_to_num([robot.q_min[i], robot.q_max[i]], posinf=ENDLESS, neginf=-ENDLESS)
        limit, damping = {"lower": low, "upper": high}, link.damping[0]
        if world:
            damping += link.armature / SIM_DT
        else:
            limit |= {"effort": robot.tau_max[i], "velocity": robot.dq_max[i]}
        add_text(ET.SubElement(axis, "limit"), **{k: repr(float(v)) for k, v in limit.items()})
        own = {"damping": repr(float(damping)), "friction": repr(link.friction)}
        if link.stiffness.any():
            own |= {"spring_reference": repr(link.springref), "spring_stiffness": repr(float(link.stiffness[0]))}
        add_text(ET.SubElement(axis, "dynamics"), **own)
        parent = link.name
    frame = ET.SubElement(model, "frame", name="ee", attached_to=parent)
    add_text(frame, pose=pose_words(tip))


def _polynomial(coefficients: np.ndarray) -> str:
    """Return a polynomial's three coefficients as text, or only the first one if the other two are 0."""
    return words(coefficients if coefficients[1:].any() else coefficients[:1])


def _check_linear(links: list[Link], form: str, *, springs: bool) -> None:
    """Raise UserError if a joint has nonlinear damping or a nonlinear spring or, with springs=False, any spring."""
    for link in links:
        nonlinear = link.damping[1:].any() or link.stiffness[1:].any()
        if nonlinear or (link.stiffness.any() and not springs):
            what = "nonlinear damping or spring" if nonlinear else f"spring of {link.stiffness[0]:g} Nm/rad"
            raise UserError(
                f"robot.mjcf: joint '{link.joint}' has a {what}, which {form} cannot represent; use the MJCF"
            )


def _place(pose: np.ndarray) -> dict[str, str]:
    quat = np.empty(4)
    mujoco.mju_mat2Quat(quat, pose[:3, :3].flatten())
    return {"pos": words(pose[:3, 3]), "quat": words(quat)}


def _moments(x: np.ndarray) -> dict[str, float]:
    at = {"ixx": (0, 0), "iyy": (1, 1), "izz": (2, 2), "ixy": (0, 1), "ixz": (0, 2), "iyz": (1, 2)}
    return {name: float(x[ij]) for name, ij in at.items()}


def _urdf_joint(root: ET.Element, name: str, kind: str, parent: str, child: str, origin: np.ndarray) -> ET.Element:
    joint = ET.SubElement(root, "joint", name=name, type=kind)
    ET.SubElement(joint, "origin", xyz=words(origin[:3, 3]), rpy=words(_roll_pitch_yaw(origin[:3, :3])))
    ET.SubElement(joint, "parent", link=parent)
    ET.SubElement(joint, "child", link=child)
    return joint


def _roll_pitch_yaw(r: np.ndarray) -> np.ndarray:
    """Return roll, pitch, yaw (3,) rad with Rz(yaw) Ry(pitch) Rx(roll) = r; at gimbal lock yaw is arbitrary."""
    yaw = np.arctan2(r[1, 0], r[0, 0])
    c, s = np.cos(yaw), np.sin(yaw)
    # roll and pitch from Rz(-yaw) r, whose elements are well conditioned for any yaw
    roll = np.arctan2(s * r[0, 2] - c * r[1, 2], c * r[1, 1] - s * r[0, 1])
    return np.array([roll, np.arctan2(-r[2, 0], c * r[0, 0] + s * r[1, 0]), yaw])


def pose_words(pose: np.ndarray) -> str:
    """Return the text of a pose (4, 4) in SDF: position, then roll, pitch and yaw."""
    return f"{words(pose[:3, 3])} {words(_roll_pitch_yaw(pose[:3, :3]))}"


def words(values: np.ndarray) -> str:
    """Return numbers as text without loss of precision."""
    return " ".join(repr(float(v)) for v in values)


def add_text(element: ET.Element, /, **children: object) -> None:
    """Append a child element for each keyword argument, with the argument's value as text."""
    for name, value in children.items():
        ET.SubElement(element, name).text = str(value)


def write_xml(path: Path, root: ET.Element) -> None:
    """Write an indented XML file."""
    ET.indent(root)
    path.write_text(ET.tostring(root, encoding="unicode") + "\n")
