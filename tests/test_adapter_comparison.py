"""The adapter comparison, over made-up transfers whose numbers are known by hand."""

import json
from dataclasses import asdict

import numpy as np
import pandas as pd
import pytest
import yaml
from cli_runs import one_line, r2s, succeed
from test_comparison import write_run

from r2s.reporting.comparison.adapter_comparison import compare_adapters, score, verdict
from r2s.reporting.comparison.adapter_comparison_page import lines, tables
from r2s.reporting.comparison.arm_conditions import condition, in_words, order, without_common
from r2s.reporting.comparison.statistics import paired
from r2s.reporting.comparison.transfers import comparable, read_transfers
from r2s.tasks.measures import Measure, MeasureTable, write_measures
from r2s.tasks.push_measures import PUSH
from r2s.tasks.reach import REACH, ReachTask
from r2s.tasks.rollout import episode_measures, gap
from r2s.tasks.task import Episodes
from r2s.tasks.track import TRACK, TrackTask

T = 100  # steps of an episode of 1 s


def episodes(off_mm, goals, path=True, ee_mm=0.0):
    """Return episodes whose hand is off by these mm all along, inf: stopped at the end; ee_mm from the origin."""
    count = len(off_mm)
    distance = 1e-3 * np.array([np.full(T, x if np.isfinite(x) else 1.0) for x in off_mm])
    distance[~np.isfinite(off_mm), -1] = np.inf
    ee = np.zeros((count, T, 3))
    ee[..., 0] = 1e-3 * ee_mm
    goal = np.array([np.full((T, 3) if path else 3, 0.1 * g) for g in goals])
    flat, joints = np.zeros((count, T)), np.zeros((count, T, 7))
    return Episodes(
        t=(1 + np.arange(T)) / T, q=joints, dq=joints, ee=ee, goal=goal, tau=joints, distance=distance,
        reward=flat, reward_smooth=flat, q_left=np.ones(count), limited=np.zeros(count), collision=np.full(count, ""),
    )  # fmt: skip


def carry(
    root, name, off_mm, adapt="none", *, goals=None, path=True, ee_mm=0.0, policy="paths", predicts=True, **given
):
    """Write a transfer: adapter, what the arm was asked (payload=1.0, ...), and how far off its hand was."""
    folder, goals = root / name, range(len(off_mm)) if goals is None else goals
    folder.mkdir(parents=True)
    robot, status = given.pop("robot", {"name": "panda"}), given.pop("status", "done")
    config = {
        "policy": f"runs/train/{policy}",
        "adapt": {"name": adapt} | given.pop("settings", {}),
        "arm": {"name": "twin", "variant": "rigid", "seed": 0, "payload": 0.0, "friction_scale": 1.0} | given,
    }
    (folder / "config.yaml").write_text(yaml.safe_dump(config))
    (folder / "policy.yaml").write_text(yaml.safe_dump({"robot": robot}))
    (folder / "overrides.yaml").write_text("[]\n")
    number = len(list(root.iterdir()))
    meta = {"stage": "transfer", "status": status, "start": f"2026-01-01T00:00:{number:02d}"}
    (folder / "meta.json").write_text(json.dumps(meta))
    (folder / "summary.json").write_text(json.dumps({"twin": {"asked": len(off_mm)}}))
    timing = {"what": ["policy", "adapter"], "median_ms": [0.3, 0.012]}
    pd.DataFrame(timing).to_csv(folder / "timing.csv", index=False)
    ran, predicted = episodes(off_mm, goals, path, ee_mm), episodes(off_mm, goals, path) if predicts else None
    np.savez(folder / "episodes_twin.npz", **asdict(ran))
    rows = episode_measures(TrackTask() if path else ReachTask(), ran, predicted)
    pd.DataFrame(rows).to_csv(folder / "episodes_twin.csv", index=False)
    write_measures(folder, TRACK if path else REACH)


def made(root):
    """Return the comparison of the transfers in a folder."""
    return compare_adapters(comparable(read_transfers(sorted(root.iterdir()))[0])[0])


def value(table, measure, row, where, what="mean"):
    s = table.scores
    return s[(s["measure"] == measure) & (s["row"] == row) & (s["condition"] == where)][what].item()


