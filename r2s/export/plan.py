"""What a policy that follows plans needs beside the law, in NumPy: a second writing of what r2s/tasks/track.py does.

A plan is a timed path, a row for each control step: the hand's place and velocity, the joints' angles, speeds and
accelerations. It needs nothing of r2s; `r2s export` puts it into the one file of a bundle.
"""

from typing import Any

import numpy as np

from r2s.export.base import Base, check_base
from r2s.export.law import BundleError, Model

COLUMNS = ("place", "velocity", "q", "dq", "ddq")  # of a plan
# what an entry of an observation may be made of where a goal is a plan, beside what it is of a point
OF_PLAN = ("ahead", "velocity", "limited", "q_off", "dq_off", "base")


def width(of: str, joints: int, preview: int) -> int:
    """Return how many numbers there are in an entry of an observation."""
    return {"ee": 3, "goal": 3, "error": 3, "velocity": 3, "limited": 1, "ahead": 3 * preview}.get(of, joints)


def check_goal(contract: dict[str, Any]) -> None:
    """Raise BundleError where what a contract says of goals, preview and base cannot be."""
    n, goal, base, seen = len(contract["joints"]), contract["goal"], contract["base"], contract["observation"]
    preview, made = seen["preview"], {entry["of"] for entry in seen["entries"]}
    if goal["kind"] == "point":
        if preview:
            raise BundleError(f"contract.json: observations of preview {preview}; a goal that is a point has none")
        if base is not None:
            raise BundleError("contract.json: a base, which a goal that is a point does not have")
        if goal["shape"] != [3]:
            raise BundleError(f"contract.json: a point of shape {goal['shape']}; [3] is allowed")
        return
    if goal["kind"] != "plan":
        raise BundleError(f"contract.json: goals are '{goal['kind']}'; this runtime takes 'point' and 'plan'")
    if not isinstance(preview, int) or preview < 1 or not isinstance(goal["steps"], int) or goal["steps"] < 1:
        raise BundleError(f"contract.json: a preview of {preview} samples in {goal['steps']} steps")
    if goal["shape"] != [goal["steps"] + 1 + preview, 6 + 3 * n]:
        raise BundleError(
            f"contract.json: plans of shape {goal['shape']}; {goal['steps']} steps, a preview of {preview} and {n} "
            f"joints make {[goal['steps'] + 1 + preview, 6 + 3 * n]}"
        )
    ends = np.cumsum([0, 3, 3, n, n, n]).tolist()
    for name, begin, end in zip(COLUMNS, ends[:-1], ends[1:], strict=True):
        if goal["columns"][name] != [begin, end]:
            raise BundleError(f"contract.json: '{name}' of a plan is at {goal['columns'][name]}; {begin} is next")
    if goal["row_hz"] != contract["rates"]["policy_hz"]:
        raise BundleError(
            f"contract.json: plans of {goal['row_hz']} Hz and a policy of {contract['rates']['policy_hz']} Hz"
        )
    if (base is None) == ("base" in made):
        words = "a base that no observation has" if base else "observations of a base that is not there"
        raise BundleError(f"contract.json: {words}")
    if base is not None:
        check_base(base, n)


class Follower:
    """Where in a plan a policy is, what it sees of it, and what its torque is added to.

    Args:
        contract: whose goals are plans.
    """

    def __init__(self, contract: dict[str, Any]):
        goal = contract["goal"]
        self._steps, self._hz, self._preview = goal["steps"], goal["row_hz"], contract["observation"]["preview"]
        self._at = {name: slice(*goal["columns"][name]) for name in COLUMNS}
        self._base = None if contract["base"] is None else Base(contract)
        self._shape, self._plan = tuple(goal["shape"]), np.zeros(0)

    def take(self, plan: Any) -> None:
        """Take the plan of the next motion; raise BundleError where there is none, of the size and finite."""
        if plan is None:
            raise BundleError("the policy of this bundle follows plans: one is told to `reset`")
        plan = np.array(plan, dtype=float)
        if plan.shape != self._shape:
            raise BundleError(f"the plan is of shape {plan.shape}; {self._shape} is allowed")
        if not (good := np.isfinite(plan)).all():
            row, column = np.argwhere(~good)[0]
            raise BundleError(
                f"the plan is {plan[row, column]} in row {row}, column {column}; finite ones are allowed"
            )
        if self._base is not None:
            q, dq, ddq = (plan[:, self._at[k]] for k in ("q", "dq", "ddq"))
            self._base.prepare(q, dq, ddq, self._hz, self._steps + 1)
        self._plan = plan

    def __call__(
        self, step: int, q: np.ndarray, dq: np.ndarray, ee: np.ndarray, limited: float
    ) -> dict[str, np.ndarray]:
        """Return what there is to see of the plan in a control step: `goal`, where the hand is to be, and OF_PLAN.

        Beyond the last step the plan's end is held.

        Args:
            step: from 0. q, dq: (n,) rad, rad/s. ee: (3,) m, the hand.
            limited: share of the last control period in which the law changed what was asked for.
        """
        if not self._plan.size:
            raise BundleError("the policy of this bundle follows plans: one is told to `reset`")
        row, at, plan = min(step, self._steps), self._at, self._plan
        now = plan[row]
        made = {"goal": now[at["place"]], "velocity": now[at["velocity"]], "limited": np.array([limited])}
        made["ahead"] = (plan[row + 1 : row + 1 + self._preview, at["place"]] - ee).ravel()
        made |= {"q_off": now[at["q"]] - q, "dq_off": now[at["dq"]] - dq}
        if self._base is not None:
            made["base"] = self._base(row, q, dq)
        return made


def plan_of(model: Model, q: np.ndarray, dq: np.ndarray, ddq: np.ndarray) -> np.ndarray:
    """Return the plan (rows, 6 + 3 n) of joint motions (rows, n) rad, rad/s, rad/s^2."""
    hands = np.empty((len(q), 6))
    for k in range(len(q)):
        model.place(q[k])
        ee, jacobian = model.hand()
        hands[k] = np.concatenate([ee, jacobian @ dq[k]])
    return np.hstack([hands, q, dq, ddq])
