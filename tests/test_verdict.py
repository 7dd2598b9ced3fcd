"""A verdict before a fit: a defect fails its own line, late signals are measured, expected widths are those found."""

import json
from dataclasses import replace

import numpy as np
import pytest
from conftest import conf
from test_scaling import arm, log_of  # noqa: F401 (a fixture)

from r2s.commands import run_command
from r2s.errors import UserError
from r2s.identification.expected_width import expected_widths
from r2s.identification.identify import identify
from r2s.identification.search.least_squares import LeastSquares
from r2s.identification.settings import Settings
from r2s.identification.verdict import FAIL, PASS, WARN, judge
from r2s.physics.dynamics import nominal_dynamics
from r2s.recordings.recording import Recording

IDENTIFY = conf("identify/default")
LATE_S = 0.01


def settings(torque, **change):
    own = {k: IDENTIFY[k] for k in ("bounds", "cutoff_hz")} | {"prior": IDENTIFY["prior"][torque]}
    terms = ["offset", "delay"] if torque == "commanded" else ["offset", "link"]
    return Settings(**own | {"terms": terms, "family": "coulomb", "breakaway": None, "nthread": 1} | change)


def nominal_of(robot, share=0.02):
    """Return the arm with friction of half of `share` of tau_max at 1 rad/s; the log has 0.11."""
    return nominal_dynamics(robot, **conf("friction/uniform") | {"phi1": (share * robot.tau_max).tolist()})


def judged(robot, recording, **change):
    return judge(robot, nominal_of(robot), recording, settings(recording.torque, **change))


def lines(verdict):
    return {line.check: line for line in verdict.lines}


@pytest.fixture(scope="module")
def robot(arm):  # noqa: F811
    return arm(1.0)


@pytest.fixture(scope="module")
def log(robot):
    return log_of(robot)


@pytest.mark.long
@pytest.mark.parametrize(
    ("torque", "share"),
    [*(pytest.param(*x, marks=pytest.mark.slow) for x in (("measured", 0.18), ("motor", 0.02))), ("commanded", 0.02)],
)
def test_the_expected_widths_are_those_that_the_fit_finds(robot, torque, share):
    """Within a factor of 1.5 where the data determine the value: 512 draws scatter by 5 %, and the noise by more.

    Friction starts 20 % off, within the narrow prior of link-side torque, or ten times too small.
    """
    r, start = log_of(robot, torque), nominal_of(robot, share)
    expected = expected_widths(robot, start, r, settings(torque))
    found = identify(robot, start, r, [LeastSquares(level="torque")], settings(torque))
    assert found.space.names == expected.space.names
    seen = found.found.identifiable
    assert seen.sum() >= 3
    ratio = (expected.width / (found.found.high - found.found.low))[seen]
    assert ratio.min() > 1 / 1.5
    assert ratio.max() < 1.5
    assert (expected.identifiable == seen).mean() > 0.9


def test_a_good_recording_passes_each_line(robot, log):
    verdict = judged(robot, log)
    assert verdict.worst == PASS, [str(line) for line in verdict.warnings]
    assert len({line.check for line in verdict.lines}) == len(verdict.lines) == 12
    verdict.refuse()


DEFECTS = {
    "clock": lambda r: {"t": 2 * r.t},
    "units and signs": lambda r: {"tau": -r.tau},
    "order of joints": lambda r: {"dq": r.dq[:, [1, 0, 2]]},
    "gravity": lambda r: {"torque": "commanded"},
    "joints": lambda r: {"q": r.q + np.array([0, 3, 0])},
}


@pytest.mark.parametrize("check", DEFECTS)
def test_a_defect_fails_its_line_and_is_refused_in_one_line(robot, log, check):
    verdict = judged(robot, replace(log, **DEFECTS[check](log)))
    assert [line.check for line in verdict.fails] == [check]
    with pytest.raises(UserError) as caught:
        verdict.refuse()
    assert str(caught.value) == verdict.fails[0].found
    assert verdict.expected is None


