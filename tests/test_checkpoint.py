"""A stopped training continues; a value that is not finite stops it."""

import shutil
import time
import zipfile

import numpy as np
import pandas as pd
import pytest
import torch
from cli_runs import r2s, started, succeed
from conftest import conf
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf
from test_envs import calibration  # noqa: F401

from r2s.learning.checkpoint import Checkpoint, load_tensors, save_tensors
from r2s.learning.env import TaskEnv
from r2s.learning.evaluate import make_evaluation
from r2s.learning.randomization import UniformRandomization
from r2s.learning.replay import Replay
from r2s.learning.tqc import TQC
from r2s.learning.train import Budget, Callbacks, Loop, generators, set_generators, train
from r2s.physics.dynamics import Dynamics, nominal_dynamics, with_family
from r2s.physics.friction import BRISTLE
from r2s.physics.robot import load_robot
from r2s.stages.build import CONF
from r2s.stages.train import keep_calibration, make_parts
from r2s.tasks.reach import ReachTask

QUICK = [
    "root=runs",
    "threads=1",
    "compile=false",
    "budget.minutes=null",
    "evaluation.episodes=4",
    "algo.hidden=[32,32]",
    "algo.batch_size=32",
    "budget.env_steps=4800",
    "evaluation.env_steps=1600",
    "algo.learning_starts=800",
    "algo.demonstrations=800",
    "algo.replay_size=5000",
    "task.speed_noise=0.05",
]


@pytest.fixture(scope="module")
def panda():
    return load_robot(**conf("robot/panda"))


def dynamics_of(panda, family="sigmoid"):
    dynamics = nominal_dynamics(panda, **conf("friction/paper"), inertia_scale=conf("inertia/paper")["scale"])
    return with_family(dynamics, family)


def make_env(panda, family="sigmoid", seed=0):
    """Return an environment of 4 arms whose friction, delay, lag and noise are drawn anew at every reset."""

    def drawn(rng: np.random.Generator, m: int) -> Dynamics:
        d = UniformRandomization(panda, dynamics_of(panda, family), **conf("dr/paper"))(rng, m)
        timing = {"delay": rng.uniform(1e-3, 5e-3, m), "lag": rng.uniform(0, 2e-3, m)}
        return Dynamics(**{**vars(d), **timing})

    given = {k: tuple(v) if isinstance(v, list) else v for k, v in conf("task/reach").items()}
    task = ReachTask(**given | {"speed_noise": 0.05})
    return TaskEnv(panda, task, drawn, 4, nthread=1, seed=seed, stagger=True)


def make_algo(env):
    torch.manual_seed(0)
    mean, std = (torch.from_numpy(s) for s in env.task.observation_scale(env.robot))
    scale = torch.from_numpy(env.task.torque_limit(env.robot))
    return TQC((mean, std), scale, hidden=(16, 16), explore_correlation=0.9)


@pytest.mark.long
@pytest.mark.parametrize("family", ["sigmoid", "bristle"])
def test_an_environment_goes_back_to_its_state(panda, family):
    """From `state`, another environment does the same steps, resets and draws included, to the bit."""
    one, other = make_env(panda, family), make_env(panda, family)
    at, actions = one.reset(), torch.rand(260, 4, 7, generator=torch.Generator().manual_seed(0)) * 2 - 1
    for action in actions[:30]:
        at["action"] = action
        at = one.step_and_maybe_reset(at)[1]
    kept, seen = one.state(), at.clone()
    rows = []
    for env, start in ((one, at), (other, seen)):
        if env is other:
            env.reset()
            env.set_state(kept)
        row, state = [], start
        for action in actions[30:]:
            state["action"] = action
            step, state = env.step_and_maybe_reset(state)
            row.append(torch.cat([step["next"]["observation"], step["next"]["reward_terms"]], -1))
        rows.append(torch.stack(row))
    assert torch.equal(*rows)
    assert family != BRISTLE.name or np.abs(one.arms.sim.state()["_memory"]).max() > 0


