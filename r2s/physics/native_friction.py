"""Friction inside MuJoCo's physics step: a compiled force that reads `jnt_user`.

`install()` puts the laws of friction.py into MuJoCo as a native callback: `mujoco.batch.Batch` then gives every
simulation its own arm at full speed. The same callback holds the driver's law (limits.py), which needs feedback every
millisecond, and behind it the motors' delay (actuation.py). It is the control callback, the last before
accelerations, because who is held by the net torque (stick_slip.py) depends on all other forces.

The force is linearly implicit. With D = d tau_f / dv >= 0 at the current velocity it adds D v - tau_f to
qfrc_passive and D to dof_damping, so the implicit integrators solve with M + h D: exact to first order, and stable
where the explicit form chatters (real wrist joints: slopes of 3-10 Nm s/rad on 0.004-0.012 kg m^2).
"""

import ctypes
from collections.abc import Callable
from functools import cache
from types import FunctionType
from typing import Any

import mujoco
import numpy as np
from llvmlite import ir
from numba import carray, types
from numba.extending import intrinsic, is_jitted

from r2s.compiled import cfunc, njit
from r2s.physics.actuation import SLOTS, turn
from r2s.physics.friction import FAMILIES, PHI, WIDTH_DQ, Family
from r2s.physics.limits import COLUMNS, TAU_MAX, WORK, guard
from r2s.physics.stick_slip import TINY, coming_velocity, element, turns

# Columns of jnt_user. The first marks a model as ours: the callback is process-global and must leave others alone.
MARK, FAMILY, P1 = range(3)
OFFSET, BREAK_NEG, BREAK_POS, DQ_MIN, DAMPING = range(P1 + PHI, P1 + PHI + 5)
DRAG_SIN, DRAG_COS, LOAD, STEP, LINK, BODY = range(DAMPING + 1, DAMPING + 7)  # LINK: the next twelve are in use
MASS_ERROR, MOMENT_ERROR, MASS, MOMENT = BODY + 1, BODY + 2, BODY + 5, BODY + 6  # 1, 3, 1, 3 wide
NET, REST_NEG, REST_POS = range(MOMENT + 3, MOMENT + 6)  # NET: stick_slip.py holds. REST: friction as sliding begins
GRAVITY = REST_POS + 1  # 3 wide
DELAY, LAG, LEVEL = range(GRAVITY + 3, GRAVITY + 6)  # LEVEL: of friction, as the driver's law believes
LIMITS = LEVEL + 1  # of the driver, COLUMNS wide; 0: there is none
WIDTH = LIMITS + COLUMNS
MARKER = 7_202_020.0
# Rows of what a step knows of its joints. REST and EDGES: two each, of the negative and the positive direction.
SPEED, FORCE, FRICTION, LOADED, COMING, REST, EDGES, ROWS = 0, 1, 2, 3, 4, 5, 7, 9
# Rows of n that an arm remembers: bristles, the command before, what the motors do, cycles (a number), in how many of
# them the law changed what was asked for (a number), and SLOTS of commands.
BRISTLE, SENT, MOTOR, CYCLE, LIMITED, LINE = range(6)
KEPT = LINE + SLOTS
USUAL = 7  # joints

# the place of a law is its number in `jnt_user`
_BUILT_IN = (*(f.native for f in FAMILIES), *(f.sharp for f in FAMILIES if f.sharp is not None))
_laws: list[Callable] = [*_BUILT_IN]


def number(family: Family, hold: str) -> int:
    """Return what `jnt_user` calls a family's law; a new one is compiled into the physics step first (seconds)."""
    law = family.native if hold == "command" or family.sharp is None else family.sharp
    if law not in _laws:
        _laws.append(law)
        install()
    return _laws.index(law)


def install() -> None:
    """Put the native laws into MuJoCo, once per process. Models without our marker in `jnt_user` are untouched."""
    _callback(tuple(_laws))


def _either(number: int, own: Callable, others: Callable) -> Callable:
    """Return the compiled law that is `own` where it is asked for by its number, else `others`."""
    own = own if is_jitted(own) else njit(own)

    @njit(inline="always")
    def law(asked, p, v, h, memory):
        if asked == number:
            return own(p, v, h, memory)
        return others(asked, p, v, h, memory)

    return law


@njit
def _no_law(asked, p, v, h, memory):
    return 0.0, 0.0


def _in_order(laws: tuple[Callable, ...]) -> Callable:
    """Return the compiled law that is each of these where it is asked for by its place."""
    law: Callable = _no_law
    for k in reversed(range(len(laws))):
        law = _either(k, laws[k], law)
    return law


_law = _in_order(_BUILT_IN)


