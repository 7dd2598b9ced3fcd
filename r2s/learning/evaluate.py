"""How well a policy reaches: 200 fixed goals, deterministic, in simulation. The measures serve every arm."""

from collections.abc import Callable

import numpy as np
import torch

from r2s.learning.env import ReachEnv
from r2s.physics.dynamics import Dynamics
from r2s.physics.robot import Robot
from r2s.tasks.episode import Acts, Episodes
from r2s.tasks.reach import Task, sample_goals
from r2s.tasks.rewards import PAPER, terms

GOAL_SEED = 7_000_000  # goals, starts and draws of every evaluation; trainings use their own seeds


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
        before, distance0 = env.sim.dq.copy(), np.maximum(np.linalg.norm(goals - env.sim.ee, axis=-1), 1e-3)
        for _ in range(task.steps):
            state["action"] = policy.action(state["observation"])
            state = env._step(state)
            dq, distance = env.sim.dq.copy(), np.linalg.norm(goals - env.sim.ee, axis=-1)
            rows["q"].append(env.sim.q.copy())
            rows["dq"].append(dq)
            rows["ee"].append(env.sim.ee.copy())
            rows["tau"].append(env.actuation.last.copy())
            rows["distance"].append(distance)
            rows["reward"].append(terms(distance, distance0, dq, (dq - before) * task.ctrl_hz) @ PAPER)
            before = dq
        t = (1 + np.arange(task.steps)) / task.ctrl_hz
        return Episodes(t=t, goal=goals, **{k: np.stack(v, 1) for k, v in rows.items()})

    return evaluate
