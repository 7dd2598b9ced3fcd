"""contract.json: all that a program has to know to run a policy on the arm that it was trained for.

Every number of the driver's law stands here, as r2s/physics/limits.py and r2s/arm/driver.py have it: a runtime has
none of its own. JSON knows no infinity: null stands for a limit that is not there.
"""

from typing import Any, Protocol, cast

import numpy as np

from r2s.arm import driver
from r2s.errors import UserError
from r2s.export.law import LAW_JOINT
from r2s.export.runtime import CONVENTION, FORMAT, MADE_OF
from r2s.physics import limits as law
from r2s.physics.actuation import low_pass_factor
from r2s.physics.description import chain
from r2s.physics.dynamics import Dynamics
from r2s.physics.robot import SIM_DT, Robot
from r2s.tasks.task import Entry, State, Task

UNITS = {"q_low": "rad", "q_high": "rad", "q_fade": "rad", "most": "rad/s", "slowing": "rad/s^2", "offset": "rad/s"}
UNITS |= {"dq_max": "rad/s", "added": "kg m^2", "tau_max": "Nm", "step": "Nm per cycle", "friction": "Nm"}
UNITS |= {"asked": "Nm", "q_stop_low": "rad", "q_stop_high": "rad", "dq_stop": "rad/s"}


class Says(Protocol):
    """A task that says how its observations are made."""

    def layout(self, robot: Robot) -> list[Entry]:
        """Return what is in an observation, in its order."""
        ...


def make_contract(robot: Robot, task: Task, friction: np.ndarray, rotors: np.ndarray | None = None) -> dict[str, Any]:
    """Return the contract of a policy of this arm and task, without files, versions and seal.

    Args:
        robot, task: what it was trained on and at. friction: (n,) Nm, as of `r2s.physics.limits.guard`. rotors: (n,)
            kg m^2, what the law believes of them; None: the robot's.

    Raises:
        UserError: the task does not say how its observations are made, or needs what no runtime of a bundle has.
    """
    travels(robot, task)
    links, hand = chain(robot, Dynamics.of(robot, np.zeros((robot.n, 3))), friction=False)
    rows = (
        {"name": k.name, "place": k.origin[:3, 3], "frame": k.origin[:3, :3], "axis": k.axis, "mass": k.mass}
        | {"com": k.com, "tensor": k.inertia}
        for k in links
    )
    return {
        "format": FORMAT,
        "robot": robot.name,
        "joints": [link.joint for link in links],
        "units": {"angle": "rad", "speed": "rad/s", "torque": "Nm", "length": "m", "frame": "the arm's base"},
        "rates": {"policy_hz": task.ctrl_hz, "cycle_hz": round(1 / SIM_DT), "low_pass_hz": task.cutoff_hz},
        "torque": {
            "convention": CONVENTION,
            "means": "tau_J_d of libfranka: the arm adds its own compensation of gravity",
            "max_Nm": listed(robot.tau_max),
            "max_rate_Nm_per_s": listed(robot.dtau_max),
            "asked_for_Nm": listed(task.torque(robot)),
        },
        "limits": {
            "q_min_rad": listed(robot.q_min),
            "q_max_rad": listed(robot.q_max),
            "dq_max_rad_per_s": listed(robot.dq_max),
        },
        "observation": observation(robot, task),
        "start": {"q_rad": listed(robot.q_home), "within_rad": getattr(task, "start_spread", None)},
        "goal": goal(robot, task),
        "model": {
            "gravity": "none: the arm compensates it",
            "links": [{k: v if isinstance(v, str) else listed(v) for k, v in row.items()} for row in rows],
            "hand_m": listed(hand[:3, 3]),
            "rotors": listed(robot.armature if rotors is None else rotors),
        },
        "law": {"units": UNITS, "joint": of_joints(robot, task, friction), "number": numbers(task)},
    }


