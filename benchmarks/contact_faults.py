"""Faults while an arm presses: the task of `safety_campaign.py --contact`, and how its forces are judged."""

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
from common import NEW, ROBOT

from r2s.arm.clients.collision_thresholds import thresholds_of
from r2s.arm.twins.touch import draw_surface
from r2s.physics.contact_stop import RELEASED, SLIDES
from r2s.physics.push_limit import STOPS, PushLimit
from r2s.physics.surface import UNIT_DEPTH, Surface, load_tool
from r2s.tasks.press import PressTask
from r2s.tasks.surface_task import START

FORCE_MAX, SPEED_NEAR = 45.0, 0.03  # N, m/s
CYCLES = 1500, 2600  # of an episode, in which the cause comes: the tip presses
ARM = replace(ROBOT, tool=load_tool("r2s:models/press_tool.json"))
POINT, NORMAL = PressTask().plane(ARM)
SURFACE = {"point": POINT.tolist(), "normal": NORMAL.tolist()}
NOISE = 1.5  # N, of a force that the twin's wrench of the present cycle and its own delay add to a held one


@cache
def press(stop: str) -> PressTask:
    """Return the task of a case."""
    task = PressTask(stop=stop, point=tuple(POINT), normal=tuple(NORMAL)).with_model(ARM, NEW)
    return task.pushing_within(ARM, NEW.level, FORCE_MAX, SPEED_NEAR)


def stop_of(number: int, kinds: int) -> str:
    """Return what a stop of fault `number` does, so that every kind of fault meets every kind of stop."""
    return list(STOPS)[number // kinds % len(STOPS)]


def setting(stop: str, seed: tuple[int, int]) -> tuple[Any, dict[str, Any]]:
    """Return the robot, whose home is the start of the episode, and settings of `robot_side.Motion`."""
    task = press(stop)
    goal = task.goals(ARM, np.random.default_rng(seed), 1)[0]
    given = {"task": task, "goal": goal, "friction": NEW.level, "collision": thresholds_of(ARM, task.push_limit)}
    return replace(ARM, q_home=goal[START:].copy()), given


def bound(limit: PushLimit, surface: Surface, q: np.ndarray, force: float) -> float:
    """Return the largest force, N, at q (7,) rad on a surface that is as stiff as at this force."""
    depth = (force / float(surface.coefficient)) ** (1.0 / float(surface.exponent))
    slope = max(1.0, float(surface.exponent) * (depth / UNIT_DEPTH) ** (float(surface.exponent) - 1.0))
    return limit.bound(ARM, q, slope * float(surface.stiffness), float(surface.friction))


def judge_force(stop: str, twin_seed: int, log: Any, row: int, end: int, driven: bool) -> dict[str, Any]:
    """Return the forces of a case, N, whether they were over the bound, and what was not as decided, or "".

    log: of the robot. row, end: of the fault and of the end of the motion. driven: whether the driver ended it.
    """
    limit, surface = press(stop).push_limit, draw_surface(ARM, SURFACE, np.random.default_rng([twin_seed, 4]))
    force = np.linalg.norm(log.force, axis=1)
    peak = int(force.argmax())
    most = bound(limit, surface, log.q[peak], force[peak])  # type: ignore[arg-type]
    out = {
        "force_N": force[row],
        "largest_N": force.max(),
        "share": force.max() / most,
        "left_N": force[end],
        "undecided": "",
    }
    out["over_force"] = bool(force.max() > most)
    hidden = limit.at(ARM, NEW.level, log.q[row])[1]  # type: ignore[union-attr]
    if not driven:
        return out
    if stop == "hold" and abs(force[end] - force[row]) > hidden + NOISE:
        out["undecided"] = f"held {force[end]:.1f} N of {force[row]:.1f} N"
    most = RELEASED + (1.0 - SLIDES) * hidden
    if (stop == "release" and force[end] > most) or (stop == "retreat" and force[end] > 0.0):
        out["undecided"] = f"{stop} left {force[end]:.1f} N of {force[row]:.1f} N"
    return out