def test_the_scores_are_those_by_hand(tmp_path):
    """Roots of mean squares, shares of time, gaps, cost, the worst condition, and where an adapter is worse."""
    for seed in (0, 1):
        carry(tmp_path, f"n{seed}", [1.0, 3.0], seed=seed, ee_mm=2.0)
        carry(tmp_path, f"n_heavy{seed}", [7.0, 1.0], seed=seed, payload=1.0)
        carry(tmp_path, f"o{seed}", [2.0, 4.0], "observer", seed=seed)
        carry(tmp_path, f"o_heavy{seed}", [3.0, 1.0], "observer", seed=seed, payload=1.0)
    found = made(tmp_path)
    assert list(tables(found)["RMSE of the path, mm"].columns) == ["nominal", "1.0 kg"]
    assert list(found.runs) == ["none", "observer"]
    assert value(found, "path_rmse_mm", "none", "nominal") == pytest.approx(5**0.5)
    assert value(found, "path_rmse_mm", "observer", "1.0 kg", "difference") == pytest.approx(5**0.5 - 5)
    assert value(found, "within_5mm", "none", "1.0 kg") == 0.5
    assert value(found, "ee_path_rmse_mm", "none", "nominal") == pytest.approx(2.0)
    assert value(found, "ee_path_rmse_mm", "observer", "nominal") == 0.0
    assert found.costs.loc["observer"].tolist() == pytest.approx([12.0])
    assert found.costs.loc["none"].tolist() == [0.0]
    worst = "none: time within 5 mm 100 % on the nominal arm, 50 % in its worst condition, 1.0 kg."
    assert verdict(found, "none") == worst
    # each path of 1 or 3 mm is 1 mm worse with it, whatever is drawn
    worse = "Significantly worse than none: nominal (RMSE of the path 3.16 mm instead of 2.24)."
    assert verdict(found, "observer").endswith(worse)
    assert "No episode was stopped." in lines(found)


def test_an_adapter_that_is_the_same_as_none_differs_by_nothing(tmp_path):
    """Exactly 0 in every draw, while its own interval is wide: the same arms and episodes are drawn for both."""
    rng = np.random.default_rng(0)
    for seed in range(3):
        off = rng.uniform(1, 9, 5)
        carry(tmp_path, f"n{seed}", off, seed=seed)
        carry(tmp_path, f"r{seed}", off, "rls", seed=seed)
    found = made(tmp_path)
    for measure in ("path_rmse_mm", "within_5mm"):
        for what in ("difference", "worse_low", "worse_high"):
            assert value(found, measure, "rls", "nominal", what) == 0.0
        assert value(found, measure, "rls", "nominal", "high") > value(found, measure, "rls", "nominal", "low")
    assert "Nowhere significantly worse than none" in verdict(found, "rls")


def test_the_bootstrap_draws_arms_and_of_each_its_episodes():
    """Arms that differ and episodes that do not: as many of one arm as binomial, whole shares of each."""
    draws = paired([np.zeros((4, 2)), np.ones((4, 2))], np.random.default_rng(0))
    assert np.array_equal(draws[:, 0], draws[:, 1])
    assert set(draws[:, 0]) == {0.0, 0.5, 1.0}
    assert np.mean(draws[:, 0] == 0.5) == pytest.approx(0.5, abs=0.05)
    alone = paired([np.array([[0.0], [1.0]])], np.random.default_rng(0))
    assert np.mean(alone == 0.5) == pytest.approx(0.5, abs=0.05)


def test_only_episodes_of_all_adapters_count(tmp_path):
    """An arm or episode that one row does not have is left out of all rows, with a line about it."""
    carry(tmp_path, "n0", [1.0, 3.0, 5.0])
    carry(tmp_path, "n1", [100.0] * 3, seed=1)
    carry(tmp_path, "r0", [1.0, 3.0], "rls", goals=[0, 1])
    summary = tmp_path / "r0" / "summary.json"  # one was not begun, as the arm would have touched something
    summary.write_text(summary.read_text().replace('"asked": 2', '"asked": 3'))
    found = made(tmp_path)
    assert value(found, "path_rmse_mm", "none", "nominal") == pytest.approx(5**0.5)
    assert found.left_out == [
        "nominal: 1 of 3 episodes of twin, rigid, seed 0 left out, not all rows have them",
        "nominal: twin, rigid, seed 1 left out, no transfer with rls",
    ]


