"""The league of adapters, over made-up transfers whose numbers are known by hand."""

import json
from dataclasses import asdict

import numpy as np
import pandas as pd
import pytest
import yaml
from test_cli import one_line, r2s, succeed
from test_comparison import write_run

from r2s.reporting.conditions import condition, in_words, order
from r2s.reporting.league import league, verdict
from r2s.reporting.league_page import lines, tables
from r2s.reporting.statistics import paired
from r2s.reporting.transfers import comparable, read_transfers
from r2s.tasks.episode import gap
from r2s.tasks.task import Episodes

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


def carry(root, name, off_mm, adapt="none", *, goals=None, path=True, ee_mm=0.0, told=None, policy="paths", **given):
    """Write a transfer: adapter, what the arm was asked (payload=1.0, ...), and how far off its hand was."""
    folder, goals = root / name, range(len(off_mm)) if goals is None else goals
    folder.mkdir(parents=True)
    robot, status = given.pop("robot", {"name": "panda"}), given.pop("status", "done")
    config = {
        "policy": f"runs/train/{policy}",
        "adapt": {"name": adapt} | given.pop("settings", {}),
        "arm": {"name": "twin", "make": 1, "seed": 0, "payload": 0.0, "friction": 1.0, "late": 0.0} | given,
    }
    trained = {"robot": robot, "adapt": {"name": told, "told": True} if told else {"name": "none"}}
    (folder / "config.yaml").write_text(yaml.safe_dump(config))
    (folder / "policy.yaml").write_text(yaml.safe_dump(trained))
    (folder / "overrides.yaml").write_text("[]\n")
    number = len(list(root.iterdir()))
    meta = {"stage": "transfer", "status": status, "start": f"2026-01-01T00:00:{number:02d}"}
    (folder / "meta.json").write_text(json.dumps(meta))
    row = {"asked": len(off_mm)} | ({} if adapt == "none" else {"adapter_minutes": 2.0 if told == adapt else 0.0})
    (folder / "summary.json").write_text(json.dumps({"twin": row}))
    timing = {"what": ["policy", "adapter"], "median_ms": [0.3, 0.012]}
    pd.DataFrame(timing).to_csv(folder / "timing.csv", index=False)
    np.savez(folder / "episodes_twin.npz", **asdict(episodes(off_mm, goals, path, ee_mm)))
    np.savez(folder / "episodes_predicted.npz", **asdict(episodes(off_mm, goals, path)))


def made(root):
    """Return the league of what is in a folder."""
    return league(comparable(read_transfers(sorted(root.iterdir()))[0])[0])


def value(table, measure, row, where, what="mean"):
    s = table.scores
    return s[(s["measure"] == measure) & (s["row"] == row) & (s["condition"] == where)][what].item()


def test_a_league_says_what_was_put_in(tmp_path):
    """By hand: roots of means of squares, shares of time, gaps, cost, what is kept, and where harm is done."""
    for seed in (0, 1):
        carry(tmp_path, f"n{seed}", [1.0, 3.0], seed=seed, ee_mm=2.0)
        carry(tmp_path, f"n_heavy{seed}", [7.0, 1.0], seed=seed, payload=1.0)
        carry(tmp_path, f"o{seed}", [2.0, 4.0], "observer", seed=seed)
        carry(tmp_path, f"o_heavy{seed}", [3.0, 1.0], "observer", seed=seed, payload=1.0)
    found = made(tmp_path)
    assert list(tables(found)["RMSE of the path, mm"].columns) == ["as it is", "1.0 kg"]
    assert list(found.runs) == ["none", "observer"]
    assert value(found, "rmse", "none", "as it is") == pytest.approx(5**0.5)
    assert value(found, "rmse", "observer", "1.0 kg", "difference") == pytest.approx(5**0.5 - 5)
    assert value(found, "success", "none", "1.0 kg") == 0.5
    assert value(found, "gap", "none", "as it is") == pytest.approx(2.0)
    assert value(found, "gap", "observer", "as it is") == 0.0
    assert found.costs.loc["observer"].tolist() == pytest.approx([12.0, 0.0])
    assert found.costs.loc["none"].tolist() == [0.0, 0.0]
    assert verdict(found, "none").startswith("none keeps 50 % of its success with the arm as it is; its worst")
    # each path of 1 or 3 mm is 1 mm worse with it, whatever is drawn
    assert verdict(found, "observer").endswith("Harm against none: as it is (RMSE, mm: 3.16 instead of 2.24).")
    assert "No episode was stopped." in lines(found)


def test_an_adapter_that_is_the_same_as_none_differs_by_nothing(tmp_path):
    """Exactly 0 in every draw, while its own interval is wide: the same arms and episodes are drawn for both."""
    rng = np.random.default_rng(0)
    for seed in range(3):
        off = rng.uniform(1, 9, 5)
        carry(tmp_path, f"n{seed}", off, seed=seed)
        carry(tmp_path, f"r{seed}", off, "rls", seed=seed)
    found = made(tmp_path)
    for measure in ("rmse", "success"):
        for what in ("difference", "worse_low", "worse_high"):
            assert value(found, measure, "rls", "as it is", what) == 0.0
        assert value(found, measure, "rls", "as it is", "high") > value(found, measure, "rls", "as it is", "low")
    assert "No harm is seen" in verdict(found, "rls")


