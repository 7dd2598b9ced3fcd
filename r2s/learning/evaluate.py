"""How well a policy does in simulation: 200 fixed episodes, deterministic, the same for every policy.

Two sets of goals, starts and draws: a training is watched, and its best policy chosen, on SELECTED; what is reported
of a policy comes from JUDGED, on which no policy is chosen. Settings of conf/algo and conf/reward have been compared
on JUDGED too: benchmarks/minutes.py judges them on goals of its own.
"""

from collections.abc import Callable

import numpy as np

from r2s.learning.batch import ArmBatch
from r2s.learning.randomization import TellingDraw
from r2s.physics.dynamics import Dynamics
from r2s.physics.robot import Robot
from r2s.tasks.episode import Acts, Episodes, rollout
from r2s.tasks.task import Task

SELECTED, JUDGED = 7_000_000, 2_026_1122  # seeds; trainings use their own, below 2^20


def streams(seed: int) -> list[np.random.Generator]:
    """Return independent generators of starts, goals and draws."""
    return [np.random.default_rng(s) for s in np.random.SeedSequence(seed).spawn(3)]


def fixed_episodes(robot: Robot, task: Task, count: int, seed: int = JUDGED) -> tuple[np.ndarray, np.ndarray]:
    """Return starts (count, n) rad and goals (count, ...): the same for every policy, simulator and arm."""
    of_starts, of_goals, _ = streams(seed)
    goals = task.goals(robot, of_goals, count)
    return task.begin(task.starts(robot, of_starts, count), goals), goals


def fixed_draws(draw: Callable[[np.random.Generator, int], Dynamics], count: int, seed: int = JUDGED) -> Dynamics:
    """Return the dynamics of the arms of those episodes."""
    return draw(streams(seed)[2], count)


def make_evaluation(
    robot: Robot,
    task: Task,
    draw: Callable[[np.random.Generator, int], Dynamics],
    *,
    episodes: int = 200,
    nthread: int = 0,
    seed: int = JUDGED,
) -> Callable[[Acts], Episodes]:
    """Return policy -> Episodes: all fixed episodes at once, each arm with its own (fixed) draw of the dynamics.

    The function raises FloatingPointError where an action or a reward is not finite.
    """
    drawn = fixed_draws(draw, episodes, seed)
    arms = ArmBatch(robot, task, drawn, episodes, nthread)
    if isinstance(draw, TellingDraw):
        arms.tell(*draw.said(np.random.default_rng([seed, 4]), drawn))
    starts, goals = fixed_episodes(robot, task, episodes, seed)

    def evaluate(policy: Acts) -> Episodes:
        done = rollout(policy, arms, task, starts, goals)
        if not np.isfinite(done.reward).all():
            episode, step = np.argwhere(~np.isfinite(done.reward))[0]
            raise FloatingPointError(f"reward of episode {episode} is {done.reward[episode, step]} at step {step}")
        return done

    return evaluate
