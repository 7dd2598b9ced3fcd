"""Check that an arm's file has a serial chain without couplings, complete limits and plausible masses."""

from pathlib import Path

import mujoco
import numpy as np

from r2s.errors import UserError, choices

LIGHTEST = 1 / 500  # smallest link mass / moving mass: real wrists have 1/170 (UR16e) to 1/20, placeholders 1/10,000
HEAVIEST = 2.0  # largest link mass / mass of all other links: up to 0.8 for the upper arm of a real arm
DEGREES_FROM = 30.0  # rad; position limits above this value, up to 360, are probably in degrees
VIRTUAL = 0.01  # m: a link whose two joints are closer is part of a universal joint and needs no mass
WEIGHT = 2.0  # largest plausible gravity torque in the worst posture, as a multiple of tau_max
POSTURES = 200  # number of random postures in which gravity torque is computed
WIDEST = 2.0  # largest plausible distance of a link's parts from the link's center of mass, in arm lengths
DENSEST = 2e4  # kg/m^3, tungsten: no link has smaller moments than a tungsten ball of the link's mass


def check_arm(model: mujoco.MjModel, path: Path) -> None:
    """Raise UserError unless the joints are uncoupled hinges of one serial chain, with one joint per body."""
    name = f"robot.mjcf: {path.name}"
    if model.njnt == 0:
        raise UserError(f"{name} has no joints")
    for i in range(model.njnt):
        if model.jnt_type[i] != mujoco.mjtJoint.mjJNT_HINGE:
            kind, joint = mujoco.mjtJoint(int(model.jnt_type[i])).name, model.joint(i).name
            hint = f"; a gripper's or a rail's is welded by robot.lock={{{joint}: 0}}"
            if kind == "mjJNT_FREE":
                hint = "; it carries the arm: delete it, so that the base is fixed"
            raise UserError(f"{name}: expected hinges, got {kind} (joint '{joint}'){hint}")
    for i, (previous, body) in enumerate(zip(model.jnt_bodyid[:-1], model.jnt_bodyid[1:], strict=True)):
        if previous == body:
            raise UserError(
                f"{name}: joints '{model.joint(i).name}' and '{model.joint(i + 1).name}' are both in body "
                f"'{model.body(body).name}'; give each a body of its own: move the first joint to a new body around "
                "this one, with a small mass"
            )
        ancestors, at = [], int(body)
        while at:
            at = int(model.body_parentid[at])
            ancestors.append(at)
        if previous not in ancestors:
            raise UserError(
                f"{name} is not a serial arm: link '{model.body(body).name}' does not follow "
                f"'{model.body(previous).name}'; weld the joints of a gripper or of a second arm by "
                f"robot.lock={{{model.joint(i + 1).name}: 0}}"
            )
    _check_couplings(model, name)


def _check_couplings(model: mujoco.MjModel, name: str) -> None:
    """Raise UserError for equality constraints and tendons that exert torque between the links."""
    for i in np.flatnonzero(model.eq_active0).tolist():
        kind, ends = mujoco.mjtEq(int(model.eq_type[i])), (model.eq_obj1id[i], model.eq_obj2id[i])
        if kind in (mujoco.mjtEq.mjEQ_CONNECT, mujoco.mjtEq.mjEQ_WELD):
            bodies = [model.site_bodyid[k] if model.eq_objtype[i] == mujoco.mjtObj.mjOBJ_SITE else k for k in ends]
            welded = len({int(model.body_weldid[k]) for k in bodies}) == 1
            if welded or any(model.body_mocapid[k] >= 0 for k in bodies):  # a mocap body is a handle for the user
                continue
            what = " and ".join(f"'{model.body(k).name}'" for k in bodies)
        elif kind == mujoco.mjtEq.mjEQ_JOINT:
            what = " and ".join(f"'{model.joint(k).name}'" for k in ends if k >= 0)
        else:
            what = f"'{model.equality(i).name}'"
        raise UserError(
            f"{name}: the equality constraint of {what} ties joints together, and r2s models an open chain; lock one "
            "of them by robot.lock, or delete the constraint"
        )
    for i in range(model.ntendon):
        acts = [model.tendon_stiffness[i], model.tendon_damping[i], model.tendon_frictionloss[i]]
        acts += [model.tendon_armature[i], model.tendon_limited[i], *model.tendon_stiffnesspoly[i]]
        if any(acts) or model.tendon_dampingpoly[i].any():
            raise UserError(
                f"{name}: tendon '{model.tendon(i).name}' acts between the joints (spring, damping, friction, rotor "
                "or limit), which r2s does not model; delete it, or give the joint itself stiffness and springref"
            )


def gravity_of(model: mujoco.MjModel, path: Path) -> np.ndarray:
    """Return the file's gravity (3,) m/s^2, even if a flag in the file disables gravity.

    Raises:
        UserError: the file's gravity is zero.
    """
    if not model.opt.gravity.any():
        raise UserError(
            f"robot.gravity: {path.name} has gravity 0 0 0; set robot.gravity=[0, 0, -9.81] for an upright base "
            "([0, 0, 0] in free fall)"
        )
    return model.opt.gravity.copy()


