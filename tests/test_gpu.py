"""Training with device=cuda: learners, noise, checkpoints and policies. Skipped where torch finds no GPU."""

import os
import subprocess
import sys
import time
from pathlib import Path

import pandas as pd
import pytest
import torch
from test_checkpoint import QUICK

from r2s.learning.ddpg import DDPG
from r2s.learning.sac import SAC
from r2s.learning.td3 import TD3
from r2s.learning.tqc import TQC
from r2s.learning.train import generators, set_generators

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="torch finds no GPU")
GPU = torch.device("cuda:0")
RUN = Path(__file__).parents[1] / "run.py"
D, N, B = 20, 7, 64


def learner(kind, device):
    torch.manual_seed(0)
    return kind((torch.zeros(D), torch.ones(D)), torch.ones(N), hidden=(64, 64), gamma=0.97).to(device)


def batch_of(device):
    draw = torch.Generator().manual_seed(1)
    batch = {k: torch.randn(B, D, generator=draw) for k in ("observation", "next_observation")}
    batch |= {"action": torch.rand(B, N, generator=draw) * 2 - 1, "reward": torch.randn(B, generator=draw)}
    return {k: v.to(device) for k, v in (batch | {"terminated": torch.zeros(B)}).items()}


def noise_of(kind, device):
    draws = torch.randn(2, B, N, generator=torch.Generator().manual_seed(2)).to(device)
    return {DDPG: (), TD3: (draws[0],)}.get(kind, (tuple(draws),))


@pytest.mark.parametrize("kind", [DDPG, SAC, TD3, TQC])
def test_losses_and_gradients_equal_those_of_the_processor(kind):
    """To 1e-4 of the gradient's norm: sums of 64 float32 products, over three layers and a mean of 64 rows."""
    sides = []
    for device in (torch.device("cpu"), GPU):
        algo = learner(kind, device)
        losses, gradients = algo.gradients(batch_of(device), *noise_of(kind, device))
        sides.append([torch.cat([g.flatten() for g in gradients]).cpu(), {k: float(v) for k, v in losses.items()}])
    (first, one), (second, other) = sides
    assert float((first - second).norm() / first.norm()) < 1e-4
    assert one == pytest.approx(other, rel=1e-4, abs=1e-6)


@pytest.mark.parametrize("kind", [DDPG, SAC, TD3, TQC])
def test_captured_updates_equal_eager_ones(kind):
    """Compiled, a GPU replays captured graphs, whose outputs the next replay overwrites: five updates in a row."""
    ends = []
    for compiled in (False, True):
        algo, batch = learner(kind, GPU), batch_of(GPU)
        assert not compiled or algo.compile(B)
        torch.cuda.manual_seed(0)
        ends.append(torch.tensor([float(algo.update(batch)["loss_critic"]) for _ in range(5)]))
    torch.testing.assert_close(*ends, rtol=1e-3, atol=1e-5)


def test_noise_goes_on_where_it_stopped():
    torch.cuda.manual_seed(0)
    states = generators(GPU)
    first = torch.randn(5, device=GPU)
    set_generators(states, GPU)
    assert torch.equal(first, torch.randn(5, device=GPU))


def command(*words, at, gpu=True):
    """Start run.py, which a fork with CUDA could not be; without `gpu` it runs as on a machine that has none."""
    hidden = {} if gpu else {"CUDA_VISIBLE_DEVICES": ""}
    return subprocess.Popen([sys.executable, str(RUN), *words], cwd=at, env=os.environ | hidden)


def stop_training(name, at):
    """Train on the GPU, kill it after the first checkpoint and return its run folder."""
    folder = at / "runs" / "train" / name
    process = command(*QUICK, "device=cuda", f"name={name}", at=at)
    while not (folder / "checkpoints" / "state.pt").is_file():
        assert process.poll() is None, "it ended before it could be killed"
        time.sleep(0.02)
    process.kill()
    process.wait()
    return folder


def test_a_killed_training_resumes_to_the_same_policy(tmp_path):
    stopped, whole = stop_training("stopped", tmp_path), tmp_path / "runs" / "train" / "whole"
    assert command(f"resume={stopped}", at=tmp_path).wait() == 0
    assert command(*QUICK, "device=cuda", "name=whole", at=tmp_path).wait() == 0
    one, other = (torch.load(f / "policy.pt", weights_only=True)["state"] for f in (stopped, whole))
    assert all(torch.equal(v, other[k]) for k, v in one.items())
    first, second = (pd.read_csv(f / "metrics.csv").drop(columns="wall_clock_s") for f in (stopped, whole))
    pd.testing.assert_frame_equal(first, second)


def test_a_machine_without_a_gpu_goes_on_and_runs_the_policy(tmp_path):
    """The checkpoint of a GPU resumes with device=cpu, and the policy it ends with is transferred there."""
    stopped = stop_training("moved", tmp_path)
    assert command(f"resume={stopped}", at=tmp_path, gpu=False).wait() == 2  # its device is missing, and it says so
    assert command(f"resume={stopped}", "device=cpu", at=tmp_path, gpu=False).wait() == 0
    words = ("stage=transfer", f"policy={stopped}", "arm=none", "evaluation.episodes=2", "root=runs", "name=there")
    assert command(*words, at=tmp_path, gpu=False).wait() == 0
    assert (tmp_path / "runs" / "transfer" / "there" / "summary.json").is_file()