def test_a_rate_below_the_filters_fails_and_a_slow_one_warns(robot, log):
    for every, verdict in (60, FAIL), (20, WARN):
        slow = log.rows(np.arange(0, len(log.t), every), log.trajectory[::every])
        assert lines(judged(robot, slow))["rate"].verdict == verdict


def late(x):
    steps = round(LATE_S * 1000)
    return np.concatenate([np.repeat(x[:1], steps, axis=0), x[:-steps]])


@pytest.mark.long
def test_a_late_signal_is_measured(robot, log):
    """Of 10 ms, within 1 ms; a log without has none."""
    found = lines(judged(robot, replace(log, dq=late(log.dq))))["lateness of dq"]
    assert (found.verdict, "r2s corrects it as a delay" in found.found) == (PASS, True)
    np.testing.assert_allclose(found.values["dq_late_s"], LATE_S, atol=1e-3)
    for terms, verdict in (["signal_delay"], PASS), ([], WARN):
        how = {"terms": ["offset", "link", *terms]}
        found = lines(judged(robot, replace(log, tau=late(log.tau)), **how))["lateness of tau"]
        assert found.verdict == verdict
        assert found.values["tau_late_s"] == pytest.approx(LATE_S, abs=1e-3)


@pytest.mark.long
def test_what_a_motion_lacks_is_named(robot, log):
    """A joint at rest, a motion twice, and friction speeds that are not reached, five times slower."""
    both = (np.tile(x, (2, 1)) for x in (log.q * [1, 1, 0], 0.2 * log.dq * [1, 1, 0], log.tau))
    poor = Recording(np.tile(5 * log.t, 2), *both, "measured", np.repeat([0, 1], len(log.t))).in_phase()
    found = lines(judged(robot, poor))
    assert found["joints"].verdict == found["repeats"].verdict == found["friction speeds"].verdict == WARN
    assert "joint 3 hardly moves" in found["joints"].found
    assert "joint 1, 2, 3 faster than 20 % of dq_max" in found["friction speeds"].advice


@pytest.mark.long
def test_r2s_check_prints_a_table_and_writes_json(robot, log, tmp_path, monkeypatch, capsys):
    """Of a recording that passes, and of one that fails, which ends with one line."""
    log.save(tmp_path / "good.npz")
    replace(log, t=2 * log.t).save(tmp_path / "bad.npz")
    monkeypatch.chdir(tmp_path)
    own = ["robot=other", f"robot.mjcf={robot.mjcf}", "robot.ddq_max=15", "friction.family=coulomb"]
    run_command(["check", "data=recording", "data.path=good.npz", "to=verdict.json", *own])
    page, document = capsys.readouterr().out, json.loads((tmp_path / "verdict.json").read_text())
    for check in document["checks"]:
        assert check["check"] in page
    assert document["verdict"] in (PASS, WARN)
    assert "offset[1]" in document["expected_width95"]
    with pytest.raises(UserError, match=r"q changes 0\.5 times") as caught:
        run_command(["check", "data=recording", "data.path=bad.npz", *own])
    assert "\n" not in str(caught.value)
    assert json.loads((tmp_path / "runs" / "check" / "bad.json").read_text())["verdict"] == FAIL


@pytest.mark.long
@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["data=arm"], "check: expected data=recording data.path=FILE, or data=kinova_gen3"),
        (["data=kinova_gen3", "arm=panda"], "check: expected robot=, data=, .* got 'arm=panda'"),
        (["data=kinova_gen3", "to=x.yaml"], "to: expected FILE.json, got x.yaml"),
        (["data=recording", "data.path=none.npz", "data.torque=measured"], "no file none.npz"),
    ],
)
def test_a_wrong_check_is_one_line(words, line, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UserError, match=line) as caught:
        run_command(["check", *words])
    assert "\n" not in str(caught.value)
    assert not list(tmp_path.iterdir())
