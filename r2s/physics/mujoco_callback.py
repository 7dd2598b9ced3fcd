"""Add friction, control law, safety filter and motors to MuJoCo's physics step, by a compiled callback.

`install()` registers a native control callback. The callback reads each arm's parameters from `jnt_user`, so a batch
of different arms runs at full speed. In each physics step, the callback computes friction (friction.py). Once
`Simulator.drive` has been called, the callback also computes control law (control_laws.py), safety filter
(safety_filter.py) and motor delay (actuation.py). Stiction (stick_slip.py) and contact (contact.py) need the sum of
all other forces. The callback knows this sum, because MuJoCo computes accelerations right after the callback.

A linearly implicit method integrates the friction torque tau_f. The callback subtracts tau_f from qfrc_passive, and
adds the slope D = d tau_f / dv >= 0 at the current velocity v to dof_damping. MuJoCo's implicit integrator therefore
solves with the matrix M + h D. The method is accurate to first order. It is stable even for the wrist joints of real
arms, where D is 3-10 Nm s/rad and the inertia is 0.004-0.012 kg m^2.
"""

from collections.abc import Callable
from functools import cache
from typing import Any

import mujoco
import numpy as np
from numba import carray, types

from r2s.compiled import cfunc, njit
from r2s.physics.actuation import SLOTS, condition_joint, motor_torque
from r2s.physics.contact import contact_velocity, near
from r2s.physics.contact_layout import COLUMNS as CONTACT_COLUMNS
from r2s.physics.contact_layout import ROWS as CONTACT_ROWS
from r2s.physics.control_laws import control_law
from r2s.physics.friction import BRISTLE as BRISTLE_FAMILY
from r2s.physics.friction import FAMILIES, PHI, WIDTH_DQ, Family
from r2s.physics.linear_algebra import packed_element
from r2s.physics.mujoco_layout import DATA_FIELDS, MODEL_FIELDS, struct_offsets
from r2s.physics.push_limit import COLUMNS as PUSH_COLUMNS
from r2s.physics.push_limit import limit_pushes
from r2s.physics.safety_filter import COLUMNS, TAU_MAX, WORK, JointDynamics, fade, limit_acceleration, limit_rate
from r2s.physics.safety_filter import STEP as TAU_STEP
from r2s.physics.stick_slip import TINY, JointForces, any_reversal, coming_velocity
from r2s.physics.user_laws import as_doubles, call_friction, friction_address, stack

# Columns of jnt_user. MARK identifies models of r2s: the callback is global in a process and ignores other models.
MARK, FAMILY, P1 = range(3)
OFFSET, BREAK_NEG, BREAK_POS, DQ_MIN, DAMPING = range(P1 + PHI, P1 + PHI + 5)
DRAG_SIN, DRAG_COS, LOAD, STEP, LINK, BODY = range(DAMPING + 1, DAMPING + 7)  # LINK: whether to sum up link masses
MASS_ERROR, MOMENT_ERROR, MASS, MOMENT = BODY + 1, BODY + 2, BODY + 5, BODY + 6  # widths: 1, 3, 1, 3
NET, REST_NEG, REST_POS = range(MOMENT + 3, MOMENT + 6)  # NET: use stick_slip.py. REST: friction at sliding onset
GRAVITY = REST_POS + 1  # 3 wide
DELAY, LAG, LEVEL = range(GRAVITY + 3, GRAVITY + 6)  # LEVEL: friction level for the safety filter
LIMITS = LEVEL + 1  # limits of the safety filter, COLUMNS wide; 0: no filter
# Settings of the control: number of the law (NO_CONTROL: `rollout` sets efforts), cycles of the soft start, factor
# of the low-pass, largest target Nm, and the sizes of command, memory and parameters of the law in `userdata`
CONTROL, FADE, LOW_PASS, TARGET_MAX, COMMANDS, MEMORIES, PARAMETERS = range(LIMITS + COLUMNS, LIMITS + COLUMNS + 7)
# First index in `userdata` of the contact (contact.py) and of the push limit (push_limit.py); 0: none
CONTACT, PUSH = PARAMETERS + 1, PARAMETERS + 2
WIDTH = PUSH + 1
NO_CONTROL = -1.0
MARKER = 7_202_020.0
# Rows of `joint`, computed in each step. REST and EDGES have two rows each: negative and positive direction.
SPEED, FORCE, FRICTION, LOADED, COMING, REST, EDGES, ROWS = 0, 1, 2, 3, 4, 5, 7, 9
# Rows (n,) in `userdata`: bristle deflection, last command, motor state, cycle number (one value), number of cycles
# changed by the safety filter (one value), low-pass state, effort, noise of the measured speeds, last SLOTS commands.
# After these rows: command, memory and parameters of the control law; with a tool, also push limit and contact.
BRISTLE, SENT, MOTOR, CYCLE, LIMITED, FILTERED, EFFORT, NOISE, LINE = range(9)
KEPT = LINE + SLOTS
USUAL = 7  # number of joints for which numba unrolls the loops of `_drive`; other arms run slower

