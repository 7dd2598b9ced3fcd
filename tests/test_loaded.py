"""A payload is identified from a recording of the loaded arm, on top of the arm identified without it."""

import json
import sys
from dataclasses import replace

import numpy as np
import pytest
import yaml
from conftest import ROOT

from r2s.errors import UserError
from r2s.identification.arm_uncertainty import Arm
from r2s.identification.parameter_file import save_parameters
from r2s.identification.parameters import ParameterEstimate, parameter_space
from r2s.identification.payload.body import BodySpace
from r2s.identification.payload.estimate import identify_payload
from r2s.identification.payload.payload_file import save_payload
from r2s.physics.payload import Payload, dynamics_with_payload, payload_of
from r2s.physics.rigid_body import tensor_elements
from r2s.physics.surface import Tool, load_tool

sys.path.insert(0, str(ROOT / "benchmarks"))
from scaling import COULOMB_SHARE, OFFSET_SHARE, VISCOUS_SHARE, log, truth_of
from scaling import arm as make_arm

SECONDS = 6.0
BOUNDS = {"coulomb": [1e-3, 1e3], "viscous": [0.0, 1e3], "offset": [-1e2, 1e2], "inertia_scale": [0.2, 5.0]}
SHARE = 0.02  # standard deviation of the identified arm's friction, of the friction


@pytest.fixture(scope="module")
def robot():
    return make_arm(3, 87.0)


def identified(robot, truth, torque, seed=0, **more):
    """Return an arm that is off its truth by a draw of its posterior."""
    space = parameter_space(robot, truth, BOUNDS | more)
    rng, tau = np.random.default_rng(seed), SHARE * robot.tau_max
    own = {"coulomb": COULOMB_SHARE * tau, "viscous": VISCOUS_SHARE * tau, "offset": OFFSET_SHARE * tau}
    sigma = space.expand(own | {"inertia_scale": SHARE, "gain": 2e-3, "delay": 1e-5}, 0.0)
    x = space.start + sigma * rng.normal(size=sigma.shape)
    return Arm(space, x, x + sigma * rng.normal(size=(512, len(x))))


def carried(robot, share=0.7):
    """Return a payload: a share of the rated mass, 7 cm away, of 5 to 9 cm radii of gyration."""
    mass = share * robot.payload_max[0]
    tensor = mass * np.array([[4e-3, 5e-4, 0.0], [5e-4, 6e-3, -3e-4], [0.0, -3e-4, 5e-3]])
    return Payload(np.array(mass), np.array([0.03, -0.02, 0.06]), tensor)


def truth_and_recording(robot, torque, payload, declared=None, seed=3):
    truth = truth_of(robot, masses=(1.0,))
    loaded = dynamics_with_payload(robot, truth, payload, declared)
    return truth, log(robot, loaded, torque, seconds=SECONDS, seed=seed)


def check_found(found, payload, most=2.0):
    """Errors are at most `most` times half the 95 % interval: ten numbers, so 3 % of draws would fail at 2."""
    true = {"mass": payload.mass, "centre": payload.centre, "inertia": tensor_elements(payload.inertia)}
    for name, value in found.values.items():
        half = 0.5 * np.ptp(found.interval(name), axis=0)
        assert (np.abs(value - true[name]) < most * half).all(), name
    assert found.interval("mass")[0] < found.mass < found.interval("mass")[1]


@pytest.fixture(scope="module", params=["measured", "motor"])
def found(request, robot):
    payload = carried(robot)
    truth, recording = truth_and_recording(robot, request.param, payload)
    return identify_payload(identified(robot, truth, request.param, gain=[-0.3, 0.3]), recording), payload


def test_the_payload_that_was_carried_is_identified(found):
    """From link-side and motor torque; a heavy payload shows mass, centre and tensor."""
    estimate, payload = found
    check_found(estimate, payload)
    assert estimate.mass == pytest.approx(payload.mass, rel=0.03)
    assert np.linalg.norm(estimate.centre - payload.centre) < 5e-3
    assert estimate.identifiable["mass"]
    assert estimate.identifiable["centre"].all()
    assert (estimate.rmse(estimate.predicted) < 0.1 * estimate.rmse(estimate.without)).all()


