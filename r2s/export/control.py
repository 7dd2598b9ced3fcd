"""Control laws in a bundle: the compiled laws of r2s, run here as plain Python.

`r2s export` copies the source of the control law into the one file of a bundle. So a bundle needs nothing of r2s, and
runs the same function as training did.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from r2s.export.law import BundleError, is_number
from r2s.physics.control_laws import computed_torque_law, torque_law

LAWS: dict[str, Callable] = {"torque": torque_law, "computed_torque": computed_torque_law}


class Control:
    """The controller of a contract: from the policy's action to target torques, once per cycle.

    Args:
        contract: whose `control` it is.
    """

    def __init__(self, contract: dict[str, Any]):
        control = contract["control"]
        self._law = LAWS[control["name"]]
        self._parameters = np.array(control["parameters"], dtype=float)
        self._memory_size, self._n = control["memory_size"], len(contract["joints"])
        self.action_dim = len(control["action_scale"])
        self.reset()

    def reset(self) -> None:
        """Begin a motion."""
        self._memory = np.zeros(self._memory_size)

    def __call__(self, q: np.ndarray, dq: np.ndarray, command: np.ndarray) -> np.ndarray:
        """Return the target torque (n,) Nm of this cycle."""
        out = np.zeros(self._n)
        self._law(q, dq, command, self._parameters, self._memory, out)
        return out

    def at_rest(self, q: np.ndarray, dq: np.ndarray, setpoint: np.ndarray) -> np.ndarray:
        """Return the torque (n,) Nm of an action of zero, in the first cycle of a command."""
        out = np.zeros(self._n)
        command = np.concatenate([np.zeros(self.action_dim), setpoint])
        self._law(q, dq, command, self._parameters, np.zeros(self._memory_size), out)
        return out


def check_control(contract: dict[str, Any]) -> None:
    """Raise BundleError if the controller of a contract is unknown or inconsistent."""
    control, torque = contract["control"], contract["torque"]
    name, scale = control["name"], control["action_scale"]
    if name not in LAWS:
        raise BundleError(
            f"contract.json: control is '{name}'; this runtime has {', '.join(LAWS)}, "
            "the r2s_runtime.py of the bundle has its own"
        )
    for key in ("action_scale", "action_offset", "parameters"):
        if not all(map(is_number, control[key])):
            raise BundleError(f"contract.json: control.{key} is {control[key]}; expected finite numbers")
    if len(control["action_offset"]) != len(scale):
        raise BundleError(
            f"contract.json: expected {len(scale)} numbers, got {len(control['action_offset'])} "
            "(control.action_offset)"
        )
    limit = torque["limit_Nm"]
    if name == "torque" and scale != limit:
        raise BundleError(f"contract.json: an action of 1 is {scale} Nm, the torque limit is {limit}")
    if name == "computed_torque" and any(x > most for x, most in zip(scale, limit, strict=True)):
        raise BundleError(f"contract.json: an action of 1 is {scale} Nm, the torque limit is {limit}")
    setpoint, goals = control["setpoint"], contract["goal"]["kind"]
    if setpoint not in (None, "plan", "goal", "surface"):
        raise BundleError(f"contract.json: control.setpoint is '{setpoint}'; allowed: plan, goal, surface")
    if (control["model"] is None) == (setpoint == "plan" or goals == "surface"):
        raise BundleError("contract.json: control.model and control.setpoint go together: a plan needs a model")
    if setpoint is not None and goals != {"plan": "plan", "goal": "point", "surface": "surface"}[setpoint]:
        raise BundleError(f"contract.json: control.setpoint is the {setpoint}, goals are {goals}s")
