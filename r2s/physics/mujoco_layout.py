"""Find the byte offsets of the mjModel and mjData fields that the compiled callback reads, in a compiled model."""

import ctypes
from typing import Any

import mujoco
import numpy as np

MODEL_FIELDS = ("nv", "nbody", "nuser_jnt", "jnt_user", "dof_damping")
DATA_FIELDS = (  # in the order of mujoco_callback.py
    *("qpos", "qvel", "qfrc_applied", "qfrc_passive", "qfrc_bias", "M", "userdata"),
    *("xpos", "xmat", "xanchor", "xaxis"),
)


def struct_offsets(width: int, kept: int) -> dict[str, int]:
    """Return the byte offsets of MODEL_FIELDS in mjModel and DATA_FIELDS in mjData, found in a compiled model.

    The field with the address of an array's NumPy view is the pointer to this array. MuJoCo's introspection lists the
    size fields in the order of the struct.

    Args:
        width: number of columns of `jnt_user` in that model. kept: number of rows of `userdata` (kept, n).
    """
    joints = "".join("<body><joint/><geom size='1'/>" for _ in range(3)) + "</body>" * 3
    spec = mujoco.MjSpec.from_string(
        f"<mujoco><size nuser_jnt='{width}' nuserdata='{3 * kept}'/><worldbody>{joints}</worldbody></mujoco>"
    )
    model = spec.compile()
    data = mujoco.MjData(model)
    sizes = [f.name for f in _size_fields()]
    offsets = {name: 8 * sizes.index(name) for name in ("nv", "nbody", "nuser_jnt")}

    def scan(struct: Any, names: tuple[str, ...]) -> None:
        word = ctypes.cast(struct._address, ctypes.POINTER(ctypes.c_int64))
        missing = {getattr(struct, name).ctypes.data: name for name in names}
        k = 0
        while missing:  # the loop ends, as the struct contains every array's address
            if name := missing.pop(word[k], None):
                offsets[name] = 8 * k
            k += 1

    scan(model, ("jnt_user", "dof_damping"))
    scan(data, DATA_FIELDS)
    seen = np.ctypeslib.as_array(ctypes.cast(model._address, ctypes.POINTER(ctypes.c_int64)), (len(sizes),))
    if seen[sizes.index("nv")] != model.nv or seen[sizes.index("nuser_jnt")] != width:
        raise RuntimeError(f"mujoco {mujoco.__version__}: mjModel is not laid out as its introspection says")
    return offsets


def _size_fields() -> list[Any]:
    """Return the integer fields at the beginning of mjModel, in order; all are mjtSize (64 bit)."""
    from mujoco.introspect import structs

    fields: list[Any] = []
    for field in structs.STRUCTS["mjModel"].fields:
        if str(field.type) != "mjtSize":
            break
        fields.append(field)
    return fields
