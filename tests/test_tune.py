"""A search suggests settings, trains and reports; a killed search continues with its unfinished trials."""

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
from hydra import compose, initialize_config_dir
from test_comparison import write_run

from r2s.errors import UserError
from r2s.reporting.tuning import against_table, best_so_far, read_grid
from r2s.runs import Job, Run
from r2s.stages.build import CONF
from r2s.stages.tune import TrialRun, Tune, at_edges, corners, follow, parse_range, suggest, words_of

TUNE = yaml.safe_load((ROOT / "conf" / "stage" / "tune.yaml").read_text())["tune"]
TOY = [
    "+experiment=[tune,toy]",
    "budget.env_steps=4000",
    "evaluation.env_steps=800",
    "algo.learning_starts=320",
    "algo.demonstrations=320",
]
TOY += ["tune.trials=3", "tune.startup=1", "tune.workers=2", "evaluation.episodes=2"]
TOY += ["tune.space={algo: [td3], algo.batch_size: [16, 32], algo.lr: 'log(1e-4, 1e-2)'}"]


def test_a_range_is_parsed():
    """Numbers, spaces and kind; the space of conf/stage/tune.yaml is valid."""
    assert parse_range("x", "log(2e-4, 1e-3)") == (2e-4, 1e-3, True)
    assert parse_range("x", "interval( -1,2)") == (-1.0, 2.0, False)
    assert set(Tune(**TUNE).space) == {"algo", "algo.lr", "algo.batch_size", "algo.gamma"}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"space": {"algo.lr": "log(0, 1)"}}, r"tune.space.algo.lr: expected a number in \(0, inf\), got 0.0"),
        ({"space": {"algo.lr": "log(1, 0.1)"}}, r"tune.space.algo.lr: expected a number in \(1.0, inf\), got 0.1"),
        ({"space": {"algo.lr": "lg(1, 2)"}}, r"tune.space.algo.lr: expected \[values\], log.*got 'lg\(1, 2\)'"),
        ({"space": {"algo.lr": "interval(nan, 2)"}}, r"got nan"),
        ({"space": {"algo": []}}, r"tune.space.algo: expected a list of values such as \[128, 256\], got \[\]"),
        ({"space": {}}, r"tune.space: expected \{option.*got \{\}"),
        ({"trials": 0}, r"tune.trials: expected .*, got 0"),
        ({"workers": 0.5}, r"tune.workers: expected .*, got 0.5"),
        ({"against": "/nowhere/grid_*"}, r"tune.against: '/nowhere/grid_\*' matches no folder"),
        ({"against": 5}, r"tune.against: 5 matches no folder"),
    ],
)
def test_a_wrong_setting_gets_one_line(change, message):
    with pytest.raises(UserError, match=message):
        Tune(**TUNE | change)


def training(root, name, status, values=()):
    """Write the run folder of a training with this status; return it open if it is running."""
    run = Run(root, Job("train", name, "stage: train\n", [], 0, 1))
    for k, value in enumerate(values):
        run.log("evaluations", {"env_steps": k, "return_paper": value})
    if status == "failed":
        run.__exit__(FloatingPointError, FloatingPointError("the loss of update 1 is nan"), None)
    elif status == "done":
        run.__exit__(None, None, None)
    return run


def make_trial(study, root, number=0):
    command = [sys.executable, "-c", "import sys; sys.exit('out of memory')"]
    return TrialRun(study.ask(), root / "train" / f"t_{number}", command, root / "logs" / "t.txt")


def test_a_trial_follows_the_files_of_its_run_folder(tmp_path):
    """Values come from evaluations.csv, the end from meta.json, also of a training that another process writes."""
    optuna = pytest.importorskip("optuna")
    study = optuna.create_study(direction="maximize", pruner=optuna.pruners.NopPruner())
    one = make_trial(study, tmp_path)
    assert one.status() == "none"
    run = training(tmp_path, "t_0", "running", [1.0, 2.0])
    with open(run.folder / "evaluations.csv", "a") as file:
        file.write("3,3")  # the training is writing this row
    assert one.status() == "left"
    assert not follow(study, one, "return_paper")
    assert study.trials[0].intermediate_values == {0: 1.0, 1: 2.0}
    run.__exit__(None, None, None)
    assert follow(study, one, "return_paper")
    assert study.trials[0].value == 2.0
    assert one.starts == 0


