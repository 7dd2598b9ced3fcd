"""A task is a protocol: what reach.py provides, another file can; environment and rollout ask for nothing else."""

# ruff: noqa: D102 (`Task` says what the methods of a task are)
from dataclasses import replace

import numpy as np
import pytest
import torch
from conftest import conf

from r2s.arm.policy_runner import PolicyRunner
from r2s.arm.simulated import SimulatedArm
from r2s.learning.env import TaskEnv
from r2s.learning.evaluate import make_evaluation
from r2s.learning.policy import make_policy
from r2s.learning.vector_arms import VectorArms
from r2s.physics.collision import CollisionCheck
from r2s.physics.dynamics import nominal_dynamics
from r2s.physics.robot import load_robot
from r2s.tasks.rollout import measures, rollout
from r2s.tasks.task import BaseTask, Task

PANDA = load_robot(**conf("robot/panda"))
NEW = nominal_dynamics(PANDA, **conf("friction/paper"))


class Line(BaseTask):
    """Follow a point that moves on a line; its place 0.2 s ahead is in the observation. Goals are (m, 2, 3), ends."""

    ctrl_hz, cutoff_hz, steps, substeps = 50, 100.0, 10, 20
    observation_summary, paper_weights = "q dq error ahead; rad, rad/s, m", np.array([-1.0, -0.01])
    reward_terms = ("distance", "acceleration")

    def torque_limit(self, robot):
        return 0.1 * robot.tau_max

    def starts(self, robot, rng, count):
        return np.tile(robot.q_home, (count, 1))

    def goals(self, robot, rng, count):
        return np.array([0.5, 0.0, 0.5]) + rng.uniform(-0.1, 0.1, (count, 2, 3))

    def observation_scale(self, robot):
        return np.zeros(2 * robot.n + 6), np.ones(2 * robot.n + 6)

    def point(self, goals, t):
        share = np.clip(t * self.ctrl_hz / self.steps, 0.0, 1.0)[:, None]
        return (1 - share) * goals[:, 0] + share * goals[:, 1]

    def observe(self, state, goals, torque):
        ahead = self.point(goals, state.t + 0.2) - state.ee
        parts = [state.q, state.dq, self.point(goals, state.t) - state.ee, ahead]
        return np.concatenate(parts, 1).astype(np.float32)

    def distance_scale(self, state, goals):
        return np.ones(len(goals))

    def judge(self, state, ddq, goals, reference):
        distance = np.linalg.norm(self.point(goals, state.t) - state.ee, axis=-1)
        return distance, np.stack([distance / reference, np.abs(ddq).mean(1)], 1)

    def measures(self, episodes):
        return measures(episodes)


def test_another_task_is_trained_and_evaluated_as_ours():
    """A timed path with a preview: the environment's specs follow from the task, and evaluations run."""
    task: Task = Line()
    env = TaskEnv(PANDA, task, lambda rng, m: NEW, 3, nthread=1)
    state = env.reset()
    assert state["observation"].shape == (3, 20)
    for _ in range(task.steps):
        state["action"] = torch.zeros(3, PANDA.n)
        step, state = env.step_and_maybe_reset(state)
    assert step["next", "reward_terms"].shape == (3, 2)
    assert step["next", "truncated"].all()
    done = make_evaluation(PANDA, task, lambda rng, m: NEW, episodes=2, nthread=1)(make_policy(PANDA, task, (8,)))
    expected = [
        np.linalg.norm(task.point(done.goal, np.full(2, t)) - done.ee[:, k], axis=-1) for k, t in enumerate(done.t)
    ]
    np.testing.assert_allclose(done.distance.T, expected, atol=1e-15)


def quiet(dynamics):
    """Return an arm of known truth without noise."""
    return SimulatedArm(PANDA, dynamics, position_noise=0.0, velocity_noise=0.0)


@pytest.mark.parametrize(
    "make", [lambda task: VectorArms(PANDA, task, NEW, 1, 1), lambda task: PolicyRunner(quiet(NEW), task, NEW.level)]
)
def test_time_begins_with_the_episode(make):
    """A state says how long its episode has run, in the batch and on an arm; a second episode starts at 0."""
    task = Line()
    arms = make(task)
    for _ in range(2):
        state = arms.place(PANDA.q_home[None], 0)
        assert not state.t.any()
        for k in range(3):
            state = arms.step(np.zeros((1, PANDA.n)))
            np.testing.assert_allclose(state.t, (k + 1) / task.ctrl_hz, rtol=1e-12)


def test_an_arm_that_touches_something_has_ended_its_episode():
    """Of three arms one drives its hand into its link or the table: it stays as it was then, and did not reach."""
    task = Line()
    task.steps = 40
    starts = np.tile(PANDA.q_home, (3, 1))
    starts[1] = [0.0, 1.5, 0, -1.6, 0, 2.2, 0.8]  # the hand far out, a little above the table

    class Down:
        def action(self, observation):
            """Push the second joint of the second arm."""
            return torch.tensor([[0.0] * 7, [0.0, 1.0, 0, 0, 0, 0, 0], [0.0] * 7])[: len(observation)]

    done = rollout(
        Down(), VectorArms(PANDA, task, NEW, 3, 1), task, starts, task.goals(PANDA, np.random.default_rng(0), 3)
    )
    when, what = done.collision[1].split(" s: ")
    assert what.endswith("and the table")
    assert list(done.collision[[0, 2]]) == ["", ""]
    k = round(float(when) * task.ctrl_hz) - 1
    touches = CollisionCheck(PANDA)
    assert not touches(done.q[1, :k]).any()
    assert touches(done.q[1, k:]).all()
    assert np.array_equal(done.q[1, k:], np.broadcast_to(done.q[1, k], done.q[1, k:].shape))
    assert np.isinf(done.distance[:, -1]).tolist() == [False, True, False]
    assert measures(done)["collision"] == pytest.approx(1 / 3)


class ZeroAction:
    """Asks for nothing."""

    def action(self, observation):
        """Return zeros."""
        return torch.zeros(len(observation), PANDA.n)


def test_an_episode_that_stops_keeps_its_last_state():
    """An arm that stops at once: the state of the stop lasts, its distance is worth nothing at the end."""
    task, starts = Line(), np.tile(PANDA.q_home, (2, 1))
    starts[1, 1] = PANDA.q_max[1] - 0.01  # within what a driver brings to rest
    arms = PolicyRunner(quiet(replace(NEW, offset=0 * NEW.offset)), task, NEW.level)
    done = rollout(ZeroAction(), arms, task, starts, task.goals(PANDA, np.random.default_rng(0), 2))
    assert [stop.episode for stop in arms.stops] == [1]
    assert np.array_equal(done.q[1], np.broadcast_to(done.q[1, 0], done.q[1].shape))
    assert np.isinf(done.distance[1, -1])
    assert np.isfinite(done.distance[0]).all()
    still = replace(done, dq=np.zeros_like(done.dq))
    assert measures(still)["rest"] == 0.5  # the arm that stopped did not come to rest itself
