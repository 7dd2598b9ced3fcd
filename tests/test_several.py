"""The stage and `r2s check` take one recording, a list or a pattern, each with its own torque, rate and payload."""

import json

import numpy as np
import pytest
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf
from test_known import PHI, TOOL, log, nominal, robot, truth  # noqa: F401 (fixtures)

from r2s.commands import run_command
from r2s.errors import UserError
from r2s.override_checks import extended
from r2s.stages.build import CONF
from r2s.stages.identify import identify, make_parts

A = "cold/a.npz"


@pytest.fixture(scope="module")
def folder(tmp_path_factory, robot, truth):  # noqa: F811
    """A folder with two logs, a slow one, one with a tool, and one of a warm arm."""
    place = tmp_path_factory.mktemp("logs")
    (place / "cold").mkdir()
    first, second = (log(robot, truth, k) for k in (0, 1))
    first.save(place / "cold" / "a.npz")
    second.save(place / "cold" / "b.npz")
    slow = second.rows(np.arange(0, len(second.t), 4), second.trajectory[::4])
    np.savetxt(
        place / "slow.csv",
        np.column_stack([slow.t, slow.q, slow.dq, slow.tau]),
        delimiter=",",
        header=",".join(["t", *(f"{x}{j}" for x in ("q", "dq", "tau") for j in (1, 2, 3))]),
        comments="",
    )
    log(robot, truth, 2, payload=TOOL).save(place / "tool.npz")
    log(robot, nominal_friction(truth), 3, "measured").save(place / "sensor.npz")
    warm = type(truth)(**{**vars(truth), "phi": PHI * [[1.0], [1.2], [1.0]]})
    log(robot, warm, 4).save(place / "warm.npz")
    return place


def nominal_friction(truth):  # noqa: F811
    return type(truth)(**{**vars(truth), "phi": 0.1 * PHI})


@pytest.fixture(scope="module")
def words(robot, folder):  # noqa: F811
    arm = ["robot=other", f"robot.mjcf={robot.mjcf}", "robot.ddq_max=15", "friction.family=coulomb"]
    return [*arm, "data=recording", "data.torque=motor", "identify.terms.motor=[offset]"]


@pytest.fixture(scope="module")
def base(words):
    with initialize_config_dir(str(CONF.resolve()), version_base="1.3"):
        return compose("config", ["stage=identify", "threads=1", *words])


@pytest.fixture
def config(base, folder, monkeypatch):
    """Work in the folder of the logs; return a function from changed settings to a config."""
    monkeypatch.chdir(folder)

    def changed(**settings):
        cfg = base.copy()
        for key, value in settings.items():
            OmegaConf.update(cfg, key.replace("__", "."), value, force_add=True)
        return cfg

    return changed


@pytest.fixture
def groups(config):
    return lambda **settings: make_parts(config(**settings)).groups


def test_what_is_stated_is_a_key_on_the_command_line():
    """Of any parameter, without a +; the widths of a kind of torque stay what they are."""
    assert extended(["identify.prior.coulomb.mean=[3,2,1]"]) == ["++identify.prior.coulomb.mean=[3,2,1]"]
    assert extended(["identify.prior.coulomb=3"]) == ["++identify.prior.coulomb=3"]
    for word in ("identify.prior.motor.coulomb=0.3", "identify.prior.measured=null", "seed=1"):
        assert extended([word]) == [word]


def test_a_list_a_pattern_and_a_mapping_name_recordings(groups):
    """Kinds of torque are fitted in turn, link-side first; each recording holds out its own end."""
    (both,) = groups(data__path="cold/*.npz")
    assert list(both.train) == list(both.validation) == ["a", "b"]
    assert both.train["a"].duration == pytest.approx(2.9, abs=0.02)
    listed = groups(data__path=[A, {"path": "sensor.npz", "torque": "measured"}, "slow.csv"])
    assert [g.torque for g in listed] == ["measured", "motor"]
    assert list(listed[1].train) == ["a", "slow"]
    assert listed[1].train["slow"].rate_hz == pytest.approx(250)


def test_validation_by_recording(groups):
    (group,) = groups(data__path=A, data__validation=["cold/b.npz", "tool.npz"])
    assert list(group.train) == ["a"]
    assert list(group.validation) == ["b", "tool"]
    assert group.train["a"].duration == pytest.approx(4.0, abs=0.01)


def test_a_declared_payload_is_taken_out(groups, robot, truth):  # noqa: F811
    """What is left is the torque of the arm without it: to 2 % of the payload's, where the filter has no edge."""
    payload = {"mass": 0.8, "centre": [0.03, 0.0, 0.05]}  # a sphere of water: 0.0006 kg m^2
    (group,) = groups(data__path=[A, {"path": "tool.npz", "payload": payload}], data__validation="cold/b.npz")
    bare, loaded = log(robot, truth, 2), log(robot, truth, 2, payload=TOOL)
    rows = slice(100, -100)
    left = group.train["tool"].tau[rows] - bare.tau[rows]
    assert np.sqrt((left**2).mean()) < 0.02 * np.sqrt(((loaded.tau - bare.tau)[rows] ** 2).mean())


