"""The learner's benchmark compares like with like: both sides in one mode, on the same transitions."""

import sys
from pathlib import Path

import pytest
import torch

sys.path.insert(0, str(Path(__file__).parent.parent / "benchmarks"))
import bench

from r2s.learning.train import matmul_precision


def test_modes_are_all_combinations():
    """Eager and compiled, float32 and bfloat16; no mode of one side meets another of the peer."""
    assert [str(m) for m in bench.MODES] == [
        *("eager float32", "eager bfloat16"),
        *("compiled float32", "compiled bfloat16"),
    ]


@pytest.mark.parametrize(
    "mode", [pytest.param(m, marks=pytest.mark.slow if m.compiled else ()) for m in bench.MODES], ids=str
)
def test_learner_rates(mode, monkeypatch):
    """Both sides run in the mode that the row names, and leave the precision of products as it was."""
    monkeypatch.setattr(bench, "REPEATS", 1)
    before = torch.get_num_threads(), torch.get_float32_matmul_precision()
    ours, peer = bench.learner(bench.ROBOT, 1, mode, b=8, hidden=(16,))
    torch.set_num_threads(before[0])
    assert ours > 0
    assert peer > 0
    assert torch.get_float32_matmul_precision() == before[1]


def test_torchrl_update_learns_the_same():
    """Both updates reduce the critic's loss on one repeated batch: the peer's step does learn."""
    torch.manual_seed(0)
    algo, batch = bench.make_tqc(bench.ROBOT, bench.MODES[0], 32, (32,)), bench.random_batch(bench.ROBOT, 32)
    theirs = bench.torchrl_update(algo, batch, bench.LR)
    with matmul_precision("highest"):
        first, ours = [float(algo.update(batch)["loss_critic"]) for _ in range(60)][::59]
        peer = [float(theirs()["loss_qvalue"]) for _ in range(60)]
    assert ours < first
    assert peer[-1] < peer[0]
