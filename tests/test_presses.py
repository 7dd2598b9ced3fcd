"""Presses recorded on a twin, the surface identified from them, and the chain of a task on a surface."""

import json
from dataclasses import replace

import numpy as np
import pytest
import yaml
from hydra import compose, initialize_config_dir
from hydra.core.hydra_config import HydraConfig
from test_cli import TOY, r2s, succeed
from test_press import DR_CONF, PANDA, TRUE

from r2s.arm.interface import ArmStopped
from r2s.arm.presses import LOADS, PAUSE_S, press_plan, record_presses
from r2s.arm.twins.make_twin import make_twin
from r2s.errors import UserError
from r2s.identification.contact.exchange import linearized
from r2s.learning.randomization import ContactRandomization
from r2s.physics.contact_layout import EXPONENT, FORCE, K
from r2s.physics.impedance import FORCE_MAX
from r2s.physics.robot import SIM_DT
from r2s.stages import pipeline
from r2s.stages.build import CONF
from r2s.stages.data import ArmData


@pytest.mark.long
def test_presses_load_the_surface_along_paths():
    """One path rises from the least to the most force, the next one falls; the rows are commands on one clock."""
    plan = replace(press_plan(PANDA, TRUE), episode_s=4.5)
    twin, forces = make_twin(PANDA, surface=True), []
    send = twin.command

    def command(tau):
        forces.append(-twin._touch.contact[FORCE : FORCE + 3] @ plan.plane(PANDA)[1])
        send(tau)

    twin.command = command
    recording = record_presses(twin, plan, TRUE, 2)
    assert recording.torque == "commanded"
    rows = round(plan.episode_s / SIM_DT)
    np.testing.assert_array_equal(recording.trajectory, np.repeat([0, 1], rows))
    steps = np.diff(recording.t)
    assert steps[rows - 1] == pytest.approx(PAUSE_S + SIM_DT)
    np.testing.assert_allclose(np.delete(steps, rows - 1), SIM_DT)
    low, high = (share * plan.own.parameters[FORCE_MAX] for share in LOADS)
    assert plan.force == (low, high)
    pressed = np.abs(np.array(forces)).reshape(2, -1)[:, :rows]
    begin = round(plan.begin_s / SIM_DT)
    # the model is of another arm: within 4 N, less than the range of 14 N
    ends = [[pressed[k, begin : begin + 200].mean(), pressed[k, -200:].mean()] for k in (0, 1)]
    np.testing.assert_allclose(ends, [[low, high], [high, low]], atol=4.0)


@pytest.mark.long
def test_late_commands_in_any_path_end_the_presses():
    """The arm got 90 % of its commands in time in the first path, all in the second: no recording."""
    plan = replace(press_plan(PANDA, TRUE), episode_s=4.0)
    twin, paths = make_twin(PANDA, surface=True), []
    read, move_to, twin.realtime = twin.read, twin.move_to, True

    def place(q):
        paths.append(q)
        return move_to(q)

    twin.read = lambda: replace(read(), control_command_success_rate=0.9 if len(paths) == 1 else 1.0)
    twin.move_to = place
    with pytest.raises(ArmStopped, match=r"^the arm got 90\.0 % of its commands in time, at least 99 % are needed$"):
        record_presses(twin, plan, TRUE, 2)


def test_too_few_presses_are_one_line():
    data = {"kind": "arm", "torque": "commanded", "seconds": 5.0, "excitation_seed": 0, "excitation": None}
    with pytest.raises(UserError, match=r"data.presses: expected 0, or at least 4: .* got 3$"):
        ArmData(**data, ramp_poses=0, presses=3)
    done = r2s("stage=identify", "data.presses=6")
    assert done.returncode == 2
    assert "data.presses: give the arm, identified from free motion, by calibration=" in done.stdout + done.stderr


def slope_at_10_newton(contact):
    """Return dF/dd, N/m, of F = K d^e at 10 N, of a row of `contact_columns`."""
    k, e = contact[K], contact[EXPONENT]
    return e * k ** (1 / e) * 10.0 ** (1 - 1 / e)


def test_changes_for_an_adapter_act_only_in_transfers():
    """Arm and surface are identified without the payload that the adapter has to estimate."""
    words = ["stage=pipeline", "task=press", "adapt=rls", "arm.payload=1"]
    with initialize_config_dir(str(CONF.resolve()), version_base="1.3"):
        config = compose("config", words, return_hydra_config=True)
        HydraConfig.instance().set_config(config)
        cfg = pipeline.compose_step(words, "stage=pipeline")
        arm, surface, _, transfers = pipeline.commands(cfg, "a", words)
    assert "data.presses=6" in surface["surface"]
    assert not [w for w in arm["identify"] + surface["surface"] if w.startswith("arm.payload")]
    assert all("arm.payload=1" in transfers[label] for label in ("identified", "adapted"))


@pytest.mark.slow
@pytest.mark.parametrize("task", ["press", "wipe"])
def test_the_pipeline_identifies_arm_and_surface(task, tmp_path):
    """Free motion and presses are recorded, both are identified, and what is trained on them runs on the twin."""
    words = [*TOY, f"task={task}", "pipeline.train_minutes=null", "data.seconds=10", "evaluation.episodes=2"]
    succeed("stage=pipeline", *words, f"root={tmp_path}", "name=a")
    summary = json.loads((tmp_path / "pipeline/a/summary.json").read_text())
    truth = slope_at_10_newton(make_twin(PANDA, surface=True)._touch.contact)
    assert summary["contact"]["slope_N_per_m"] == pytest.approx(truth, rel=0.1)  # 10 s of motion identify the arm
    rows = {"identified model, twin", "nominal model, twin", "hybrid control, identified model, twin"}
    assert rows <= set(summary["reach"])
    assert all(summary["reach"][row]["contact"] > 0.9 for row in rows)
    assert (tmp_path / "identify/a_surface/contact.npz").is_file()
    trained = tmp_path / "train/a_identified"
    config = yaml.safe_load((trained / "config.yaml").read_text())
    assert config["dr"]["surface"] == str(tmp_path / "identify/a_surface")
    if task == "wipe":
        assert config["task"]["friction"] == pytest.approx(summary["contact"]["friction"], rel=1e-3)
    draw = ContactRandomization(PANDA, TRUE, **DR_CONF | {"surface": str(trained)})(np.random.default_rng(0), 200)
    slopes = [linearized(draw.surface.one(k))[0] for k in range(200)]
    low, high = summary["contact"]["slope_interval95_N_per_m"]
    assert np.mean((low <= np.array(slopes)) & (np.array(slopes) <= high)) > 0.85  # 95 % of more draws
