"""Recordings of a twin that presses on the surface of its seed and slides along it, with the true force."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from common import ROOT

from r2s.arm.twins.make_twin import make_twin
from r2s.physics.contact_layout import FORCE, NORMAL
from r2s.physics.rigid_body import mass_matrix
from r2s.physics.robot import SIM_DT, Robot
from r2s.physics.surface import Tool
from r2s.physics.tip import Tip
from r2s.recordings.recording import Recording

TOOL = Tool(np.array([0.0, 0.0, 0.06]), 0.01)  # m
STIFFNESS, RATE, POSTURE = 800.0, 25.0, 8.0  # N/m; 1/s, of the damping; Nm/rad
ABOVE = 0.03  # m, from the tip at home to the nominal surface
LOADS = (0.010, 0.018, 0.026, 0.018, 0.010)  # m, of the commanded depth: 8 to 20 N
PLACES = ((0.0, 0.0), (0.04, 0.05), (-0.03, -0.06))  # m
SLIDE, SPEED = 0.05, 0.06  # m, m/s
WRIST = np.array([0.3, 0.3, 0.3, 0.3, 1.0, 1.0, 1.0])  # of POSTURE: the tip's spring leaves the orientation free
STEP, HOLD, LIFT = 0.4, 0.4, 0.02  # s, s, m


def twin_run(variant: str, seed: int) -> Path:
    """Return the run folder of a twin's identification from free motion."""
    return ROOT / "runs" / "identify" / f"wrench_{variant}_{seed}"


def armed(robot: Robot) -> Robot:
    """Return the robot with the tip of these recordings."""
    return replace(robot, tool=TOOL)


def _plan() -> np.ndarray:
    """Return (T, 3) m, the commanded tip relative to the nominal surface: across, along, above."""
    knots, times = [(0.0, 0.0, ABOVE - TOOL.radius)], [0.0]

    def go(x: float, y: float, z: float, seconds: float) -> None:
        knots.append((x, y, z))
        times.append(times[-1] + seconds)

    go(0.0, 0.0, ABOVE - TOOL.radius, 0.5)
    for x, y in PLACES:
        go(x, y, LIFT, 1.0)
        for depth in LOADS:
            go(x, y, -depth, STEP if depth != LOADS[0] else 0.8)
            go(x, y, -depth, HOLD)
        for way in ((SLIDE, 0.0), (0.0, SLIDE)):
            for share in (1.0, 0.0):
                go(x + share * way[0], y + share * way[1], -LOADS[1], SLIDE / SPEED)
        go(x, y, LIFT, 0.6)
    t = np.arange(0.0, times[-1], SIM_DT)
    return np.column_stack([np.interp(t, times, column) for column in np.array(knots).T])


def press_twin(robot: Robot, variant: str, seed: int) -> tuple[Recording, np.ndarray, np.ndarray]:
    """Return recording, force on the arm (T, 3) N, and normal of a twin; the robot has a tool."""
    tip = Tip(robot)
    start = tip(robot.q_home)[0]
    nominal = start - np.array([0.0, 0.0, ABOVE])
    twin = make_twin(
        robot, variant=variant, seed=seed, surface={"point": nominal.tolist(), "normal": [0.0, 0.0, 1.0]}
    )
    state, last, rows, forces = twin.move_to(robot.q_home), np.zeros(robot.n), [], []
    mass = mass_matrix(robot, robot.q_home[None])[0]
    for above in _plan():
        place, jacobian = tip(state.q)
        goal = nominal + above + np.array([0.0, 0.0, TOOL.radius])
        pull = STIFFNESS * (goal - place)
        tau = jacobian.T @ pull + POSTURE * (robot.q_home - state.q) * WRIST - RATE * mass @ state.dq
        last = last + np.clip(tau - last, -0.9, 0.9)
        rows.append((state.q, state.dq, last))
        forces.append(twin._touch.contact[FORCE : FORCE + 3].copy())
        twin.command(last)
        state = twin.read()
    q, dq, tau = (np.array(x) for x in zip(*rows, strict=True))
    normal = twin._touch.contact[NORMAL : NORMAL + 3].copy()
    return Recording(np.arange(len(q)) * SIM_DT, q, dq, tau, "commanded"), np.array(forces), normal
