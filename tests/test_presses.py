"""Presses recorded on a twin, the surface identified from them, and the chain of a task on a surface."""

import json
from collections import deque
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest
import yaml
from cli_runs import TOY, r2s, succeed
from hydra import compose, initialize_config_dir
from hydra.core.hydra_config import HydraConfig
from test_press import DR_CONF, PANDA, TRUE

from r2s.arm.interface import ArmState, ArmStopped
from r2s.arm.presses import LOADS, PAUSE_S, _recording, press_plan, record_presses
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


@contextmanager
def composed(*words):
    """Yield the config of a pipeline and its overrides, with Hydra ready to compose the config of each command."""
    words = ["stage=pipeline", *words]
    with initialize_config_dir(str(CONF.resolve()), version_base="1.3"):
        HydraConfig.instance().set_config(compose("config", words, return_hydra_config=True))
        yield pipeline.compose_step(words, "stage=pipeline"), words


def steps_of(*words):
    """Return the commands of a pipeline."""
    with composed(*words) as (cfg, typed):
        return pipeline.commands(cfg, "a", typed)


def test_changes_for_an_adapter_act_only_in_transfers():
    """Arm and surface are identified without the payload that the adapter has to estimate."""
    arm, surface, _, transfers = steps_of("task=press", "adapt=rls", "arm.payload=1")
    assert "data.presses=6" in surface["surface"]
    assert not [w for w in arm["identify"] + surface["surface"] if w.startswith("arm.payload")]
    assert all("arm.payload=1" in transfers[label] for label in ("identified", "adapted"))


def test_safety_reaches_the_presses_of_a_pipeline():
    """The limits of a pipeline hold for its presses too; free motion touches nothing."""
    limits = ["safety.force_max=40", "safety.speed_near=0.03"]
    arm, surface, *_ = steps_of("task=press", *limits)
    assert set(limits) <= set(surface["surface"])
    assert not set(limits) & set(arm["identify"])


def test_a_physical_arm_keeps_its_declared_payload():
    """Its control box compensates the payload in every motion."""
    first, *_ = steps_of("task=track", "adapt=rls", "arm=panda", "arm.address=x", "arm.declared_payload=0.7")
    assert "arm.declared_payload=0.7" in first["identify"]


@pytest.mark.parametrize("words", [["task=push"], ["task=track", "adapt=rls"]])
def test_a_controller_without_training_gets_no_budget(words):
    _, *_, trained, _ = steps_of(*words, "pipeline.train_minutes=null", "budget.env_steps=9000")
    learn = [label for label, own in trained.items() if "budget.env_steps=9000" in own]
    assert learn == ["identified", "nominal"]


def test_the_box_of_a_push_is_no_surface_of_the_identification():
    """The identification moves the arm without a tool."""
    first, *_, transfers = steps_of("task=push", "arm.surface=box")
    assert not [w for w in first["identify"] if w.startswith("arm.surface")]
    assert "arm.surface=box" in transfers["reference"]


@pytest.mark.long
def test_every_training_is_checked_before_the_arm_moves(monkeypatch):
    """Also a training that needs the identified model: what it does not read, and a controller that it refuses."""
    monkeypatch.setattr(pipeline.identify, "make_parts", lambda cfg: None)
    with (
        composed("task=track", "adapt=rls", "control=cartesian_impedance") as given,
        pytest.raises(UserError, match=r"algo: computed_torque cannot do .* control=cartesian_impedance"),
    ):
        pipeline.check_steps(*given)
    monkeypatch.setattr(pipeline, "UNLEARNED", [w for w in pipeline.UNLEARNED if w != "budget"])
    with (
        composed("task=push", "pipeline.train_minutes=null", "budget.env_steps=9000") as given,
        pytest.raises(UserError, match=r"'reference': budget.env_steps: .* nothing is trained"),
    ):
        pipeline.check_steps(*given)


def test_the_time_of_presses_is_the_arms_clock():
    """A lost cycle is a step of 2 ms; the arm's clock starts again with each path, and the recording's goes on."""
    zeros, clock = np.zeros(7), [0.0, 0.001, 0.003, 0.004, 0.005, 0.006]
    log = deque((ArmState(t, zeros, zeros, zeros, zeros), zeros) for t in [*clock, *clock])
    recording = _recording(log, [0, 6, 12], "panda")
    steps = [0.001, 0.002, 0.001, 0.001, 0.001]
    np.testing.assert_allclose(np.diff(recording.t), [*steps, PAUSE_S + SIM_DT, *steps])


def test_presses_obey_the_safety_limits():
    """The driver gets the limit, and the plan requests no more than it allows; a limit too low is one line."""
    free, limited = press_plan(PANDA, TRUE), press_plan(PANDA, TRUE, force_max=30.0, speed_near=0.03)
    assert free.push_limit is None
    assert (limited.push_limit.force_max, limited.push_limit.speed_near) == (30.0, 0.03)
    hidden = limited.push_limit.at(PANDA, TRUE.level, PANDA.q_home)[1]
    assert limited.force[1] == pytest.approx(30.0 - 2 * hidden)
    assert limited.force[1] < free.force[1]
    assert limited.force[1] / limited.force[0] == pytest.approx(free.force[1] / free.force[0])
    with pytest.raises(UserError, match=r"^safety.force_max: 12 N is not allowed with data.presses; 18.6 N or more"):
        press_plan(PANDA, TRUE, force_max=12.0)


@pytest.mark.long
def test_a_limit_acts_while_the_arm_presses_and_when_a_path_ends():
    """The force on a twin stays below the limit, and the tip has left the surface before the next start."""
    plan = replace(press_plan(PANDA, TRUE, force_max=30.0), episode_s=4.5)
    plan = plan.pushing_within(PANDA, TRUE.level, 30.0, 0.03)
    twin, forces, starts = make_twin(PANDA, surface=True), [], []
    send, move_to = twin.command, twin.move_to

    def force():
        return abs(twin._touch.contact[FORCE : FORCE + 3] @ plan.plane(PANDA)[1])

    def command(tau):
        forces.append(force())
        send(tau)

    def place(q):
        starts.append(force())
        return move_to(q)

    twin.command, twin.move_to = command, place
    recording = record_presses(twin, plan, TRUE, 2)
    assert 5.0 < max(forces) < 30.0
    assert max(starts) < 5.0
    assert len(recording.t) > 2 * round(plan.episode_s / SIM_DT)  # the rows in which the tip leaves the surface
    assert (np.diff(recording.t) > 0).all()


@pytest.mark.slow
@pytest.mark.parametrize("task", ["press", "wipe"])
def test_the_pipeline_identifies_arm_and_surface(task, tmp_path):
    """Free motion and presses are recorded, both are identified, and what is trained on them runs on the twin."""
    words = [*TOY, f"task={task}", "pipeline.train_minutes=null", "data.seconds=10", "evaluation.episodes=2"]
    succeed("stage=pipeline", *words, f"root={tmp_path}", "name=a")
    summary = json.loads((tmp_path / "pipeline/a/summary.json").read_text())
    truth = slope_at_10_newton(make_twin(PANDA, surface=True)._touch.contact)
    assert summary["contact"]["slope_N_per_m"] == pytest.approx(truth, rel=0.1)  # 10 s of motion identify the arm
    rows = {"identified model, twin", "nominal model, twin", "controller without learning, identified model, twin"}
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