@intrinsic
def _as_doubles(typingctx, address):
    def codegen(context, builder, signature, args):
        return builder.inttoptr(args[0], ir.DoubleType().as_pointer())

    return types.CPointer(types.float64)(types.int64), codegen


@intrinsic
def _stack(typingctx, count):  # NumPy's own arrays cost a step a tenth of its time
    def codegen(context, builder, signature, args):
        return builder.alloca(ir.DoubleType(), args[0])

    return types.CPointer(types.float64)(types.int64), codegen


@njit(inline="always")
def _weight(mass, hx, hy, hz, anchor, axis, gravity):
    """Return Nm that gravity turns a joint with: axis . ((h - mass anchor) x gravity), of first moments h kg m."""
    x, y, z = hx - mass * anchor[0], hy - mass * anchor[1], hz - mass * anchor[2]
    level = gravity[0] * (axis[1] * z - axis[2] * y) + gravity[1] * (axis[2] * x - axis[0] * z)
    return level + gravity[2] * (axis[0] * y - axis[1] * x)


@cache
def _callback(laws: tuple[Callable, ...]) -> Any:
    """Compile the force of these laws, in the order of their numbers, and put it into MuJoCo."""
    force = _force_at(_struct_offsets())
    if own := laws[len(_BUILT_IN) :]:
        names = {**globals(), "_law": _in_order(laws)}
        force = FunctionType(force.__code__, names, closure=force.__closure__)
    signature = types.void(types.CPointer(types.int64), types.CPointer(types.int64))
    compiled = cfunc(signature, error_model="numpy", cache=not own)(force)
    mujoco.set_mjcb_control(compiled.ctypes)
    return compiled  # kept alive by the cache: MuJoCo holds only the address


