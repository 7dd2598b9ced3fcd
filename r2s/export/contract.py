"""contract.json: all that a program has to know to run a policy on the arm that it was trained for.

Every number of the driver's law stands here, as r2s/physics/limits.py and r2s/arm/driver.py have it, and of the model
whose torque a policy's is added to (r2s/tasks/model_torque.py): a runtime has none of its own.
JSON knows no infinity: null stands for a limit that is not there.
"""

from typing import Any, Protocol, cast

import numpy as np

from r2s.arm import driver
from r2s.errors import UserError
from r2s.export.base import FRICTION
from r2s.export.law import LAW_JOINT
from r2s.export.plan import COLUMNS, OF_PLAN, width
from r2s.export.runtime import CONVENTION, FORMAT, MADE_OF
from r2s.physics import limits as law
from r2s.physics.actuation import low_pass_factor
from r2s.physics.description import chain
from r2s.physics.dynamics import Dynamics
from r2s.physics.friction import WIDTH_DQ
from r2s.physics.robot import SIM_DT, Robot
from r2s.tasks.model_torque import SLIDES, ModelTorque
from r2s.tasks.task import Entry, State, Task
from r2s.tasks.track import TrackTask

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
    own = Dynamics.of(robot, np.zeros((robot.n, 3)))
    links, hand = chain(robot, own, friction=False)
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
            "action_Nm": listed(task.share * task.torque(robot)),
        },
        "limits": {
            "q_min_rad": listed(robot.q_min),
            "q_max_rad": listed(robot.q_max),
            "dq_max_rad_per_s": listed(robot.dq_max),
        },
        "observation": observation(robot, task),
        "start": start(robot, task),
        "goal": plans(robot, task) if isinstance(task, TrackTask) else goal(robot, task),
        "base": base(task, task.model) if isinstance(task, TrackTask) and task.model is not None else None,
        "model": {
            "gravity": "none: the arm compensates it",
            "links": links_of(robot, own),
            "hand_m": listed(hand[:3, 3]),
            "rotors": listed(robot.armature if rotors is None else rotors),
        },
        "law": {"units": UNITS, "joint": of_joints(robot, task, friction), "number": numbers(task)},
    }


def travels(robot: Robot, task: Task) -> None:
    """Raise UserError where a runtime, which takes a point or a plan of `TrackTask`, could not do a task."""
    if isinstance(task, TrackTask):
        if task.model is not None and task.model.dynamics.family.name not in FRICTION:
            raise UserError(
                f"export: a base with friction of family '{task.model.dynamics.family.name}' does not travel; the "
                f"runtime of a bundle knows {', '.join(FRICTION)}"
            )
        return
    goals, torque = task.goals(robot, np.random.default_rng(0), 1), task.torque(robot)
    needs, numbers = [], " x ".join(map(str, goals.shape[1:]))
    if goals.shape != (1, 3):
        needs.append(f"its goals are of {numbers} numbers")
    if not np.allclose(task.target(np.ones((1, robot.n)), State.still(robot), goals, torque), torque):
        needs.append("its actions are not the torque")
    if needs:
        raise UserError(
            f"export: a policy of {type(task).__name__} does not travel: {' and '.join(needs)}; the runtime of a "
            "bundle takes points, and the plans of r2s.tasks.track.TrackTask. stage=transfer runs it"
        )


def links_of(robot: Robot, dynamics: Dynamics) -> list[dict[str, Any]]:
    """Return the rows of a model: each link's joint, mass, centre and tensor, in its frame at angle zero."""
    out = []
    for k in chain(robot, dynamics, friction=False)[0]:
        row: dict[str, Any] = {"place": k.origin[:3, 3], "frame": k.origin[:3, :3], "axis": k.axis}
        row |= {"mass": k.mass, "com": k.com, "tensor": k.inertia}
        out.append({"name": k.name} | {what: listed(values) for what, values in row.items()})
    return out


