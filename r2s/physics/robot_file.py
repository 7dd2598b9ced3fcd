"""Read the arm in an MJCF or URDF file, weld locked joints, and remove elements of the simulation.

The reader removes loose objects of MJCF scenes: bodies with free or ball joints only. The reader welds a gripper's
fingers at the positions in `robot.lock`, so the fingers become part of the link that carries the gripper.
"""

from collections.abc import Mapping
from pathlib import Path
from xml.etree import ElementTree as ET

import mujoco
import numpy as np

from r2s.errors import UserError, choices, nearest
from r2s.physics.urdf import NO_RANGE, is_urdf, read_urdf
from r2s.physics.welds import Bodies

JOINT, EQ = mujoco.mjtJoint, mujoco.mjtEq
FREE_OR_BALL = (JOINT.mjJNT_FREE, JOINT.mjJNT_BALL)


def read_spec(path: Path, lock: Mapping[str, float] | None = None) -> tuple[mujoco.MjSpec, np.ndarray]:
    """Return the MjSpec of an MJCF or URDF file, and the velocity limits, rad/s, (n,) or a scalar; nan: no limit.

    Args:
        path: the file.
        lock: {joint: rad or m}, positions at which to weld joints, such as a gripper's or a rail's.

    Raises:
        UserError: the file is not valid, or does not contain a joint of `lock`.
    """
    if is_urdf(path):
        return read_urdf(path, lock)
    try:
        spec = mujoco.MjSpec.from_file(str(path))
        for joint in ET.parse(path).iter("joint"):  # MuJoCo reads a range of 0 to 0 as no range
            if joint.get("range") and not any(float(x) for x in joint.get("range", "").split()) and joint.get("name"):
                spec.joint(joint.get("name")).info = NO_RANGE
        if loose := [body for body in spec.worldbody.bodies if _is_loose(body)]:
            _remove(spec, loose)
        if lock:
            _weld(spec, lock, path)
    except UserError:
        raise
    except ValueError as error:
        raise UserError(f"robot.mjcf: {path} is not a valid MJCF: {' '.join(str(error).split())}") from None
    return spec, np.array(np.nan)


def strip(spec: mujoco.MjSpec) -> None:
    """Remove elements that describe the simulation, not the arm: motors, sensors, keyframes, physics switches.

    `strip` adds each motor's damping to its joint; `rotors` returns the rotor inertia. Call `check_arm` before
    `strip`.
    """
    for actuator in spec.actuators:
        joint = spec.joint(actuator.target) if actuator.trntype == mujoco.mjtTrn.mjTRN_JOINT else None
        if joint is not None:  # reflected by the square of the gear (MuJoCo, XML reference)
            joint.damping = joint.damping + actuator.gear[0] ** 2 * actuator.damping
    for item in [*spec.actuators, *spec.sensors, *spec.keys, *spec.equalities, *spec.tendons]:
        spec.delete(item)
    for body in spec.bodies:
        body.gravcomp = 0.0  # gravcomp is a switch of the simulation: torque measured at the links contains gravity
    spec.option.disableflags = int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    spec.option.density = spec.option.viscosity = 0.0


def rotors(model: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray]:
    """Return each joint's rotor inertia (n,) kg m^2 and viscous damping (n,) Nm s/rad, both including the motor's."""
    armature, damping = model.dof_armature[model.jnt_dofadr].copy(), model.dof_damping[model.jnt_dofadr].copy()
    for i in np.flatnonzero(model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT):
        joint, square = model.actuator_trnid[i, 0], model.actuator_gear[i, 0] ** 2
        armature[joint] += square * model.actuator_armature[i]
        damping[joint] += square * model.actuator_damping[i]
    return armature, damping


def _is_loose(body: mujoco.MjsBody) -> bool:
    """Return whether a body is loose, that is, whether all joints of its subtree are free or ball joints."""
    joints = [joint.type for below in (body, *body.find_all("body")) for joint in below.joints]
    return bool(joints) and all(kind in FREE_OR_BALL for kind in joints)


