"""Run the control law of a bundle in plain Python; r2s itself runs the same function, compiled by numba.

`r2s export` copies the source of the control law into r2s_runtime.py of the bundle, so that the bundle runs the same
function as the training and does not need r2s.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from r2s.physics.control_laws import computed_torque_law, torque_law

LAWS: dict[str, Callable] = {"torque": torque_law, "computed_torque": computed_torque_law}


class Control:
    """The control law of a contract, which maps the policy's command and the arm's state to a target torque.

    Args:
        contract: contract of the bundle; the entry `control` describes the controller.
    """

    def __init__(self, contract: dict[str, Any]):
        control = contract["control"]
        self._law = LAWS[control["name"]]
        self._parameters = np.array(control["parameters"], dtype=float)
        self._memory_size, self._n = control["memory_size"], len(contract["joints"])
        self.action_dim = len(control["action_scale"])
        self.reset()

    def reset(self) -> None:
        """Clear the memory of the control law before a motion."""
        self._memory = np.zeros(self._memory_size)

    def __call__(self, q: np.ndarray, dq: np.ndarray, command: np.ndarray) -> np.ndarray:
        """Return the target torque (n,) Nm of this cycle; `command` contains the action, then the setpoint."""
        out = np.zeros(self._n)
        self._law(q, dq, command, self._parameters, self._memory, out)
        return out

    def at_rest(self, q: np.ndarray, dq: np.ndarray, setpoint: np.ndarray) -> np.ndarray:
        """Return the control law's torque (n,) Nm for an action of zero in the first cycle of a motion."""
        out = np.zeros(self._n)
        command = np.concatenate([np.zeros(self.action_dim), setpoint])
        self._law(q, dq, command, self._parameters, np.zeros(self._memory_size), out)
        return out