def test_every_draw_is_a_body(found):
    """Moments are positive, and none is above the sum of the others."""
    estimate, _ = found
    xx, yy, zz, xy, xz, yz = estimate.draws["inertia"].T
    tensors = np.stack([np.stack([xx, xy, xz], -1), np.stack([xy, yy, yz], -1), np.stack([xz, yz, zz], -1)], -1)
    moments = np.linalg.eigvalsh(tensors)
    assert (estimate.draws["mass"] > 0).all()
    assert (moments[:, 0] > 0).all()
    assert (moments[:, 0] + moments[:, 1] >= moments[:, 2] * (1 - 1e-9)).all()


@pytest.mark.long
@pytest.mark.parametrize("declared", [None, 0.5])
def test_from_commands_whatever_was_declared(robot, declared):
    """A declared payload is compensated by the arm, and the estimate is that of the whole payload."""
    payload = carried(robot)
    half = None if declared is None else replace(payload, mass=declared * payload.mass, inertia=0.5 * payload.inertia)
    truth, recording = truth_and_recording(robot, "commanded", payload, half)
    arm = identified(robot, truth, "commanded", delay=[0.0, 0.02])
    estimate = identify_payload(arm, recording, declared=half)
    check_found(estimate, payload)
    assert estimate.mass == pytest.approx(payload.mass, rel=0.05)


def test_a_gain_that_stands_in_for_the_masses_is_not_the_payloads(robot):
    """All masses are 8 % less than in the file, and gains took that: the payload is right within 2 %, not 8 % off."""
    payload, truth = carried(robot), truth_of(robot, masses=(1.0,))
    lighter = replace(truth, mass=0.92 * truth.mass, inertia=0.92 * truth.inertia)
    recording = log(robot, dynamics_with_payload(robot, lighter, payload), "measured", seconds=SECONDS, seed=3)
    arm = identified(robot, truth, "measured", gain=[-0.3, 0.3])
    gain = np.where(np.isin(np.arange(len(arm.x)), arm.space.where("gain")), -0.08, 0.0)
    estimate = identify_payload(replace(arm, x=arm.x + gain, samples=arm.samples + gain), recording)
    check_found(estimate, payload)
    assert estimate.mass == pytest.approx(payload.mass, rel=0.02)
    assert 0.02 < 0.5 * np.ptp(estimate.interval("mass")) / payload.mass < 0.08


def test_no_payload_is_no_payload(robot):
    truth, recording = truth_and_recording(robot, "measured", None)
    estimate = identify_payload(identified(robot, truth, "measured", gain=[-0.3, 0.3]), recording)
    low, high = estimate.interval("mass")
    assert low < 0.01 * robot.payload_max[0]
    assert high < 0.03 * robot.payload_max[0]
    assert not estimate.identifiable["centre"].any()


def test_the_same_seed_gives_the_same(robot):
    truth, recording = truth_and_recording(robot, "measured", carried(robot))
    arm = identified(robot, truth, "measured")
    first, second = (identify_payload(arm, recording, seed=4).draws["mass"] for _ in range(2))
    np.testing.assert_array_equal(first, second)


def test_the_slope_of_the_body_is_its_derivative():
    space, z = BodySpace.about(3.0, 0.15, 2.0), np.array([2.0, 0.1, -0.05, 0.02, 0.3, -0.4, 0.1, 0.2, -0.1, 0.3])
    h = 1e-6 * np.eye(10)
    expected = ((space.standard(z + h) - space.standard(z - h)) / 2e-6).T
    np.testing.assert_allclose(space.slope(z), expected, rtol=1e-6, atol=1e-9)


