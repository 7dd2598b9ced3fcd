"""Make contract.json, which contains all data that a program needs to run a policy on the arm of the training.

The contract contains all parameters of driver and safety filter (r2s/arm/driver.py, r2s/physics/safety_filter.py), of
the controller, and of the model for computed torque (r2s/physics/inverse_dynamics.py).
JSON has no infinity, so null stands for a missing limit.
"""

from typing import Any, Protocol, cast

import numpy as np

from r2s.arm import drive_cycle, driver
from r2s.arm.clients.fr3 import as_driven
from r2s.control.computed_torque import ComputedTorque
from r2s.control.controller import Controller
from r2s.control.impedance import Impedance
from r2s.errors import UserError
from r2s.export.inverse_dynamics import FRICTION
from r2s.export.law import Model
from r2s.export.plan import COLUMNS
from r2s.export.runtime import FORMAT
from r2s.export.surface_contract import pushes, reflexes, surface_goal, surface_start
from r2s.learning.policy import observation_words
from r2s.physics import safety_filter as law
from r2s.physics.actuation import low_pass_factor
from r2s.physics.description import chain
from r2s.physics.dynamics import Dynamics
from r2s.physics.friction import WIDTH_DQ
from r2s.physics.inverse_dynamics import SLIDES, InverseDynamics
from r2s.physics.robot import SIM_DT, Robot
from r2s.tasks.surface_task import SurfaceTask
from r2s.tasks.task import ObservationTerm, Task, observation_scale
from r2s.tasks.track import TrackTask

CONVENTION = "without gravity"
# sources of observation terms for every kind of goal; `pull` is J^T times the position error
MADE_OF = ("q", "dq", "ee", "goal", "error", "effort", "pull")
MORE_OF = {  # additional sources, by the kind of goal
    "point": (),
    "plan": ("ahead", "velocity", "limited", "q_off", "dq_off", "control"),
    "surface": (
        *("tip", "height", "tip_velocity", "rate", "force", "force_error", "above_target", "limited", "path_error"),
        "velocity",
    ),
}
NEAR_RAD = 0.05  # rad, allowed distance of a joint from the start posture; half the path error allowed in `move_to`
FIRST_ROW = "at rest, at the joint angles of a plan's first row"
RESTING = 0.1  # rad/s, speed below which a joint is at rest: five times the driver's STILL, for noisier sensors
UNITS = {"q_low": "rad", "q_high": "rad", "q_fade": "rad", "most": "rad/s", "slowing": "rad/s^2", "offset": "rad/s"}
UNITS |= {"dq_max": "rad/s", "added": "kg m^2", "tau_max": "Nm", "step": "Nm per cycle", "friction": "Nm"}
UNITS |= {"asked": "Nm", "q_stop_low": "rad", "q_stop_high": "rad", "dq_stop": "rad/s"}
UNITS |= {"spring": "Nm/rad", "release": "Nm per cycle", "held_most": "Nm"}


class DescribesObservation(Protocol):
    """A task that describes the terms of its observations."""

    def observation_terms(self, robot: Robot) -> list[ObservationTerm]:
        """Return the terms of an observation, in the order of the observation vector."""
        ...


