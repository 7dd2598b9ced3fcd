"""How well a policy reaches: 200 fixed goals, deterministic, in simulation. The measures serve every arm."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import mujoco
import numpy as np
import torch

from r2s.env import ReachEnv, Task, sample_goals
from r2s.rewards import PAPER
from r2s.robot import Robot
from r2s.simulator import Dynamics

GOAL_SEED = 7_000_000  # goals, starts and draws of every evaluation; trainings use their own seeds
HOLD_S = 0.5  # s, at the end of an episode: reached means reached and held


@dataclass(frozen=True)
class Episodes:
    """E finished episodes of T control steps; row k is the state after step k.

    Attributes:
        t: (T,) s. q, dq: (E, T, n). ee: (E, T, 3) m. goal: (E, 3) m. tau: (E, T, n) Nm, the command at the end of
        the step. distance: (E, T) m. reward: (E, T), eq. (2).
    """

    t: np.ndarray
    q: np.ndarray
    dq: np.ndarray
    ee: np.ndarray
    goal: np.ndarray
    tau: np.ndarray
    distance: np.ndarray
    reward: np.ndarray


class Acts(Protocol):
    """What reaches: a policy (r2s/networks.py) or the model-based reference (r2s/oracle.py)."""

    def action(self, observation: torch.Tensor) -> torch.Tensor:
        """Return actions (B, n) in [-1, 1] for observations (B, d)."""
        ...


class Kinematics:
    """Where the arm's hand is, from joint angles and the nominal geometry: what a real arm knows, too."""

    def __init__(self, robot: Robot):
        self._model = robot.model(gravity=False)
        self._data = mujoco.MjData(self._model)
        self._site = self._model.site(robot.ee_site).id

    def __call__(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return ee (3,) m and its Jacobian (3, n) m/rad at q (n,) rad."""
        self._data.qpos = q
        mujoco.mj_kinematics(self._model, self._data)
        ee = self._data.site_xpos[self._site].copy()
        return ee, np.cross(self._data.xaxis, ee - self._data.xanchor).T


def measures(episodes: Episodes) -> dict[str, float]:
    """Return one row of evaluations.csv.

    success_x: share of episodes within x of the goal for the whole last 0.5 s. distance_median_m: median over goals
    of the mean distance in that time. return_paper: mean sum of eq. (2). time_to_reach_s: median time after which the
    hand stays within 2 cm, of the episodes that got there. overshoot_m: how far out of 2 cm it came again after it
    had first been within, mean of those that had.
    """
    step = episodes.t[1] - episodes.t[0]
    last = episodes.distance[:, -round(HOLD_S / step) :]
    away = episodes.distance > 0.02
    steps = episodes.distance.shape[1]
    since = np.where(away.any(1), steps - np.argmax(away[:, ::-1], axis=1), 0)
    there = since < steps
    first = np.argmin(away, axis=1)
    later = [
        max(0.0, row[k:-1].max(initial=0.0) - 0.02)
        for row, k, out in zip(episodes.distance, first, away, strict=True)
        if not out.all()
    ]
    return {
        "success_5cm": float((last.max(1) < 0.05).mean()),
        "success_2cm": float((last.max(1) < 0.02).mean()),
        "success_1cm": float((last.max(1) < 0.01).mean()),
        "success_5mm": float((last.max(1) < 0.005).mean()),
        "distance_median_m": float(np.median(last.mean(1))),
        "return_paper": float(episodes.reward.sum(1).mean()),
        "time_to_reach_s": float(np.median(since[there]) * step) if there.any() else float("nan"),
        "overshoot_m": float(np.mean(later)) if later else float("nan"),
    }


def gap(one: Episodes, other: Episodes) -> dict[str, float]:
    """Return how far apart one policy came out on the same goals: RMSE of the hand's path, mm, and of torques, Nm."""
    path = np.linalg.norm(one.ee - other.ee, axis=-1)
    return {
        "ee_path_rmse_mm": float(1e3 * np.sqrt((path**2).mean())),
        "tau_rmse_Nm": float(np.sqrt(((one.tau - other.tau) ** 2).mean())),
    }


def fixed_episodes(robot: Robot, task: Task, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return starts (count, n) rad and goals (count, 3) m: the same for every policy, simulator and arm."""
    rng = np.random.default_rng(GOAL_SEED)
    starts = robot.q_home + rng.uniform(-task.start_spread, task.start_spread, (count, robot.n))
    return starts, sample_goals(robot, task, rng, count)


def make_evaluation(
    robot: Robot,
    task: Task,
    draw: Callable[[np.random.Generator, int], Dynamics],
    *,
    episodes: int = 200,
    nthread: int = 0,
) -> Callable[[Acts], Episodes]:
    """Return policy -> Episodes: all fixed episodes at once, each arm with its own (fixed) draw of the dynamics."""
    env = ReachEnv(robot, task, draw, episodes, nthread=nthread, seed=GOAL_SEED)
    starts, goals = fixed_episodes(robot, task, episodes)

    @torch.no_grad()
    def evaluate(policy: Acts) -> Episodes:
        env.place(starts, goals)
        state = env.read()
        rows: dict[str, list[np.ndarray]] = {k: [] for k in ("q", "dq", "ee", "tau", "distance", "reward")}
        for _ in range(task.steps):
            state["action"] = policy.action(state["observation"])
            state = env._step(state)
            rows["q"].append(env.sim.q.copy())
            rows["dq"].append(env.sim.dq.copy())
            rows["ee"].append(env.sim.ee.copy())
            rows["tau"].append(env.actuation.last.copy())
            rows["distance"].append(state["distance"].numpy()[:, 0].astype(float))
            rows["reward"].append(state["reward_terms"].numpy() @ PAPER)
        t = (1 + np.arange(task.steps)) / task.ctrl_hz
        return Episodes(t=t, goal=goals, **{k: np.stack(v, 1) for k, v in rows.items()})

    return evaluate
