"""Joint friction: the paper's sigmoid (eq. 5), its breakaway dead zone (eq. 6) and torque offsets.

Two forms of one law. `friction_torque`, `friction_slope` and `passive_torque` are NumPy, for readers and as the
tests' oracle. `install()` puts the same law into MuJoCo as a native passive force that reads its parameters from
`jnt_user`, so that `mujoco.batch.Batch` gives every simulation its own arm at full speed. The same callback holds the
soft limits of the driver (r2s/actuation.py), which need feedback every millisecond, too.

The native force is linearly implicit. With D = d tau_f / dv at the current velocity it adds D v - tau_f to
qfrc_passive and D to dof_damping, so the implicit integrators solve with M + h D: exact to first order, and stable
where the explicit form chatters (real wrist joints: slopes of 3-10 Nm s/rad on 0.004-0.012 kg m^2).
"""

import ctypes
from functools import cache
from typing import Any

import mujoco
import numpy as np

# Columns of jnt_user. The first marks a model as ours: the callback is process-global and must leave others alone.
MARK, PHI1, PHI2, PHI3, OFFSET, BREAK_NEG, BREAK_POS, DQ_MIN, DAMPING = range(9)
Q_LOW, Q_HIGH, Q_GAIN, DQ_SOFT, DQ_GAIN = range(9, 14)  # the driver's soft limits; gains of 0: none
WIDTH = 14
MARKER = 7_202_019.0


def sigmoid(x: np.ndarray) -> np.ndarray:
    """Return the logistic function, without overflow at any finite x."""
    e = np.exp(-np.abs(x))
    return np.where(x >= 0, 1.0, e) / (1.0 + e)


def friction_torque(dq: np.ndarray, phi: np.ndarray) -> np.ndarray:
    """Return the dynamic friction torque of eq. (5), Nm; zero at rest, positive for positive velocity.

    Args:
        dq: (..., n) rad/s.
        phi: (..., n, 3): phi1 Nm, phi2 s/rad, phi3 rad/s.
    """
    phi1, phi2, phi3 = phi[..., 0], phi[..., 1], phi[..., 2]
    return phi1 * (sigmoid(phi2 * (dq + phi3)) - sigmoid(phi2 * phi3))


def friction_slope(dq: np.ndarray, phi: np.ndarray) -> np.ndarray:
    """Return d friction_torque / d dq, Nm s/rad, for the arguments of `friction_torque`."""
    s = sigmoid(phi[..., 1] * (dq + phi[..., 2]))
    return phi[..., 0] * phi[..., 1] * s * (1.0 - s)


def friction_level(phi: np.ndarray, dq_max: np.ndarray) -> np.ndarray:
    """Return (..., n) Nm: the mean magnitude of friction at plus and minus `dq_max` (..., n) rad/s."""
    return 0.5 * (friction_torque(dq_max, phi) - friction_torque(-dq_max, phi))


def passive_torque(
    dq: np.ndarray, tau: np.ndarray, phi: np.ndarray, offset: np.ndarray, breakaway: np.ndarray, dq_min: float
) -> np.ndarray:
    """Return what the joints feel beside the command `tau`, Nm: offset - friction, or the dead zone's hold.

    Dead zone (eq. 6 and Table II): while abs(dq) < dq_min and command plus offset lie within the breakaway band,
    the action is nullified (the joint feels neither command nor offset).

    Args:
        dq, tau, offset: (..., n) rad/s, Nm, Nm.
        phi: (..., n, 3).
        breakaway: (..., n, 2) Nm, negative and positive.
        dq_min: rad/s.
    """
    drive = tau + offset
    held = (np.abs(dq) < dq_min) & (drive > breakaway[..., 0]) & (drive < breakaway[..., 1])
    return np.where(held, -tau, offset) - friction_torque(dq, phi)


def pack(
    phi: np.ndarray, offset: np.ndarray, breakaway: np.ndarray, dq_min: float, damping: np.ndarray
) -> np.ndarray:
    """Return the first columns of `jnt_user`, (..., n, Q_LOW), for the arguments of `passive_torque`.

    damping is the MJCF's own (n,) Nm s/rad.
    """
    rows = np.empty((*np.broadcast_shapes(phi.shape[:-1], offset.shape, breakaway.shape[:-1]), Q_LOW))
    rows[..., MARK] = MARKER
    rows[..., PHI1 : PHI3 + 1] = phi
    rows[..., OFFSET] = offset
    rows[..., BREAK_NEG : BREAK_POS + 1] = breakaway
    rows[..., DQ_MIN] = dq_min
    rows[..., DAMPING] = damping
    return rows