def make_contract(robot: Robot, task: Task, friction: np.ndarray, rotors: np.ndarray | None = None) -> dict[str, Any]:
    """Return a policy's contract without the keys files, versions, trained and seal, which `write_bundle` adds.

    Args:
        robot, task: robot and task of the training. friction: (n,) Nm, Coulomb friction, see
            `safety_filter.filter_torque`.
        rotors: armatures (n,) kg m^2 for the safety filter; if None, the armatures of `robot`.

    Raises:
        UserError: the task has no `observation_terms`, or the runtime of a bundle does not support the task.
    """
    check_exportable(robot, task)
    control = task.control(robot)
    own = Dynamics.of(robot, np.zeros((robot.n, 3)))
    links, hand = chain(robot, own, friction=False)
    model = {
        "gravity": "none: the arm compensates it",
        "links": links_of(robot, own),
        "hand_m": listed(hand[:3, 3]),
        "rotors": listed(robot.armature if rotors is None else rotors),
    }
    place = shoulder(model, robot)
    if isinstance(task, SurfaceTask):
        form = surface_goal(robot, task)
    else:
        form = plans(robot, task, place) if isinstance(task, TrackTask) else goal(robot, task, place)
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
            "limit_Nm": listed(task.torque_limit(robot)),
        },
        "control": controller(control, task),
        "limits": {
            "q_min_rad": listed(robot.q_min),
            "q_max_rad": listed(robot.q_max),
            "dq_max_rad_per_s": listed(robot.dq_max),
        },
        "observation": observation(robot, task),
        "start": start(robot, task),
        "goal": form,
        "model": model,
        "law": {
            "units": UNITS,
            "joint": of_joints(as_driven(robot), task, friction),
            "number": numbers(task),
            "push": pushes(robot, task.push_limit),
            "reflexes": reflexes(robot, task),
        },
    }


def kind_of(task: Task) -> str:
    """Return the kind of a task's goals: "plan", "surface" (a plan on a surface) or "point"."""
    return "plan" if isinstance(task, TrackTask) else "surface" if isinstance(task, SurfaceTask) else "point"


def shoulder(model: dict[str, Any], robot: Robot) -> list[float]:
    """Return the position (3,) m of the shoulder (joint 2, or the only joint); the goals lie around the shoulder."""
    arm = Model(model)
    arm.place(robot.q_home)
    return listed(arm.origin[min(1, robot.n - 1)])


def check_exportable(robot: Robot, task: Task) -> None:
    """Raise UserError unless the runtime of a bundle supports the task's goals, controller and friction family."""
    control, kind = task.control(robot), kind_of(task)
    model = model_of(control, task)
    if model is not None and model.dynamics.family.name not in FRICTION:
        raise UserError(
            f"export: the runtime of a bundle has no friction of family '{model.dynamics.family.name}'; "
            f"allowed: {', '.join(FRICTION)}"
        )
    if isinstance(task, SurfaceTask) and model is None:
        raise UserError(f"export: {type(task).__name__} needs a model of the arm; call with_model first")
    follows = isinstance(control, ComputedTorque) and kind == "plan"
    impedes = isinstance(control, Impedance) and (
        kind == "surface" or (control.setpoint_size == 3 and kind == "point")
    )
    if control.setpoint_size and not (follows or impedes):
        raise UserError(
            f"export: control={control.name} takes setpoints, which the runtime of a bundle has for task=track under "
            "control=computed_torque, for goals that are points under control=cartesian_impedance, and for "
            "impedances of tasks on a surface; stage=transfer runs it"
        )
    goals = task.goals(robot, np.random.default_rng(0), 1)
    if kind == "point" and goals.shape != (1, 3):
        numbers = " x ".join(map(str, goals.shape[1:]))
        raise UserError(
            f"export: goals of {type(task).__name__} have {numbers} numbers; the runtime of a bundle takes points, "
            "and the plans of r2s.tasks.track.TrackTask and of tasks on a surface; stage=transfer runs it"
        )


def model_of(control: Controller, task: Task) -> InverseDynamics | None:
    """Return the arm model that computed torque or the contact-force estimate needs; None if neither is used."""
    if isinstance(control, ComputedTorque):
        return control.model
    return task.model if isinstance(task, SurfaceTask) else None


def controller(control: Controller, task: Task) -> dict[str, Any]:
    """Return the entry `control`: action space, parameters of the law, and the arm model that the law needs."""
    kind, model = kind_of(task), model_of(control, task)
    return {
        "name": control.name,
        "action": control.action,
        "unit": control.unit,
        "action_scale": listed(control.action_scale),
        "action_offset": listed(control.action_offset),
        "parameters": listed(control.parameters),
        "memory_size": control.memory_size,
        "setpoint": {"point": "goal"}.get(kind, kind) if control.setpoint_size else None,
        "model": None if model is None else identified(model, getattr(control, "ahead_s", 0.0), kind),
    }


