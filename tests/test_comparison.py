"""What can be said of several trainings, against hand calculations and known distributions."""

import json

import numpy as np
import pandas as pd
import pytest

from r2s.errors import UserError
from r2s.reporting.comparison import band, groups, improvement_table, read_runs, sensitivity_table, summary_table
from r2s.reporting.statistics import improvement, interquartile_mean, interval


def write_run(folder, seed, lr, score, algo="tqc", status="done", extra=""):
    """Write a run folder with three evaluations that end at a return of `score`."""
    folder.mkdir(parents=True)
    (folder / "config.yaml").write_text(
        f"seed: {seed}\nname: {folder.name}\nalgo: {{name: {algo}, lr: {lr}{extra}}}\ndr: {{name: around}}\n"
    )
    (folder / "meta.json").write_text(json.dumps({"status": status}))
    (folder / "summary.json").write_text("{}")
    table = {"env_steps": [10, 20, 30], "updates": [1, 2, 3], "wall_clock_s": [5.0, 10.0, 15.0 + seed]}
    table |= {k: [0.0, 0.5, 1.0] for k in ("success_2cm", "success_1cm", "success_5mm")}
    table |= {"distance_median_m": [0.1, 0.05, 0.01], "return_paper": [score - 20.0, score - 10.0, score]}
    pd.DataFrame(table).to_csv(folder / "evaluations.csv", index=False)


@pytest.fixture
def runs(tmp_path):
    """Two settings of tqc, one of td3 with a setting of its own, three seeds each, and what must not count."""
    for seed in range(3):
        write_run(tmp_path / f"a{seed}", seed, 1e-3, -80.0 - seed)
        write_run(tmp_path / f"b{seed}", seed, 1e-4, -100.0 - seed)
        write_run(tmp_path / f"c{seed}", seed, 5e-4, -90.0 - seed, "td3", extra=", policy_delay: 2")
    write_run(tmp_path / "stopped", 0, 1e-3, 0.0, status="running")
    (tmp_path / "other").mkdir()
    return read_runs(sorted(tmp_path.iterdir()))


def test_groups_are_what_runs_differ_in(runs):
    """Seeds, names and unfinished runs make no group; settings that differ within an algorithm name it."""
    assert len(runs) == 9
    found = groups(runs)
    assert {k: len(v) for k, v in found.items()} == {"tqc, lr 0.001": 3, "tqc, lr 0.0001": 3, "td3, lr 0.0005": 3}
    assert list(groups([r for r in runs if r.settings["algo.lr"] != 1e-4])) == ["tqc", "td3"]


def test_nothing_finished_is_one_line(tmp_path):
    """Folders without a finished training are a user's mistake."""
    with pytest.raises(UserError, match=r"^runs: no finished run"):
        read_runs([tmp_path])


def test_the_interquartile_mean_leaves_a_quarter_out_on_each_side():
    """By hand: whole values, and the values at the edge in part; constants stay, order does not matter."""
    assert interquartile_mean(np.array([9.0, 1.0, 2.0, 100.0])) == pytest.approx(5.5)
    assert interquartile_mean(np.array([0.0, 1.0, 2.0, 3.0, 50.0])) == pytest.approx((0.75 * 1 + 2 + 0.75 * 3) / 2.5)
    assert interquartile_mean(np.full((2, 3), 7.0)) == pytest.approx([7.0, 7.0])
    assert interquartile_mean(np.array([4.0])) == 4.0


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


def test_tables_say_what_was_put_in(runs):
    """Scores, their intervals within the seeds' range, who is better, and who depends on its settings."""
    grouped = groups(runs)
    table = summary_table(grouped).set_index(["group", "measure"])
    row = table.loc[("tqc, lr 0.001", "return_paper")]
    assert row["seeds"] == 3
    assert row["iqm"] == pytest.approx(-81.0)
    assert -82.001 <= row["low"] <= row["iqm"] <= row["high"] <= -79.999
    better = improvement_table(grouped).set_index(["better", "than", "measure"])["probability"]
    assert better["tqc, lr 0.001", "tqc, lr 0.0001", "return_paper"] == 1.0
    assert better["tqc, lr 0.0001", "tqc, lr 0.001", "return_paper"] == 0.0
    assert better["tqc, lr 0.001", "td3, lr 0.0005", "success_1cm"] == 0.5
    sensitivity = sensitivity_table(grouped).set_index("algo")
    assert list(sensitivity.index) == ["tqc"]
    assert sensitivity.loc["tqc", "best"] == pytest.approx(-81.0)
    assert sensitivity.loc["tqc", "worst"] == pytest.approx(-101.0)
    assert sensitivity.loc["tqc", "spread"] == pytest.approx(10.0)


def test_a_band_is_over_what_all_seeds_have(runs):
    """The mean of the seeds' curves, between their lowest and highest, up to the end of the shortest."""
    group = groups(runs)["tqc, lr 0.001"]
    at, (middle, low, high) = band(group, "wall_clock_s", "return_paper", points=5)
    assert (at[0], at[-1]) == (5.0, 15.0)
    assert low[0] == -102.0
    assert middle[0] == pytest.approx(-101.0)
    assert high[0] == -100.0
    assert high[-1] == pytest.approx(-80.0)
