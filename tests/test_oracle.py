"""The model-based reference: it reaches, because its model is the arm; it is driven like a policy."""

import numpy as np
import pytest
import torch
from conftest import conf
from omegaconf import OmegaConf

from r2s.errors import UserError
from r2s.excitation.minimum_jerk import minimum_jerk
from r2s.learning.evaluate import fixed_episodes, make_evaluation
from r2s.learning.model_based import Oracle
from r2s.physics.dynamics import nominal_dynamics
from r2s.physics.robot import load_robot
from r2s.stages.build import unread
from r2s.tasks.reach import ReachTask
from r2s.tasks.rollout import measures


@pytest.fixture(scope="module")
def panda():
    return load_robot(**conf("robot/panda"))


@pytest.fixture(scope="module")
def task():
    return ReachTask(**{k: tuple(v) if isinstance(v, list) else v for k, v in conf("task/reach").items()})


@pytest.fixture(scope="module")
def dynamics(panda):
    return nominal_dynamics(panda, **conf("friction/paper"), inertia_scale=conf("inertia/paper")["scale"])


@pytest.mark.long
def test_it_reaches_every_goal(panda, task, dynamics):
    """With the true model: every goal within 5 mm, held, at a return above -110; again from the same object."""
    evaluate = make_evaluation(panda, task, lambda rng, m: dynamics, episodes=24, nthread=1)
    oracle = Oracle(panda, task, dynamics)
    first, second = (measures(evaluate(oracle)) for _ in range(2))
    assert first["success_5mm"] == 1.0
    assert first["return_paper"] > -110.0
    assert first == second


@pytest.mark.long
def test_a_wrong_model_shows(panda, task, dynamics):
    """Believing the published OLD friction, it does worse: what it does comes from its model."""
    evaluate = make_evaluation(panda, task, lambda rng, m: dynamics, episodes=24, nthread=1)
    old = nominal_dynamics(panda, **conf("friction/gaz2019"))
    wrong, right = (measures(evaluate(Oracle(panda, task, d)))["success_5mm"] for d in (old, dynamics))
    assert wrong < right - 0.1


def test_inverse_kinematics_ends_at_the_goal_within_the_limits(panda, task, dynamics):
    """The hand is at the goal to 0.2 mm; a joint that an action does not move stays where it is."""
    oracle, stuck = Oracle(panda, task, dynamics), task.torque_limit(panda) < dynamics.level
    assert np.flatnonzero(stuck).tolist() == [4, 6]
    from r2s.physics.rigid_body import Kinematics

    kinematics = Kinematics(panda)
    for start, goal in zip(*fixed_episodes(panda, task, 40), strict=True):
        q = oracle.inverse_kinematics(start, goal)
        assert np.all((q > panda.q_min) & (q < panda.q_max))
        assert np.linalg.norm(kinematics(q)[0] - goal) < 2e-4
        np.testing.assert_array_equal(q[stuck], start[stuck])


def test_minimum_jerk_starts_and_ends_at_rest():
    """Ends, rest at both, the peak speed of 1.875 times the mean, and derivatives that agree with differences."""
    start, end = np.zeros(2), np.array([1.0, -2.0])
    for t, place in ((0.0, start), (2.0, end), (9.0, end)):
        q, dq, ddq = minimum_jerk(start, end, 2.0, t)
        np.testing.assert_allclose(q, place, atol=1e-12)
        np.testing.assert_allclose(np.r_[dq, ddq], 0.0, atol=1e-12)
    assert minimum_jerk(start, end, 2.0, 1.0)[1] == pytest.approx(1.875 * end / 2.0)
    h = 1e-5
    before, at, after = (minimum_jerk(start, end, 2.0, 0.6 + k * h) for k in (-1, 0, 1))
    np.testing.assert_allclose((after[0] - before[0]) / (2 * h), at[1], atol=1e-6)
    np.testing.assert_allclose((after[1] - before[1]) / (2 * h), at[2], atol=1e-6)


def test_an_episode_begins_where_there_is_no_effort(panda, task, dynamics):
    """The same observation with no effort starts a new plan: the same action whatever went before."""
    oracle = Oracle(panda, task, dynamics)
    evaluate = make_evaluation(panda, task, lambda rng, m: dynamics, episodes=2, nthread=1)
    seen: list[torch.Tensor] = []
    inner = oracle.action

    def watch(observation):
        seen.append(observation.clone())
        return inner(observation)

    oracle.action = watch  # type: ignore[method-assign]
    evaluate(oracle)
    assert torch.equal(inner(seen[0]), Oracle(panda, task, dynamics).action(seen[0]))


@pytest.mark.parametrize("move_s", [float("nan"), 0.0, -1.0])
def test_a_motion_takes_time(panda, task, dynamics, move_s):
    with pytest.raises(UserError, match=r"move_s: expected .*, got .*"):
        Oracle(panda, task, dynamics, move_s=move_s)


def test_what_a_training_reads_is_nothing_to_a_controller():
    """Also where an experiment has set it for all algorithms."""
    target = "r2s.learning.model_based.Oracle"
    algo = {"_target_": target, "name": "oracle"}
    cfg = OmegaConf.create({"stage": "train", "calibration": None, "algo": algo, "adapt": {"name": "none"}})
    cfg.algo.update({"move_s": 0.6, "batch_size": 32, "n_envs": 8})
    assert unread("algo.move_s", cfg) is None
    assert unread("algo", cfg) is None
    assert str(unread("algo.batch_size", cfg)).startswith("algo.batch_size: nothing is trained with algo=oracle")