def links_of(robot: Robot, dynamics: Dynamics) -> list[dict[str, Any]]:
    """Return for each link: pose and axis of its joint at angle 0; mass, center and tensor in the link frame."""
    out = []
    for k in chain(robot, dynamics, friction=False)[0]:
        row: dict[str, Any] = {"place": k.origin[:3, 3], "frame": k.origin[:3, :3], "axis": k.axis}
        row |= {"mass": k.mass, "com": k.com, "tensor": k.inertia}
        out.append({"name": k.name} | {what: listed(values) for what, values in row.items()})
    return out


def observation(robot: Robot, task: Task) -> dict[str, Any]:
    """Return the entry `observation`: each term's name, unit, source and slice of the observation vector."""
    if not hasattr(task, "observation_terms"):
        raise UserError(
            f"export: {type(task).__name__} does not describe its observations; it needs a method "
            "observation_terms(robot) -> list of r2s.tasks.task.ObservationTerm"
        )
    control, describes = task.control(robot), cast(DescribesObservation, task)
    preview, known = task.preview if isinstance(task, TrackTask) else 0, (*MADE_OF, *MORE_OF[kind_of(task)])
    terms = describes.observation_terms(robot)
    if control.observes_torque:
        limit = tuple(task.torque_limit(robot).tolist())
        terms = [*terms, ObservationTerm("control torque / torque limit", "1", "control", divided_by=limit)]
    entries, at = [], 0
    for e in terms:
        if e.of not in known:
            raise UserError(f"export: observation '{e.name}' comes from '{e.of}'; allowed: {', '.join(known)}")
        wide = width(e.of, robot.n, preview)
        by = list(e.divided_by) if isinstance(e.divided_by, tuple) else e.divided_by
        place = {"slice": [at, at + wide], "divided_by": by, "tanh": e.tanh}
        entries.append({"name": e.name, "unit": e.unit, "of": e.of} | place)
        at += wide
    if at != (size := len(observation_scale(task, robot)[0])):
        raise UserError(f"export: {type(task).__name__}.observation_terms has {at} numbers, observations have {size}")
    words = {"size": at, "dtype": "float32", "history": 0, "preview": preview}
    words |= {"words": observation_words(task, control)}
    return words | {"normalised": "in policy.onnx", "entries": entries}


def width(of: str, joints: int, preview: int) -> int:
    """Return the number of values of one signal in the observation; `of` is the signal's name, such as "q"."""
    own = {"ee": 3, "goal": 3, "error": 3, "velocity": 3, "limited": 1, "ahead": 3 * preview}
    own |= {"tip": 3, "tip_velocity": 3, "path_error": 3, "height": 1, "rate": 1, "force": 1, "force_error": 1}
    return {**own, "above_target": 1}.get(of, joints)


def goal(robot: Robot, task: Task, shoulder_m: list[float]) -> dict[str, Any]:
    """Return the entry `goal` for goals that are points: format of a goal, and region of the training's goals."""
    out: dict[str, Any] = {"kind": "point", "shape": [3], "unit": "m", "frame": "the arm's base"}
    if hasattr(task, "region"):
        low, high = task.region(robot)
        own = {"shoulder_m": shoulder_m, "shoulder_distance_m": [low, high]}
        own |= {"lowest_m": task.height, "azimuth_rad": task.azimuth}  # type: ignore[attr-defined]
        out["trained"] = own
    return out


