"""Gymnasium: r2s/PandaReach-v0 keeps its contract, alone and as a batch, and other libraries train on it."""

import json
import subprocess
import sys
import warnings
from functools import cache

import numpy as np
import pytest
import torch
from conftest import ROOT
from scipy.stats import t
from test_envs import SHORT

from r2s.errors import UserError
from r2s.learning.env import TaskEnv

gym = pytest.importorskip("gymnasium", reason="needs gymnasium: pip install 'r2s[gym]'")
check_env = pytest.importorskip("gymnasium.utils.env_checker").check_env

import r2s.envs  # noqa: E402 (after the skip)
from r2s.learning.gym_env import ArmEnv, ArmVectorEnv  # noqa: E402

REACH = "r2s/PandaReach-v0"
STEPS = 10  # of an episode of SHORT
NOISE = "task.speed_noise=0.05"
LONG, EPISODES = 150_000, 200  # env steps of a training; goals of its evaluation


@cache
def parts(*words):
    """Return robot, task, randomization and reward; drawing goals is what takes time, so there are few."""
    robot, task, draw, reward, _ = r2s.envs.parts({"task": "reach"}, [*SHORT, *words])
    return (robot, task._with("pool", 8), draw), {"reward": reward}


def make(*words):
    given, settings = parts(*words)
    return ArmEnv(*given, **settings)


def batch(count, *words, **more):
    given, settings = parts(*words)
    return ArmVectorEnv(*given, count, nthread=1, **settings, **more)


def actions(steps, *shape, seed=0):
    return np.random.default_rng(seed).uniform(-1, 1, (steps, *shape, 7)).astype(np.float32)


