"""Made-up episodes, curves and torques for figures and recordings, and what a recording contains."""

from pathlib import Path

import mujoco
import numpy as np
import pandas as pd
from rerun.chunk import RrdReader

from r2s.physics.robot import Robot
from r2s.reporting.viewer.data import Episode, Overlay


def make_episode(robot: Robot, seed: int, rows: int = 60) -> Episode:
    """A random walk about the home pose."""
    rng = np.random.default_rng(seed)
    q = robot.q_home + np.cumsum(0.01 * rng.normal(size=(rows, robot.n)), axis=0)
    model = robot.model(gravity=False)
    data, ee = mujoco.MjData(model), np.empty((rows, 3))
    for k in range(rows):
        data.qpos[:] = q[k]
        mujoco.mj_kinematics(model, data)
        ee[k] = data.site(robot.ee_site).xpos
    return Episode(0.02 * np.arange(rows), q, ee, ee[-1] + 0.02, rng.normal(size=q.shape))


def make_curve(rows: int = 12) -> pd.DataFrame:
    steps, success = 1000 * np.arange(1, rows + 1), np.linspace(0, 1, rows)
    table = {key: success for key in ("success_5cm", "success_2cm", "success_1cm", "success_5mm")}
    extra = {"distance_median_m": 0.3 - 0.2 * success, "return_paper": -100 + 50 * success}
    return pd.DataFrame({"env_steps": steps, "wall_clock_s": steps / 100, **table, **extra})


def make_overlay(n: int, rows: int = 400) -> Overlay:
    t = 0.01 * np.arange(rows)
    measured = np.sin(t[:, None] * (1 + np.arange(n)))
    return Overlay(t, measured, {"nominal": 0.7 * measured, "identified": measured + 0.01})


def entities(path: Path) -> set[str]:
    return {chunk.entity_path for chunk in RrdReader(path).stream()}