def travels(robot: Robot, task: Task) -> None:
    """Raise UserError where a runtime, which takes a point and sends what the policy says, could not do a task."""
    goals, torque = task.goals(robot, np.random.default_rng(0), 1), task.torque(robot)
    needs, numbers = [], " x ".join(map(str, goals.shape[1:]))
    if goals.shape != (1, 3):
        needs.append(f"its goals are plans of {numbers} numbers")
    if not np.allclose(task.target(np.ones((1, robot.n)), State.still(robot), goals, torque), torque):
        needs.append("its actions are added to what it computes with a model")
    if needs:
        raise UserError(
            f"export: a policy of {type(task).__name__} does not travel: {' and '.join(needs)}; the runtime of "
            "a bundle takes points and has no model's torque to add to. stage=transfer runs it"
        )


def observation(robot: Robot, task: Task) -> dict[str, Any]:
    """Return what is where in an observation: name, unit, what it is made of, and its slice."""
    if not hasattr(task, "layout"):
        raise UserError(
            f"export: {type(task).__name__} does not say how its observations are made; it needs a method "
            "layout(robot) -> list of r2s.tasks.task.Entry"
        )
    says = cast(Says, task)
    entries, at = [], 0
    for e in says.layout(robot):
        if e.of not in MADE_OF:
            raise UserError(f"export: observation '{e.name}' is made of '{e.of}'; allowed: {', '.join(MADE_OF)}")
        wide = 3 if e.of in ("ee", "goal", "error") else robot.n
        by = list(e.divided_by) if isinstance(e.divided_by, tuple) else e.divided_by
        place = {"slice": [at, at + wide], "divided_by": by, "tanh": e.tanh}
        entries.append({"name": e.name, "unit": e.unit, "of": e.of} | place)
        at += wide
    if at != len(task.observation_scale(robot)[0]):
        raise UserError(
            f"export: {type(task).__name__}.layout is of {at} numbers, its observations have another size"
        )
    words = {"size": at, "dtype": "float32", "history": 0, "preview": 0, "words": task.observed}
    return words | {"normalised": "in policy.onnx", "entries": entries}


def goal(robot: Robot, task: Task) -> dict[str, Any]:
    """Return what a goal is, and where those of the training lay."""
    out: dict[str, Any] = {"shape": [3], "unit": "m", "frame": "the arm's base"}
    if hasattr(task, "region"):
        low, high = task.region(robot)
        own = {"shoulder_distance_m": [low, high], "lowest_m": task.height, "azimuth_rad": task.azimuth}  # type: ignore[attr-defined]
        out["trained"] = own
    return out


def of_joints(robot: Robot, task: Task, friction: np.ndarray) -> dict[str, list[Any]]:
    """Return the rows of the law that each joint has its own number in."""
    matrix = law.limits(robot, task.torque(robot))
    values = [matrix[:, k] for k in range(law.COLUMNS)]
    values += [friction, task.torque(robot), robot.q_min + driver.Q_INSIDE, robot.q_max - driver.Q_INSIDE]
    values.append(driver.DQ_INSIDE * robot.dq_max)
    return {name: listed(row) for name, row in zip(LAW_JOINT, values, strict=True)}


def numbers(task: Task) -> dict[str, float]:
    """Return the numbers of the law that all joints share."""
    deadline = max(driver.DEADLINE_S, driver.PERIODS / task.ctrl_hz)
    own = {"cycle_s": SIM_DT, "low_pass": low_pass_factor(task.cutoff_hz), "brake_s": law.BRAKE_S, "rate": law.RATE}
    own |= {"approach": law.APPROACH, "allowed": law.ALLOWED, "nothing": law.NOTHING, "exact": law.EXACT}
    own |= {"dry": law.DRY, "sure": law.SURE, "pivots": law.PIVOTS, "rounds": law.ROUNDS}
    return own | {"damp_s": driver.DAMP_S, "still": driver.STILL, "deadline_s": deadline}


def listed(values: Any) -> Any:
    """Return numbers as JSON has them; null where they are not finite."""
    if np.ndim(values) == 0:
        return float(values) if np.isfinite(values) else None
    return [listed(v) for v in values]