def _remove(spec: mujoco.MjSpec, loose: list[mujoco.MjsBody]) -> None:
    """Delete the bodies `loose` and every element that refers to one of these bodies."""
    spec.compile()  # so that `delete` also removes the bodies' qpos from keyframes
    bodies = [below for body in loose for below in (body, *body.find_all("body"))]
    gone = {x.name for body in bodies for x in (body, *body.joints, *body.sites, *body.geoms) if x.name}
    _forget(spec, gone)
    for body in loose:
        spec.delete(body)


def _forget(spec: mujoco.MjSpec, names: set[str]) -> None:
    """Delete all sensors, and each equality, tendon and actuator that refers to an element in `names`."""
    for sensor in spec.sensors:
        spec.delete(sensor)
    for tendon in spec.tendons:
        if names & {wrap.target.name for wrap in tendon.path if wrap.target is not None}:
            names = names | {tendon.name}
            spec.delete(tendon)
    for equality in spec.equalities:
        if names & {equality.name1, equality.name2}:
            spec.delete(equality)
    for actuator in spec.actuators:
        if actuator.target in names:
            spec.delete(actuator)


def _weld(spec: mujoco.MjSpec, lock: Mapping[str, float], path: Path) -> None:
    """Weld the bodies of locked joints, and lump each welded body with the link that it is attached to."""
    model, joints = spec.compile(), {joint.name: joint for joint in spec.joints}
    at = {str(name): float(value) for name, value in lock.items()}
    for name in at:
        if name not in joints or joints[name].type not in (JOINT.mjJNT_HINGE, JOINT.mjJNT_SLIDE):
            raise UserError(
                f"robot.lock: no hinge or slide '{name}' in {path.name}; joints: {choices(joints)}"
                f"{nearest(name, joints)}"
            )
    for equality in spec.equalities:  # a finger that mirrors a locked finger
        first, second, c = equality.name1, equality.name2, equality.data
        if equality.type == EQ.mjEQ_JOINT and equality.active and second in at and first not in at:
            x = at[second] - model.joint(second).qpos0[0]
            at[first] = model.joint(first).qpos0[0] + sum(c[k] * x**k for k in range(5))
    data = mujoco.MjData(model)
    for name, value in at.items():
        data.qpos[model.joint(name).qposadr] = value
    mujoco.mj_kinematics(model, data)
    _forget(spec, set(at))
    for body in {joints[name].parent.id: joints[name].parent for name in at}.values():
        above = int(model.body_parentid[body.id])
        position, quat, inverse = np.empty(3), np.empty(4), np.empty(4)
        mujoco.mju_negQuat(inverse, data.xquat[above])
        mujoco.mju_rotVecQuat(position, data.xpos[body.id] - data.xpos[above], inverse)
        mujoco.mju_mulQuat(quat, inverse, data.xquat[body.id])
        if body.frame is not None:
            body.set_frame(body.parent.add_frame())
        body.pos, body.quat = position, quat
        body.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
    welded = {joints[name].parent.name or joints[name].parent.id for name in at}
    for name in at:
        spec.delete(joints[name])
    _lump(spec, welded)


def _lump(spec: mujoco.MjSpec, welded: set[str | int]) -> None:
    """Add the inertia of welded bodies, and of bodies fixed to welded bodies, to the links that move these bodies."""
    model = spec.compile()
    bodies, of = Bodies(model), {body.id: body for body in spec.bodies}
    carriers = {int(model.body_weldid[body.id]) for body in of.values() if (body.name or body.id) in welded}
    for carrier in carriers - {0}:
        mass, com, inertia = bodies.lumped(carrier)
        for k in np.flatnonzero(model.body_weldid == carrier).tolist():
            body = of[k]
            body.explicitinertial, body.mass, body.inertia = True, 0.0, np.zeros(3)
            body.fullinertia = np.full(6, np.nan)
            body.ipos, body.iquat = np.zeros(3), np.array([1.0, 0, 0, 0])  # else MuJoCo computes both from geoms
            for geom in body.geoms:
                geom.mass = 0.0
        moments, axes = np.linalg.eigh(inertia)
        quat = np.empty(4)
        mujoco.mju_mat2Quat(quat, (axes * [1, 1, np.sign(np.linalg.det(axes))]).flatten())
        body = of[carrier]
        body.mass, body.ipos, body.iquat, body.inertia = mass, com, quat, moments
        body.ialt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