def test_the_bootstrap_draws_arms_and_of_each_its_episodes():
    """Arms that differ and episodes that do not: as many of one arm as binomial, whole shares of each."""
    draws = paired([np.zeros((4, 2)), np.ones((4, 2))], np.random.default_rng(0))
    assert np.array_equal(draws[:, 0], draws[:, 1])
    assert set(draws[:, 0]) == {0.0, 0.5, 1.0}
    assert np.mean(draws[:, 0] == 0.5) == pytest.approx(0.5, abs=0.05)
    alone = paired([np.array([[0.0], [1.0]])], np.random.default_rng(0))
    assert np.mean(alone == 0.5) == pytest.approx(0.5, abs=0.05)


def test_only_what_all_adapters_of_a_condition_have_counts(tmp_path):
    """An arm or an episode that one lacks is left out for all, and said."""
    carry(tmp_path, "n0", [1.0, 3.0, 5.0])
    carry(tmp_path, "n1", [100.0] * 3, seed=1)
    carry(tmp_path, "r0", [1.0, 3.0], "rls", goals=[0, 1])
    summary = tmp_path / "r0" / "summary.json"  # one was not begun, as the arm would have touched something
    summary.write_text(summary.read_text().replace('"asked": 2', '"asked": 3'))
    found = made(tmp_path)
    assert value(found, "rmse", "none", "as it is") == pytest.approx(5**0.5)
    assert found.left_out == [
        "as it is: 1 of 3 episodes of twin, make 1, seed 0 are left out, not all rows have them",
        "as it is: twin, make 1, seed 1 is left out, rls was not there",
    ]


def test_a_stopped_path_is_no_success_and_has_no_rmse(tmp_path):
    """It leaves the RMSE of all rows, unless a row was stopped in all of them; its success is 0."""
    carry(tmp_path, "n", [1.0, 3.0])
    carry(tmp_path, "r", [1.0, np.inf], "rls")
    carry(tmp_path, "o", [np.inf, np.inf], "observer")
    found = made(tmp_path)
    assert value(found, "rmse", "none", "as it is") == value(found, "rmse", "rls", "as it is") == pytest.approx(1.0)
    assert np.isnan(value(found, "rmse", "observer", "as it is"))
    assert value(found, "success", "rls", "as it is") == 0.5
    stops = tables(found)["episodes that were stopped"]["as it is"]
    assert stops.to_dict() == {"none": "0 of 2", "observer": "2 of 2", "rls": "1 of 2"}


def test_of_reaching_success_is_to_be_within_1_cm_at_the_end(tmp_path):
    """And one episode has no interval, so that harm is not known."""
    carry(tmp_path, "n", [9.0], path=False)
    carry(tmp_path, "r", [11.0], "rls", path=False, ee_mm=4.0)
    found = made(tmp_path)
    assert set(found.measures) == {"success", "gap"}
    assert [value(found, "success", row, "as it is") for row in ("none", "rls")] == [1.0, 0.0]
    assert tables(found)["success within 1 cm, %"].loc["rls", "as it is"] == "0"
    assert "Harm: not known" in verdict(found, "rls")


def test_adapters_that_never_met_an_arm_have_no_league(tmp_path):
    """It is said what is left out, and nothing is averaged."""
    carry(tmp_path, "n", [1.0, 2.0])
    carry(tmp_path, "r", [1.0, 2.0], "rls", seed=1)
    found = made(tmp_path)
    assert list(tables(found)) == ["what an adapter costs"]
    assert lines(found)[-2:] == [
        "as it is: twin, make 1, seed 0 is left out, rls was not there",
        "as it is: twin, make 1, seed 1 is left out, none was not there",
    ]
    assert "Harm: not known" in verdict(found, "rls")


def test_the_gap_is_that_of_the_transfer():
    """Over all episodes the same as `gap` says, in another order of what was predicted."""
    from r2s.reporting.transfers import figures

    ran, model = episodes([1.0, 2.0], [0, 1], ee_mm=3.0), episodes([1.0, 2.0], [1, 0])
    found = figures(asdict(ran), asdict(model))["gap"]
    assert np.sqrt((found**2).mean()) == pytest.approx(gap(ran, model)["ee_path_rmse_mm"])


def test_without_a_prediction_there_is_no_gap(tmp_path):
    """As with simulator=none; it is said."""
    carry(tmp_path, "n", [1.0, 2.0])
    (tmp_path / "n" / "episodes_predicted.npz").unlink()
    found = made(tmp_path)
    assert "gap" not in found.measures
    assert "1 of 1 transfers have no path gap: with simulator=none nothing was predicted." in lines(found)


