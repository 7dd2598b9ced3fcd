"""A sweep writes a run folder for each job and goes on without one that fails; experiments do what they say."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
from cli_runs import SHORT, TOY, r2s, root, succeed  # noqa: F401 (a fixture)
from conftest import ROOT

from r2s.tasks.rewards import PAPER, Curriculum


@pytest.mark.long
def test_a_sweep_goes_on_without_the_job_that_fails(tmp_path):
    """One bad value: one line, exit status 2, the other job done; a repeated sweep skips that one."""
    sweep = ["-m", *SHORT, f"root={tmp_path}", "skip_completed=true", "name=lr${algo.lr}", "algo.lr=2.0,1e-3"]
    done = r2s(*sweep)
    assert done.returncode == 2
    assert "error: algo.lr: expected a number in (0, 1], got 2.0\n" in done.stderr
    assert done.stderr.endswith("error: 1 job of the sweep failed, see above; the others are done\n")
    assert json.loads((tmp_path / "train" / "lr0.001" / "meta.json").read_text())["status"] == "done"
    assert [p.name for p in (tmp_path / "train").iterdir()] == ["lr0.001"]
    assert f"already finished: {tmp_path}/train/lr0.001" in r2s(*sweep).stdout


@pytest.mark.long
def test_a_command_that_a_job_of_a_sweep_runs_fails_by_itself(tmp_path):
    """It ends with status 2 and is no failed job of the sweep, so that the job sees that its command failed."""
    env = os.environ | {"R2S_FAILED": str(tmp_path / "failed.txt")}
    command = [sys.executable, "run.py", "seed=-1", f"root={tmp_path}"]
    done = subprocess.run(command, cwd=ROOT, env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr.startswith("error: seed: ")
    assert not any(tmp_path.iterdir())


@pytest.mark.slow
def test_the_grid_is_what_its_file_says(tmp_path):
    """paper_grid, cut down to two jobs, runs them side by side in folders named by their settings."""
    grid = ["-m", "+experiment=[paper_grid,toy]", f"root={tmp_path}", 'grid.algo="td3,tqc"', 'grid.lr="1e-3"']
    succeed(*grid, *SHORT[1:], 'grid.batch_size="16"', 'grid.gamma="0.9"', 'grid.seed="3"')
    names = sorted(p.name for p in (tmp_path / "train").iterdir())
    assert names == [f"grid_{a}_lr0.001_batch16_gamma0.9_seed3" for a in ("td3", "tqc")]
    config = yaml.safe_load((tmp_path / "train" / names[0] / "config.yaml").read_text())
    assert (config["seed"], config["threads"], config["algo"]["policy_delay"]) == (3, 1, 2)
    assert all((tmp_path / "train" / name / "policy.onnx").is_file() for name in names)


@pytest.mark.long
def test_every_algorithm_trains(root):  # noqa: F811
    """A sweep over those that the grid leaves out writes a run folder with a policy each."""
    out = succeed("-m", "algo=ddpg,sac", f"root={root}", *SHORT)
    folders = re.findall(r"written: (\S+)", out)
    assert len(folders) == 2
    assert all((Path(f) / "policy.onnx").is_file() for f in folders)


@pytest.mark.long
def test_the_papers_reward_ends_alone_and_without_noise(tmp_path):
    """experiment=paper_reward ends in eq. (2) alone; noise has fallen 15-fold before, the learning rate threefold."""
    succeed("+experiment=[paper_reward,toy]", f"root={tmp_path}", "name=eq2")
    config = yaml.safe_load((tmp_path / "train" / "eq2" / "config.yaml").read_text())
    reward = Curriculum(**{k: v for k, v in config["reward"].items() if k != "_target_"})
    algo, (_, alone) = config["algo"], reward.anneal
    assert alone < 1
    assert np.array_equal(reward.weights(None, alone), PAPER)
    assert algo["explore_end"] ** alone < 1 / 15
    lr_share = 1 - (1 - algo["lr_end"]) * (alone - algo["lr_decay"]) / (1 - algo["lr_decay"])
    assert lr_share < 1 / 3
