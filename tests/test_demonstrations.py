"""Demonstrations: the reference acts, with noise, before the first update; tasks without one act at random."""

import json

import numpy as np
import pytest
import torch
from cli_runs import r2s, succeed
from conftest import conf
from test_checkpoint import make_algo, make_env
from test_faults import composed
from test_press import PANDA, TRUE
from test_push import make_task as pushing

from r2s.learning.demonstrations import make_demonstrator
from r2s.learning.model_based import Oracle, hybrid_force
from r2s.learning.train import Loop, Training
from r2s.physics.dynamics import nominal_dynamics
from r2s.physics.robot import load_robot
from r2s.stages.build import make_dynamics
from r2s.stages.train import make_parts
from r2s.tasks.track import TrackTask

LEARNING_STARTS = 400  # env steps; of 4 arms, 2 s each


@pytest.fixture(scope="module")
def panda():
    return load_robot(**conf("robot/panda"))


@pytest.fixture(scope="module")
def dynamics(panda):
    return nominal_dynamics(panda, **conf("friction/paper"))


def values(path):
    return {k: tuple(v) if isinstance(v, list) else v for k, v in conf(path).items()}


def test_arms_are_at_their_goals_when_learning_starts(panda, dynamics):
    """With demonstrations each arm is nearer than 5 cm, the one without noise 1 cm; with random torques none is."""
    ends = {}
    for demonstrates in (False, True):
        env = make_env(panda)
        env.reset()  # staggered; the reset of the training is not
        demonstrator = make_demonstrator(panda, env.task, dynamics) if demonstrates else None
        run = Training(env, make_algo(env), None, Loop(batch_size=16, learning_starts=LEARNING_STARTS), demonstrator)
        while run.env_steps < LEARNING_STARTS:
            with run.step(0.0):
                pass
        state = env.arms.read()
        ends[demonstrates] = np.linalg.norm(state.ee - env.goal, axis=-1)
    assert ends[False].min() > 0.05 > ends[True].max()
    assert ends[True][0] < 0.01


def test_noise_grows_from_arm_to_arm_and_keeps_actions_in_range(panda, dynamics):
    """Arm 0 acts as the reference; all actions are in [-1, 1]; a seed gives the same actions."""
    env = make_env(panda)
    observation = env.reset()["observation"]
    torch.manual_seed(0)
    one, other = (make_demonstrator(panda, env.task, dynamics) for _ in range(2))
    reference = Oracle(panda, env.task, dynamics).action(observation)
    actions = torch.stack([one.action(observation) for _ in range(50)])
    assert torch.equal(actions[0, 0], reference[0])
    assert actions.abs().max() <= 1.0
    spread = actions.std(0).mean(-1)
    assert (spread[1:] > spread[:-1]).all()
    torch.manual_seed(0)
    assert torch.equal(other.action(observation), actions[0])


def test_which_tasks_demonstrate(panda, dynamics):
    """Pushing with the task's own impedance does; tracking, and reaching with impedance targets, do not."""
    assert make_demonstrator(PANDA, pushing(), TRUE) is not None
    track = TrackTask(**values("task/track")).with_model(panda, dynamics)
    assert make_demonstrator(panda, track, dynamics) is None


@pytest.mark.long
@pytest.mark.parametrize("name", ["ddpg", "sac", "td3", "tqc"])
def test_a_policy_of_a_surface_task_begins_as_the_hybrid_controller(name):
    """Its untrained actions are zero, so an evaluation equals that of `algo=hybrid_force`."""
    cfg = composed("task=press", f"algo={name}", "task.episode_s=4.5", "threads=1", "evaluation.episodes=2")
    parts = make_parts(cfg)
    assert parts.demonstrator.at_zero
    assert parts.algo.action_l2 == cfg.algo.residual_l2
    reference = hybrid_force(parts.robot, parts.task, make_dynamics(cfg, parts.robot))
    mine, its = (parts.evaluate(policy) for policy in (parts.algo.policy, reference))
    np.testing.assert_array_equal(mine.force, its.force)
    assert make_parts(composed("task=press", f"algo={name}", "algo.demonstrations=0")).demonstrator is None


@pytest.mark.long
def test_demonstrations_that_fill_the_budget_are_one_line(tmp_path):
    done = r2s("+experiment=toy", "algo=tqc", "algo.demonstrations=4000", f"root={tmp_path}")
    assert (done.returncode, list(tmp_path.iterdir())) == (2, [])
    assert done.stderr == (
        "error: budget.env_steps: expected more than 4000, the env steps before the first update of "
        "algo.demonstrations=4000 and algo.n_envs=8, got 4000\n"
    )


@pytest.mark.slow
def test_demonstrations_shorten_a_training(tmp_path):
    """After 56,000 env steps most goals are reached to 1 cm (74 % and more), without hardly any (6 %)."""
    reached = {}
    for shown in ("0", "6400"):
        words = ["algo=tqc", "threads=1", "compile=false", "budget.minutes=null", "budget.env_steps=56000"]
        succeed(*words, f"algo.demonstrations={shown}", f"root={tmp_path}", f"name={shown}")
        summary = json.loads((tmp_path / "train" / shown / "summary.json").read_text())
        reached[shown] = summary["last"]["success_1cm"]
    assert reached["6400"] > 0.5 > reached["0"]