def test_a_failed_training_is_a_failed_trial(tmp_path):
    """After evaluations the search continues; before the first one it stops with the training's error."""
    optuna = pytest.importorskip("optuna")
    study = optuna.create_study()
    training(tmp_path, "t_0", "failed", [1.0])
    assert follow(study, make_trial(study, tmp_path), "return_paper")
    training(tmp_path, "t_1", "failed")
    with pytest.raises(UserError, match=r"training t_1 failed: FloatingPointError: the loss of update 1 is nan"):
        follow(study, make_trial(study, tmp_path, 1), "return_paper")
    assert [t.state.name for t in study.trials] == ["FAIL", "FAIL"]


def test_a_training_that_never_begins_ends_the_search(tmp_path):
    """After MOST_STARTS attempts; the error names the file with its output."""
    optuna = pytest.importorskip("optuna")
    study = optuna.create_study()
    one = make_trial(study, tmp_path)
    for _ in range(3):
        assert not follow(study, one, "return_paper")
        one._process.wait()  # type: ignore[union-attr]
    with pytest.raises(UserError, match=r"training t_0 ended 3 times before its end; see .*logs/t.txt"):
        follow(study, one, "return_paper")
    assert one.log.read_text() == "out of memory\n" * 3


@pytest.mark.parametrize("ignored", ["SIGINT", "SIGINT SIGTERM"])
def test_a_training_that_ignores_ctrl_c_is_ended(ignored, tmp_path, monkeypatch):
    """As children of a shell in the background do."""
    monkeypatch.setattr("r2s.stages.tune.STOP_S", 0.1)
    trial = pytest.importorskip("optuna").create_study().ask()
    ignore = "".join(f"signal.signal(signal.{name}, signal.SIG_IGN)\n" for name in ignored.split())
    code = f"import signal, sys, time\n{ignore}print('ready', file=sys.stderr, flush=True)\ntime.sleep(60)"
    one = TrialRun(trial, tmp_path, [sys.executable, "-c", code], tmp_path / "logs" / "t.txt")
    one.start()
    while one.log.read_text() != "ready\n":
        time.sleep(0.01)
    one.stop()
    assert one._process.returncode == -(signal.SIGKILL if "TERM" in ignored else signal.SIGTERM)  # type: ignore[union-attr]


def test_a_grid_without_a_finished_training_of_the_task_is_one_line(tmp_path):
    """Known before the search: unfinished runs, and runs without the measure."""
    write_run(tmp_path / "a", status="running")
    write_run(tmp_path / "b", "algo=oracle", env_steps=0)
    write_run(tmp_path / "c")
    assert len(read_grid(f"{tmp_path}/*", "return_paper")) == 1
    with pytest.raises(UserError, match=r"with path_rmse_mm, .* none: a \(unfinished\); b, c \(no path_rmse_mm\)$"):
        read_grid(f"{tmp_path}/*", "path_rmse_mm")


def test_none_in_a_space_is_null():
    """Hydra reads 'None' as a string."""
    trial = pytest.importorskip("optuna").trial.FixedTrial({"algo.residual_l2": None, "algo.lr": 1e-3})
    settings = suggest(trial, {"algo.residual_l2": [None, 2.0], "algo.lr": "log(1e-4, 1e-2)"})
    assert words_of(settings) == ["algo.residual_l2=null", "algo.lr=0.001"]


def test_corners_hold_every_value_and_both_ends():
    """Each at least once, beside the first values of the other axes."""
    space = {"algo": ["td3", "sac"], "algo.lr": "log(1e-4, 1e-2)", "algo.tau": [0.01]}
    first = {"algo": "td3", "algo.lr": 1e-4, "algo.tau": 0.01}
    assert corners(space) == [first, first | {"algo": "sac"}, first | {"algo.lr": 1e-2}]