def plans(robot: Robot, task: TrackTask, shoulder_m: list[float]) -> dict[str, Any]:
    """Return the entry `goal` for goals that are plans: format of a plan, and ranges of the training's plans."""
    ends = np.cumsum([0, 3, 3, robot.n, robot.n, robot.n]).tolist()
    low, high = task.region(robot)
    trained = {"kinds": list(task.kinds), "size_m": list(task.size), "fastest_m_per_s": list(task.speed)}
    trained |= {"seconds": task.episode_s, "ramp_s": task.ramp_s, "shoulder_distance_m": [low, high]}
    trained |= {"shoulder_m": shoulder_m, "lowest_m": task.height, "azimuth_rad": task.azimuth}
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
    """Return the entry `start`: the start posture, and the largest deviation and speed of a joint at the start."""
    rest = {"within_rad": NEAR_RAD, "fastest_rad_per_s": RESTING}
    if isinstance(task, TrackTask):
        return {"words": FIRST_ROW} | rest
    if isinstance(task, SurfaceTask):
        return {"words": FIRST_ROW + "; q_rad: of plan.npy"} | rest | surface_start(robot, task)
    spread = getattr(task, "start_spread", None)
    return {"q_rad": listed(robot.q_home)} | rest | {"within_rad": None if spread is None else spread + NEAR_RAD}


WORDS = {
    "plan": (
        "command torque + M (ddq + w^2 (q - q_arm) + 2 w (dq - dq_arm)) + C(q, dq) + g(q) - g_nominal(q) "
        "+ friction(dq) - offset - drag_sin sin q - drag_cos cos q + load |g_nominal(q)| tanh(dq / load_sign); "
        "q, dq, ddq of the plan `ahead_s` later; w multiplies the errors of now; M, C, g of these links; w and "
        "the cycles between two updates of the feedback are `parameters`"
    ),
    "surface": (
        "observe the force F of the tip, the least squares of J^T F = tau_J_d - (C(q, dq) + g(q) - g_nominal(q) "
        "+ friction(dq) - offset - drag_sin sin q - drag_cos cos q + load |g_nominal(q)| tanh(dq / load_sign)); "
        "C, g of these links"
    ),
}


def identified(arm: InverseDynamics, ahead_s: float, kind: str) -> dict[str, Any]:
    """Return the entry `control.model`: the parameters of the arm model, and the formula that uses them."""
    robot, d = arm.robot, arm.dynamics
    names = FRICTION[d.family.name]
    phi = dict(zip(d.family.names, d.phi.T, strict=False))
    return {
        "words": WORDS[kind],
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
        "number": {"ahead_s": ahead_s, "sign_rad_per_s": WIDTH_DQ, "load_sign_rad_per_s": SLIDES},
    }


def of_joints(robot: Robot, task: Task, friction: np.ndarray) -> dict[str, list[Any]]:
    """Return {name in UNITS: n values}, the parameters of safety filter and driver that have a value per joint."""
    matrix = law.filter_limits(robot, task.torque_limit(robot))
    values = [matrix[:, k] for k in range(law.COLUMNS)]
    values += [friction, task.torque_limit(robot), robot.q_min + driver.Q_INSIDE, robot.q_max - driver.Q_INSIDE]
    values += [driver.DQ_INSIDE * robot.dq_max, driver.spring(robot)]
    values += [drive_cycle.RELEASE * SIM_DT * robot.tau_max, drive_cycle.ADDED * robot.tau_max]
    return {name: listed(row) for name, row in zip(UNITS, values, strict=True)}


def numbers(task: Task) -> dict[str, float]:
    """Return {name: value}, the parameters of safety filter and driver that are the same for all joints."""
    deadline = max(driver.DEADLINE_S, driver.PERIODS / task.ctrl_hz)
    own = {"cycle_s": SIM_DT, "low_pass": low_pass_factor(task.cutoff_hz), "brake_s": law.BRAKE_S, "rate": law.RATE}
    own |= {"approach": law.APPROACH, "allowed": law.ALLOWED, "nothing": law.FADED, "exact": law.TOLERANCE}
    own |= {"dry": law.FRICTION_WIDTH, "sure": law.FRICTION_SHARE, "pivots": law.PIVOTS, "rounds": law.ROUNDS}
    return own | {"damp_s": driver.DAMP_S, "still": drive_cycle.STILL, "deadline_s": deadline}


def listed(values: Any) -> Any:
    """Return a number or an array in a form that JSON can express; values that are not finite become null."""
    if np.ndim(values) == 0:
        return float(values) if np.isfinite(values) else None
    return [listed(v) for v in values]