# the index of a friction law is its number in `jnt_user`
BUILT_IN = (*(f.native for f in FAMILIES), *(f.sharp for f in FAMILIES if f.sharp is not None))
BRISTLES, PRESLIDING = FAMILIES.index(BRISTLE_FAMILY), BRISTLE_FAMILY.names.index("presliding")


def number(family: Family, hold: str) -> int:
    """Return the number that selects a friction law in `jnt_user`; compile a user's law once per process."""
    law = family.native if hold == "command" or family.sharp is None else family.sharp
    return BUILT_IN.index(law) if law in BUILT_IN else friction_address(law)


def _either(number: int, own: Callable, others: Callable) -> Callable:
    """Return a compiled function that calls `own` if the first argument is `number`, and otherwise `others`."""

    @njit(inline="always")
    def law(asked, p, v, h, memory):
        if asked == number:
            return own(p, v, h, memory)
        return others(asked, p, v, h, memory)

    return law


_law: Callable = call_friction
for _k in reversed(range(len(BUILT_IN))):
    _law = _either(_k, BUILT_IN[_k], _law)


@njit(inline="always")
def _weight(mass, hx, hy, hz, anchor, axis, gravity):
    """Return a joint's gravity torque, Nm: axis^T ((h - mass * anchor) x gravity). The first moment h is in kg m."""
    x, y, z = hx - mass * anchor[0], hy - mass * anchor[1], hz - mass * anchor[2]
    level = gravity[0] * (axis[1] * z - axis[2] * y) + gravity[1] * (axis[2] * x - axis[0] * z)
    return level + gravity[2] * (axis[0] * y - axis[1] * x)


@njit(inline="always")
def _first_moment(mass, xpos, xmat, h):
    """Convert a body's first moment h (3) kg m from the body's frame to the world frame; mass: kg, of the body."""
    x = mass * xpos[0] + xmat[0] * h[0] + xmat[1] * h[1] + xmat[2] * h[2]
    y = mass * xpos[1] + xmat[3] * h[0] + xmat[4] * h[1] + xmat[5] * h[2]
    z = mass * xpos[2] + xmat[6] * h[0] + xmat[7] * h[1] + xmat[8] * h[2]
    return x, y, z


@njit(inline="always")
def _direction(v, net, z, user):
    """Return the factor on load-dependent friction, in [-1, 1], and its derivative by the speed v, s/rad.

    z: bristle deflection.
    """
    if user[FAMILY] == BRISTLES:  # z after the coming step, without bristle damping
        per_v = user[STEP] / user[P1 + PRESLIDING]
        return z + per_v * (v - abs(v) * z), per_v * (1.0 - (z if v > 0.0 else -z))
    if net:
        return np.sign(v), 0.0
    sign = np.tanh(v / WIDTH_DQ)
    return sign, (1.0 - sign * sign) / WIDTH_DQ


@cache
def install() -> Any:
    """Register the callback, once per process; the callback ignores models without MARKER in `jnt_user`.

    Returns:
        The compiled function. The cache keeps the function alive, because MuJoCo holds only the function's address.
    """
    signature = types.void(types.CPointer(types.int64), types.CPointer(types.int64))
    compiled = cfunc(signature, error_model="numpy", cache=True)(_force_at(struct_offsets(WIDTH, KEPT)))
    mujoco.set_mjcb_control(compiled.ctypes)
    return compiled