def check_limits(
    model: mujoco.MjModel,
    path: Path,
    low: np.ndarray,
    high: np.ndarray,
    home: np.ndarray,
    torque: np.ndarray,
    unset: list[str],
) -> None:
    """Raise UserError unless position and torque limits are complete and q_home is within the position limits.

    Args:
        model, path: arm and file. low, high, home: (n,) rad, position limits, q_home. torque: (n,) Nm, torque limits.
        unset: names of joints with a range of 0 to 0 in the file.
    """
    if unset:
        raise UserError(
            f"robot.q_min: {path.name} limits {choices(unset)} to 0 to 0 rad: set robot.q_min=[...] and "
            "robot.q_max=[...], declare an endless joint continuous, or lock it by robot.lock"
        )
    valid = (low < high) & (np.isfinite(low) == np.isfinite(high))
    if not np.all(valid):
        j = int(np.argmin(valid))
        raise UserError(
            f"robot.q_min: expected q_min below q_max, or neither, got {low[j]:g} and {high[j]:g} rad (joint {j + 1})"
        )
    far = np.maximum(np.abs(low), np.abs(high))
    degrees = (far > DEGREES_FROM) & (far <= 360)
    if degrees.any():
        j = int(degrees.argmax())
        raise UserError(
            f"robot.q_min: {path.name} has limits of {low[j]:g} to {high[j]:g} rad (joint {j + 1}): are they in "
            "degrees? Set robot.q_min=[...] and robot.q_max=[...] in rad"
        )
    if not np.all(torque > 0):
        joints = [model.joint(i).name or f"joint {i + 1}" for i in np.flatnonzero(~(torque > 0))]
        sided = "; its motor has force in one direction only" if (torque == 0).any() else ""
        raise UserError(
            f"robot.tau_max: no torque limit of {choices(joints)} in {path.name}{sided}; set robot.tau_max=[...]"
        )
    if np.any(home < low) or np.any(home > high):
        j = int(np.argmax(np.maximum(low - home, home - high)))
        raise UserError(
            f"robot.q_home: expected {low[j]:.3f} to {high[j]:.3f} rad, got {home[j]:.3f} (joint {j + 1})"
        )


def check_masses(
    model: mujoco.MjModel, path: Path, gravity: np.ndarray, home: np.ndarray, torque: np.ndarray
) -> None:
    """Raise UserError if a link has an implausible mass or inertia tensor; torque: (n,) Nm, torque limits."""
    each = np.bincount(model.body_weldid, model.body_mass, model.nbody)[model.jnt_bodyid]
    names = [model.body(k).name or f"link {i + 1}" for i, k in enumerate(model.jnt_bodyid)]
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    reach = np.append(np.linalg.norm(np.diff(data.xanchor, axis=0), axis=1), np.inf)
    length = max(float(reach[:-1].sum()), 0.1)
    for i, mass in enumerate(each):
        rest, what = each.sum() - mass, f"robot.mjcf: {path.name}: link '{names[i]}'"
        if mass < LIGHTEST * each.sum() and reach[i] > VIRTUAL:
            raise UserError(
                f"{what} has {mass:.3g} kg of the arm's {each.sum():.3g} kg: a placeholder? Give it the link's mass"
            )
        if len(each) > 3 and mass > HEAVIEST * rest:
            raise UserError(
                f"{what} has {mass:.4g} kg, all other links together have {rest:.3g} kg: correct its mass in the file"
            )
        body = int(model.jnt_bodyid[i])
        own = model.body_mass[body]
        least = 1.2 * own * (3 * own / (4 * np.pi * DENSEST)) ** (2 / 3)  # trace of a tungsten ball's tensor
        trace, most = float(model.body_inertia[body].sum()), 2 * own * (WIDEST * length) ** 2
        if reach[i] > VIRTUAL and own > 0 and (trace < least or (trace > most and len(each) > 1)):
            moments = " ".join(f"{x:.3g}" for x in model.body_inertia[body])
            size = "less than a ball of tungsten" if trace < least else "as if it were longer than the arm"
            raise UserError(
                f"{what} has {own:.4g} kg with moments {moments} kg m^2, {size}: its mass or its tensor is wrong (or "
                "not in kg m^2)"
            )
    needed = _weight(model, gravity, home)
    if (needed > WEIGHT * torque).any():
        j = int((needed / torque).argmax())
        raise UserError(
            f"robot.mjcf: {path.name}: joint {j + 1} would need {needed[j]:.4g} Nm to hold the links, its limit is "
            f"{torque[j]:g} Nm; masses: {choices(f'{n} {m:.3g} kg' for n, m in zip(names, each, strict=True))}; "
            "correct them in the file, or robot.tau_max"
        )


def _weight(model: mujoco.MjModel, gravity: np.ndarray, home: np.ndarray) -> np.ndarray:
    """Return each joint's largest gravity torque (n,) Nm in POSTURES random postures within pi rad of home."""
    data, out, most = mujoco.MjData(model), np.empty(model.nv), np.zeros(model.njnt)
    before = model.opt.gravity.copy(), model.opt.disableflags
    model.opt.gravity[:], model.opt.disableflags = gravity, 0
    for q in home + np.random.default_rng(0).uniform(-np.pi, np.pi, (POSTURES, model.njnt)):
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_rne(model, data, 0, out)
        most = np.maximum(most, np.abs(out))
    model.opt.gravity[:], model.opt.disableflags = before
    return most


def torque_limits(model: mujoco.MjModel) -> np.ndarray:
    """Return the torque limits (n,) Nm from the joints' actuatorfrcrange or their motors; nan: no limit."""
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