def test_a_stopped_path_is_no_success_and_has_no_rmse(tmp_path):
    """It leaves the RMSE of all rows, unless a row was stopped in all of them; its success is 0."""
    carry(tmp_path, "n", [1.0, 3.0])
    carry(tmp_path, "r", [1.0, np.inf], "rls")
    carry(tmp_path, "o", [np.inf, np.inf], "observer")
    found = made(tmp_path)
    assert [value(found, "path_rmse_mm", row, "nominal") for row in ("none", "rls")] == pytest.approx([1.0, 1.0])
    assert np.isnan(value(found, "path_rmse_mm", "observer", "nominal"))
    assert value(found, "within_5mm", "rls", "nominal") == 0.5
    stops = tables(found)["stopped episodes"]["nominal"]
    assert stops.to_dict() == {"none": "0 of 2", "observer": "2 of 2", "rls": "1 of 2"}


def test_a_stopped_push_leaves_the_distance_of_the_others():
    """Its distance is infinite; all rows omit the episode, and their means stay finite."""
    rows = {"row": ["none"] * 3 + ["rls"] * 3, "arm": "twin", "goal": [0, 1, 2] * 2, "arm_stopped": 0}
    shared = pd.DataFrame(rows | {"distance_median_m": [0.01, 0.03, 0.05, 0.02, np.inf, 0.04]})
    found = score(shared, PUSH["distance_median_m"], {"none": None, "rls": "none"}).set_index("row")
    assert found["mean"].tolist() == pytest.approx([0.03, 0.03])
    assert found["episodes"].tolist() == [2, 2]
    assert np.isfinite(found.loc["rls", ["low", "high", "worse_low", "worse_high"]].astype(float)).all()


def test_of_reaching_success_is_to_be_within_1_cm_at_the_end(tmp_path):
    """And one episode has no interval, so that nothing is significant."""
    carry(tmp_path, "n", [9.0], path=False)
    carry(tmp_path, "r", [11.0], "rls", path=False, ee_mm=4.0)
    found = made(tmp_path)
    assert set(found.measures) == {"success_1cm", "ee_path_rmse_mm"}
    assert [value(found, "success_1cm", row, "nominal") for row in ("none", "rls")] == [1.0, 0.0]
    assert tables(found)["success at 1 cm, %"].loc["rls", "nominal"] == "0"
    assert "A comparison with adapt=none needs" in verdict(found, "rls")


def test_adapters_on_different_arms_do_not_compare(tmp_path):
    """The lines name what is left out, and nothing is averaged."""
    carry(tmp_path, "n", [1.0, 2.0])
    carry(tmp_path, "r", [1.0, 2.0], "rls", seed=1)
    found = made(tmp_path)
    assert list(tables(found)) == ["cost of an adapter"]
    assert lines(found)[-2:] == [
        "nominal: twin, rigid, seed 0 left out, no transfer with rls",
        "nominal: twin, rigid, seed 1 left out, no transfer with none",
    ]
    assert "A comparison with adapt=none needs" in verdict(found, "rls")


def test_the_gap_is_that_of_the_transfer(tmp_path):
    """Over all episodes it is `gap`."""
    carry(tmp_path, "n", [1.0, 2.0], ee_mm=3.0)
    ran, model = episodes([1.0, 2.0], [0, 1], ee_mm=3.0), episodes([1.0, 2.0], [0, 1])
    found = read_transfers([tmp_path / "n"])[0][0].episodes["ee_path_rmse_mm"]
    assert np.sqrt((found**2).mean()) == pytest.approx(gap(ran, model)["ee_path_rmse_mm"])


def test_measures_of_a_task_from_outside_r2s_are_compared(tmp_path):
    """Its run folders describe their measures; a rise of a lower-is-better measure is worse."""
    force = Measure("force_N", "force", "force error", "N", 1, 1, lower_is_better=True)
    for adapt, sizes in (("none", [1.0, 3.0]), ("rls", [2.0, 4.0])):
        for kg in (0.0, 1.0):
            carry(tmp_path, f"{adapt}{kg}", [1.0, 2.0], adapt, payload=kg)
            write_measures(tmp_path / f"{adapt}{kg}", MeasureTable((force,), ("force_N",)))
            rows = pd.DataFrame({"force_N": [(1 + kg) * f for f in sizes], "arm_stopped": 0.0})
            rows.to_csv(tmp_path / f"{adapt}{kg}" / "episodes_twin.csv", index=False)
    found = made(tmp_path)
    assert tables(found)["force error, N"].loc["none", "1.0 kg"].startswith("4.0\n[")
    assert verdict(found, "rls") == (
        "rls: force error 3.0 N on the nominal arm, 6.0 N in its worst condition, 1.0 kg. Significantly worse than "
        "none: nominal (force error 3.0 N instead of 2.0); 1.0 kg (force error 6.0 N instead of 4.0)."
    )