def _force_at(at: dict[str, int]) -> Callable:
    """Return the force to compile, of mjModel and mjData whose fields lie `at` these bytes.

    The offsets are integers in its closure, which numba counts among what a kept function was compiled of.
    """
    nv_at, nuser_at = at["nv"] // 8, at["nuser_jnt"] // 8
    user_at, damping_at = at["jnt_user"] // 8, at["dof_damping"] // 8
    qpos_at, qvel_at = at["qpos"] // 8, at["qvel"] // 8
    applied_at, passive_at = at["qfrc_applied"] // 8, at["qfrc_passive"] // 8
    memory_at, bias_at, mass_at = at["userdata"] // 8, at["qfrc_bias"] // 8, at["M"] // 8
    xpos_at, xmat_at = at["xpos"] // 8, at["xmat"] // 8
    anchor_at, axis_at, nbody_at = at["xanchor"] // 8, at["xaxis"] // 8, at["nbody"] // 8
    model_words, data_words = (
        max(at[k] for k in _MODEL_FIELDS) // 8 + 1,
        max(at[k] for k in _DATA_FIELDS) // 8 + 1,
    )

    def friction_force(model_ptr, data_ptr):
        model = carray(model_ptr, (model_words,))
        if model[nuser_at] != WIDTH:
            return
        n, nbody = model[nv_at], model[nbody_at]
        user = carray(_as_doubles(model[user_at]), (n, WIDTH))  # type: ignore[call-arg]
        damping = carray(_as_doubles(model[damping_at]), (n,))  # type: ignore[call-arg]
        data = carray(data_ptr, (data_words,))
        q = carray(_as_doubles(data[qpos_at]), (n,))  # type: ignore[call-arg]
        qvel = carray(_as_doubles(data[qvel_at]), (n,))  # type: ignore[call-arg]
        applied = carray(_as_doubles(data[applied_at]), (n,))  # type: ignore[call-arg]
        qfrc_passive = carray(_as_doubles(data[passive_at]), (n,))  # type: ignore[call-arg]
        kept = carray(_as_doubles(data[memory_at]), (KEPT, n))  # type: ignore[call-arg]
        memory = kept[BRISTLE]
        xpos = carray(_as_doubles(data[xpos_at]), (nbody, 3))  # type: ignore[call-arg]
        xmat = carray(_as_doubles(data[xmat_at]), (nbody, 9))  # type: ignore[call-arg]
        anchor = carray(_as_doubles(data[anchor_at]), (n, 3))  # type: ignore[call-arg]
        axis = carray(_as_doubles(data[axis_at]), (n, 3))  # type: ignore[call-arg]
        net = user[0, NET] != 0.0  # of all joints of an arm, or of none
        if net:
            bias = carray(_as_doubles(data[bias_at]), (n,))  # type: ignore[call-arg]
            mass = carray(_as_doubles(data[mass_at]), (n * (n + 1) // 2,))  # type: ignore[call-arg]
        if user[0, LIMITS + TAU_MAX] > 0.0 and user[0, MARK] == MARKER:
            fields = data[qpos_at], data[qvel_at], data[applied_at], data[bias_at], data[mass_at], data[memory_at]
            if n == USUAL:
                _drive(USUAL, model[user_at], fields)
            else:
                _drive(n, model[user_at], fields)
        if net:
            work = carray(_stack(n * (n + 4)), (n + 4, n))  # type: ignore[call-arg]
            joint = carray(_stack(ROWS * n), (ROWS, n))  # type: ignore[call-arg]
            slow = False
        # mass and first moment of everything beyond a joint, errors and nominal
        em, ex, ey, ez, lm, lx, ly, lz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for j in range(n - 1, -1, -1):
            if user[j, MARK] != MARKER:
                return
            v = 0.0 if net and abs(qvel[j]) < TINY else qvel[j]
            friction, slope = _law(user[j, FAMILY], user[j, P1 : P1 + PHI], v, user[j, STEP], memory[j : j + 1])
            pull, loaded = user[j, OFFSET], 0.0
            if user[j, DRAG_SIN] != 0.0 or user[j, DRAG_COS] != 0.0:
                pull += user[j, DRAG_SIN] * np.sin(q[j]) + user[j, DRAG_COS] * np.cos(q[j])
            if user[j, LINK] != 0.0:
                body = int(user[j, BODY])
                m, h0, h1, h2 = (
                    user[j, MASS_ERROR],
                    user[j, MASS_ERROR + 1],
                    user[j, MASS_ERROR + 2],
                    user[j, MASS_ERROR + 3],
                )
                em += m
                ex += m * xpos[body, 0] + xmat[body, 0] * h0 + xmat[body, 1] * h1 + xmat[body, 2] * h2
                ey += m * xpos[body, 1] + xmat[body, 3] * h0 + xmat[body, 4] * h1 + xmat[body, 5] * h2
                ez += m * xpos[body, 2] + xmat[body, 6] * h0 + xmat[body, 7] * h1 + xmat[body, 8] * h2
                gravity = user[j, GRAVITY : GRAVITY + 3]
                pull += _weight(em, ex, ey, ez, anchor[j], axis[j], gravity)
                m, h0, h1, h2 = user[j, MASS], user[j, MASS + 1], user[j, MASS + 2], user[j, MASS + 3]
                lm += m
                lx += m * xpos[body, 0] + xmat[body, 0] * h0 + xmat[body, 1] * h1 + xmat[body, 2] * h2
                ly += m * xpos[body, 1] + xmat[body, 3] * h0 + xmat[body, 4] * h1 + xmat[body, 5] * h2
                lz += m * xpos[body, 2] + xmat[body, 6] * h0 + xmat[body, 7] * h1 + xmat[body, 8] * h2
                load = _weight(lm, lx, ly, lz, anchor[j], axis[j], gravity)
                loaded = user[j, LOAD] * abs(load)
                sign = np.sign(v) if net else np.tanh(v / WIDTH_DQ)
                friction += loaded * sign
                slope += 0.0 if net else loaded * (1.0 - sign * sign) / WIDTH_DQ
            slope = max(slope, 0.0)  # an implicit falling branch would take inertia away
            # mj_passive has already subtracted dof_damping * v with the slope of the step before: put it right
            force = (damping[j] - user[j, DAMPING]) * v - friction
            damping[j] = user[j, DAMPING] + slope
            drive = applied[j] + pull
            held = not net and abs(v) < user[j, DQ_MIN] and user[j, BREAK_NEG] < drive < user[j, BREAK_POS]
            qfrc_passive[j] += force + (-applied[j] if held else pull)
            if net:
                joint[SPEED, j], joint[FRICTION, j], joint[LOADED, j] = v, friction, loaded
                joint[FORCE, j] = qfrc_passive[j] + applied[j] - bias[j]
                slow |= abs(v) <= user[j, DQ_MIN] or v == 0.0
        if net and (slow or turns(mass, damping, user[0, STEP], joint[SPEED], joint[FORCE], work)):
            _hold(mass, damping, bias, applied, qvel, user, joint, work, qfrc_passive)

    return friction_force


@njit(error_model="numpy", forceinline=True)
def _drive(n, user, fields):
    """Let the driver's law and the motors turn what is asked for into what the joints feel, in place.

    Called with a constant n, it is compiled for that: loops unroll, and the law costs half (docs/law.md).

    Args:
        n: joints. user, fields: addresses of MuJoCo's arrays.
    """
    user = carray(_as_doubles(user), (n, WIDTH))  # type: ignore[call-arg]
    q, dq = carray(_as_doubles(fields[0]), (n,)), carray(_as_doubles(fields[1]), (n,))
    applied, bias = carray(_as_doubles(fields[2]), (n,)), carray(_as_doubles(fields[3]), (n,))
    mass, kept = carray(_as_doubles(fields[4]), (n * (n + 1) // 2,)), carray(_as_doubles(fields[5]), (KEPT, n))
    desk = carray(_stack((2 * n + WORK) * n), (2 * n + WORK, n))
    cycle = SLOTS + int(kept[CYCLE, 0])
    sent = kept[LINE + cycle % SLOTS]
    level, limits = user[:, LEVEL], user[:, LIMITS:]
    kept[LIMITED, 0] += guard(q, dq, applied, kept[SENT], 1.0, level, mass, bias, limits, desk, sent)
    kept[SENT, :] = sent
    turn(kept[LINE:], kept[MOTOR], cycle, user[0, DELAY], user[0, LAG], applied)
    kept[CYCLE, 0] += 1.0


@njit(cache=True, error_model="numpy")
def _hold(mass, damping, bias, applied, qvel, user, joint, work, passive):
    """Change the passive force of a step so that it ends with the velocities that stick_slip.py finds.

    Arguments are fields of MuJoCo, `joint` (ROWS, n) what the callback knows, and `work` (n + 4, n) anything.
    """
    n, h = len(qvel), user[0, STEP]
    coming, rest, edges = joint[COMING], joint[REST : REST + 2], joint[EDGES : EDGES + 2]
    for j in range(n):
        joint[FORCE, j] += joint[FRICTION, j]
        rest[0, j], rest[1, j] = user[j, REST_NEG] - joint[LOADED, j], user[j, REST_POS] + joint[LOADED, j]
        edges[0, j], edges[1, j] = min(user[j, BREAK_NEG], rest[0, j]), max(user[j, BREAK_POS], rest[1, j])
    dq_min = max(user[0, DQ_MIN], TINY)
    if not coming_velocity(
        mass, damping, h, joint[SPEED], joint[FORCE], joint[FRICTION], rest, edges, dq_min, work, coming
    ):
        return
    for j in range(n):
        passive[j] = bias[j] - applied[j] + damping[j] * (coming[j] - qvel[j])
    for k in range(n):
        change = (coming[k] - qvel[k]) / h
        if change != 0.0:
            for j in range(n):
                passive[j] += element(mass, j, k) * change


_MODEL_FIELDS = ("nv", "nbody", "nuser_jnt", "jnt_user", "dof_damping")
_DATA_FIELDS = (
    *("qpos", "qvel", "qfrc_applied", "qfrc_passive", "qfrc_bias", "M", "userdata"),
    *("xpos", "xmat", "xanchor", "xaxis"),
)


def _struct_offsets() -> dict[str, int]:
    """Return byte offsets within mjModel and mjData, found in live structs rather than written down.

    Pointers are found by the address of their NumPy view, sizes by their place in mjModel's introspection.
    """
    joints = "".join("<body><joint/><geom size='1'/>" for _ in range(3)) + "</body>" * 3
    spec = mujoco.MjSpec.from_string(
        f"<mujoco><size nuser_jnt='{WIDTH}' nuserdata='{3 * KEPT}'/><worldbody>{joints}</worldbody></mujoco>"
    )
    model = spec.compile()
    data = mujoco.MjData(model)
    sizes = [f.name for f in _size_fields()]
    offsets = {name: 8 * sizes.index(name) for name in ("nv", "nbody", "nuser_jnt")}

    def scan(struct: Any, names: tuple[str, ...]) -> None:
        word = ctypes.cast(struct._address, ctypes.POINTER(ctypes.c_int64))
        wanted = {getattr(struct, name).ctypes.data: name for name in names}
        k = 0
        while wanted:  # ends: every array's address is in its struct
            if name := wanted.pop(word[k], None):
                offsets[name] = 8 * k
            k += 1

    scan(model, ("jnt_user", "dof_damping"))
    scan(data, _DATA_FIELDS)
    seen = np.ctypeslib.as_array(ctypes.cast(model._address, ctypes.POINTER(ctypes.c_int64)), (len(sizes),))
    if seen[sizes.index("nv")] != model.nv or seen[sizes.index("nuser_jnt")] != WIDTH:
        raise RuntimeError(f"mujoco {mujoco.__version__}: mjModel is not laid out as its introspection says")
    return offsets


def _size_fields() -> list[Any]:
    """Return mjModel's leading integer fields, all mjtSize (64 bit), in order."""
    from mujoco.introspect import structs

    fields: list[Any] = []
    for field in structs.STRUCTS["mjModel"].fields:
        if str(field.type) != "mjtSize":
            break
        fields.append(field)
    return fields