@pytest.mark.long
def test_a_killed_training_resumes_to_the_same_policy(tmp_path):
    """Killed after its first checkpoint and resumed: the same policy and evaluations as without, to the bit."""
    stopped = started(*QUICK, "name=stopped", at=tmp_path)
    whole = started(*QUICK, "name=whole", at=tmp_path)
    state = tmp_path / "runs" / "train" / "stopped" / "checkpoints" / "state.pt"
    while not state.is_file():
        assert stopped.is_alive(), "it ended before it could be killed"
        time.sleep(0.02)
    stopped.kill()
    succeed(f"resume={state.parent.parent}", at=tmp_path)
    whole.join()
    assert whole.exitcode == 0
    folders = [tmp_path / "runs" / "train" / name for name in ("whole", "stopped")]
    policies = [torch.load(f / "policy.pt", weights_only=True)["state"] for f in folders]
    assert all(torch.equal(v, policies[1][k]) for k, v in policies[0].items())
    for table in ("evaluations", "metrics"):
        first, second = (pd.read_csv(f / f"{table}.csv").drop(columns="wall_clock_s") for f in folders)
        pd.testing.assert_frame_equal(first, second)
    assert not (folders[1] / "checkpoints").exists()
    again = r2s(f"resume={folders[1]}", at=tmp_path)
    assert again.returncode == 2
    assert again.stderr.strip().endswith("is finished")


def test_a_stopped_training_draws_from_its_own_copy_of_the_identification(calibration, tmp_path):  # noqa: F811
    """dr=identified: with the folder of the identification gone, the arms of a resumed training are the same."""
    words = ["dr=identified", "algo.n_envs=4", *QUICK]
    own, drawn = tmp_path / "own", []
    own.mkdir()
    with initialize_config_dir(str(CONF.resolve()), version_base="1.3"):
        cfg = compose("config", words)
    cfg.calibration = str(calibration)
    OmegaConf.resolve(cfg)  # as in the config.yaml of a run folder
    for resume in (None, str(own)):
        cfg.resume = resume
        drawn.append(make_parts(cfg).draw(np.random.default_rng(0), 5).offset)
        keep_calibration(cfg, own)
        shutil.rmtree(calibration, ignore_errors=True)
    np.testing.assert_array_equal(*drawn)


def add(replay, count, at_once):
    """Put the next `count` transitions into the buffer, each with its number, `at_once` of them in a call."""
    numbers = torch.arange(replay.seen, replay.seen + count, dtype=torch.float32)
    for part in numbers.split(at_once):
        replay.extend({"action": part[:, None]})


@pytest.mark.parametrize("at_once", [1, 3, 10, 27])
def test_a_buffer_holds_the_last_transitions(at_once):
    """Number k in row k % size, however many are added in a call; samples reach all of them and nothing else."""
    replay = Replay(10)
    for count in (4, 5, 27, 1, 13):
        add(replay, count, at_once)
        last = torch.arange(max(0, replay.seen - 10), replay.seen)
        assert len(replay) == len(last)
        assert torch.equal(replay.transitions(int(last[0]), replay.seen)["action"][:, 0], last.float())
        assert set(replay.sample(1000)["action"][:, 0].tolist()) == set(last.tolist())


@pytest.mark.parametrize("gaps", [[3] * 9, [7] * 5, [4, 9, 1, 10, 3], [10] * 3, [25, 1, 33, 2], [6, 30, 5]])
def test_a_buffer_comes_back_to_the_row_at_any_gap(gaps, tmp_path):
    """Row for row, cursor and draws included; the files hold the buffer and less than one chunk more."""
    size, replay, longest = 10, Replay(10), 4
    checkpoint = Checkpoint(tmp_path)
    for gap in gaps:
        add(replay, gap, 1)
        checkpoint.save({}, replay)
        chunks = [torch.load(f, weights_only=True)["action"] for f in tmp_path.glob("replay_*.pt")]
        longest = min(max(longest, gap), size)
        assert sum(map(len, chunks)) <= min(replay.seen, size - 1 + longest)
        again, back = Replay(size), Checkpoint(tmp_path)
        assert back.load(again)["seen"] == again.seen == replay.seen
        for step in range(2):  # as it was saved, and after more transitions
            draws = []
            for buffer in (replay, again):
                torch.manual_seed(0)
                draws.append(buffer.sample(64)["action"])
            assert torch.equal(*draws)
            first = replay.seen - len(replay)
            kept = [buffer.transitions(first, replay.seen)["action"] for buffer in (replay, again)]
            assert torch.equal(*kept)
            if step == 0:
                add(replay, 4, 1)
                add(again, 4, 4)
        back.save({}, again)  # goes on from what it loaded
        checkpoint = back


def on_gpu(path, to):
    """Copy a checkpoint file as a GPU writes it: each storage is labelled cuda:0 in the file's pickle."""
    with zipfile.ZipFile(path) as file, zipfile.ZipFile(to, "w") as copy:
        for name in file.namelist():
            content = file.read(name)
            if name.endswith("data.pkl"):
                assert b"X\x03\x00\x00\x00cpu" in content
                content = content.replace(b"X\x03\x00\x00\x00cpu", b"X\x06\x00\x00\x00cuda:0")
            copy.writestr(name, content)