def close(one, other):
    """Compare what two environments return, infos included; a batch may round otherwise than a single arm."""
    assert type(one) is type(other)
    if isinstance(one, dict):
        assert one.keys() == other.keys()
        one, other = list(one.values()), [other[key] for key in one]
    if isinstance(one, tuple | list) or (isinstance(one, np.ndarray) and one.dtype.hasobject):
        for a, b in zip(one, other, strict=True):
            close(a, b)
    elif one is not None:
        np.testing.assert_allclose(one, other, rtol=1e-5, atol=1e-5)


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "few"),
    [(REACH, []), *((f"r2s/Panda{t}-v0", ["task.pool=2"]) for t in ("Track", "Press", "Wipe", "Push"))],
)
def test_the_checker_has_no_complaint(name, few):
    """check_env, with every warning an error."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(gym.make(name, overrides=few).unwrapped, skip_render_check=True)


@pytest.mark.long
def test_a_name_makes_one_arm_or_a_batch():
    """`r2s.envs:` imports the module that registers the names; `make_vec` makes one simulator."""
    assert gym.make(f"r2s.envs:{REACH}", overrides=SHORT).spec.id == REACH
    envs = gym.make_vec(REACH, num_envs=3, threads=1, overrides=SHORT)
    assert isinstance(envs, ArmVectorEnv)
    assert (envs.num_envs, envs.env.arms.width) == (3, 3)


def test_a_seed_gives_its_trajectory():
    """Goals, arms and sensor noise: two environments agree to the bit, another seed differs."""
    path = []
    for seed in (3, 3, 4):
        env = make(NOISE)
        first = env.reset(seed=seed)[0]
        path.append(np.array([first, *(env.step(action)[0] for action in actions(STEPS))]))
        path[-1] = np.concatenate([path[-1], [env.reset()[0]]])
    assert np.array_equal(path[0], path[1])
    assert not np.isclose(path[0][0], path[2][0]).all()


@pytest.mark.long
def test_a_camera_has_the_noise_of_the_task():
    """The pose of a box is off by other amounts with each seed and for each arm, and alone as in a batch."""
    seen = {}
    for m in (0.0, 0.01):
        robot, task, draw, _, _ = r2s.envs.parts({"task": "push"}, ["task.pool=2", f"task.pose_noise=[{m},1]"])
        both, one = ArmVectorEnv(robot, task, draw, 2, nthread=1), ArmEnv(robot, task, draw)
        seen[m] = both.reset(seed=3)[0]
        close(seen[m][1], one.reset(seed=4)[0])
    assert (np.abs(seen[0.01] - seen[0.0]).max(1) > 1e-3).all()


@pytest.mark.long
@pytest.mark.parametrize("dr", ["paper", "force"])
@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_a_batch_is_gymnasiums_own_batch_of_single_arms(mode, dr):
    """Three arms with seeds, over two episodes: observations, rewards, ends, final observations and infos."""
    ours = batch(3, NOISE, f"dr={dr}", autoreset_mode=mode)
    theirs = gym.vector.SyncVectorEnv([lambda: make(NOISE, f"dr={dr}")] * 3, autoreset_mode=mode)
    assert ours.metadata["autoreset_mode"] == theirs.metadata["autoreset_mode"]
    assert ours.single_observation_space == theirs.single_observation_space
    for seed in (7, None, [5, 1, 9]):
        close(ours.reset(seed=seed), theirs.reset(seed=seed))
        for action in actions(2 * STEPS + 3, 3):
            close(ours.step(action), theirs.step(action))


def test_next_step_starts_an_episode_instead_of_a_step():
    """The step after the end ignores its action, which may be anything, and has no reward and no end."""
    envs = batch(2)
    envs.reset(seed=0)
    for k, action in enumerate(actions(STEPS, 2)):
        _, _, terminated, truncated, info = envs.step(action)
        assert not terminated.any()
        assert (truncated == (k == STEPS - 1)).all()
        assert "final_obs" not in info
    observation, reward, terminated, truncated, info = envs.step(np.full((2, 7), np.nan))
    assert not np.concatenate([reward, terminated, truncated]).any()
    assert not observation[:, 7:14].any()  # speeds: at rest
    assert (info["distance"] > 0).all()


def test_without_automatic_resets_the_user_resets():
    """A step after the end is refused; a masked reset starts the arms of the mask and leaves the others alone."""
    envs = batch(2, autoreset_mode="Disabled")
    envs.reset(seed=0)
    for action in actions(STEPS, 2):
        last = envs.step(action)[0]
    with pytest.raises(UserError, match="the episode of arm 0 has ended"):
        envs.step(action)
    observation, _ = envs.reset(options={"reset_mask": np.array([True, False])})
    assert np.array_equal(observation[1], last[1])
    assert not observation[0, 7:14].any()
    with pytest.raises(UserError, match="the episode of arm 1 has ended"):
        envs.step(action)
    single = make()
    single.reset(seed=0)
    for action in actions(STEPS):
        *_, truncated, _ = single.step(action)
    assert truncated
    with pytest.raises(UserError, match="the episode of arm 0 has ended"):
        single.step(action)


@pytest.mark.long
def test_rewards_and_ends_are_those_of_r2ss_own_environment():
    """The same starts, goals and actions, with reward=paper and the default: equal observations, rewards, ends."""
    for reward in ("paper", "curriculum"):
        words = "dr=none", f"reward={reward}"
        envs = batch(2, *words, autoreset_mode="Disabled")
        envs.set_progress(0.5)
        observation, _ = envs.reset(seed=0)
        given, settings = parts(*words)
        own = TaskEnv(*given, 2, nthread=1, **settings)
        own.weights = own.reward.weights(own.task, 0.5)
        own.place(envs.env.arms.sim.q.copy(), envs.env.goal.copy())
        state = own.read()
        np.testing.assert_array_equal(envs.normalized(state["observation"].numpy()), observation)
        for action in actions(STEPS, 2):
            state["action"] = torch.from_numpy(action)
            after = own._step(state)
            observation, got, terminated, truncated, info = envs.step(action)
            np.testing.assert_array_equal(envs.normalized(after["observation"].numpy()), observation)
            np.testing.assert_array_equal(after["reward"][:, 0].numpy(), got.astype(np.float32))
            np.testing.assert_array_equal(after["reward_terms"].numpy(), info["reward_terms"])
            np.testing.assert_array_equal(after["distance"][:, 0].numpy(), info["distance"].astype(np.float32))
            assert np.array_equal(after["truncated"][:, 0].numpy(), truncated)
            assert np.array_equal(after["terminated"][:, 0].numpy(), terminated)


def test_the_weights_adapt_as_in_r2ss_own_loop():
    """Torques that the safety filter changes raise its penalty, by the terms that `info` gives."""
    envs = batch(4)
    envs.reset(seed=0)
    reward, task, factor = envs.env.reward, envs.env.task, envs.env.reward.factor
    for k, action in enumerate(np.sign(actions(STEPS, 4)) * np.float32(1.0)):
        envs.set_progress(0.5 + 0.01 * k)
        np.testing.assert_allclose(envs.env.weights, reward.weights(task, 0.5 + 0.01 * k, factor), rtol=1e-5)
        *_, info = envs.step(action)
        factor = reward.adapt(factor, 0.5 + 0.01 * (k + 1), info["reward_terms"].mean(0), 4)
    assert factor > 1.0


@pytest.mark.parametrize(
    ("call", "line"),
    [
        (lambda: batch(2, autoreset_mode="always"), "autoreset_mode: expected one of NextStep, SameStep, Disabled"),
        (lambda: batch(2).step(np.zeros((2, 6))), r"expected actions of shape \(2, 7\), got \(2, 6\)"),
        (lambda: batch(2).reset(seed=[1]), "seed: expected a number or 2 of them, got 1"),
        (lambda: batch(2).reset(options={"reset_mask": [1, 0]}), "reset_mask: expected 2 booleans"),
    ],
)
def test_a_wrong_call_is_one_line(call, line):
    with pytest.raises(UserError, match=line):
        call()


def test_an_action_beyond_its_space_is_clipped_and_one_that_is_no_number_refused():
    envs, other = batch(2), batch(2)
    for env in (envs, other):
        env.reset(seed=0)
    close(envs.step(np.full((2, 7), 5.0)), other.step(np.ones((2, 7))))
    with pytest.raises(FloatingPointError, match="action of arm 0 is nan"):
        envs.step(np.full((2, 7), np.nan))


def test_gymnasiums_statistics_count_episodes():
    """Its own wrapper of vector environments finds length and return of every episode."""
    for mode in ("NextStep", "SameStep"):
        envs = gym.wrappers.vector.RecordEpisodeStatistics(batch(2, autoreset_mode=mode))
        envs.reset(seed=0)
        total = np.zeros(2)
        for action in actions(STEPS, 2):
            _, reward, _, _, info = envs.step(action)
            total += reward
        np.testing.assert_allclose(info["episode"]["r"], total, rtol=1e-6)


@pytest.mark.long
def test_td3_as_cleanrl_writes_it_trains_on_it(monkeypatch):
    """The example, for some hundred steps, twice the same."""
    monkeypatch.syspath_prepend(ROOT / "examples")
    import cleanrl_td3

    monkeypatch.setattr(cleanrl_td3, "LEARNING_STARTS", 320)
    measures = [cleanrl_td3.train(640, *SHORT, "threads=1", episodes=4) for _ in range(2)]
    np.testing.assert_equal(*measures)
    assert np.isfinite(measures[0]["return_paper"])


@pytest.mark.long
def test_sac_of_sb3_trains_on_it(monkeypatch):
    """The example, for some hundred steps, twice the same; sb3's own checker accepts the single arm."""
    pytest.importorskip("stable_baselines3", reason="needs stable-baselines3: pip install 'r2s[gym]'")
    from stable_baselines3.common.env_checker import check_env as check

    monkeypatch.syspath_prepend(ROOT / "examples")
    import sb3_sac

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check(make())
    monkeypatch.setattr(sb3_sac, "RANDOM", 320)
    measures = [sb3_sac.train(640, *SHORT, "threads=1", episodes=4) for _ in range(2)]
    np.testing.assert_equal(*measures)
    assert np.isfinite(measures[0]["return_paper"])