def test_names_are_as_short_as_tells_rows_apart(tmp_path):
    """A policy is named where an arm met two of a kind; a policy that is told is named by its adapter alone."""
    carry(tmp_path, "a", [1.0], policy="a/paths")
    carry(tmp_path, "b", [1.0], "rls", policy="a/paths")
    carry(tmp_path, "c", [1.0], "osi", told="osi", policy="told")
    assert list(made(tmp_path).runs) == ["none", "rls", "osi"]
    assert made(tmp_path).costs.loc["osi", "minutes"] == 2.0
    carry(tmp_path, "d", [1.0], told="osi", policy="told")
    assert set(made(tmp_path).runs) == {"none", "none (policy for osi)", "osi", "rls"}
    assert value(made(tmp_path), "rmse", "osi", "as it is", "reference") == "none (policy for osi)"
    carry(tmp_path, "e", [1.0], policy="b/paths")
    carry(tmp_path, "f", [1.0], "rls", policy="b/paths", settings={"rate": 2})
    names = set(made(tmp_path).runs)
    assert names == {"none (a/paths)", "none (b/paths)", "none (train/told)", "osi", "rls, rate=None", "rls, rate=2"}


def test_arms_with_a_policy_each_are_one_row(tmp_path):
    """As where each arm was identified, and trained for, by itself."""
    for seed in (0, 1):
        carry(tmp_path, f"n{seed}", [1.0, 2.0], seed=seed, policy=f"m{seed}")
        carry(tmp_path, f"r{seed}", [1.0, 2.0], "rls", seed=seed, policy=f"m{seed}")
    found = made(tmp_path)
    assert list(found.runs) == ["none", "rls"]
    assert value(found, "rmse", "rls", "as it is", "arms") == 2
    assert found.key == [f"m{k} is the policy of none, rls on twin, make 1, seed {k}" for k in (0, 1)]


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
        "r_old": "done again",
        "fr3": "another robot: robot.name differs",
        "reach": "another task: to reach a goal",
        "few": "another evaluation: evaluation.episodes is 1, not 2",
        "elsewhere": "other goals",
    }
    assert others == {
        "died": "failed",
        "before": "it has no policy.yaml",
        "bare": "no episode on an arm",
        "broken": "unreadable",
    }


@pytest.mark.parametrize(
    ("arm", "words"),
    [
        ({"make": 2, "seed": 7, "payload": 0, "load": None, "friction": 1, "late": 0.0}, "as it is"),
        ({"payload": 1}, "1.0 kg"),
        ({"payload": {"mass": 1}}, "1.0 kg"),
        ({"payload": {"mass": 1.0, "on_s": 2}}, "1.0 kg, on_s=2"),
        ({"payload": {"mass": 0.0, "on_s": 2}}, "as it is"),
        ({"load": 0.5, "friction": 0.8, "late": 0.005}, "told of 0.5 kg, friction 0.8, 5 ms later"),
        ({"stiffness": 10000}, "stiffness 10000.0"),
        ({"soft_start_s": 0.5}, "as it is"),
    ],
)
def test_conditions_in_words(arm, words):
    """Beside make and seed; what is the same reads the same."""
    assert in_words(condition(arm)) == words


def test_conditions_in_order():
    """As it is first, then by what and how much; what is not a twin's own counts where it was typed."""
    asked = [{"friction": 0.8}, {"payload": 1.5}, {}, {"payload": 0.5}]
    assert sorted(asked, key=order) == [{}, {"payload": 0.5}, {"payload": 1.5}, {"friction": 0.8}]
    assert in_words(condition({"soft_start_s": 0.5}, ["arm.soft_start_s"])) == "soft_start_s=0.5"


def test_the_stage_makes_the_league_and_a_training_keeps_it_away(tmp_path):
    """Through the front door; beside a training transfers are left out, and how to get the league is said."""
    runs = tmp_path / "runs"
    for adapt in ("none", "rls"):
        for kg in (0.0, 1.0):
            carry(runs / "transfer", f"{adapt}{kg}", [1.0, 2.0], adapt, payload=kg)
    said = " ".join(succeed("stage=compare", "runs=runs/transfer/*", "name=a", at=tmp_path).split())
    assert "League of adapters: 4 transfers to twin, make 1, seed 0, 2 episodes each" in said
    assert "rls keeps 100 % of its success" in said
    folder = runs / "compare" / "a"
    assert "rls keeps 100 % of its success" in (folder / "report.md").read_text()
    assert len(pd.read_csv(folder / "league.csv")) == 12  # measures, rows, conditions
    write_run(runs / "train" / "t")
    said = " ".join(succeed("stage=compare", "runs=runs/t*/*", "name=b", at=tmp_path).split())
    assert "left out, no finished trainings: none0.0, none1.0, rls0.0, rls1.0 (stage=transfer)" in said
    assert "stage=compare makes the league of transfers where runs= matches no training" in said


def test_no_finished_transfer_is_one_line(tmp_path):
    carry(tmp_path / "runs" / "transfer", "died", [1.0], status="failed")
    one_line(r2s("stage=compare", "runs=runs/transfer/*", at=tmp_path), r"runs: no finished run.*died \(failed\)")
    assert not (tmp_path / "runs" / "compare").exists()