def test_a_checkpoint_of_a_gpu_loads_without_one(panda, tmp_path):
    """Weights and moments of the optimizer arrive on the processor, and the next update is the same."""
    algo = make_algo(make_env(panda))
    sizes = {"observation": len(algo.normalizer.mean), "action": 7}
    batch = {k: torch.rand(8, v) for k, v in (sizes | {"next_observation": sizes["observation"]}).items()}
    batch |= {"reward": torch.rand(8), "terminated": torch.zeros(8)}
    algo.update(batch)
    states = {"cuda": torch.zeros(16, dtype=torch.uint8)} | generators(torch.device("cpu"))  # of both devices
    save_tensors(tmp_path / "cpu.pt", {"algo": algo.state_dict()} | states)
    on_gpu(tmp_path / "cpu.pt", tmp_path / "gpu.pt")
    saved, other = load_tensors(tmp_path / "gpu.pt", "resume"), make_algo(make_env(panda))
    other.load_state_dict(saved["algo"])
    set_generators(saved, torch.device("cpu"))
    second = other.update(batch)
    set_generators(states, torch.device("cpu"))
    assert second == algo.update(batch)


def train_briefly(env, algo, concurrent=False):
    evaluate = make_evaluation(env.robot, env.task, env.draw, episodes=2, nthread=1)
    loop = Loop(batch_size=16, learning_starts=80, concurrent=concurrent)
    train(env, algo, evaluate, loop, Budget(None, 1200))


@pytest.mark.long
@pytest.mark.parametrize(("starts", "every", "evaluated"), [(0, 160, [160]), (160, 40, [164, 200, 240])])
def test_updates_begin_with_the_first_transition_and_evaluations_keep_their_distance(panda, starts, every, evaluated):
    """Also without random steps, and where evaluations were due before the first update."""
    env, rows = make_env(panda), []
    evaluate = make_evaluation(env.robot, env.task, env.draw, episodes=1, nthread=1)
    loop = Loop(batch_size=16, learning_starts=starts, eval_env_steps=every)
    train(env, make_algo(env), evaluate, loop, Budget(None, 240), callbacks=Callbacks(evaluated=rows.append))
    assert [row["env_steps"] for row in rows] == [*evaluated, 240]
    assert rows[-1]["updates"] == (240 - max(4, starts)) / 4


@pytest.mark.long
def test_arms_that_step_beside_the_updates_give_the_same_run(panda):
    """Bit for bit what steps and updates in turn give: networks, optimizer and arms."""
    ends = []
    for concurrent in (False, True):
        env = make_env(panda)
        torch.manual_seed(0)
        algo = make_algo(env)
        train_briefly(env, algo, concurrent)
        assert algo.updates > 200
        ends.append((algo.state_dict(), env.read()["observation"]))
    torch.testing.assert_close(*ends, rtol=0, atol=0)


def train_until_it_breaks(env, algo, concurrent=False):
    with pytest.raises(FloatingPointError) as caught:
        train_briefly(env, algo, concurrent)
    return str(caught.value)


def break_goal(env, step):
    """Return the environment with a NaN goal from its step number `step` on."""
    inner, count = env._step, 0

    def broken(state):
        nonlocal count
        count += 1
        if count == step:
            env.goal[2, 1] = np.nan
        return inner(state)

    env._step = broken
    return env


@pytest.mark.long
@pytest.mark.parametrize("concurrent", [False, True])
def test_a_number_that_is_not_finite_in_a_step_stops_the_run(panda, concurrent):
    """NaN in the physics: the message names value, arm and time."""
    env = break_goal(make_env(panda), 250)
    message = train_until_it_breaks(env, make_algo(env), concurrent)
    assert "observation of arm 2 is nan" in message
    assert message.endswith("after 996 env steps")


def test_a_loss_that_is_not_finite_stops_the_run(panda):
    """A NaN in a network: the message names the update."""
    env = make_env(panda)
    algo = make_algo(env)
    inner = algo.update

    def broken(batch):
        if algo.updates == 40:
            algo.critics.weight[0].data[0, 0, 0] = float("nan")
        return inner(batch)

    algo.update = broken  # type: ignore[method-assign]
    assert train_until_it_breaks(env, algo).startswith("the loss of update 41 is nan, after ")


@pytest.mark.long
def test_an_evaluation_that_is_not_finite_stops_the_run(panda):
    env = make_env(panda)

    def evaluate(policy):
        raise FloatingPointError("action of arm 0 is nan at step 0 of its episode")

    with pytest.raises(FloatingPointError, match=r"after 4000 env steps, in an evaluation$"):
        train(env, make_algo(env), evaluate, Loop(batch_size=16, learning_starts=4000), Budget(None, 4000))