@pytest.mark.long
@pytest.mark.parametrize(
    ("change", "line"),
    [
        ({"data__path": "cold/*.npy"}, r"data.path: no file matches 'cold/\*.npy'; did you mean"),
        ({"data__path": [A, A]}, "data.path: cold/a.npz is named twice"),
        ({"data__path": [{"path": A, "torqe": "motor"}]}, "data.path: expected the keys path, .*mean 'torque'"),
        ({"data__path": [{"torque": "motor"}]}, "data.path: expected FILE, a pattern, or {path: FILE, torque: ...}"),
        ({"data__path": [A, {"path": "sensor.npz", "torque": "motor"}]}, "sensor.npz: .*measured"),
        ({"data__path": [{"path": "tool.npz", "payload": "find"}]}, "name a motor recording without one"),
        ({"data__path": [A, {"path": "tool.npz", "payload": 900}]}, r"tool.npz: payload: expected a number in \[0, "),
        ({"data__validation": [A]}, "data.validation is the training file itself"),
        ({"data__validation": {"path": "sensor.npz", "torque": "measured"}}, "sensor.npz holds measured torque, and"),
        ({"identify__prior__coulom__mean": 3}, "identify.prior: unknown parameter 'coulom'"),
        ({"identify__prior__coulomb": 3}, "identify.prior.coulomb: expected identify.prior.coulomb.mean="),
        ({"identify__prior__coulomb__mean": [3, 2]}, "a positive number or a list of 3 .*, got 2 values"),
        ({"identify__prior__offset__mean": 99}, "identify.prior.offset.mean: 99 is outside identify.bounds.offset"),
        ({"identify__from": "runs/identify/coold"}, "identify.from: no parameters.yaml at .*coold"),
        ({"identify__drift": -1}, "identify.drift: expected a number in"),
        ({"data__torque": None, "data__loaded": "sensor.npz"}, "data.loaded: expected motor torque .*got measured"),
        ({"data__ramps": A}, "data.ramps: ramps determine .* data.path has only motor torque"),
    ],
)
def test_a_mistake_is_one_line_before_anything_is_written(groups, change, line):
    with pytest.raises(UserError, match=line) as caught:
        groups(**{"data__path": A} | change)
    assert "\n" not in str(caught.value)


def test_a_recording_in_other_units_is_named(groups, folder, robot, truth):  # noqa: F811
    bad = log(robot, truth, 5)
    type(bad)(**{**vars(bad), "tau": 1e3 * bad.tau}).save(folder / "milli.npz")
    with pytest.raises(UserError, match=r"^milli.npz: the recording: motor tau is 1000 times what threelink needs"):
        groups(data__path=[A, "milli.npz"])
    with pytest.raises(UserError, match="motor tau is 1000 times what threelink needs"):
        groups(data__path=A, data__loaded="milli.npz")


@pytest.mark.long
def test_check_judges_each_recording(words, folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    given = [*words, "identify.prior.offset.mean=[0.4,null,null]"]
    run_command(["check", *given, "data.path=cold/*.npz"])
    assert capsys.readouterr().out.count("written: ") == 2
    for name in ("a", "b"):
        verdict = json.loads((folder / "runs" / "check" / f"{name}.json").read_text())
        assert verdict["recording"] == f"cold/{name}.npz"
    with pytest.raises(UserError, match="to: 2 recordings have a file each"):
        run_command(["check", *given, "data.path=cold/*.npz", "to=x.json"])


@pytest.mark.slow
def test_the_command(config, folder):
    """Two dates: the first from two kinds of torque with a payload to find, the second with the drift since."""
    tool, sensor = {"path": "tool.npz", "payload": "find"}, {"path": "sensor.npz", "torque": "measured"}
    identify(config(data__path=[A, "cold/b.npz", sensor, tool], name="cold"), [])
    run = folder / "runs" / "identify" / "cold"
    summary = json.loads((run / "summary.json").read_text())
    assert {*summary} >= {"train", "validation", "recordings", "measured", "payloads"}
    assert summary["payloads"]["tool"]["mass_kg"] == pytest.approx(0.8, rel=0.05)
    assert {*summary["recordings"]} == {"a", "b", "a, held out", "b, held out"}
    assert {*json.loads((run / "verdict.json").read_text())["recordings"]} == {"a", "b", "sensor"}
    for name in ("measured/parameters.yaml", "payload_tool/payload.yaml", "parameters.yaml"):
        assert (run / name).is_file(), name
    identify(config(data__path="warm.npz", identify__from=str(run), name="warm"), [])
    later = folder / "runs" / "identify" / "warm"
    drift = json.loads((later / "summary.json").read_text())["drift"]["parameters"]
    assert drift["coulomb[2]"]["changed"]
    assert drift["coulomb[2]"]["low"] < 0.2 * PHI[1, 0] < drift["coulomb[2]"]["high"]
    assert "Drift since" in (later / "report.md").read_text()