def test_arms_and_tools_read_the_file(found, robot, tmp_path):
    """payload.yaml is the payload for arm.payload and arm.declared_payload; tool.json has its mass."""
    estimate, _ = found
    own = replace(robot, tool=Tool(np.array([0.0, 0.0, 0.1]), 0.01))
    save_payload(tmp_path / "payload.yaml", own, estimate, {"recording": "loaded"})
    for path in (tmp_path, tmp_path / "payload.yaml"):
        read = payload_of(str(path), robot.payload_max, "arm.declared_payload")
        assert read.mass == estimate.mass
        np.testing.assert_allclose(read.centre, estimate.centre, rtol=1e-12)
        np.testing.assert_allclose(read.inertia, estimate.tensor, rtol=1e-12, atol=1e-18)
    assert load_tool(tmp_path / "tool.json").mass == estimate.mass
    document = yaml.safe_load((tmp_path / "payload.yaml").read_text())
    inertia = np.reshape(document["libfranka"]["load_inertia"], (3, 3))
    np.testing.assert_allclose(inertia, estimate.tensor, rtol=1e-12, atol=1e-18)
    with pytest.raises(
        UserError, match=r"^arm.payload: no payload.yaml at .*payload.yml; did you mean 'payload.yaml'"
    ):
        payload_of(str(tmp_path / "payload.yml"), (3.0, 0.15))
    (tmp_path / "payload.yaml").write_text("robot: x\n")
    with pytest.raises(UserError, match=r"^arm.payload: .* is not a payload.yaml of r2s"):
        payload_of(str(tmp_path), (3.0, 0.15))


def calibration(folder, robot, arm, torque):
    """Write the run folder of an identification."""
    folder.mkdir()
    alike = np.zeros(len(arm.x), dtype=bool)
    estimate = ParameterEstimate(arm.x, arm.x, arm.x, alike, arm.samples)
    save_parameters(folder / "parameters.yaml", arm.space, estimate, {"torque": torque})


def run(folder, *words):
    """Compose and run stage=identify in this process."""
    from hydra import compose, initialize_config_dir

    from r2s.stages.identify import identify

    with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        given = ["stage=identify", "data=recording", f"root={folder / 'runs'}", "tracker=[csv]", *words]
        cfg = compose("config", given)
    identify(cfg, given)
    return folder / "runs" / "identify"


@pytest.mark.long
def test_the_command(robot, tmp_path):
    """A loaded recording on top of a calibration gives payload.yaml, table and figure; a mistake is one line."""
    payload = carried(robot, 0.5)
    truth, recording = truth_and_recording(robot, "motor", payload)
    recording.save(tmp_path / "loaded.npz")
    calibration(tmp_path / "arm", robot, identified(robot, truth, "motor"), "motor")
    given = ["robot=other", f"robot.mjcf={robot.mjcf}", f"data.loaded={tmp_path / 'loaded.npz'}"]
    arm = f"calibration={tmp_path / 'arm'}"
    mistakes = {
        "": "data.loaded: give the arm by calibration=RUN_FOLDER, or its motion without payload by data.path=FILE",
        f"{arm} data.torque=measured": "data.torque: expected motor, from which calibration=.* got measured",
        f"{arm} data.declared_payload=1.0": "data.declared_payload: motor torque contains the weight of the payload",
        f"{arm} data.loaded={tmp_path / 'load.npz'}": "load.npz",
        f"calibration={tmp_path / 'leg'}": "calibration: no parameters.yaml at .*leg",
    }
    for more, line in mistakes.items():
        with pytest.raises(UserError, match=line) as caught:
            run(tmp_path, *given, *more.split())
        assert "\n" not in str(caught.value)
    assert not (tmp_path / "runs").exists()
    folder = run(tmp_path, *given, arm, "name=load") / "load"
    entry = json.loads((folder / "summary.json").read_text())["payload"]
    assert entry["mass_kg"] == pytest.approx(float(payload.mass), rel=0.05)
    for name in ("payload.yaml", "payload_posterior.npz", "parameters.yaml", "posterior.npz", "figures/payload.png"):
        assert (folder / name).is_file(), name