def install() -> None:
    """Put the native law into MuJoCo, once per process. Models without our marker in `jnt_user` are untouched."""
    _callback()


@cache
def _callback() -> Any:
    from llvmlite import ir
    from numba import carray, cfunc, types
    from numba.extending import intrinsic

    at = _struct_offsets()
    nv_at, nuser_at = at["nv"] // 8, at["nuser_jnt"] // 8
    user_at, damping_at = at["jnt_user"] // 8, at["dof_damping"] // 8
    qpos_at, qvel_at = at["qpos"] // 8, at["qvel"] // 8
    applied_at, passive_at = at["qfrc_applied"] // 8, at["qfrc_passive"] // 8
    model_words, data_words = (
        max(at[k] for k in _MODEL_FIELDS) // 8 + 1,
        max(at[k] for k in _DATA_FIELDS) // 8 + 1,
    )

    @intrinsic
    def as_doubles(typingctx, address):
        def codegen(context, builder, signature, args):
            return builder.inttoptr(args[0], ir.DoubleType().as_pointer())

        return types.CPointer(types.float64)(types.int64), codegen

    @cfunc(types.void(types.CPointer(types.int64), types.CPointer(types.int64)))
    def passive(model_ptr, data_ptr):
        model = carray(model_ptr, (model_words,))
        if model[nuser_at] != WIDTH:
            return
        n = model[nv_at]
        user = carray(as_doubles(model[user_at]), (n, WIDTH))  # type: ignore[call-arg]
        damping = carray(as_doubles(model[damping_at]), (n,))  # type: ignore[call-arg]
        data = carray(data_ptr, (data_words,))
        q = carray(as_doubles(data[qpos_at]), (n,))  # type: ignore[call-arg]
        qvel = carray(as_doubles(data[qvel_at]), (n,))  # type: ignore[call-arg]
        applied = carray(as_doubles(data[applied_at]), (n,))  # type: ignore[call-arg]
        qfrc_passive = carray(as_doubles(data[passive_at]), (n,))  # type: ignore[call-arg]
        for j in range(n):
            if user[j, MARK] != MARKER:
                return
            phi1, phi2, phi3 = user[j, PHI1], user[j, PHI2], user[j, PHI3]
            v = qvel[j]
            x = phi2 * (v + phi3)
            e = np.exp(-abs(x))
            s = (1.0 if x >= 0 else e) / (1.0 + e)
            y = phi2 * phi3
            e = np.exp(-abs(y))
            s0 = (1.0 if y >= 0 else e) / (1.0 + e)
            slope = phi1 * phi2 * s * (1.0 - s)
            # mj_passive has already subtracted dof_damping * v with the slope of the step before: put it right
            force = (damping[j] - user[j, DAMPING]) * v - phi1 * (s - s0)
            damping[j] = user[j, DAMPING] + slope
            drive = applied[j] + user[j, OFFSET]
            held = abs(v) < user[j, DQ_MIN] and user[j, BREAK_NEG] < drive < user[j, BREAK_POS]
            if user[j, DQ_GAIN] > 0.0 and abs(v) > user[j, DQ_SOFT]:
                damping[j] += user[j, DQ_GAIN]
                force -= user[j, DQ_GAIN] * (v - (user[j, DQ_SOFT] if v > 0.0 else -user[j, DQ_SOFT]))
            beyond = max(0.0, q[j] - user[j, Q_HIGH]) + min(0.0, q[j] - user[j, Q_LOW])
            force -= user[j, Q_GAIN] * beyond
            qfrc_passive[j] += force + (-applied[j] if held else user[j, OFFSET])

    mujoco.set_mjcb_passive(passive.ctypes)
    return passive  # kept alive by the cache: MuJoCo holds only the address


_MODEL_FIELDS = ("nv", "nuser_jnt", "jnt_user", "dof_damping")
_DATA_FIELDS = ("qpos", "qvel", "qfrc_applied", "qfrc_passive")


def _struct_offsets() -> dict[str, int]:
    """Return byte offsets within mjModel and mjData, found in live structs rather than written down.

    Pointers are found by the address of their NumPy view; nv and nuser_jnt by values no other leading size has.
    """
    joints = "".join("<body><joint/><geom size='1'/>" for _ in range(3)) + "</body>" * 3
    spec = mujoco.MjSpec.from_string(f"<mujoco><size nuser_jnt='{WIDTH}'/><worldbody>{joints}</worldbody></mujoco>")
    model = spec.compile()
    data = mujoco.MjData(model)
    sizes = [f.name for f in _size_fields()]
    offsets = {"nv": 8 * sizes.index("nv"), "nuser_jnt": 8 * sizes.index("nuser_jnt")}

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
