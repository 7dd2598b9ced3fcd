"""Compiled control laws, which map a command to joint torques every millisecond.

A control law is a compiled function `law(q, dq, command, parameters, memory, out)` with these arguments:

    q, dq: (n,) rad, rad/s, measured in this cycle.
    command: (c,), the policy's action in SI units, then the task's setpoint; constant in a control period.
    parameters: (p,), parameters of the law, constant during a motion.
    memory: (k,), state of the law, 0 at the beginning of a motion.
    out: (n,) Nm, target torque that the law computes, without gravity.

Training runs a control law in MuJoCo's callback (mujoco_callback.py), and every arm runs the same law in the driver
(r2s/arm/driver.py) or in an exported bundle. The package r2s/control selects the control law and its parameters. The
control laws are in r2s/physics, beside MuJoCo's callback, because numba caches compiled code per folder.
"""

from collections.abc import Callable
from typing import Protocol

import numpy as np

from r2s.compiled import njit
from r2s.physics.impedance_laws import cartesian_impedance_law, joint_impedance_law
from r2s.physics.user_laws import call_control, control_address


class ControlLaw(Protocol):
    """Interface of a control law and its parameters; `Controller` (r2s/control/controller.py) implements it.

    Attributes:
        law: compiled function. parameters: (p,). command_size, memory_size: numbers of values in command and memory.
    """

    @property
    def law(self) -> Callable: ...  # noqa: D102 (see the class)
    @property
    def parameters(self) -> np.ndarray: ...  # noqa: D102
    @property
    def command_size(self) -> int: ...  # noqa: D102
    @property
    def memory_size(self) -> int: ...  # noqa: D102


@njit(cache=True, error_model="numpy")
def torque_law(q, dq, command, parameters, memory, out):
    """Write the command to `out` as target torque, for `control=torque`."""
    for j in range(len(q)):
        out[j] = command[j]


@njit(cache=True, error_model="numpy")
def computed_torque_law(q, dq, command, parameters, memory, out):
    """Write the computed torque: feedforward plus a critically damped PD law, weighted with the mass matrix.

    Every `hold` cycles, the law computes tau = command torque + feedforward + M (w^2 (q_d - q) + 2 w (dq_d - dq)).

    command: command torque (n) and feedforward (n) Nm, q_d (n) rad, dq_d (n) rad/s, mass matrix M (n n) kg m^2.
    parameters: bandwidth w, rad/s, and number `hold` of cycles between two updates of tau.
    memory: number of cycles since the last update of tau, and tau (n) Nm.
    """
    n = len(q)
    if memory[0] == 0.0:
        w = parameters[0]
        for j in range(n):
            torque = command[j] + command[n + j]
            for k in range(n):
                error = w**2 * (command[2 * n + k] - q[k]) + 2 * w * (command[3 * n + k] - dq[k])
                torque += command[(4 + j) * n + k] * error
            memory[1 + j] = torque
    for j in range(n):
        out[j] = memory[1 + j]
    memory[0] = (memory[0] + 1.0) % parameters[1]


BUILT_IN = (torque_law, computed_torque_law, joint_impedance_law, cartesian_impedance_law)


def law_number(law: Callable) -> int:
    """Return the number that selects a law in `control_law`; compile a user's law once per process."""
    return BUILT_IN.index(law) if law in BUILT_IN else control_address(law)


def _either(own_number: int, own: Callable, others: Callable) -> Callable:
    @njit(inline="always")
    def law(number, q, dq, command, parameters, memory, out):
        if number == own_number:
            own(q, dq, command, parameters, memory, out)
        else:
            others(number, q, dq, command, parameters, memory, out)

    return law


control_law: Callable = call_control  # (number, q, dq, command, parameters, memory, out), see `law_number`
for _k in reversed(range(len(BUILT_IN))):
    control_law = _either(_k, BUILT_IN[_k], control_law)


@njit(cache=True, error_model="numpy")
def _run_built_in(number, q, dq, command, parameters, memory, out):
    for i in range(len(q)):
        memory[:] = 0.0
        control_law(number, q[i], dq[i], command[i], parameters, memory, out[i])


def run_law(law: Callable, q: np.ndarray, dq: np.ndarray, command: np.ndarray, parameters: np.ndarray, memory: int):
    """Return a law's torques (m, n) Nm in the first cycle of a motion, at q, dq (m, n) with commands (m, c)."""
    out = np.empty(q.shape)
    q, dq = np.ascontiguousarray(q), np.ascontiguousarray(dq)  # one array type, so that numba compiles only once
    if law in BUILT_IN:
        _run_built_in(BUILT_IN.index(law), q, dq, command, parameters, np.zeros(memory), out)
        return out
    for i in range(len(q)):
        law(q[i], dq[i], command[i], parameters, np.zeros(memory), out[i])
    return out