@pytest.mark.slow
def test_equal_steps_reach_what_r2ss_own_loop_reaches(monkeypatch, tmp_path):
    """SAC of TorchRL and of sb3: success at 2 cm not below the 95 % prediction interval of three own trainings."""
    pytest.importorskip("stable_baselines3", reason="needs stable-baselines3: pip install 'r2s[gym]'")
    monkeypatch.syspath_prepend(ROOT / "examples")
    import sb3_sac
    import torchrl_sac

    own = []
    for seed in range(3):
        words = [f"seed={seed}", f"budget.env_steps={LONG}", f"evaluation.env_steps={LONG}", f"root={tmp_path}"]
        words += [
            "algo=sac",
            "budget.minutes=null",
            "threads=1",
            "compile=false",
            "algo.demonstrations=0",
            f"name={seed}",
        ]
        subprocess.run([sys.executable, "run.py", *words], cwd=ROOT, check=True, capture_output=True)
        own.append(json.loads((tmp_path / "train" / str(seed) / "summary.json").read_text())["last"]["success_2cm"])
    mean = np.mean(own)
    spread = np.hypot(np.std(own, ddof=1), np.sqrt(mean * (1 - mean) / EPISODES))
    least = mean - t.ppf(0.975, 2) * spread * np.sqrt(1 + 1 / 3)
    theirs = {
        e.__name__: e.train(LONG, "threads=1", episodes=EPISODES)["success_2cm"] for e in (torchrl_sac, sb3_sac)
    }
    print(f"own {own}, others {theirs}")
    assert all(value >= least for value in theirs.values()), (own, theirs)
