"""How well a policy does in simulation: 200 fixed episodes, deterministic, the same for every policy."""

from collections.abc import Callable, Mapping

import numpy as np

from r2s.learning.batch import ArmBatch
from r2s.physics.dynamics import Dynamics
from r2s.physics.robot import Robot
from r2s.tasks.episode import Acts, Episodes, rollout
from r2s.tasks.task import Task

GOAL_SEED = 7_000_000  # goals, starts and draws of every evaluation; trainings use their own seeds


def fixed_episodes(robot: Robot, task: Task, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return starts (count, n) rad and goals (count, ...): the same for every policy, simulator and arm."""
    rng = np.random.default_rng(GOAL_SEED)
    starts = task.starts(robot, rng, count)
    return starts, task.goals(robot, rng, count)


def make_evaluation(
    robot: Robot,
    task: Task,
    draw: Callable[[np.random.Generator, int], Dynamics],
    *,
    episodes: int = 200,
    nthread: int = 0,
) -> Callable[[Acts], Episodes]:
    """Return policy -> Episodes: all fixed episodes at once, each arm with its own (fixed) draw of the dynamics.

    The function raises FloatingPointError where an action or a reward is not finite.
    """
    drawn = draw(np.random.default_rng(GOAL_SEED), episodes)
    arms = ArmBatch(robot, task, drawn, episodes, nthread)
    starts, goals = fixed_episodes(robot, task, episodes)

    def evaluate(policy: Acts) -> Episodes:
        done = rollout(policy, arms, task, starts, goals)
        if not np.isfinite(done.reward).all():
            episode, step = np.argwhere(~np.isfinite(done.reward))[0]
            raise FloatingPointError(f"reward of episode {episode} is {done.reward[episode, step]} at step {step}")
        return done

    return evaluate


def selection_score(row: Mapping[str, float]) -> float:
    """Return what makes one evaluation better than another: 1 % more within 1 cm is worth 1 of the return."""
    return 100 * row["success_1cm"] + row["return_paper"]