def test_without_a_prediction_there_is_no_gap(tmp_path):
    """As with simulator=none; a line reports it."""
    carry(tmp_path, "n", [1.0, 2.0], predicts=False)
    found = made(tmp_path)
    assert "ee_path_rmse_mm" not in found.measures
    assert "1 of 1 transfers have no path gap: with simulator=none there is no prediction." in lines(found)


def test_names_are_as_short_as_distinct(tmp_path):
    """A policy is named where one arm met two."""
    carry(tmp_path, "a", [1.0], policy="a/paths")
    carry(tmp_path, "b", [1.0], "rls", policy="a/paths")
    assert list(made(tmp_path).runs) == ["none", "rls"]
    carry(tmp_path, "e", [1.0], policy="b/paths")
    carry(tmp_path, "f", [1.0], "rls", policy="b/paths", settings={"rate": 2})
    names = set(made(tmp_path).runs)
    assert names == {"none (a/paths)", "none (b/paths)", "rls, rate=None", "rls, rate=2"}


def test_arms_with_a_policy_each_are_one_row(tmp_path):
    """As where each arm was identified, and trained for, by itself."""
    for seed in (0, 1):
        carry(tmp_path, f"n{seed}", [1.0, 2.0], seed=seed, policy=f"m{seed}")
        carry(tmp_path, f"r{seed}", [1.0, 2.0], "rls", seed=seed, policy=f"m{seed}")
    found = made(tmp_path)
    assert list(found.runs) == ["none", "rls"]
    assert value(found, "path_rmse_mm", "rls", "nominal", "arms") == 2
    assert found.key == [f"m{k} is the policy of none, rls on twin, rigid, seed {k}" for k in (0, 1)]


def test_what_cannot_be_compared_is_set_apart(tmp_path):
    """Another robot, task, number of goals or goals; of what was done again the last counts."""
    carry(tmp_path, "n", [1.0, 2.0])
    carry(tmp_path, "r_old", [8.0, 8.0], "rls")
    carry(tmp_path, "r", [1.0, 2.0], "rls")
    carry(tmp_path, "fr3", [1.0, 2.0], robot={"name": "fr3"})
    carry(tmp_path, "reach", [1.0, 2.0], path=False)
    carry(tmp_path, "few", [1.0])
    carry(tmp_path, "elsewhere", [1.0, 2.0], goals=[7, 8])
    carry(tmp_path, "died", [1.0, 2.0], status="failed")
    carry(tmp_path, "before", [1.0, 2.0])
    (tmp_path / "before" / "policy.yaml").unlink()
    carry(tmp_path, "bare", [1.0, 2.0])
    (tmp_path / "bare" / "episodes_twin.npz").unlink()
    carry(tmp_path, "broken", [1.0, 2.0])
    (tmp_path / "broken" / "episodes_twin.npz").write_text("mine")
    found, others = read_transfers(sorted(tmp_path.iterdir()))
    runs, apart = comparable(found)
    assert {r.folder.name for r in runs} == {"n", "r"}
    assert apart == {
        "r_old": "repeated later",
        "fr3": "another robot: robot.name differs",
        "reach": "another task: selected by success at 1 cm, not time within 5 mm",
        "few": "another evaluation: evaluation.episodes is 1, not 2",
        "elsewhere": "other goals",
    }
    assert others == {
        "died": "failed",
        "before": "no policy.yaml",
        "bare": "no episode on an arm",
        "broken": "unreadable",
    }


