"""Call a user's control or friction law from the cached compiled code of r2s.

Compiling the code of r2s for a new law would take half a minute in every process, so r2s compiles only the user's
law, and calls the law by address. A built-in law has an index, a small integer, instead of an address. r2s stores
index or address as a float64, which is exact, because addresses are below 2^53.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir
from numba import carray, types
from numba.core.errors import NumbaError
from numba.extending import intrinsic, is_jitted

from r2s.compiled import cfunc, njit
from r2s.errors import UserError

LEAST_ADDRESS = 4096  # the first page of memory contains no function
DOUBLES, COUNT = types.CPointer(types.float64), types.int64
CONTROL = types.void(DOUBLES, DOUBLES, COUNT, DOUBLES, COUNT, DOUBLES, COUNT, DOUBLES, COUNT, DOUBLES)
FRICTION = types.void(DOUBLES, COUNT, types.float64, types.float64, DOUBLES, DOUBLES)
_compiled: dict[Callable, Any] = {}  # C function of each law; its address is valid while the function exists


@intrinsic
def as_doubles(typingctx, address):
    """Return a pointer to the float64 values at an address."""

    def codegen(context, builder, signature, args):
        return builder.inttoptr(args[0], ir.DoubleType().as_pointer())

    return DOUBLES(types.int64), codegen


@intrinsic
def stack(typingctx, count):
    """Return a pointer to `count` float64 values on the stack; a NumPy array would take a tenth of a step's time."""

    def codegen(context, builder, signature, args):
        return builder.alloca(ir.DoubleType(), args[0])

    return DOUBLES(types.int64), codegen


@intrinsic
def _call(typingctx, address, args):
    """Call the void C function at `address` with the values in `args`; pointers are passed as integers."""

    def codegen(context, builder, signature, values):
        given = [builder.extract_value(values[1], k) for k in range(len(args))]
        double, integer = ir.DoubleType(), ir.IntType(64)
        of = [double if kind == types.float64 else integer for kind in args]
        function = builder.inttoptr(values[0], ir.FunctionType(ir.VoidType(), of).as_pointer())
        builder.call(function, given)
        return context.get_dummy_value()

    return types.void(types.int64, args), codegen


@njit(cache=True)
def call_control(address, q, dq, command, parameters, memory, out):
    """Call the control law at an address (control_laws.py); write torques of 0 for an invalid address."""
    if address < LEAST_ADDRESS:
        out[:] = 0.0
        return
    arrays = q.ctypes.data, dq.ctypes.data, len(q), command.ctypes.data, len(command), parameters.ctypes.data
    rest = len(parameters), memory.ctypes.data, len(memory), out.ctypes.data
    _call(np.int64(address), (*arrays, *rest))  # type: ignore[call-arg]


@njit(cache=True)
def call_friction(address, p, v, h, memory):
    """Call the friction law at an address (friction.py); return torque and slope, 0 for an invalid address."""
    if address < LEAST_ADDRESS:
        return 0.0, 0.0
    out = carray(stack(2), (2,))  # type: ignore[call-arg]
    values = p.ctypes.data, len(p), v, h, memory.ctypes.data, out.ctypes.data
    _call(np.int64(address), values)  # type: ignore[call-arg]
    return out[0], out[1]


def control_address(law: Callable) -> int:
    """Compile a user's control law, once per process, and return its address for `call_control`.

    Raises:
        UserError: numba cannot compile the law.
    """
    inner = law if is_jitted(law) else njit(law)

    def function(q, dq, n, command, c, parameters, p, memory, k, out):
        first, rest = (carray(q, (n,)), carray(dq, (n,))), (carray(memory, (k,)), carray(out, (n,)))
        inner(first[0], first[1], carray(command, (c,)), carray(parameters, (p,)), rest[0], rest[1])

    return _address(law, CONTROL, function)


def friction_address(law: Callable) -> int:
    """Compile a user's friction law, once per process, and return its address for `call_friction`.

    Raises:
        UserError: numba cannot compile the law.
    """
    inner = law if is_jitted(law) else njit(law)

    def function(p, n, v, h, memory, out):
        values = carray(out, (2,))
        values[0], values[1] = inner(carray(p, (n,)), v, h, carray(memory, (1,)))

    return _address(law, FRICTION, function)


def _address(law: Callable, signature: Any, function: Callable) -> int:
    """Compile `function`, which calls `law`, as a C function, once per law; return the C function's address."""
    if law not in _compiled:
        try:
            _compiled[law] = cfunc(signature, error_model="numpy")(function)
        except NumbaError as error:
            lines = (line.strip(" -") for line in str(error).splitlines())
            why = next((line for line in lines if line and not line.startswith("Failed in nopython mode")), "")
            name = f"{law.__module__}.{getattr(law, '__name__', 'law')}"
            raise UserError(f"{name}: numba cannot compile this law: {why[:200]}") from None
    return _compiled[law].address
