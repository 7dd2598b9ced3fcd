"""Estimates from a recording: the stage's files, pauses by the clock, and one line for what cannot be used."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from omegaconf import OmegaConf
from test_adaptation import accurate, recording, robot, truth

from r2s.adaptation.arm_model import make_arm_model
from r2s.adaptation.estimator import Estimator
from r2s.adaptation.momentum import BODY
from r2s.adaptation.noise_model import default_noise
from r2s.adaptation.offline_estimation import UNKNOWN_PAUSE_S, at_rate, estimate_recording, pauses, table
from r2s.adaptation.tuning import SPAN
from r2s.errors import UserError
from r2s.physics.robot import SIM_DT
from r2s.recordings.recording import Recording
from r2s.stages.adapter_factory import with_declared_payload
from r2s.stages.estimate import calibrated_by_commands, compensated, given_recording


def test_the_same_data_give_the_same_estimate():
    arm, noise = accurate()
    first, second = (table(estimate_recording(robot(), Estimator(arm, noise), recording(on=0.0))) for _ in range(2))
    assert first.equals(second)


def test_an_unsuitable_recording_gets_one_line():
    data = recording()
    with pytest.raises(UserError, match="expected commanded, got measured"):
        at_rate(robot(), replace(data, torque="measured"))
    slow = Recording(t=data.t[::10], q=data.q[::10], dq=data.dq[::10], tau=data.tau[::10], torque="commanded")
    with pytest.raises(UserError, match="expected at least 200 Hz, got 100 Hz"):
        at_rate(robot(), slow)
    with pytest.raises(UserError, match="expected 7 joints of panda, got 6"):
        at_rate(
            robot(), Recording(t=data.t, q=data.q[:, :6], dq=data.dq[:, :6], tau=data.tau[:, :6], torque="commanded")
        )
    arm, noise = accurate()
    estimator = Estimator(arm, noise)
    with pytest.raises(UserError, match=r"expected q, dq and tau of 7 joints, got \(6,\)"):
        estimator(np.zeros(6), np.zeros(6), np.zeros(6))
    assert not estimator(np.full(7, np.nan), np.zeros(7), np.zeros(7))


@pytest.mark.slow
def test_the_stage_estimates_from_a_recording(tmp_path, capsys):
    """stage=estimate data=recording writes lines, estimate.csv, figures and a summary; mistakes get one line."""
    from hydra import compose, initialize_config_dir

    from r2s.stages.build import CONF
    from r2s.stages.estimate import estimate

    recording(on=1.0, off=2.0, noise=2e-3).save(tmp_path / "work.npz")
    words = ["stage=estimate", "data=recording", f"data.path={tmp_path / 'work.npz'}", f"root={tmp_path}", "name=w"]

    def config(*others):
        with initialize_config_dir(str(CONF.resolve()), version_base="1.3"):
            return compose("config", [*words, *others])

    with pytest.raises(UserError, match=r"data\.torque: expected commanded for stage=estimate, got measured"):
        estimate(config("data.torque=measured"), [])
    with pytest.raises(UserError, match=r"no file .*wrk.npz; did you mean 'work.npz'"):
        estimate(config("data.torque=commanded", f"data.path={tmp_path / 'wrk.npz'}"), [])
    assert not (tmp_path / "estimate").exists()
    estimate(config("data.torque=commanded"), [])
    folder = tmp_path / "estimate" / "w"
    assert "kg" in capsys.readouterr().out
    written = ("estimate.csv", "wrench.csv", "recording.rrd", "figures/payload.png", "figures/wrench.png")
    assert all((folder / name).is_file() for name in written)
    with pytest.raises(UserError, match=r"^robot\.tool: estimate\.surface needs the tip that touches"):
        estimate(config("data.torque=commanded", f"estimate.surface={tmp_path}"), [])
    rows = pd.read_csv(folder / "estimate.csv")
    before = rows.iloc[round(1.9 / (SPAN * SIM_DT))]
    # without calibration= no delay is known: 3 ms of it cause torque errors in every acceleration
    assert abs(before["mass_kg"] - 1.0) < 2 * before["mass_kg_half"]


def given(*words):
    """Return a config of stage=estimate data=recording with overrides "KEY=VALUE"."""
    data = {"kind": "recording", "path": "a.npz", "torque": "commanded", "payload": None, "loaded": None}
    cfg = OmegaConf.create({"data": {**data, "declared_payload": None}, "calibration": None})
    return OmegaConf.merge(cfg, OmegaConf.from_dotlist(list(words)))


def test_a_load_that_was_compensated_during_the_identification_is_not_compensated_twice(tmp_path):
    """The identified model lacks it; what counts is the change of the declared payload since."""
    arm = {"name": "panda", "declared_payload": 0.7}
    OmegaConf.save(
        OmegaConf.create({"stage": "identify", "data": {"kind": "arm"}, "arm": arm}), tmp_path / "config.yaml"
    )
    for now, mass in ((0.7, 0.0), (1.0, 0.3), (None, -0.7)):
        cfg = OmegaConf.create({"arm": arm | {"declared_payload": now}})
        found = with_declared_payload(cfg, robot(), truth(), tmp_path / "parameters.yaml")
        assert found.declared_payload[0] == pytest.approx(mass)
        assert with_declared_payload(cfg, robot(), truth(), None).declared_payload[0] == (now or 0.0)


def test_a_recording_has_its_declared_payload():
    """Gravity compensation removed its weight from the commands; a payload to be identified is none of this stage."""
    found = compensated(given("data.declared_payload=2.0"), robot(), truth())
    assert found.declared_payload[0] == 2.0
    assert not compensated(given(), robot(), truth()).declared_payload.any()
    with pytest.raises(UserError, match=r"^data\.declared_payload: expected a number in \[0, 3\], got 99"):
        compensated(given("data.declared_payload=99"), robot(), truth())
    for key in ("payload", "loaded"):
        with pytest.raises(
            UserError, match=rf"^data\.{key}: stage=estimate finds the payload itself, got 2\.0; leave"
        ):
            given_recording(given(f"data.{key}=2.0"), robot())


def test_an_estimate_needs_a_model_from_commanded_torque(tmp_path):
    """Like an adapter; also if the folder has the recordings."""
    (tmp_path / "parameters.yaml").write_text("source: {torque: measured}\n")
    (tmp_path / "train.npz").touch()
    with pytest.raises(UserError, match=r"^calibration: .* data\.torque=commanded, got measured \("):
        calibrated_by_commands(given(f"calibration={tmp_path}"), robot())


@pytest.mark.slow
def test_the_old_name_of_the_stage_gives_the_new_one():
    from r2s.override_checks import check_overrides

    with pytest.raises(UserError, match=r"^stage=watch is now stage=estimate$"):
        check_overrides(["stage=watch"], None)


def test_a_pause_widens_the_estimate_by_the_clock():
    """Ten seconds without rows add the drift of ten seconds, a restarted clock that of a minute, and `t` has both."""
    data, half = recording(noise=2e-3), round(1.5 / SIM_DT)
    arm = make_arm_model(robot(), truth())
    noise, trajectory = default_noise(arm), np.arange(len(data.t)) // half
    offset, after = BODY + 7, {}
    for pause in (0.0, 10.0, -1.5):  # s
        cut = replace(data, t=data.t + pause * trajectory, trajectory=trajectory)
        assert pauses(cut)[1] == pytest.approx(max(pause + SIM_DT, 0.0) or UNKNOWN_PAUSE_S)
        estimator = Estimator(arm, noise)
        estimates = estimate_recording(robot(), estimator, cut.select(cut.trajectory == 0))
        before = estimator.internals[0].P.diagonal().copy()
        estimator.begin(pauses(cut)[1])
        after[pause] = estimator.internals[0].P.diagonal() - before
        assert estimator.now.t == pytest.approx(estimates[-1].t + pauses(cut)[1], abs=2 * SPAN * SIM_DT)
    for pause, seconds in ((10.0, 10.0 + SIM_DT), (-1.5, UNKNOWN_PAUSE_S)):
        np.testing.assert_allclose(after[pause][offset : offset + 7], seconds * noise.offset_drift**2, rtol=1e-9)
        np.testing.assert_allclose(after[pause][BODY:offset], seconds * noise.friction_drift**2, rtol=1e-9)
    assert after[10.0][0] > 0.1 * noise.prior[0] ** 2  # the payload may have been changed unseen