@pytest.mark.parametrize(
    ("arm", "words"),
    [
        ({"variant": "elastic", "payload": 0, "declared_payload": None, "friction_scale": 1}, "nominal"),
        ({"payload": 1}, "1.0 kg"),
        ({"payload": {"mass": 1}}, "1.0 kg"),
        ({"payload": {"mass": 1.0, "on_s": 2}}, "1.0 kg, on_s=2"),
        ({"payload": {"mass": 0.0, "on_s": 2}}, "nominal"),
        ({"payload": "runs/identify/hand"}, "payload=runs/identify/hand"),
        (
            {"declared_payload": 0.5, "friction_scale": 0.8, "extra_delay_s": 0.005},
            "0.5 kg declared, friction x 0.8, 0.005 s later",
        ),
        ({"stiffness": 10000}, "stiffness 10000.0"),
        ({"soft_start_s": 0.5}, "nominal"),
    ],
)
def test_conditions_in_words(arm, words):
    """Without variant and seed; equal conditions have equal words."""
    assert in_words(condition(arm)) == words


def test_conditions_in_order():
    """Nominal first, then by setting and size; other overrides of the arm count too."""
    asked = [{"friction_scale": 0.8}, {"payload": 1.5}, {}, {"payload": 0.5}]
    assert sorted(asked, key=order) == [{}, {"payload": 0.5}, {"payload": 1.5}, {"friction_scale": 0.8}]
    assert in_words(condition({"soft_start_s": 0.5}, ["arm.soft_start_s"])) == "soft_start_s=0.5"


def test_what_all_transfers_set_is_no_condition():
    """Such as the address of an arm, or its surface; a payload of all remains, because none is the nominal value."""
    arms = [{"address": "172.16.0.2", "surface": True, "payload": kg} for kg in (0.0, 1.0)]
    both = [condition(arm, ["arm.address", "arm.surface"]) for arm in arms]
    assert without_common(both) == [{}, {"payload": 1.0}]
    assert without_common(both[1:]) == [{"payload": 1.0}]
    assert without_common([*both, {"surface": "box"}]) == [*both, {"surface": "box"}]


def test_arms_at_two_addresses_are_two_nominal_arms(tmp_path):
    """Each has its losses, from a column *nominal* and a column with a payload."""
    for at in ("172.16.0.2", "172.16.0.3"):
        for kg in (0.0, 1.0):
            carry(tmp_path, f"{at}_{kg}", [1.0 + kg, 3.0], address=at, payload=kg, surface=True)
    for run in tmp_path.iterdir():
        (run / "overrides.yaml").write_text("[arm.address=x, arm.surface=true]\n")
    found = made(tmp_path)
    assert {r.arm for r in found.runs["none"]} == {f"twin, rigid, seed 0, 172.16.0.{k}" for k in (2, 3)}
    assert found.losses["condition"].tolist() == ["nominal", "1.0 kg"]
    assert "in its worst condition, 1.0 kg" in verdict(found, "none")


@pytest.mark.long
def test_the_stage_compares_adapters_unless_there_is_a_training(tmp_path):
    """Through the command line; with a training, transfers are left out with a hint."""
    runs = tmp_path / "runs"
    for adapt in ("none", "rls"):
        for kg in (0.0, 1.0):
            carry(runs / "transfer", f"{adapt}{kg}", [1.0, 2.0], adapt, payload=kg)
    out = " ".join(succeed("stage=compare", "runs=runs/transfer/*", "name=a", at=tmp_path).split())
    assert "Adapter comparison: 4 transfers to twin, rigid, seed 0, 2 episodes each" in out
    assert "rls: time within 5 mm 100 % on the nominal arm, 100 % in its worst condition, 1.0 kg" in out
    folder = runs / "compare" / "a"
    assert "rls: time within 5 mm 100 %" in (folder / "report.md").read_text()
    assert len(pd.read_csv(folder / "adapter_comparison.csv")) == 12  # measures, rows, conditions
    write_run(runs / "train" / "t")
    out = " ".join(succeed("stage=compare", "runs=runs/t*/*", "name=b", at=tmp_path).split())
    assert "no finished trainings: none0.0, none1.0, rls0.0, rls1.0 (stage=transfer)" in out
    assert "stage=compare compares adapters if runs= has transfers only" in out


@pytest.mark.long
def test_no_finished_transfer_is_one_line(tmp_path):
    carry(tmp_path / "runs" / "transfer", "died", [1.0], status="failed")
    one_line(
        r2s("stage=compare", "runs=runs/transfer/*", at=tmp_path), r"runs: expected finished runs.*died \(failed\)"
    )
    assert not (tmp_path / "runs" / "compare").exists()
