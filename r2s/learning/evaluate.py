"""Evaluation in simulation: 200 episodes without exploration noise, the same for every policy.

A seed determines goals, start postures and dynamics of the episodes. Episodes with the seed SELECTION serve to
select the best policy of a training run. Episodes with the seed REPORT serve to report results, never to select a
policy. Settings of conf/algo and conf/reward were chosen with REPORT, so benchmarks/minutes.py uses a third seed.
"""

from collections.abc import Callable

import numpy as np

from r2s.learning.randomization import Draw
from r2s.learning.vector_arms import VectorArms
from r2s.physics.dynamics import Dynamics
from r2s.physics.robot import Robot
from r2s.tasks.rollout import Episodes, PolicyLike, rollout
from r2s.tasks.task import Task

SELECTION, REPORT = 7_000_000, 2_026_1122  # seeds; trainings use smaller seeds


def generators(seed: int) -> list[np.random.Generator]:
    """Return independent random generators for start postures, goals and dynamics."""
    return [np.random.default_rng(s) for s in np.random.SeedSequence(seed).spawn(3)]


def fixed_episodes(robot: Robot, task: Task, count: int, seed: int = REPORT) -> tuple[np.ndarray, np.ndarray]:
    """Return start postures (count, n) rad and goals (count, ...), the same for every policy, simulator and arm."""
    starts, goals, _ = generators(seed)
    drawn = task.goals(robot, goals, count)
    return task.begin(task.starts(robot, starts, count), drawn), drawn


def fixed_draws(draw: Draw, count: int, seed: int = REPORT) -> Dynamics:
    """Return the dynamics of the arms in the episodes of `fixed_episodes`."""
    return draw(generators(seed)[2], count)


def make_evaluation(
    robot: Robot, task: Task, draw: Draw, *, episodes: int = 200, nthread: int = 0, seed: int = REPORT
) -> Callable[[PolicyLike], Episodes]:
    """Return a function that runs a policy in the fixed episodes, in parallel, and returns the `Episodes`.

    The function raises FloatingPointError if an action or a reward is not finite.
    """
    arms = VectorArms(robot, task, fixed_draws(draw, episodes, seed), episodes, nthread)
    starts, goals = fixed_episodes(robot, task, episodes, seed)

    def evaluate(policy: PolicyLike) -> Episodes:
        done = rollout(policy, arms, task, starts, goals)
        if not np.isfinite(done.reward).all():
            episode, step = np.argwhere(~np.isfinite(done.reward))[0]
            raise FloatingPointError(f"reward of episode {episode} is {done.reward[episode, step]} at step {step}")
        return done

    return evaluate