def _force_at(at: dict[str, int]) -> Callable:
    """Return the callback as a function to compile; at: byte offsets of the fields of mjModel and mjData.

    The offsets are integers in the function's closure, so numba caches a separate function for each set of offsets.
    """
    nv_at, nbody_at, nuser_at = (at[k] // 8 for k in ("nv", "nbody", "nuser_jnt"))
    user_at, damping_at = (at[k] // 8 for k in ("jnt_user", "dof_damping"))
    q_at, dq_at, applied_at, passive_at, bias_at, mass_at, memory_at, xpos_at, xmat_at, anchor_at, axis_at = (
        at[k] // 8 for k in DATA_FIELDS
    )
    model_words, data_words = (max(at[k] for k in fields) // 8 + 1 for fields in (MODEL_FIELDS, DATA_FIELDS))

    def friction_force(model_ptr, data_ptr):
        model = carray(model_ptr, (model_words,))
        if model[nuser_at] != WIDTH:
            return
        data, n = carray(data_ptr, (data_words,)), model[nv_at]
        user = carray(as_doubles(model[user_at]), (n, WIDTH))  # type: ignore[call-arg]
        if user[0, LIMITS + TAU_MAX] > 0.0 and user[0, MARK] == MARKER:
            fields = data[q_at], data[dq_at], data[applied_at], data[bias_at], data[mass_at], data[memory_at]
            places = data[xpos_at], data[xmat_at], data[anchor_at], data[axis_at]
            if user[0, CONTROL] != NO_CONTROL:
                _control(n, model[user_at], fields)
            if n == USUAL:
                _drive(USUAL, model[user_at], fields, places)
            else:
                _drive(n, model[user_at], fields, places)
        sizes = n, model[nbody_at]
        forces = model[damping_at], data[applied_at], data[passive_at], data[bias_at], data[mass_at], data[memory_at]
        _friction(
            sizes,
            user,
            data[q_at],
            data[dq_at],
            forces,
            (data[xpos_at], data[xmat_at], data[anchor_at], data[axis_at]),
        )

    return friction_force


@njit(cache=True, error_model="numpy", forceinline=True)
def _friction(sizes, user, q, dq, forces, places):
    """Add friction, offsets and errors of the gravity compensation to the passive force of a step.

    Args:
        sizes: numbers of joints and of bodies. user: (n, WIDTH), columns of `jnt_user`.
        forces: addresses of damping, applied, passive, bias, M, userdata.
        places: addresses of xpos, xmat, xanchor, xaxis.
    """
    n, nbody = sizes
    q, dq = carray(as_doubles(q), (n,)), carray(as_doubles(dq), (n,))  # type: ignore[call-arg]
    damping, applied = carray(as_doubles(forces[0]), (n,)), carray(as_doubles(forces[1]), (n,))
    passive, bias = carray(as_doubles(forces[2]), (n,)), carray(as_doubles(forces[3]), (n,))
    mass, memory = carray(as_doubles(forces[4]), (n * (n + 1) // 2,)), carray(as_doubles(forces[5]), (n,))
    xpos, xmat = carray(as_doubles(places[0]), (nbody, 3)), carray(as_doubles(places[1]), (nbody, 9))
    anchor, axis = carray(as_doubles(places[2]), (n, 3)), carray(as_doubles(places[3]), (n, 3))
    net, slow = user[0, NET] != 0.0, False  # net: whether stick_slip.py solves stiction, for all joints
    at = int(user[0, CONTACT])
    touch = at != 0
    joint = carray(stack(ROWS * n), (ROWS, n))  # type: ignore[call-arg]
    # mass and first moment of all links beyond a joint: errors of gravity compensation (e), nominal values (l)
    em, ex, ey, ez, lm, lx, ly, lz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for j in range(n - 1, -1, -1):
        if user[j, MARK] != MARKER:
            return
        v = 0.0 if net and abs(dq[j]) < TINY else dq[j]
        friction, slope = _law(user[j, FAMILY], user[j, P1 : P1 + PHI], v, user[j, STEP], memory[j : j + 1])
        pull, loaded = user[j, OFFSET], 0.0
        if user[j, DRAG_SIN] != 0.0 or user[j, DRAG_COS] != 0.0:
            pull += user[j, DRAG_SIN] * np.sin(q[j]) + user[j, DRAG_COS] * np.cos(q[j])
        if user[j, LINK] != 0.0:
            body, gravity = int(user[j, BODY]), user[j, GRAVITY : GRAVITY + 3]
            error, nominal = user[j, MASS_ERROR], user[j, MASS]
            x, y, z = _first_moment(error, xpos[body], xmat[body], user[j, MOMENT_ERROR : MOMENT_ERROR + 3])
            em, ex, ey, ez = em + error, ex + x, ey + y, ez + z
            pull += _weight(em, ex, ey, ez, anchor[j], axis[j], gravity)
            x, y, z = _first_moment(nominal, xpos[body], xmat[body], user[j, MOMENT : MOMENT + 3])
            lm, lx, ly, lz = lm + nominal, lx + x, ly + y, lz + z
            loaded = user[j, LOAD] * abs(_weight(lm, lx, ly, lz, anchor[j], axis[j], gravity))
            sign, steep = _direction(v, net, memory[j], user[j])
            friction += loaded * sign
            slope += loaded * steep
        slope = max(slope, 0.0)  # a negative slope would reduce the inertia M + h D
        # mj_passive has already subtracted dof_damping * v; add back the part due to the previous step's slope
        force = (damping[j] - user[j, DAMPING]) * v - friction
        damping[j] = user[j, DAMPING] + slope
        drive = applied[j] + pull
        held = not net and abs(v) < user[j, DQ_MIN] and user[j, BREAK_NEG] < drive < user[j, BREAK_POS]
        passive[j] += force + (-applied[j] if held else pull)
        if net or touch:
            joint[SPEED, j], joint[FRICTION, j], joint[LOADED, j] = v, friction, loaded
            joint[FORCE, j] = passive[j] + applied[j] - bias[j]
            slow |= net and (abs(v) <= user[j, DQ_MIN] or v == 0.0)
    if net or touch:
        work = carray(stack(n * (2 * n + 6)), (2 * n + 6, n))  # type: ignore[call-arg]
        jacobian = carray(stack(CONTACT_ROWS * n), (CONTACT_ROWS, n))  # type: ignore[call-arg]
        contact = carray(as_doubles(forces[5]), (at + CONTACT_COLUMNS,))[at:]  # type: ignore[call-arg]
        if touch:
            body = int(user[n - 1, BODY])
            place = xpos[body], xmat[body]
            touch = near(contact, place, anchor, axis, joint[SPEED], user[0, STEP], jacobian)
        reverses = slow or touch
        if net and not reverses:
            reverses = any_reversal(mass, damping, user[0, STEP], joint[SPEED], joint[FORCE], work)
        if reverses:
            loads = mass, damping, bias, applied, passive
            _hold(loads, dq, user, joint, work, (contact, jacobian), touch)


@njit(cache=True, error_model="numpy")
def _control(n, user, fields):
    """Replace the applied torques by those of the control law; a variable n saves a minute of compilation."""
    user = carray(as_doubles(user), (n, WIDTH))  # type: ignore[call-arg]
    q, dq = carray(as_doubles(fields[0]), (n,)), carray(as_doubles(fields[1]), (n,))
    applied, kept = carray(as_doubles(fields[2]), (n,)), carray(as_doubles(fields[5]), (KEPT, n))
    c, k, p = int(user[0, COMMANDS]), int(user[0, MEMORIES]), int(user[0, PARAMETERS])
    rest = carray(as_doubles(fields[5]), (KEPT * n + c + k + p,))[KEPT * n :]
    speed = carray(stack(n), (n,))  # type: ignore[call-arg]
    for j in range(n):
        speed[j] = dq[j] + kept[NOISE, j]
    control_law(user[0, CONTROL], q, speed, rest[:c], rest[c + k :], rest[c : c + k], applied)


@njit(cache=True, error_model="numpy", forceinline=True)
def _drive(n, user, fields, places):
    """Apply `condition_joint`, safety filter, delay and lag, in this order, to the applied torques.

    If n is a constant, numba unrolls the loops, which halves the filter's time (benchmarks/law.py).

    Args:
        n: number of joints. user, fields, places: addresses of MuJoCo's arrays.
    """
    user = carray(as_doubles(user), (n, WIDTH))  # type: ignore[call-arg]
    q, dq = carray(as_doubles(fields[0]), (n,)), carray(as_doubles(fields[1]), (n,))
    applied, bias = carray(as_doubles(fields[2]), (n,)), carray(as_doubles(fields[3]), (n,))
    mass, kept = carray(as_doubles(fields[4]), (n * (n + 1) // 2,)), carray(as_doubles(fields[5]), (KEPT, n))
    if user[0, CONTROL] != NO_CONTROL:
        for j in range(n):
            target = min(max(applied[j], -user[j, TARGET_MAX]), user[j, TARGET_MAX])
            kept[FILTERED, j], kept[EFFORT, j] = condition_joint(
                target, kept[FILTERED, j], kept[EFFORT, j], kept[CYCLE, 0] + 1.0, user[0, LOW_PASS], user[0, FADE],
                user[j, LIMITS + TAU_MAX], user[j, LIMITS + TAU_STEP],
            )  # fmt: skip
            applied[j] = kept[EFFORT, j]
    desk = carray(stack((2 * n + WORK) * n), (2 * n + WORK, n))
    cycle = SLOTS + int(kept[CYCLE, 0])
    sent = kept[LINE + cycle % SLOTS]
    level, limits = user[:, LEVEL], user[:, LIMITS : LIMITS + COLUMNS]
    arm = JointDynamics(q, dq, mass, bias)
    changed = fade(q, dq, applied, limits, sent)
    at = int(user[0, PUSH])
    if at == 0:
        changed |= limit_acceleration(arm, 1.0, level, limits, desk, sent)
    else:
        limit = carray(as_doubles(fields[5]), (at + PUSH_COLUMNS,))[at:]  # type: ignore[call-arg]
        changed |= _push(limit, arm, int(user[n - 1, BODY]), places, kept[SENT], (level, limits), sent)
    limit_rate(kept[SENT], limits, sent)
    kept[LIMITED, 0] += changed
    kept[SENT, :] = sent
    motor_torque(kept[LINE:], kept[MOTOR], cycle, user[0, DELAY], user[0, LAG], applied)
    kept[CYCLE, 0] += 1.0


@njit(cache=True, error_model="numpy")
def _push(limit, arm, body, places, last, bounds, sent):
    """Apply the push limit to the command `sent` (n,) Nm; places: addresses of xpos, xmat, xanchor, xaxis."""
    n = len(sent)
    xpos, xmat = carray(as_doubles(places[0]), (body + 1, 3)), carray(as_doubles(places[1]), (body + 1, 9))  # type: ignore[call-arg]
    anchor, axis = carray(as_doubles(places[2]), (n, 3)), carray(as_doubles(places[3]), (n, 3))  # type: ignore[call-arg]
    kinematics = xpos[body], xmat[body], anchor, axis
    return limit_pushes(limit, arm, kinematics, last, 1.0, bounds[0], bounds[1], sent)


@njit(cache=True, error_model="numpy")
def _hold(forces, dq, user, joint, work, touch, touches):
    """Change the passive force so that the step ends with the velocities that stick_slip.py or contact.py computes.

    Args:
        forces: MuJoCo's M, damping, bias, applied, passive. dq: (n,) rad/s, joint velocities. user: (n, WIDTH), from
            `jnt_user`. joint: (ROWS, n), results of `_friction`. work: (2 n + 6, n), scratch array.
        touch: arrays `contact` and `jacobian` that `near` wrote. touches: whether the tip may touch the surface
            (result of `near`).
    """
    mass, damping, bias, applied, passive = forces
    n, h = len(dq), user[0, STEP]
    coming, rest, edges = joint[COMING], joint[REST : REST + 2], joint[EDGES : EDGES + 2]
    if user[0, NET] == 0.0:  # FORCE already contains friction, and there is no stiction
        joint[FRICTION], joint[REST : EDGES + 2] = 0.0, 0.0
    for j in range(n if user[0, NET] != 0.0 else 0):
        joint[FORCE, j] += joint[FRICTION, j]
        rest[0, j], rest[1, j] = user[j, REST_NEG] - joint[LOADED, j], user[j, REST_POS] + joint[LOADED, j]
        edges[0, j], edges[1, j] = min(user[j, BREAK_NEG], rest[0, j]), max(user[j, BREAK_POS], rest[1, j])
    dq_min = max(user[0, DQ_MIN], TINY)
    loads = JointForces(joint[SPEED], joint[FORCE], joint[FRICTION], rest, edges)
    if touches:
        contact_velocity(touch, mass, damping, h, loads, dq_min, work, coming)
    elif not coming_velocity(mass, damping, h, loads, dq_min, work, coming):
        return
    for j in range(n):
        passive[j] = bias[j] - applied[j] + damping[j] * (coming[j] - dq[j])
    for k in range(n):
        change = (coming[k] - dq[k]) / h
        if change != 0.0:
            for j in range(n):
                passive[j] += packed_element(mass, j, k) * change
