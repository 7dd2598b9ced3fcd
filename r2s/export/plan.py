"""Make and follow the plans of a policy that tracks a trajectory, as r2s/tasks/track.py does in training.

A plan is a timed path with a row per control step: position and velocity of the end effector, and angles, speeds and
accelerations of the joints. `r2s export` copies this module into r2s_runtime.py of a bundle.
"""

from typing import Any

import numpy as np

from r2s.export.control import Control
from r2s.export.inverse_dynamics import InverseDynamics
from r2s.export.law import BundleError, Model

COLUMNS = ("place", "velocity", "q", "dq", "ddq")  # groups of columns of a plan, in this order
NO_PLAN = "the policy of this bundle follows plans: pass one to `reset`"


def finite_plan(plan: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Return a plan as an array; raise BundleError if the plan is missing, not finite, or of a wrong shape."""
    if plan is None:
        raise BundleError(NO_PLAN)
    plan = np.array(plan, dtype=float)
    if plan.shape != shape:
        raise BundleError(f"expected a plan of shape {shape}, got {plan.shape}")
    if not (good := np.isfinite(plan)).all():
        row, column = np.argwhere(~good)[0]
        raise BundleError(f"expected a finite plan, got {plan[row, column]} in row {row}, column {column}")
    return plan


class Follower:
    """Follow a plan; a call returns a control step's observation values and the controller's setpoint.

    Args:
        contract: contract with plans as goals. control: the contract's `Control`. model: not used.
    """

    def __init__(self, contract: dict[str, Any], control: Control, model: Model | None = None):
        goal = contract["goal"]
        self._steps, self._hz, self._preview = goal["steps"], goal["row_hz"], contract["observation"]["preview"]
        self._at = {name: slice(*goal["columns"][name]) for name in COLUMNS}
        self._control = control
        self._dynamics = None if contract["control"]["model"] is None else InverseDynamics(contract)
        self._setpoints = np.zeros((1, 0))
        self._shape, self._plan = tuple(goal["shape"]), np.zeros(0)

    def take(self, plan: Any) -> None:
        """Store the next motion's plan; raise BundleError if the plan is missing, not finite, or of a wrong shape."""
        plan = finite_plan(plan, self._shape)
        if self._dynamics is not None:
            q, dq, ddq = (plan[:, self._at[k]] for k in ("q", "dq", "ddq"))
            self._setpoints = self._dynamics.setpoints(q, dq, ddq, self._hz, self._steps + 1)
        self._plan = plan

    @property
    def start(self) -> np.ndarray:
        """Joint angles (n,) rad at which the plan begins."""
        if not self._plan.size:
            raise BundleError(NO_PLAN)
        return self._plan[0, self._at["q"]]

    def __call__(self, step: int, seen: dict[str, np.ndarray], limited: float) -> dict[str, np.ndarray]:
        """Return {name: values} for a control step: the values for the observation, and the controller's `setpoint`.

        The value `goal` is the reference position of the end effector. After the last step, this reference remains at
        the end of the path.

        Args:
            step: number of the control step, from 0. seen: measured q, dq (n,) rad, rad/s; end-effector position `ee`
                (3,) m.
            limited: fraction of the last control period in which the safety filter changed the command.
        """
        row, at, plan = min(step, self._steps), self._at, self._plan
        now, q, dq, ee = plan[row], seen["q"], seen["dq"], seen["ee"]
        made = {"goal": now[at["place"]], "velocity": now[at["velocity"]], "limited": np.array([limited])}
        made["ahead"] = (plan[row + 1 : row + 1 + self._preview, at["place"]] - ee).ravel()
        made |= {"q_off": now[at["q"]] - q, "dq_off": now[at["dq"]] - dq}
        if self._dynamics is not None:
            made["setpoint"] = self._setpoints[row]
            made["control"] = self._control.at_rest(q, dq, made["setpoint"])
        return made


def plan_of(model: Model, q: np.ndarray, dq: np.ndarray, ddq: np.ndarray) -> np.ndarray:
    """Return the plan (rows, 6 + 3 n) of the joint motion q, dq, ddq (rows, n) rad, rad/s, rad/s^2."""
    hands = np.empty((len(q), 6))
    for k in range(len(q)):
        model.place(q[k])
        ee, jacobian = model.hand()
        hands[k] = np.concatenate([ee, jacobian @ dq[k]])
    return np.hstack([hands, q, dq, ddq])
