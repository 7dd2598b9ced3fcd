"""Commands reach other arms: an FR3, six joints, the clients that drive hardware, a Panda's real recording.

A transfer warns of an arm that rests less than predicted; a pipeline moves a physical one by one command at a time.
"""

# ruff: noqa: F811 (the arguments are fixtures of cli_runs.py)

import json
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from cli_runs import TOY, root, succeed  # noqa: F401 (a fixture)
from conftest import REAL, conf

from r2s.arm.clients import fr3_limits
from r2s.stages import pipeline
from r2s.stages.transfer import rest_warning


@pytest.mark.slow
def test_a_policy_for_an_fr3_meets_one(root):
    """Trained with its limits, which are those of the emulator, and through its client without a stop."""
    pytest.importorskip("pylibfranka")
    succeed("robot=fr3", "name=fr3", f"root={root}", *TOY)
    config = yaml.safe_load((root / "train" / "fr3" / "config.yaml").read_text())["robot"]
    np.testing.assert_array_equal(config["q_min"], fr3_limits.Q_MIN)
    np.testing.assert_array_equal(config["q_max"], fr3_limits.Q_MAX)
    np.testing.assert_array_equal(config["dq_max"], fr3_limits.DQ_MAX)
    words = ["arm=fr3_emulated", "simulator=none", "evaluation.episodes=1", "name=fr3", f"root={root}"]
    succeed("stage=transfer", f"policy={root / 'train' / 'fr3'}", *words, *TOY)
    assert (root / "transfer" / "fr3" / "stops.txt").read_text() == "none\n"


@pytest.mark.slow
def test_another_arm_needs_no_more_than_its_file(root):
    """Six joints, their own limits, no published friction: the pipeline ends with its table."""
    arm = Path(__file__).parent / "models" / "six_joints.xml"
    words = ["robot=other", f"robot.mjcf={arm}", "pipeline.train_minutes=null", "name=six", f"root={root}", *TOY]
    out = succeed("stage=pipeline", *words)
    assert all(
        f"{model} model, {where}" in out for model in ("identified", "nominal") for where in ("mujoco", "twin")
    )
    config = yaml.safe_load((root / "train" / "six_nominal" / "config.yaml").read_text())
    assert config["friction"]["phi1"] == conf("friction/uniform")["phi1"]
    parameters = yaml.safe_load((root / "identify" / "six" / "parameters.yaml").read_text())
    assert parameters["joints"] == len(parameters["parameters"]["phi1"]["value"]) == 6


@pytest.mark.long
@pytest.mark.parametrize(
    ("arm", "package"),
    [
        ("panda_emulated", "panda_py"),
        pytest.param(
            "fr3_emulated", "pylibfranka", marks=pytest.mark.slow
        ),  # above: once, with a policy of its own, also slow
    ],
)
def test_a_policy_through_the_client_that_drives_hardware(arm, package, tmp_path):
    """The whole way, in lock-step against the emulator of the control box: no stop, and twice the same to the bit."""
    pytest.importorskip(package)
    root = tmp_path / "runs"
    succeed("name=gentle", f"root={root}", "algo.demonstrations=0", *TOY)  # of demonstrations it would learn to move
    gentle = root / "train" / "gentle"
    saved = torch.load(gentle / "policy.pt", weights_only=True)
    for name in ("actor.body.4.weight", "actor.body.4.bias"):  # a tenth: it would drift into the fence of the table
        saved["state"][name] *= 0.1
    torch.save(saved, gentle / "policy.pt")
    runs = []
    for k in range(2):
        words = [f"arm={arm}", "simulator=none", "evaluation.episodes=1", f"name={arm}_{k}"]
        succeed("stage=transfer", f"policy={gentle}", f"root={root}", *words, *TOY)
        folder = root / "transfer" / f"{arm}_{k}"
        assert (folder / "stops.txt").read_text() == "none\n"
        with np.load(folder / f"episodes_{arm}.npz") as episodes:
            runs.append({key: episodes[key] for key in episodes.files})
    assert np.ptp(runs[0]["q"], axis=1).max() > 1e-3  # it moved
    for key, values in runs[0].items():
        np.testing.assert_array_equal(runs[1][key], values)


def test_a_policy_that_rests_less_than_predicted_raises_a_warning():
    """No warning without a prediction, or if the task has no such measure."""
    rows = {"predicted": {"rest": 1.0}, "twin": {"rest": 0.49}}
    assert "51 % of the episodes on arm=twin" in rest_warning(rows, "twin")
    assert rest_warning(rows | {"twin": {"rest": 0.98}}, "twin") is None
    assert rest_warning({"twin": {"rest": 0.49}}, "twin") is None
    stopped = {"rest": 0.75, "stops": 1, "episodes": 4}  # only a stop, no moving joint
    assert rest_warning(rows | {"twin": stopped}, "twin") is None
    assert "25 % of" in rest_warning(rows | {"twin": stopped | {"rest": 0.5}}, "twin")
    assert rest_warning({"predicted": {}, "twin": {}}, "twin") is None


def test_a_pipeline_moves_a_physical_arm_with_one_command_at_a_time():
    """Twins and emulated arms are as many as the transfers; a physical arm accepts one client."""
    step = {"identified": ["stage=transfer"], "nominal": ["stage=transfer"]}
    assert pipeline.at_once(step, moves=True) == [{label: words} for label, words in step.items()]
    assert pipeline.at_once(step, moves=False) == [step]


@pytest.mark.slow  # test_identify.py has it without the command
@pytest.mark.skipif(not REAL.is_file(), reason="the real Panda recording is not beside this checkout")
def test_real_panda_is_predicted_better_than_by_the_published_model(tmp_path):
    """The command on the real recording: held-out torque improves on average over the joints."""
    succeed(
        "stage=identify",
        "data=recording",
        f"data.path={REAL}",
        "data.torque=measured",
        "name=real",
        f"root={tmp_path}",
    )
    validation = json.loads((tmp_path / "identify" / "real" / "summary.json").read_text())["validation"]
    assert np.mean(validation["torque_rmse_Nm"]) < 0.75 * np.mean(validation["nominal_torque_rmse_Nm"])
    assert np.all(np.array(validation["torque_rmse_Nm"]) <= 1.02 * np.array(validation["nominal_torque_rmse_Nm"]))
