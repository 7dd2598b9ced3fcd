"""A bundle's runtime refuses changed files, other arms, goals and starts of no training; what cannot be exported."""

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch
import yaml
from conftest import conf
from made_bundles import Exported, arm_of, drawn, loaded

from r2s import commands
from r2s.arm.clients import fr3_limits
from r2s.errors import UserError
from r2s.learning.policy import make_policy, save_policy
from r2s.tasks.reach import ReachTask


@pytest.fixture(scope="module")
def exported(tmp_path_factory) -> Exported:
    made = drawn(tmp_path_factory.mktemp("runs") / "train" / "drawn")
    commands.run_command(["export", str(made.run)])
    return made


@pytest.fixture(scope="module")
def runtime(exported) -> ModuleType:
    return loaded(exported.folder)


def edited(exported: Exported, to: Path, change: Callable[[dict], object]) -> Path:
    """Return a copy of the bundle with another contract."""
    shutil.copytree(exported.folder, to)
    contract = json.loads((to / "contract.json").read_text())
    change(contract)
    (to / "contract.json").write_text(json.dumps(contract))
    return to


EDITS: dict[str, Callable[[dict], object]] = {
    "a number of the law": lambda c: c["law"]["joint"]["most"].__setitem__(0, 2.0),
    "a missing row of the law": lambda c: c["law"]["joint"].pop("most"),
    "a missing link": lambda c: c["model"]["links"].pop(),
    "another policy rate": lambda c: c["rates"].update(policy_hz=100),
    "another order of observations": lambda c: c["observation"]["entries"].reverse(),
    "another controller": lambda c: c["control"].update(name="computed_torque"),
}


@pytest.mark.parametrize("kind", EDITS)
def test_a_contract_that_was_edited_is_refused(exported, runtime, tmp_path, kind):
    with pytest.raises(runtime.BundleError, match=r"^contract.json is not what was exported: its seal is another$"):
        runtime.Runtime(edited(exported, tmp_path / "b", EDITS[kind]), runtime.Arm(**arm_of(exported)))


def test_a_runtime_without_the_law_of_a_bundle_refuses_it(exported, runtime, tmp_path):
    """That of another bundle."""

    def change(contract):
        contract["control"]["name"] = "mine"
        contract["seal"] = runtime.seal_of(contract)

    with pytest.raises(runtime.BundleError, match=r"control is 'mine'; this runtime has .*, the r2s_runtime\.py of"):
        runtime.load(edited(exported, tmp_path / "b", change))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda c: c.update(format=1), "is of format 1"),
        (lambda c: c.pop("seal"), "contract.json is damaged: KeyError 'seal'"),
        (lambda c: c["rates"].update(policy_hz=np.nan), "contract.json is damaged: ValueError"),
    ],
)
def test_a_contract_that_cannot_be_read_is_refused(exported, runtime, tmp_path, change, words):
    with pytest.raises(runtime.BundleError, match=words) as refused:
        runtime.load(edited(exported, tmp_path / "b", change))
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("name", ["policy.onnx", "r2s_runtime.py", "model/arm.urdf", "MODEL_CARD.md", "contract.hpp"])
@pytest.mark.parametrize("damage", ["missing", "changed"])
def test_a_file_that_is_missing_or_was_changed_is_refused(exported, runtime, tmp_path, name, damage):
    folder = shutil.copytree(exported.folder, tmp_path / "b")
    content = (folder / name).read_bytes()
    (folder / name).unlink()
    if damage == "changed":
        (folder / name).write_bytes(content[:-1] + b"?")
    with pytest.raises(runtime.BundleError, match=name) as refused:
        runtime.load(folder)
    assert ("is missing" if damage == "missing" else "its sha256 is another") in str(refused.value)


@pytest.mark.parametrize("content", [b"", b"{", b"[]", b"null", b'{"format": 1}', b"\xff"])
def test_a_damaged_contract_is_refused(runtime, tmp_path, content):
    (tmp_path / "contract.json").write_bytes(content)
    with pytest.raises(runtime.BundleError) as refused:
        runtime.load(tmp_path)
    assert "\n" not in str(refused.value)


OTHER_ARMS = {
    "joints": ([f"joint{j}" for j in range(1, 7)], "expected 7 joints, got 6 of the arm"),
    "cycle_hz": (500, "expected 1000 Hz, got 500 Hz of the arm"),
    "torque": ("with gravity", "expected torque 'without gravity', got 'with gravity' of the arm"),
    "tau_max": ([87.0, 87.0, 50.0, 87.0, 12.0, 12.0, 12.0], "tau_max of joint 3: the arm allows 50 Nm"),
    "dtau_max": ([999.0] * 7, "dtau_max of joint 1: the arm allows 999 Nm/s"),
    "dq_max": ([2.175] * 7, "dq_max of joint 5: the arm allows 2.175 rad/s"),
    "q_max": ([2.8] * 7, "q_max of joint 1: the arm allows 2.8 rad"),
    "q_min": ([-2.0] * 6, "expected 7 values of q_min, got 6 of the arm"),
}


@pytest.mark.parametrize("name", OTHER_ARMS)
def test_another_arm_is_refused(exported, runtime, name):
    value, words = OTHER_ARMS[name]
    with pytest.raises(runtime.BundleError) as refused:
        runtime.Runtime(exported.folder, runtime.Arm(**arm_of(exported, **{name: value})))
    assert words in str(refused.value)