def test_the_best_at_an_edge_is_named():
    """Ends of ranges, by their scale, and of lists of numbers; algorithms have no order."""
    space = {"algo": ["a", "b", "c"], "algo.lr": "log(1e-4, 1e-2)", "x": [1, 2, 3], "y": "interval(0, 1)"}
    best = {"algo": "a", "algo.lr": 9e-3, "x": 1, "y": 0.06}
    ends = at_edges(best, space)
    assert [line.split(": ")[1].split(";")[0] for line in ends] == [
        "algo.lr=0.009 is the largest tried",
        "x=1 is the smallest tried",
    ]
    assert at_edges(best | {"algo.lr": 5e-3, "x": 2}, space) == []


@pytest.mark.long
def test_defaults_lie_inside_the_grid_and_the_space():
    """Of every algorithm and every number that they search, so that a winner may lie on either side of it."""
    grid = yaml.safe_load((ROOT / "conf" / "experiment" / "paper_grid.yaml").read_text())["grid"]
    for algo in grid.pop("algo").split(","):
        with initialize_config_dir(str(CONF.resolve()), version_base="1.3"):
            default = compose("config", [f"algo={algo}"]).algo
        axes = [(key, [float(v) for v in str(values).split(",")]) for key, values in grid.items() if key != "seed"]
        for key, axis in TUNE["space"].items():
            if key != "algo":
                axes.append(
                    (key.removeprefix("algo."), axis if isinstance(axis, list) else parse_range(key, axis)[:2])
                )
        for key, values in axes:
            inside = min(values) < default[key] < max(values)
            assert inside or set(values) == {default[key]}, f"{algo}: {key}={default[key]}, searched {values}"


def test_suggestions_lie_in_the_space():
    """An unfinished trial gets the same settings again."""
    optuna = pytest.importorskip("optuna")
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0))
    for _ in range(50):
        trial = study.ask()
        drawn = suggest(trial, TUNE["space"])
        assert drawn["algo"] in ("ddpg", "sac", "td3", "tqc")
        assert 5e-4 <= drawn["algo.lr"] <= 4e-3
        assert 0.95 <= drawn["algo.gamma"] <= 0.99
        assert suggest(optuna.trial.Trial(study, trial._trial_id), TUNE["space"]) == drawn


def test_the_best_so_far_counts_what_was_spent():
    """A trial counts from its end; a pruned one takes compute only."""
    at = np.array([5.0, 10.0, 25.0, 30.0, 100.0])
    best = best_so_far([10, 10, 10], [1.0, np.nan, 3.0], at, 1.0)
    np.testing.assert_array_equal(best, [np.nan, 1.0, 1.0, 3.0, 3.0])
    best = best_so_far([10, 10, 10], [1.0, 0.5, 3.0], at, -1.0)
    np.testing.assert_array_equal(best, [np.nan, 1.0, 0.5, 0.5, 0.5])


def test_without_a_grid_nothing_is_compared():
    assert against_table(pd.DataFrame({"value": [1.0]}), "return_paper", None, True) is None


@pytest.mark.slow
def test_a_killed_search_continues(tmp_path):
    """Each trial ends once, in the folder that it began in; the report compares with a grid."""
    env = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}

    def run(*words: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run([sys.executable, "run.py", *words], cwd=ROOT, env=env, capture_output=True, text=True)

    grid = [
        "+experiment=toy",
        "algo=td3",
        "algo.batch_size=16",
        "budget.env_steps=960",
        "algo.learning_starts=320",
        "algo.demonstrations=320",
    ]
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
        again = len(steps) - len(set(steps))  # the end is evaluated twice, also of a trial that is pruned there
        assert again == 1 if row["state"] == "complete" else again in (0, 1)
    assert (folder / "study.db").is_file()
    assert "Against the grid" in (folder / "report.md").read_text()
    best = json.loads((folder / "summary.json").read_text())["best"]
    assert best["value"] == trials["value"].max()
    assert "is finished" in run(f"resume={folder}").stderr