def observation(robot: Robot, task: Task) -> dict[str, Any]:
    """Return what is where in an observation: name, unit, what it is made of, and its slice."""
    if not hasattr(task, "layout"):
        raise UserError(
            f"export: {type(task).__name__} does not say how its observations are made; it needs a method "
            "layout(robot) -> list of r2s.tasks.task.Entry"
        )
    says = cast(Says, task)
    preview, known = (task.preview, (*MADE_OF, *OF_PLAN)) if isinstance(task, TrackTask) else (0, MADE_OF)
    entries, at = [], 0
    for e in says.layout(robot):
        if e.of not in known:
            raise UserError(f"export: observation '{e.name}' is made of '{e.of}'; allowed: {', '.join(known)}")
        wide = width(e.of, robot.n, preview)
        by = list(e.divided_by) if isinstance(e.divided_by, tuple) else e.divided_by
        place = {"slice": [at, at + wide], "divided_by": by, "tanh": e.tanh}
        entries.append({"name": e.name, "unit": e.unit, "of": e.of} | place)
        at += wide
    if at != len(task.observation_scale(robot)[0]):
        raise UserError(
            f"export: {type(task).__name__}.layout is of {at} numbers, its observations have another size"
        )
    words = {"size": at, "dtype": "float32", "history": 0, "preview": preview, "words": task.observed}
    return words | {"normalised": "in policy.onnx", "entries": entries}


def goal(robot: Robot, task: Task) -> dict[str, Any]:
    """Return what a goal is that is a point, and where those of the training lay."""
    out: dict[str, Any] = {"kind": "point", "shape": [3], "unit": "m", "frame": "the arm's base"}
    if hasattr(task, "region"):
        low, high = task.region(robot)
        own = {"shoulder_distance_m": [low, high], "lowest_m": task.height, "azimuth_rad": task.azimuth}  # type: ignore[attr-defined]
        out["trained"] = own
    return out


def plans(robot: Robot, task: TrackTask) -> dict[str, Any]:
    """Return what a goal is that is a plan, and of what family those of the training were."""
    ends = np.cumsum([0, 3, 3, robot.n, robot.n, robot.n]).tolist()
    low, high = task.region(robot)
    trained = {"kinds": list(task.kinds), "size_m": list(task.size), "fastest_m_per_s": list(task.speed)}
    trained |= {"seconds": task.episode_s, "ramp_s": task.ramp_s, "shoulder_distance_m": [low, high]}
    trained |= {"lowest_m": task.height, "azimuth_rad": task.azimuth}
    return {
        "kind": "plan",
        "shape": [task.steps + 1 + task.preview, ends[-1]],
        "steps": task.steps,
        "row_hz": task.ctrl_hz,
        "columns": {name: [begin, end] for name, begin, end in zip(COLUMNS, ends, ends[1:], strict=False)},
        "unit": "m, m/s, rad, rad/s, rad/s^2",
        "frame": "the arm's base",
        "examples": "plans.npz",
        "trained": trained,
    }


def start(robot: Robot, task: Task) -> dict[str, Any]:
    """Return where motions begin, at rest."""
    if isinstance(task, TrackTask):
        return {"words": "at rest, at the joint angles of a plan's first row"}
    return {"q_rad": listed(robot.q_home), "within_rad": getattr(task, "start_spread", None)}


def base(task: TrackTask, model: ModelTorque) -> dict[str, Any]:
    """Return what the torque of an action is added to: computed torque with this model, and its numbers."""
    robot, d = model.robot, model.dynamics
    names = FRICTION[d.family.name]
    phi = dict(zip(d.family.names, d.phi.T, strict=False))
    number = {"late_s": task.late(d), "bandwidth_rad_per_s": task.stiffness()}
    number |= {"sign_rad_per_s": WIDTH_DQ, "load_sign_rad_per_s": SLIDES}
    return {
        "words": (
            "M (ddq + w^2 (q - q_arm) + 2 w (dq - dq_arm)) + C(q, dq) + g(q) - g_nominal(q) + friction(dq) "
            "- offset - drag_sin sin q - drag_cos cos q + load |g_nominal(q)| tanh(dq / load_sign); q, dq, ddq "
            "of the plan in `late_s`, what w, the bandwidth, multiplies of now; M, C, g of these links"
        ),
        "links": links_of(robot, d),
        "rotors": listed(d.armature),
        "gravity_m_per_s2": listed(robot.gravity),
        "friction": {
            "family": d.family.name,
            "words": d.family.formula,
            "parameters": {k: listed(phi.get(k, np.zeros(robot.n))) for k in names},
            "units": {k: d.family.units[d.family.names.index(k)] for k in names},
        },
        "offset_Nm": listed(d.offset),
        "drag_sin_Nm": listed(d.drag[:, 0]),
        "drag_cos_Nm": listed(d.drag[:, 1]),
        "load": listed(d.load),
        "number": number,
    }


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