@pytest.mark.parametrize(
    ("point", "words"),
    [
        ([0.1, 0.0, 0.4], "the goal is 0.120 m from the shoulder; the training had 0.300 to 0.750 m"),
        ([2.0, 0.0, 0.4], "m from the shoulder; the training had"),
        ([0.5, 0.1, 0.05], "the goal is at a height of 0.050 m; the training had 0.1 m and more"),
        ([-0.5, 0.2, 0.4], "rad to the side; the training had up to 1.57 rad"),
        ([0.5, np.nan, 0.4], "the goal is not finite"),
    ],
)
def test_a_goal_that_the_training_did_not_have_is_refused(exported, runtime, point, words):
    """Before a motion in one line; in a motion the arm is brought to rest, and the first reason is kept."""
    other = runtime.Runtime(exported.folder, runtime.Arm(**arm_of(exported)))
    home, still = exported.robot.q_home, np.zeros(7)
    with pytest.raises(runtime.BundleError, match=words):
        other(home, still, still, np.array(point))
    other.reset()
    other(home, still, still, np.array([0.5, 0.1, 0.4]))
    assert other.driver.stopping is None
    other(home, still, still, np.array(point))
    assert re.search(words, other.driver.stopping)
    with pytest.raises(runtime.BundleError, match=r"^the motion is over, the goal is .*: call reset"):
        other(home, still, still, np.array(point))  # at rest: nothing more is commanded


def test_the_goals_of_the_training_are_not_refused(exported, runtime):
    other = runtime.Runtime(exported.folder, runtime.Arm(**arm_of(exported)))
    trained = other.contract["goal"]["trained"]
    goals = exported.task.goals(exported.robot, np.random.default_rng(1), 500)
    assert [why for goal in goals if (why := runtime.outside(trained, goal))] == []


def test_a_motion_begins_at_rest_where_those_of_the_training_did(exported, runtime):
    other = runtime.Runtime(exported.folder, runtime.Arm(**arm_of(exported)))
    home, still, goal = exported.robot.q_home, np.zeros(7), np.array([0.5, 0.1, 0.4])
    for off, dq, words in (
        (0.2, 0.0, r"joint 3 is at 0.200 rad; motions begin within 0.15 rad of 0.000"),
        (0.0, 0.3, r"joint 3 moves at 0.300 rad/s; motions begin at rest"),
        (np.nan, 0.0, "the arm's state is not finite"),
    ):
        other.reset()
        with pytest.raises(runtime.BundleError, match=words):
            other(home + off * np.eye(7)[2], still + dq * np.eye(7)[2], still, goal)
    other(home + 0.14, still, still, goal)


def test_an_arm_that_slows_before_its_limits_refuses_a_bundle_that_does_not(exported, runtime):
    """A Panda's bundle on an arm with an FR3's speed law."""
    slows = fr3_limits.DECELERATION, fr3_limits.VELOCITY_OFFSET
    with pytest.raises(runtime.BundleError, match=r"rad before a limit of joint . the arm allows .* another arm"):
        runtime.Runtime(exported.folder, runtime.Arm(**arm_of(exported), slows=slows))


@pytest.mark.long
def test_the_bundle_of_an_fr3_runs_on_an_fr3(tmp_path):
    made = drawn(tmp_path / "train" / "fr3", "robot=fr3")
    commands.run_command(["export", str(made.run)])
    runtime = loaded(made.folder)
    slows = fr3_limits.DECELERATION, fr3_limits.VELOCITY_OFFSET
    runtime.Runtime(made.folder, runtime.Arm(**arm_of(made), slows=slows))


def test_states_of_another_size_are_refused(exported, runtime):
    other = runtime.Runtime(exported.folder, runtime.Arm(**arm_of(exported)))
    with pytest.raises(runtime.BundleError, match="7 joints and 3 are allowed"):
        other(np.zeros(6), np.zeros(6), np.zeros(6), np.zeros(3))
    with pytest.raises(runtime.BundleError, match=r"\(7,\), None; 7 joints and 3 are allowed"):
        other(np.zeros(7), np.zeros(7), np.zeros(7))
    with pytest.raises(runtime.BundleError, match="takes a point in every cycle, and no plan"):
        other.reset(np.zeros((404, 27)))


def test_what_cannot_be_exported_says_so(exported, tmp_path, monkeypatch):
    """A bundle that is there, a run that is none, a controller, another policy.onnx, a task without words."""

    def refused(words: str, run: Path, *more: str) -> None:
        with pytest.raises(UserError, match=words):
            commands.run_command(["export", str(run), *more])

    refused("bundle exists", exported.run)
    refused("^export: .* is no finished run folder of stage=train", tmp_path / "nothing")
    run = shutil.copytree(exported.run, tmp_path / "run", ignore=shutil.ignore_patterns("bundle"))
    (run / "policy.onnx").write_bytes(b"no")
    refused("policy.onnx is damaged|policy.onnx", run, f"to={tmp_path / 'to'}")
    shutil.copy(exported.run / "policy.onnx", run)
    with torch.no_grad():
        other = make_policy(exported.robot, exported.task, (16, 16))
    save_policy(run, other)
    refused("is not its policy.pt", run, f"to={tmp_path / 'to'}")
    monkeypatch.delattr(ReachTask, "observation_terms")
    refused("ReachTask does not describe its observations", run)
    config = yaml.safe_load((run / "config.yaml").read_text())
    config["algo"] = {"_target_": "r2s.learning.model_based.Oracle", **conf("algo/oracle")}
    (run / "config.yaml").write_text(yaml.safe_dump(config))
    refused("algo=oracle has no network to export", run)
    assert {p.name for p in tmp_path.iterdir()} == {"run"}
    assert not [p for p in run.iterdir() if "part" in p.name]
