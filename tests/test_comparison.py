"""The comparison of trainings, against hand calculations and known distributions."""

import contextlib
import json
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from cli_runs import succeed
from hydra import compose, initialize_config_dir
from matplotlib.colors import to_rgb
from matplotlib.image import imread
from omegaconf import OmegaConf

from r2s.errors import UserError
from r2s.reporting.comparison.grouping import LONGEST, group
from r2s.reporting.comparison.page import comparison_page
from r2s.reporting.comparison.scores import (
    at_edges,
    band,
    held_out,
    improvement_matrix,
    improvement_table,
    sensitivity_table,
    summary_table,
)
from r2s.reporting.comparison.statistics import improvement, interquartile_mean, interval
from r2s.reporting.comparison.trainings import by_reason, comparable, read_trainings
from r2s.reporting.figures.colours import KNOWN, OTHERS, colours
from r2s.reporting.tables import scores_rows
from r2s.runs import Job, Run
from r2s.stages.build import CONF
from r2s.tasks.measures import Measure, MeasureTable, write_measures
from r2s.tasks.reach import REACH

ROOT = Path(__file__).parent.parent


@cache
def composed(*overrides):
    with initialize_config_dir(str(CONF.resolve()), version_base="1.3"):
        return compose("config", list(overrides))


def write_run(folder, *overrides, score=-90.0, status="done", env_steps=600_000, stage="train", **meta):
    """Write a run folder of the real config with three evaluations that end at a return of `score`."""
    folder.mkdir(parents=True)
    cfg = composed(*(o for o in overrides if not o.startswith("seed=")))
    cfg.seed = next((int(o.removeprefix("seed=")) for o in overrides if o.startswith("seed=")), 0)
    (folder / "config.yaml").write_text(OmegaConf.to_yaml(cfg))
    (folder / "overrides.yaml").write_text("".join(f"- {json.dumps(o)}\n" for o in overrides) or "[]\n")
    (folder / "meta.json").write_text(json.dumps({"status": status, "stage": stage} | meta))
    rows = [1, 2, 3] if env_steps else [1]
    at = np.array([env_steps // 3 * k for k in rows])
    table = {"env_steps": at, "updates": at // 32, "wall_clock_s": [5.0 * k + cfg.seed * (k == 3) for k in rows]}
    table |= {k: [0.0, 0.5, 1.0][-len(rows) :] for k in ("success_2cm", "success_1cm", "success_5mm")}
    table |= {"distance_median_m": 0.1 / np.array(rows), "return_paper": [score + 10 * (k - rows[-1]) for k in rows]}
    pd.DataFrame(table).to_csv(folder / "evaluations.csv", index=False)
    last = {k: float(v[-1]) for k, v in table.items()} | {"time_to_reach_s": None}  # of a policy that never got there
    (folder / "summary.json").write_text(json.dumps({"last": last}))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Two settings of tqc, one of td3, three seeds each, and folders that must not count."""
    root = tmp_path_factory.mktemp("few")
    for seed in range(3):
        write_run(root / f"a{seed}", f"seed={seed}", "algo.lr=1e-3", score=-80.0 - seed)
        write_run(root / f"b{seed}", f"seed={seed}", "algo.lr=1e-4", score=-100.0 - seed)
        write_run(root / f"c{seed}", f"seed={seed}", "algo=td3", score=-90.0 - seed)
    write_run(root / "killed", status="running")
    (root / "other").mkdir()
    return root


@pytest.fixture(scope="module")
def runs(folder):
    return read_trainings(sorted(folder.iterdir()))[0]


@pytest.fixture(scope="module")
def grouped(runs):
    return group(runs).members


@pytest.fixture(scope="module")
def user_folder(tmp_path_factory):
    """What a user has after make run, a sweep, two identified trainings, a toy, an oracle and some accidents."""
    root = tmp_path_factory.mktemp("user") / "runs" / "train"
    own = [f"root={root.parent}", "stage=train", "threads=1", "budget.minutes=3.0"]
    write_run(root / "2026-01-01_12-00-00_identified", *own, "calibration=runs/identify/2026-01-01_12-00-00")
    write_run(root / "2026-01-01_12-00-00_nominal", *own, "friction=gaz2019", "inertia=nominal")
    for k, algo in enumerate(("ddpg", "sac", "td3", "tqc")):
        for seed in (0, 1):
            write_run(root / f"{algo}{seed}", f"algo={algo}", f"seed={seed}", score=-100.0 + 10 * k + seed)
    for k in (1, 2):
        how = ("device=cpu", "compile=false", "identify.window_s=0.2", "data.seconds=5")
        write_run(root / f"judge{k}", "algo=tqc", f"calibration=runs/identify/judge-{k}", "dr=identified", *how)
    write_run(root / "paper", "dr=paper", "seed=2")
    write_run(root / "certain", "dr=none")
    write_run(root / "oracle", "algo=oracle", env_steps=0)
    for name, more in {"toy": "+experiment=toy", "toy2": "+experiment=toy", "long": "budget.minutes=60"}.items():
        write_run(root / name, more)
    for name, more in {"quick": "task.episode_s=2", "fr3": "robot=fr3", "few": "evaluation.episodes=12"}.items():
        write_run(root / name, more)
    write_run(root / "died", status="failed")
    write_run(root / "going", status="running")
    write_run(root / "found", stage="identify")
    write_run(root / "cut")
    (root / "cut" / "evaluations.csv").write_text("")
    write_run(root / "edited")
    (root / "edited" / "config.yaml").write_text("algo: [")
    (root / "notes").mkdir()
    (root / "readme.txt").write_text("mine")
    return root


def test_groups_are_what_runs_differ_in(runs, grouped):
    """Seeds, names and unfinished runs make no group; settings that differ within an algorithm name it."""
    assert len(runs) == 9
    assert {k: len(v) for k, v in grouped.items()} == {"tqc, lr=1e-3": 3, "tqc, lr=1e-4": 3, "td3": 3}
    assert list(group([r for r in runs if r.settings["algo.lr"] != 1e-4]).members) == ["tqc", "td3"]
    assert list(group([r for r in runs if r.settings["algo.lr"] == 1e-4]).members) == ["tqc"]


def test_what_a_training_does_not_read_names_no_group(user_folder):
    """Labels are short, made of what was typed and matters; defaults typed or not are one group."""
    trained, _ = read_trainings(sorted(user_folder.iterdir()))
    found = group(comparable(trained)[0])
    names = {found.key.get(label, label): {r.folder.name for r in seeds} for label, seeds in found.members.items()}
    assert names == {
        "tqc, minutes=3.0, calibration=2026-01-01_12-00-00": {"2026-01-01_12-00-00_identified"},
        "tqc, minutes=3.0, friction=gaz2019, inertia=nominal": {"2026-01-01_12-00-00_nominal"},
        **{algo: {f"{algo}0", f"{algo}1"} for algo in ("ddpg", "sac", "td3")},
        "tqc, dr=paper": {"tqc0", "tqc1", "paper"},
        "tqc, calibration=judge-1, dr=identified": {"judge1"},
        "tqc, calibration=judge-2, dr=identified": {"judge2"},
        "tqc, dr=none": {"certain"},
        "oracle": {"oracle"},
    }
    assert max(map(len, found.members)) <= LONGEST
    assert set(found.key) == {"tqc #1", "tqc #2"}


def test_settings_that_an_experiment_changed_name_a_group(tmp_path):
    """Nothing was typed of them, and yet two groups never share a name."""
    for k, lr in enumerate((1e-3, 1e-4)):
        write_run(tmp_path / str(k), f"algo.lr={lr}")
        (tmp_path / str(k) / "overrides.yaml").write_text("[]\n")
    assert list(group(read_trainings(sorted(tmp_path.iterdir()))[0]).members) == ["tqc, lr=0.001", "tqc, lr=0.0001"]


def test_limits_of_contact_and_the_precision_of_products_name_a_group(tmp_path):
    """A training reads them, so seeds with other values are of another group."""
    words = ("safety.force_max=25", "safety.force_max=40", "matmul=highest")
    for k, word in enumerate(words):
        write_run(tmp_path / str(k), word)
    assert set(group(read_trainings(sorted(tmp_path.iterdir()))[0]).members) == {f"tqc, {word}" for word in words}


def test_runs_that_are_not_comparable_are_listed_with_a_reason(user_folder):
    """The largest set is compared; the reasons of all other folders are listed."""
    trained, others = read_trainings(sorted(user_folder.iterdir()))
    runs, apart = comparable(trained)
    assert len(runs) == 15
    assert apart == {
        "few": "another evaluation: evaluation.episodes is 12, not 200",
        "fr3": "another robot: robot.q_min differs",
        "long": "another budget: 60 min, not 3",
        "quick": "another task: task.episode_s is 2, not 4.0",
        "toy": "+experiment=toy",
        "toy2": "+experiment=toy",
    }
    assert others["died"] == "failed"
    assert others["going"] == "unfinished"
    assert others["found"] == "stage=identify"
    assert others["cut"] == others["edited"] == "unreadable"
    assert others["notes"] == others["readme.txt"] == "no run folder"
    assert comparable([r for r in trained if r.toy])[1] == {"toy2": "seed 0 again, as toy"}


def test_one_commit_and_one_machine_or_set_apart(tmp_path):
    """The reason names both values; a run that other code resumed is of neither; a repeated seed counts once."""
    git, other = {"commit": "a" * 40, "dirty": False}, {"commit": "b" * 40, "dirty": False}
    here = {"git": git, "machine": {"cpu": "Xeon", "cores": 2}, "threads": 1, "device": "cpu"}
    part = here | {"start": "", "wall_clock_s": 1.0, "status": "killed", "process": {}, "packages": {}}
    for seed in range(3):
        write_run(tmp_path / f"a{seed}", f"seed={seed}", **here)
    write_run(tmp_path / "again", "seed=2", **here)
    write_run(tmp_path / "changed", "seed=3", **here | {"git": git | {"dirty": True}})
    write_run(tmp_path / "newer", "seed=4", **here | {"git": other})
    write_run(tmp_path / "both", "seed=5", **here, parts=[part, part | {"git": other}])
    write_run(tmp_path / "faster", "seed=6", **here | {"machine": {"cpu": "Epyc", "cores": 2}})
    write_run(tmp_path / "wider", "seed=7", **here | {"threads": 2})
    write_run(tmp_path / "gpu", "seed=8", **here | {"device": "cuda"})
    write_run(tmp_path / "oracle", "algo=oracle", env_steps=0, **here | {"threads": 2})
    write_run(tmp_path / "pusher", "algo=pusher", env_steps=0, **here | {"threads": 2})
    runs, apart = comparable(read_trainings(sorted(tmp_path.iterdir()))[0])
    assert [r.folder.name for r in runs] == ["a0", "a1", "a2", "oracle", "pusher"]
    assert apart == {
        "again": "seed 2 again, as a2",
        "changed": "another commit: aaaaaaaa with changes, not aaaaaaaa",
        "newer": "another commit: bbbbbbbb, not aaaaaaaa",
        "both": "another commit: aaaaaaaa and bbbbbbbb, not aaaaaaaa",
        "faster": "another machine: Epyc, not Xeon",
        "wider": "other threads: 2, not 1",
        "gpu": "another device: cuda, not cpu",
    }


def test_a_training_whose_arms_were_stopped_is_compared(tmp_path):
    """Its distance is infinite, null in a summary, in some evaluations or in all; other measures are as they are."""
    for name, at in {"early": 0, "always": slice(None), "never": []}.items():
        write_run(tmp_path / name)
        curve = pd.read_csv(tmp_path / name / "evaluations.csv")
        curve.loc[curve.index[at], "distance_median_m"] = np.inf
        curve.to_csv(tmp_path / name / "evaluations.csv", index=False)
    summary = json.loads((tmp_path / "always" / "summary.json").read_text())
    summary["last"]["distance_median_m"] = None
    (tmp_path / "always" / "summary.json").write_text(json.dumps(summary))
    trained, others = read_trainings(sorted(tmp_path.iterdir()))
    assert not others
    table = summary_table({"all": trained}).set_index("measure")
    assert table.loc["distance_median_m", "high"] == np.inf
    assert table.loc["return_paper", "iqm"] == -90.0
    assert np.isfinite(table.drop("distance_median_m")[["iqm", "low", "high"]].astype(float)).all(axis=None)
    cell = scores_rows(REACH, summary_table({"all": trained})).loc["all", "median\ndistance, mm"]
    assert cell.endswith(", -]")


def test_trainings_of_a_task_from_outside_r2s_are_compared_by_its_measures(tmp_path, panda):
    """Tables, figures and the best group follow measures.json; a lower force error is better."""
    force = Measure("force_N", "force", "force error", "N", 1, 2, lower_is_better=True)
    table = MeasureTable((force, Measure("held", "held", "time in contact", "%", 100, 0)), ("held", "force_N"))
    for k, lr in enumerate((1e-3, 1e-4)):
        folder = tmp_path / f"lr{k}"
        write_run(folder, f"algo.lr={lr}")
        write_measures(folder, table)
        curve = pd.read_csv(folder / "evaluations.csv")[["env_steps", "updates", "wall_clock_s"]]
        curve.assign(force_N=[3.0, 2.0, 1.0 + k], held=0.9).to_csv(folder / "evaluations.csv", index=False)
        last = {"env_steps": 600_000, "updates": 10, "wall_clock_s": 15.0, "force_N": 1.0 + k, "held": 0.9}
        (folder / "summary.json").write_text(json.dumps({"last": last}))
    trained, others = read_trainings(sorted(tmp_path.iterdir()))
    assert not others
    (tmp_path / "out" / "figures").mkdir(parents=True)
    run = SimpleNamespace(folder=tmp_path / "out", figure=lambda name: tmp_path / "out" / "figures" / f"{name}.png")
    tables = comparison_page(run, panda, group(trained), {}, {})
    shown = scores_rows(table, tables["scores"])
    assert list(shown.columns) == ["seeds", "held, %", "force, N"]
    assert shown["force, N"].to_list() == ["1.00", "2.00"]
    better = tables["improvement"].set_index(["better", "measure"])["probability"]
    assert better["tqc, lr=0.001", "force_N"] == 1.0
    assert "force error, last evaluation" in (run.folder / "report.md").read_text()


@pytest.mark.long
def test_the_stage_is_read_in_a_terminal_of_110_columns(user_folder, tmp_path):
    """Table, key, and the runs that were not compared; the legend leaves the figures room."""
    printed = succeed("stage=compare", f"runs={user_folder}/*", f"root={tmp_path}", "name=all")
    *lines, written = printed.splitlines()
    assert max(map(len, lines)) <= 110
    assert "last evaluation" in lines[0]
    text = " ".join(printed.split())
    for expected in (
        "tqc #1 = tqc, minutes=3.0, calibration=2026-01-01_12-00-00",
        "not comparable with these: toy, toy2 (+experiment=toy)",
        "not comparable with these: long (another budget: 60 min, not 3)",
        "no finished trainings: cut, edited (unreadable); died (failed); found (stage=identify); "
        "going (unfinished); notes, readme.txt (no run folder)",
    ):
        assert expected in text
    assert written.startswith("written:")
    folder = tmp_path / "compare" / "all"
    assert "_target_" not in (folder / "report.md").read_text()
    scores = pd.read_csv(folder / "scores.csv")
    assert scores["group"].nunique() == 10
    for name in ("learning", "scores"):
        height, width, _ = imread(folder / "figures" / f"{name}.png").shape
        assert height < 0.7 * width, f"{name}: more legend than figure"


def test_twelve_colours_differ_and_are_seen_on_white_and_black():
    """Contrast of at least 2.4 by WCAG's formula; no two colours closer than 0.08 in OKLab."""
    rgb = np.array([to_rgb(c) for c in (*KNOWN.values(), *OTHERS)])
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    bright = linear @ (0.2126, 0.7152, 0.0722) + 0.05
    assert np.all(1.05 / bright > 2.4)
    assert np.all(bright / 0.05 > 2.4)
    lms = linear @ np.array([[0.4122, 0.5363, 0.0514], [0.2119, 0.6807, 0.1074], [0.0883, 0.2817, 0.6300]]).T
    lab = np.cbrt(lms) @ np.array([[0.2105, 0.7936, -0.0041], [1.9780, -2.4286, 0.4506], [0.0259, 0.7828, -0.8087]]).T
    apart = np.linalg.norm(lab[:, None] - lab, axis=-1)
    assert np.min(apart[np.triu_indices(len(lab), 1)]) > 0.08
    assert len(set(colours([f"tqc, identified {k}" for k in range(12)]).values())) == 12


def test_nothing_finished_is_one_line(tmp_path):
    """Folders without a finished training are a user's mistake."""
    write_run(tmp_path / "died", status="failed")
    with pytest.raises(UserError, match=r"^runs: expected finished runs.*got died \(failed\)$"):
        read_trainings([tmp_path / "died"])
    assert by_reason({f"{k}": "failed" for k in range(9)}) == ["0, 1, 2, 3 and 5 more (failed)"]


def test_the_interquartile_mean_leaves_a_quarter_out_on_each_side():
    """As rliable: a quarter is rounded down; constants stay, order does not matter."""
    assert interquartile_mean(np.array([9.0, 1.0, 2.0, 100.0])) == pytest.approx(5.5)
    assert interquartile_mean(np.array([0.0, 1.0, 2.0, 3.0, 50.0])) == pytest.approx(2.0)
    assert interquartile_mean(np.array([0.0, 1.0, 5.0])) == pytest.approx(2.0)
    assert interquartile_mean(np.array([0.0, 1.0, 2.0, np.inf])) == pytest.approx(1.5)
    assert interquartile_mean(np.full((2, 3), 7.0)) == pytest.approx([7.0, 7.0])
    assert interquartile_mean(np.array([4.0])) == 4.0


def test_one_seed_has_no_interval(runs):
    """Neither a score nor a difference, nor the loss from best to median setting."""
    one = group([r for r in runs if r.seed == 0]).members
    assert summary_table(one)[["low", "high"]].isna().all(axis=None)
    assert improvement_table(one)[["low", "high"]].isna().all(axis=None)
    row = sensitivity_table(one).iloc[0]
    assert row["best"] == -80.0
    assert row[["held_out", "spread", "low", "high"]].isna().all()


def test_a_winner_by_chance_is_no_better_on_a_held_out_seed():
    """Of 12 equal settings of 3 seeds the best beats the median by more than a standard error; held out it does not.

    The mean over 200 repetitions of the held-out spread is 0 within 4 standard errors, of unit normal scores.
    """
    rng, chosen, unseen = np.random.default_rng(0), [], []
    for _ in range(200):
        x = rng.normal(size=(12, 3))
        means = x.mean(1)
        chosen.append(means.max() - np.median(means))
        winner, median = held_out([dict(enumerate(row)) for row in x])
        unseen.append((winner - median).mean())
    assert np.mean(chosen) > 3**-0.5
    assert abs(np.mean(unseen)) < 4 * np.std(unseen) / 200**0.5


@pytest.mark.long
def test_winners_at_the_edge_of_what_was_tried_are_named(tmp_path):
    """The best of three learning rates is the largest: a line; one between two others, or of two: none."""
    for k, (lr, batch) in enumerate([("5e-4", 256), ("1e-3", 256), ("2e-3", 128)]):
        write_run(tmp_path / f"up{k}", f"algo.lr={lr}", f"algo.batch_size={batch}", score=-90.0 + k)
        write_run(tmp_path / f"mid{k}", "algo=td3", f"algo.lr={lr}", score=-90.0 - abs(k - 1))
    lines = at_edges(group(read_trainings(sorted(tmp_path.iterdir()))[0]).members)
    assert lines == ["best setting of tqc: algo.lr=0.002 is the largest tried; a better one may lie beyond"]


def test_the_interval_holds_the_mean_as_often_as_it_says():
    """Of 300 samples of 20 normal draws, the 95 % interval of the mean holds the truth in 88 to 98 %."""
    rng = np.random.default_rng(0)
    inside = []
    for k in range(300):
        low, high = interval([rng.normal(size=20)], lambda d: d[0].mean(-1), seed=k)
        inside.append(low <= 0 <= high)
    assert 0.88 < np.mean(inside) < 0.98


def test_the_probability_of_improvement():
    """Certain, impossible, a tie, and shifted normals against the closed form."""
    assert improvement(np.array([2.0, 3.0]), np.array([0.0, 1.0])) == 1.0
    assert improvement(np.array([0.0]), np.array([1.0])) == 0.0
    assert improvement(np.array([1.0, 1.0]), np.array([1.0])) == 0.5
    x = np.random.default_rng(0).normal(size=(2, 2000))
    assert improvement(x[0] + 1.0, x[1]) == pytest.approx(0.760, abs=0.02)  # Phi(1 / sqrt 2)


def test_tables_hold_the_scores(grouped):
    """Scores, their intervals within the seeds' range, who is better, and who depends on its settings."""
    table = summary_table(grouped).set_index(["group", "measure"])
    row = table.loc[("tqc, lr=1e-3", "return_paper")]
    assert row["seeds"] == 3
    assert row["iqm"] == pytest.approx(-81.0)
    assert -82.001 <= row["low"] <= row["iqm"] <= row["high"] <= -79.999
    pairs = improvement_table(grouped)
    better = pairs.set_index(["better", "than", "measure"])["probability"]
    square = improvement_matrix(pairs, "return_paper")
    assert square.loc["1: tqc, lr=1e-3"].tolist() == ["-", "1.00", "1.00"]
    assert better["tqc, lr=1e-3", "tqc, lr=1e-4", "return_paper"] == 1.0
    assert better["tqc, lr=1e-4", "tqc, lr=1e-3", "return_paper"] == 0.0
    assert better["tqc, lr=1e-3", "td3", "success_1cm"] == 0.5
    sensitivity = sensitivity_table(grouped).set_index("algo")
    assert list(sensitivity.index) == ["tqc"]
    assert sensitivity.loc["tqc", "best"] == pytest.approx(-81.0)
    assert sensitivity.loc["tqc", "worst"] == pytest.approx(-101.0)
    assert sensitivity.loc["tqc", "spread"] == pytest.approx(10.0)


def test_a_band_is_over_what_all_seeds_have(grouped):
    """The mean of the seeds' curves, between their lowest and highest, up to the end of the shortest."""
    group = grouped["tqc, lr=1e-3"]
    at, (middle, low, high) = band(group, "wall_clock_s", "return_paper", points=5)
    assert (at[0], at[-1]) == (5.0, 15.0)
    assert low[0] == -102.0
    assert middle[0] == pytest.approx(-101.0)
    assert high[0] == -100.0
    assert high[-1] == pytest.approx(-80.0)


def test_meta_json_has_the_end_of_a_run(tmp_path):
    """meta.json has done, stopped (Ctrl-C) or failed, which the comparison reports."""
    for name, error in (("whole", None), ("stopped", KeyboardInterrupt()), ("broken", ValueError("why"))):
        with contextlib.suppress(KeyboardInterrupt, ValueError), Run(tmp_path, Job("train", name, "", [], 0, 1)):
            if error:
                raise error
    files = [tmp_path / "train" / name / "meta.json" for name in ("whole", "stopped", "broken")]
    seen = [json.loads(file.read_text())["status"] for file in files]
    assert seen == ["done", "stopped", "failed"]
