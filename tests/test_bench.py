"""benchmarks/bench.py compares learners like with like, and benchmarks/paper_returns.py has the costs of eq. (2)."""

import sys
from pathlib import Path

import numpy as np
import pytest
import torch

sys.path.insert(0, str(Path(__file__).parent.parent / "benchmarks"))
import bench
from paper_returns import step_cost

from r2s.learning.train import matmul_precision
from r2s.tasks import rewards


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


def test_step_cost_is_eq_2_and_cheapest_at_the_goal_below_1_54():
    """The cost of benchmarks/paper_returns.py is that of r2s/tasks/rewards.py; shaking moves its minimum away."""
    d, s = np.linspace(0.0, 0.9, 91), 3 * np.tanh(0.8)
    ddq = np.tile([0.8, 0.8, 0.8, 0.0, 0.0, 0.0, 0.0], (len(d), 1))
    terms = rewards.terms(d, np.ones(len(d)), np.zeros_like(ddq), ddq, np.zeros(len(d)))
    np.testing.assert_allclose(step_cost(d, s), -terms @ rewards.PAPER)
    assert step_cost(d, 1.54).argmin() == 0
    assert step_cost(d, 1.8).argmin() > 0
