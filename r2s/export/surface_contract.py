"""Make the contract's entries for policies that press or wipe: format of plans on a surface, and push limit."""

from typing import Any

import numpy as np

from r2s.arm.clients.collision_thresholds import thresholds_for
from r2s.errors import UserError
from r2s.export.push import PUSH_NUMBER, STOPS
from r2s.export.surface import PULL, VELOCITY, columns_of
from r2s.physics import contact_stop as stop
from r2s.physics import push_limit as law
from r2s.physics.payload import ee_pose
from r2s.physics.robot import Robot
from r2s.physics.tip import Tip
from r2s.tasks.surface_task import LAG_M, REGULAR, START, SurfaceTask
from r2s.tasks.task import Task

EXAMPLES = 64  # number of random goals; their largest target velocity and feedforward force set the allowed values
SPARE = 2.0  # allowed value / largest value of the examples; 1,158 wipes had up to 1.5 times the largest force of 64


def surface_plans(robot: Robot, task: SurfaceTask, goals: np.ndarray) -> np.ndarray:
    """Return the plans (k, steps + 1, columns) of `goals`, k goals of the task."""
    control, t = task.control(robot), np.arange(task.steps + 1) / task.ctrl_hz
    none, starts, out = np.zeros((len(t), 3)), np.zeros((len(t), robot.n)), []
    for goal in goals:
        rows = np.broadcast_to(goal, (len(t), len(goal)))
        contact = task.contact(t, rows)
        velocity = task.now(t, rows)[:, 3:6] if hasattr(task, "now") else none
        parts = [task.at(t, rows), contact[:, :3], task.depth(t, rows)[:, None], contact[:, 3:], velocity]
        out.append(np.hstack([*parts, task.begin(starts, rows), control.setpoint(task, t, rows)]))
    return np.array(out)


def surface_goal(robot: Robot, task: SurfaceTask) -> dict[str, Any]:
    """Return the contract's entry `goal` for plans on a surface: format and training ranges of a plan."""
    control, tool = task.control(robot), robot.tool
    columns = columns_of(robot.n, control.setpoint_size)
    point, normal = task.plane(robot)
    contact, radius = getattr(control, "contact", None), tool.radius  # type: ignore[union-attr]
    deepest = float(task.beyond + LAG_M - radius + task.force[1] / task.spring)
    trained = {"point_m": point.tolist(), "normal": normal.tolist(), "spread_m": task.spread}
    trained |= {"place_m": task.place, "tilt_rad": float(np.radians(task.tilt)), "force_N": list(task.force)}
    trained |= {"depth_m": [-float(task.clearance + radius), deepest]}
    trained |= {"contact": None if contact is None else contact.tolist()}  # replaces the plan's normal and force, N
    trained |= _largest_setpoints(robot, task)
    site, axes = ee_pose(robot)
    return {
        "kind": "surface",
        "shape": [task.steps + 1, columns["setpoint"][1]],
        "steps": task.steps,
        "row_hz": task.ctrl_hz,
        "columns": columns,
        "unit": "m, m/s, N, rad, and the units of the controller",
        "frame": "the arm's base",
        "examples": "plans.npz",
        "tip_m": (site + axes @ tool.tip).tolist(),  # type: ignore[union-attr]
        "regular_m2": REGULAR,
        "trained": trained | {"seconds": task.episode_s},
    }


def _largest_setpoints(robot: Robot, task: SurfaceTask) -> dict[str, float]:
    """Return the largest allowed target velocity (m/s) and feedforward force (N) of a setpoint; 0 if it has none."""
    control, t = task.control(robot), np.arange(task.steps + 1) / task.ctrl_hz
    goals = task.goals(robot, np.random.default_rng(0), EXAMPLES)
    rows = np.vstack([control.setpoint(task, t, np.broadcast_to(goal, (len(t), len(goal)))) for goal in goals])
    return {
        name: SPARE * float(np.linalg.norm(rows[:, columns], axis=1).max())
        for name, columns in (("target_m_per_s", VELOCITY), ("feedforward_N", PULL))
    }


def surface_start(robot: Robot, task: SurfaceTask) -> dict[str, Any]:
    """Return the start posture of an example plan, and the allowed deviation of a joint from a start posture, rad.

    If no joint deviates by more than the allowed deviation, the tip starts above the surface.
    """
    q = task.goals(robot, np.random.default_rng(0), 1)[0, START : START + robot.n]
    lever = np.abs(task.plane(robot)[1] @ Tip(robot)(q)[1]).sum()
    return {"q_rad": q.tolist(), "within_rad": round(float((task.clearance - task.beyond) / lever), 4)}


def pushes(robot: Robot, limit: law.PushLimit | None) -> dict[str, Any] | None:
    """Return the parameters of the push limit and of a stop in contact; None without a push limit."""
    if limit is None:
        return None
    columns = limit.columns(robot)
    values = [float(columns[k]) for k in (law.FORCE_MAX, law.SPEED_NEAR, law.SLOPE, law.MARGIN, law.RADIUS)]
    values += [law.NEAR_M, law.OVERSHOOT, law.ROUNDS, law.CLOSE, law.LEAVE, stop.LEAVES_S, stop.RELEASED]
    values += [stop.SLIDES, stop.RETREAT_M, stop.MOST, stop.GAIN]
    out: dict[str, Any] = dict(zip(PUSH_NUMBER, values, strict=True))
    for name, at in (("point", law.POINT), ("normal", law.NORMAL), ("tip", law.TIP)):
        out[name] = columns[at : at + 3].tolist()
    assert limit.stop in STOPS
    return out | {"stop": limit.stop}


def reflexes(robot: Robot, task: Task) -> dict[str, list[float]] | None:
    """Return the thresholds of a Franka arm's collision reflexes for libfranka's setCollisionBehavior.

    If the arm does not have 7 joints or the task's forces are too large, return None: the cautious thresholds apply.
    """
    if robot.n != 7:
        return None
    try:
        own = thresholds_for(robot, task)
    except UserError as error:
        print(f"no thresholds of an arm's reflexes in the bundle: {error}")
        return None
    return {"torque_Nm": list(own.torque), "force_N": list(own.force)}
