"""Settings are asked for, tried and told; a search that was killed goes on with the trials that it had begun."""

import json
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pandas as pd
import pytest
import yaml
from conftest import ROOT

from r2s.errors import UserError
from r2s.reporting.tuning import against_table, best_so_far
from r2s.stages.tune import Training, Tune, corners, span, suggested

TUNE = yaml.safe_load((ROOT / "conf" / "stage" / "tune.yaml").read_text())["tune"]
TOY = ["+experiment=[tune,toy]", "budget.env_steps=4000", "evaluation.env_steps=800", "algo.learning_starts=320"]
TOY += ["tune.trials=3", "tune.startup=1", "tune.workers=2", "evaluation.episodes=2"]
TOY += ["tune.space={algo: [td3], algo.batch_size: [16, 32], algo.lr: 'log(1e-4, 1e-2)'}"]


def test_an_axis_is_what_was_typed():
    """Numbers, spaces and kind; the file's own space is one."""
    assert span("x", "log(2e-4, 1e-3)") == (2e-4, 1e-3, True)
    assert span("x", "interval( -1,2)") == (-1.0, 2.0, False)
    assert set(Tune(**TUNE).space) == {"algo", "algo.lr", "algo.batch_size", "algo.gamma"}


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"space": {"algo.lr": "log(0, 1)"}}, r"tune.space.algo.lr: 0.0 is not allowed; a number in \(0, inf\) is"),
        ({"space": {"algo.lr": "log(1, 0.1)"}}, r"tune.space.algo.lr: 0.1 is not allowed; a number in \(1.0, inf\)"),
        ({"space": {"algo.lr": "lg(1, 2)"}}, r"tune.space.algo.lr: 'lg\(1, 2\)' is not allowed; \[values\], log"),
        ({"space": {"algo.lr": "interval(nan, 2)"}}, r"nan is not allowed"),
        ({"space": {"algo": []}}, r"tune.space.algo: \[\] is not allowed"),
        ({"space": {}}, r"tune.space: \{\} is no space"),
        ({"measure": "retrn_paper"}, r"tune.measure: 'retrn_paper' .*did you mean 'return_paper'"),
        ({"trials": 0}, r"tune.trials: 0 is not allowed"),
        ({"workers": 0.5}, r"tune.workers: 0.5 is not allowed"),
        ({"against": "/nowhere/grid_*"}, r"tune.against: '/nowhere/grid_\*' finds nothing"),
        ({"against": 5}, r"tune.against: 5 finds nothing"),
    ],
)
def test_a_space_that_is_none_is_one_line(change, said):
    with pytest.raises(UserError, match=said):
        Tune(**TUNE | change)


def test_a_training_that_was_left_running_does_not_speak_for_another(tmp_path):
    """A killed tune's training tells its progress on; how another one ended is what that one said."""
    optuna = pytest.importorskip("optuna")
    trial = optuna.create_study().ask()
    talks = "import sys, time; time.sleep({}); print({!r}, file=sys.stderr)"
    left = Training(trial, tmp_path / "tune_0", [sys.executable, "-c", talks.format(1.0, "train 50 %")])
    again = Training(trial, tmp_path / "tune_0", [sys.executable, "-c", talks.format(0.0, "it is taken")])
    assert (again.process.wait(), left.process.wait()) == (0, 0)
    assert (again.ended(), left.ended()) == ("it is taken", "train 50 %")


def test_corners_hold_every_value_and_both_ends():
    """Each at least once, beside the first values of the other axes."""
    space = {"algo": ["td3", "sac"], "algo.lr": "log(1e-4, 1e-2)", "algo.tau": [0.01]}
    first = {"algo": "td3", "algo.lr": 1e-4, "algo.tau": 0.01}
    assert corners(space) == [first, first | {"algo": "sac"}, first | {"algo.lr": 1e-2}]


def test_what_is_drawn_lies_in_the_space():
    """And is the same again where a trial that was begun goes on."""
    optuna = pytest.importorskip("optuna")
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0))
    for _ in range(50):
        trial = study.ask()
        drawn = suggested(trial, TUNE["space"])
        assert drawn["algo"] in ("ddpg", "sac", "td3", "tqc")
        assert 2e-4 <= drawn["algo.lr"] <= 1e-3
        assert 0.95 <= drawn["algo.gamma"] <= 0.98
        assert suggested(optuna.trial.Trial(study, trial._trial_id), TUNE["space"]) == drawn


def test_the_best_so_far_counts_what_was_spent():
    """A trial counts once it has ended; one that was pruned costs and brings nothing."""
    at = np.array([5.0, 10.0, 25.0, 30.0, 100.0])
    best = best_so_far([10, 10, 10], [1.0, np.nan, 3.0], at, 1.0)
    np.testing.assert_array_equal(best, [np.nan, 1.0, 1.0, 3.0, 3.0])
    best = best_so_far([10, 10, 10], [1.0, 0.5, 3.0], at, -1.0)
    np.testing.assert_array_equal(best, [np.nan, 1.0, 0.5, 0.5, 0.5])


def test_without_a_grid_nothing_is_compared():
    assert against_table(pd.DataFrame({"value": [1.0]}), "return_paper", None, True) is None


@pytest.mark.slow
def test_a_search_that_was_killed_goes_on(tmp_path):
    """Its trials end in the folders that they were begun in, once; the study is one file; a grid is beside."""
    env = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}

    def run(*words: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run([sys.executable, "run.py", *words], cwd=ROOT, env=env, capture_output=True, text=True)

    grid = ["+experiment=toy", "algo=td3", "algo.batch_size=16", "budget.env_steps=960", "algo.learning_starts=320"]
    assert run(*grid, "evaluation.episodes=2", f"root={tmp_path}", "name=grid_0").returncode == 0
    words = [*TOY, f"root={tmp_path}", "name=t", f"tune.against='{tmp_path}/train/grid_*'"]
    search = subprocess.Popen([sys.executable, "run.py", *words], cwd=ROOT, env=env)
    while not list((tmp_path / "train").glob("t_*/checkpoints/state.pt")):
        assert search.poll() is None
        time.sleep(0.1)
    search.send_signal(signal.SIGKILL)
    search.wait()
    folder = tmp_path / "tune" / "t"
    assert json.loads((folder / "meta.json").read_text())["status"] == "running"
    begun = {f.name for f in (tmp_path / "train").glob("t_*")}
    done = run(f"resume={folder}")
    assert done.returncode == 0, done.stderr
    trials = pd.read_csv(folder / "trials.csv")
    assert trials["trial"].tolist() == [0, 1, 2]
    assert set(trials["state"]) <= {"complete", "pruned"}
    assert begun <= {f.name for f in (tmp_path / "train").glob("t_*")} == {"t_0", "t_1", "t_2"}
    for k, row in trials.iterrows():
        steps = pd.read_csv(tmp_path / "train" / f"t_{k}" / "evaluations.csv")["env_steps"].tolist()
        assert steps == sorted(steps)
        again = len(steps) - len(set(steps))  # the end is evaluated once more; who is pruned there has that, too
        assert again == 1 if row["state"] == "complete" else again in (0, 1)
    assert (folder / "study.db").is_file()
    assert "Against the grid" in (folder / "report.md").read_text()
    best = json.loads((folder / "summary.json").read_text())["best"]
    assert best["value"] == trials["value"].max()
    assert "is finished" in run(f"resume={folder}").stderr
