"""A surface is identified from the torques of an arm that presses on it (benchmarks/pressing.py)."""

import json
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
import yaml
from conftest import ROOT, conf

from r2s.errors import UserError
from r2s.identification.contact.contact_file import load_contact, save_contact
from r2s.identification.contact.estimate import Arm, identify_contact
from r2s.identification.contact.exchange import linearized, mujoco_contact, sdf_surface
from r2s.identification.contact.start import external_force
from r2s.identification.contact.surface_space import stated_gears
from r2s.identification.contact.tip import TipMotion
from r2s.identification.contact.validation import press_errors
from r2s.identification.parameter_file import save_parameters
from r2s.identification.parameters import ParameterEstimate
from r2s.identification.residuals import torque_residual
from r2s.physics.robot import SIM_DT, load_robot
from r2s.physics.surface import Surface, Tool
from r2s.recordings.recording import Recording

sys.path.insert(0, str(ROOT / "benchmarks"))
from pressing import Plan, drawn_surface, estimated_arm, press_recording

ARMS = ROOT.parent / "shared" / "data" / "contact_arms"
TOOL = {"tip_in_flange_m": [0.0, 0.0, 0.0], "radius_m": 0.01}
QUICK = Plan(loads=(6.0, 18.0, 10.0, 14.0), slides=(0.0, 0.0, 0.04, 0.0), places=((0.0, 0.0), (0.08, 0.05)))
SEED = 1


@pytest.fixture(scope="module")
def robot():
    return replace(load_robot(**conf("robot/panda")), tool=Tool(np.zeros(3), 0.01))


@pytest.fixture(scope="module")
def arm(robot):
    return estimated_arm(robot, SEED)


@pytest.fixture(scope="module")
def surface():
    return drawn_surface(SEED)


@pytest.fixture(scope="module")
def recording(arm, surface):
    return press_recording(arm, surface, SEED, QUICK)


@pytest.fixture(scope="module")
def found(arm, recording):
    return identify_contact(arm, recording)


def half(found, name):
    """Return half the 95 % interval of a number."""
    low, high = found.interval(name)
    return 0.5 * (high - low)


def test_the_surface_that_was_pressed_is_identified(found, surface):
    """Numbers lie within twice their intervals (nine are tested), slope, friction and plane within the limits."""
    truth = {name: getattr(surface, name) for name in ("stiffness", "exponent", "damping", "friction")}
    truth["slope"] = linearized(surface)[0]
    for name, value in truth.items():
        assert abs(np.mean(found.interval(name)) - value) < 2 * half(found, name), name
    assert found.slope == pytest.approx(truth["slope"], rel=0.05)
    assert found.surface.friction == pytest.approx(surface.friction, abs=0.02)
    height = (surface.point - found.surface.point) @ surface.normal
    assert abs(height - np.mean(found.height)) < np.ptp(found.height) < 5e-4
    tilt = np.degrees(np.arccos(min(1.0, found.surface.normal @ surface.normal)))
    assert tilt < 2 * found.tilt_deg < 0.1
    assert all(found.identifiable.values())


@pytest.fixture(scope="module")
def behind_gears(robot, surface):
    """Return arm, surface, compliance of gears that halve the stiffness, and a recording with encoders on motors."""
    arm, surface = estimated_arm(robot, SEED), replace(surface, stiffness=3e4, exponent=1.0)
    gears = 0.006 * np.linspace(0.85, 1.15, robot.n) / robot.tau_max
    plan = replace(QUICK, places=((0.0, 0.0), (0.10, 0.08), (-0.08, 0.10)))
    return arm, surface, gears, press_recording(arm, surface, SEED, plan, gears=gears)


@pytest.fixture(scope="module")
def separated(behind_gears):
    return identify_contact(behind_gears[0], behind_gears[3])


def test_elastic_gears_are_separated_from_the_surface(robot, behind_gears, separated):
    """Gears of unknown stiffness are identified, with a surface and plane behind them."""
    _, surface, gears, _ = behind_gears
    found = separated
    low, high = np.percentile(found.draws["gears"] @ robot.tau_max, [2.5, 97.5])
    assert low < gears @ robot.tau_max < high
    assert found.identifiable["gears"]
    low, high = found.interval("slope")
    assert low < 3e4 < high < 2 * low
    rigid = found.rigid_gears
    assert rigid.interval("slope")[1] < low
    height, wrong = ((surface.point - one.surface.point) @ one.surface.normal for one in (found, rigid))
    assert found.height[0] < height < found.height[1]
    assert abs(height) < 5e-4 < abs(wrong)  # gravity moves the tip behind the encoders
    assert found.validation.rmse() < rigid.validation.rmse()


@pytest.mark.long
def test_stated_gears_sharpen_the_surface(robot, behind_gears, separated):
    """A stiffness off by two standard deviations in one direction: the interval is narrower and holds the truth."""
    arm, _, gears, recording = behind_gears
    accuracy = 0.05
    stated = stated_gears(robot.tau_max, stiffness=(1.0 + np.sqrt(2.0) * accuracy) / gears, accuracy=accuracy)
    found = identify_contact(arm, recording, gears=stated)
    low, high = found.interval("slope")
    assert low < 3e4 < high
    # gears as soft as the surface: an error of theirs is one of its stiffness, at most 2 * 1.96 * accuracy wide
    assert np.log(high / low) < 4 * accuracy < np.log(np.divide(*separated.interval("slope")[::-1]))


def test_two_springs_in_series_have_one_force(robot, surface):
    """A tip behind gears presses as a softer surface does: 1 / k = 1 / k_surface + softness, also with exponents."""
    count, stiff = 50, replace(surface, exponent=1.0, damping=0.0, friction=0.0)
    q = robot.q_home + np.zeros((count, robot.n))
    tip = TipMotion.of(robot, q, 0.0 * q, SIM_DT, np.arange(count) == 0, 0.0)
    deep = np.linspace(1e-5, 2e-3, count)
    tip = replace(tip, centre=surface.point + (tip.radius - deep)[:, None] * surface.normal)
    gears = np.linspace(5e-5, 2e-4, robot.n)
    soft = ((surface.normal @ tip.jacobian(np.arange(count), surface.normal)) ** 2 * gears).sum(1)
    for exponent in (1.0, 1.5):
        one = replace(stiff, exponent=exponent)
        _, force, depth, _ = replace(tip, compliance=gears).contact(one)
        np.testing.assert_allclose(depth + soft * force, deep, atol=1e-12)
        np.testing.assert_allclose(force, one.coefficient * depth**exponent, rtol=1e-9, atol=1e-9)


def test_the_held_out_press_is_predicted(found):
    """The last place was not fitted: its force, loading and unloading, follows from the others."""
    assert found.validation.summary()["seconds"] > 1.0
    assert max(found.validation.rmse(side) for side in (-1.0, 1.0)) < 1.0


def test_seconds_of_contact_do_not_depend_on_the_distance_of_rows(arm, recording, monkeypatch):
    """A recording of hours has rows farther apart; here at 25 per second."""
    seconds = []
    for most in (torque_residual.MOST_ROWS, 25 * recording.duration):
        monkeypatch.setattr(torque_residual, "MOST_ROWS", most)
        torque = torque_residual.TorqueResidual(arm.space, recording)
        seconds.append(torque.row_s * external_force(torque, arm.x)[2].sum())
    assert seconds[0] == pytest.approx(seconds[1], rel=0.05)


def test_the_moments_that_count_do_not_depend_on_the_size_of_the_force():
    """All forces and torques times a hundred: the same moments, and errors times a hundred."""
    rng, (T, n, scales) = np.random.default_rng(0), (200, 3, (1.0, 100.0))
    depth, tau, error = rng.uniform(0, 1, T), rng.normal(size=(T, n)), rng.normal(size=(T, n))
    kept, rows = [], np.ones((T, n), dtype=bool)
    for scale in scales:
        contact = lambda *_, f=scale: (f * tau * depth[:, None], f * depth, depth, depth)  # noqa: E731
        problem = SimpleNamespace(
            motion=SimpleNamespace(instants=np.arange(T), t=np.arange(T), filtered=lambda x: x),
            contact=contact, error=scale * error, directions=np.zeros((T, n, 1)), best_arm=lambda u: np.zeros(1),
            rows=rows, sigma=np.full((T, n), 0.05 * scale), torque=SimpleNamespace(row_s=0.01),
        )  # fmt: skip
        kept.append(press_errors(problem, np.zeros(8), [np.ones(T, dtype=bool)]))
    assert 0 < len(kept[0].t) < T
    np.testing.assert_array_equal(kept[0].t, kept[1].t)
    assert kept[1].rmse() == pytest.approx(100 * kept[0].rmse())


def test_a_seed_gives_the_same_surface(arm, recording, found):
    again = identify_contact(arm, recording)
    assert again.surface.stiffness == found.surface.stiffness
    assert np.array_equal(again.draws["slope"], found.draws["slope"])


def test_presses_without_slides_leave_friction_unknown(arm, surface, found):
    """What the recording does not show is marked or has a wide interval."""
    plan = Plan(loads=(6.0, 18.0, 10.0), slides=(0.0, 0.0, 0.0), step=0.5, places=((0.0, 0.0),))
    one = identify_contact(arm, press_recording(arm, surface, SEED, plan))
    assert one.validation is None
    assert not one.identifiable["friction"]
    assert one.tilt_deg > 10 * found.tilt_deg  # one place hardly tells the tilt


@pytest.mark.long
def test_a_second_recording_validates(arm, surface, recording):
    """data.contact_validation: presses elsewhere on the surface, with other forces."""
    other = press_recording(arm, surface, SEED, replace(QUICK, loads=(8.0, 12.0, 7.0, 16.0), places=((0.03, -0.04),)))
    found = identify_contact(arm, recording, other)
    assert found.validation.rmse() < 1.0
    assert found.validation.t[-1] <= other.t[-1] < recording.t[-1]


def test_contact_friction_is_dahls(robot, surface):
    """After a fifth of the bristle friction is mu F (1 - exp(-1/5)); noise within `play` does not relax it."""
    count, bristle = 400, surface.bristle
    centre = surface.point + (robot.tool.radius - 1e-3) * surface.normal + np.zeros((count, 3))
    along = np.cross(surface.normal, [1.0, 0.0, 0.0])
    along /= np.linalg.norm(along)
    # a single joint, far away, so that it translates the tip along the surface
    origin = centre[0] - robot.tool.radius * surface.normal - np.cross(along, surface.normal) * 1e3
    axis = -np.cross(np.cross(along, surface.normal), along)
    axes, origins = (np.broadcast_to(x, (count, 1, 3)).copy() for x in (surface.normal, origin))
    way = np.sign((np.cross(surface.normal, centre[0] - robot.tool.radius * surface.normal - origin)) @ along)
    speed = np.zeros((count, 1))
    speed[:40, 0] = way * 0.2 * bristle / (40 * SIM_DT) / 1e3
    starts = np.arange(count) == 0

    def friction(dq, play):
        tip = TipMotion(SIM_DT, starts, centre, robot.tool.radius, axes, origins, dq, play)
        tau, force, _, _ = tip.contact(surface)
        return np.abs(tau[:, 0]) / 1e3 / force / surface.friction

    assert friction(speed, 0.0)[-1] == pytest.approx(1 - np.exp(-0.2), rel=0.05)  # the first row starts the bristles
    noise = 1e-3 * np.random.default_rng(0).standard_normal((count, 1)) * 0.02 * bristle / SIM_DT
    noise[:41] = 0.0
    noise[42:] -= noise[41:-1]  # of an angle: it comes back
    assert friction(speed + np.diff(noise, axis=0, prepend=0.0), 0.2 * bristle)[-1] > 0.8 * (1 - np.exp(-0.2))
    assert axis.shape == (3,)


def test_a_press_behind_gears_keeps_friction_and_adds_none(robot, surface):
    """The tip slides, stops, and goes deeper: friction stays mu F, and the force along the normal is the force."""
    count, surface = 400, replace(surface, exponent=1.0, damping=0.0)
    q = robot.q_home + np.zeros((count, robot.n))
    tip = TipMotion.of(robot, q, 0.0 * q, SIM_DT, np.arange(count) == 0, 0.02 * surface.bristle)
    along = np.cross(surface.normal, [1.0, 0.0, 0.0])
    along /= np.linalg.norm(along)
    slid, deep = np.linspace(0.0, 1.0, count // 2), np.linspace(0.0, 1.0, count - count // 2)
    slid, deep = np.append(slid, np.ones(len(deep))), np.append(np.zeros(count // 2), deep)
    point = tip.centre[0] - (tip.radius - 5e-4) * surface.normal
    path = 3e-3 * slid[:, None] * along - 5e-4 * deep[:, None] * surface.normal
    tip = replace(tip, centre=tip.centre[0] + path, compliance=np.full(robot.n, 2e-4))
    jacobian = tip.jacobian(np.arange(count), surface.normal)
    dq = np.stack([np.linalg.pinv(J) @ v for J, v in zip(jacobian, np.gradient(path, SIM_DT, axis=0), strict=True)])
    tau, force, _, _ = replace(tip, dq=dq).contact(replace(surface, point=point))
    acting = np.stack([np.linalg.pinv(J.T) @ x for J, x in zip(jacobian, tau, strict=True)])
    normal = acting @ surface.normal
    np.testing.assert_allclose(normal[1:], force[1:], rtol=1e-6)
    across = np.linalg.norm(acting - normal[:, None] * surface.normal, axis=1)
    np.testing.assert_allclose(across[count // 2 :], surface.friction * force[count // 2 :], rtol=0.01)
    assert force[-1] > 1.5 * force[count // 2]


def test_contact_yaml_loads_as_it_was_saved(tmp_path, robot, found):
    """Surface, intervals and draws come back; a damaged file gives one line."""
    save_contact(tmp_path / "contact.yaml", robot, found, {"recording": "x"})
    loaded = load_contact(tmp_path)
    assert loaded.surface.stiffness == pytest.approx(found.surface.stiffness, rel=1e-5)
    assert np.allclose(loaded.surface.point, found.surface.point, atol=1e-8)
    assert loaded.interval["slope"] == pytest.approx(found.interval("slope"), rel=1e-5)
    assert loaded.identifiable == found.identifiable
    assert len(loaded.draws) == len(found.draws["slope"])
    assert loaded.draws[3].friction == found.draws["friction"][3]
    assert loaded.simulated.surface.stiffness == pytest.approx(found.rigid_gears.surface.stiffness, rel=1e-5)
    assert loaded.simulated.draws[3].friction == found.rigid_gears.draws["friction"][3]
    with pytest.raises(UserError, match=r"contact: no contact\.yaml at .*nowhere"):
        load_contact(tmp_path / "nowhere")
    document = yaml.safe_load((tmp_path / "contact.yaml").read_text())
    old = {key: value for key, value in document.items() if key != "rigid_gears"}  # before gears were estimated
    (tmp_path / "contact.yaml").write_text(yaml.safe_dump(old))
    assert load_contact(tmp_path).simulated.surface.stiffness == loaded.surface.stiffness
    document["parameters"]["stiffness"]["value"] = -1.0
    (tmp_path / "contact.yaml").write_text(yaml.safe_dump(document))
    with pytest.raises(UserError, match=r"not a contact\.yaml of r2s .*positive stiffness"):
        load_contact(tmp_path)


def pressed_ball(surface: Surface, mass: float) -> mujoco.MjModel:
    """Return a ball of 10 mm on a plane with the surface's MuJoCo parameters, free along x and z."""
    contact = mujoco_contact(surface, 1.0 / mass)

    def text(values):
        return " ".join(f"{v:.9g}" for v in values)

    own = " ".join(f'{key}="{text(contact[key])}"' for key in ("solref", "solimp", "friction"))
    option = f'timestep="0.001" gravity="0 0 0" cone="{contact["cone"]}" impratio="{contact["impratio"]}"'
    slides = '<joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 0 1"/>'
    ball = f'<body pos="0 0 0.01">{slides}<geom type="sphere" size="0.01" mass="{mass}" condim="3" {own}/></body>'
    plane = f'<geom type="plane" size="1 1 1" pos="{text(contact["pos_m"])}" condim="3" {own}/>'
    return mujoco.MjModel.from_xml_string(f"<mujoco><option {option}/><worldbody>{plane}{ball}</worldbody></mujoco>")


def test_mujoco_presses_as_deep_as_the_surface():
    """At 10 N the depth is exact, 1 N beside it to second order; friction holds below mu F and not above."""
    surface = Surface(np.zeros(3), np.array([0.0, 0.0, 1.0]), 8e3, 1.5, 2.0, 0.3)
    model = pressed_ball(surface, 2.0)
    for load in (9.0, 10.0, 11.0):
        data = mujoco.MjData(model)
        for _ in range(3000):
            data.qfrc_applied[:] = 0.0, -load
            data.qvel[:] *= 0.99
            mujoco.mj_step(model, data)
        depth = (load / surface.coefficient) ** (1 / surface.exponent)
        assert -data.qpos[1] == pytest.approx(depth, rel=1e-4 if load == 10.0 else 5e-3)
    speed = []
    for share in (0.9, 1.1):
        data = mujoco.MjData(model)
        for k in range(3000):
            data.qfrc_applied[:] = share * 3.0 * (k > 1500), -10.0
            mujoco.mj_step(model, data)
        speed.append(data.qvel[0])
    assert abs(speed[0]) < 1e-3 < 0.05 < speed[1]


def test_sdf_has_slope_and_damping_of_10_newtons():
    surface = Surface(np.zeros(3), np.array([0.0, 0.0, 1.0]), 5e3, 1.0, 2.0, 0.3)
    assert "<kp>5000</kp><kd>20</kd>" in sdf_surface(surface)
    assert "<mu>0.3</mu>" in sdf_surface(surface)


@pytest.fixture(scope="module")
def files(tmp_path_factory, robot, arm, surface, recording):
    """Return a folder with the recording, the tool and a calibration, as the command line reads them."""
    folder = tmp_path_factory.mktemp("contact")
    recording.save(folder / "contact.npz")
    press_recording(arm, surface, SEED, QUICK, touched=False).save(folder / "free.npz")
    replace(recording, torque="measured").save(folder / "measured.npz")
    (folder / "tool.json").write_text(json.dumps(TOOL))
    (folder / "short.json").write_text(json.dumps(TOOL | {"radius_m": 1e-4, "tip_in_flange_m": [0.0, 0.0, -0.05]}))
    (folder / "run").mkdir()
    low, high = np.quantile(arm.samples, [0.025, 0.975], axis=0)
    estimate = ParameterEstimate(arm.x, low, high, low < high, arm.samples)
    save_parameters(folder / "run" / "parameters.yaml", arm.space, estimate, {"recording": "pressing"})
    other = replace(arm.space, robot=replace(robot, name="other"))
    (folder / "other").mkdir()
    save_parameters(folder / "other" / "parameters.yaml", other, estimate, {"recording": "pressing"})
    return folder


def run(folder: Path, *words: str):
    """Compose and run stage=identify in this process."""
    from hydra import compose, initialize_config_dir

    from r2s.stages.identify import identify

    with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        given = ["stage=identify", "data=recording", f"root={folder / 'runs'}", "tracker=[csv]", *words]
        cfg = compose("config", given)
    identify(cfg, given)
    return folder / "runs" / "identify"


@pytest.mark.long
def test_the_command_writes_a_surface_that_calibration_can_be(files, capsys, found):
    """stage=identify data.contact=FILE calibration=RUN: table, figure, yaml, summary, and the arm beside it."""
    words = [f"data.contact={files / 'contact.npz'}", f"robot.tool={files / 'tool.json'}", "name=surface"]
    folder = run(files, *words, f"calibration={files / 'run'}") / "surface"
    assert "slope at 10 N" in capsys.readouterr().out
    loaded = load_contact(folder)
    assert loaded.interval["slope"] == pytest.approx(found.interval("slope"), rel=0.02)
    summary = json.loads((folder / "summary.json").read_text())["contact"]
    assert summary["validation"]["force_rmse_N"] < 1.0
    assert (folder / "figures" / "contact.png").stat().st_size > 10_000
    assert 'name="surface"' in (folder / "model" / "arm.xml").read_text()
    assert (folder / "parameters.yaml").read_text() == (files / "run" / "parameters.yaml").read_text()


MISTAKES = {
    "data.contact=contact.npz calibration=run": "robot.tool: data.contact needs the tip that touches",
    "data.contact=contact.npz robot.tool=tool.json": "data.contact: give the arm by calibration=RUN_FOLDER",
    "data.contact=contact.npz robot.tool=tool.json calibration=other": "parameters.yaml is of 'other'",
    "data.contact=contact.npz robot.tool=tool.json calibration=nowhere": "calibration: no parameters.yaml at",
    "data.contact=nowhere.npz robot.tool=tool.json calibration=run": "nowhere.npz",
    "data.contact=measured.npz robot.tool=tool.json calibration=run": "measured",
    "data.contact=contact.npz data.torque=measured robot.tool=tool.json calibration=run": "not data.torque=measured",
    "data.path=free.npz data.contact_validation=contact.npz": "there is no data.contact= to validate",
    "data.contact=free.npz robot.tool=tool.json calibration=run": "data.contact: no contact found.*does the tool",
}
GEARS = {
    ".stiffness=0": ".stiffness: expected positive numbers, Nm/rad, got 0",
    ".stiffness=[1,2]": ".stiffness: expected 7 values, for the 7 joints, got 2",
    ".stiffness=soft": r".stiffness: no gears\.yaml at ",
    ".stiffness=14": r".stiffness: robot.tau_max would twist these gears by .* rad, allowed are 0.04.* Nm/rad",
    ".accuracy=0": r".accuracy: expected a number in \(0, 0.4\], got 0",
    "=14000": r": expected identify\.gears\.stiffness= and \.accuracy=, got 14000",
}


@pytest.mark.long
@pytest.mark.parametrize("word", GEARS)
def test_gears_that_cannot_be_are_one_line(word, files):
    """Refused before a run folder exists, also where the arm would first be identified from free motion."""
    data = f"data.contact={files / 'contact.npz'}", f"calibration={files / 'run'}"
    for own in (data, (f"data.path={files / 'free.npz'}",)):
        with pytest.raises(UserError, match=rf"^identify\.gears{GEARS[word]}") as caught:
            run(files, *own, f"robot.tool={files / 'tool.json'}", "name=gears", f"identify.gears{word}")
        assert "\n" not in str(caught.value)
        assert not (files / "runs" / "identify" / "gears").exists()


def test_one_stiffness_is_that_of_the_strongest_joint(robot):
    """Its largest torque twists every joint as far; one value per joint says the same."""
    one = stated_gears(robot.tau_max, stiffness=14e3)
    each = stated_gears(robot.tau_max, stiffness=14e3 * robot.tau_max / robot.tau_max.max())
    np.testing.assert_allclose(one.shape, np.ones(robot.n))
    np.testing.assert_allclose(each.shape, one.shape)
    assert one.center == pytest.approx(robot.tau_max.max() / 14e3)


@pytest.mark.long
def test_an_arm_that_rests_in_contact_is_refused(arm, recording):
    """All joints rest: whatever presses is hidden by friction."""
    still = np.zeros_like(recording.q) + recording.q[1000]
    rest = Recording(recording.t, still, 0.0 * still, recording.tau, "commanded")
    with pytest.raises(UserError, match=r"data\.contact"):
        identify_contact(arm, rest)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_other_surfaces(robot, seed):
    """Slope within 5 %, friction within 0.02, plane within 0.5 mm and 0.1 degrees on drawn arms and surfaces."""
    one, truth = estimated_arm(robot, seed), drawn_surface(seed)
    seen = identify_contact(one, press_recording(one, truth, seed))
    assert seen.slope == pytest.approx(linearized(truth)[0], rel=0.05)
    assert seen.surface.friction == pytest.approx(truth.friction, abs=0.02)
    assert abs((seen.surface.point - truth.point) @ truth.normal) < 5e-4
    assert seen.surface.normal @ truth.normal > np.cos(np.radians(0.1))


@pytest.mark.slow
@pytest.mark.skipif(not ARMS.is_dir(), reason="the simulated contact arms are not beside this checkout")
@pytest.mark.parametrize("name", ["sigmoid", "coulomb", "stribeck"])
def test_arms_of_an_independent_simulator(robot, name):
    """With true friction and offset known to 1 %, their surfaces are found: stick and slip, exact touch and lift."""
    from r2s.identification.parameters import parameter_space
    from r2s.physics.dynamics import Dynamics
    from r2s.physics.friction import COULOMB, SIGMOID, STRIBECK
    from r2s.physics.surface import load_tool
    from r2s.recordings.readers import read

    true = json.loads((ARMS / name / "truth.json").read_text())
    own = replace(robot, tool=load_tool(ARMS / name / "tool.json"))
    friction, family = true["friction"], {"sigmoid": SIGMOID, "coulomb": COULOMB, "stribeck": STRIBECK}[name]
    if name == "sigmoid":
        phi = np.stack([friction[k] for k in ("phi1", "phi2", "phi3")], -1)
    else:
        level, viscous = (np.array([friction[f"{k}_pos"], friction[f"{k}_neg"]]) for k in ("fc", "fv"))
        spread = [(a[0] - a[1]) / (a[0] + a[1]) for a in (level, viscous)]
        columns = [level.mean(0), spread[0], viscous.mean(0), spread[1]]
        if name == "stribeck":
            pytest.skip("its truth has no place in the family's parameters; benchmarks/contact_identification.py")
        phi = np.stack(columns, -1)
    scale = np.array(true["inertia_scale"])
    nominal = replace(
        Dynamics.of(own, phi, family),
        offset=np.array(true["offset"]),
        inertia=own.inertia * scale[:, None, None],
        delay=true["delay_s"],
        lag=true["lag_s"],
    )
    space = parameter_space(own, nominal, {"offset": [-2.0, 2.0]})
    contact = true["contact"]
    found = identify_contact(Arm(space, space.start, None), read(ARMS / name / "contact.npz", torque="commanded"))
    truth = Surface(
        np.array(contact["point"]), np.array(contact["normal"]), contact["k_N_per_m"], contact["exponent"]
    )
    assert found.slope == pytest.approx(linearized(truth)[0], rel=0.01)
    assert found.surface.friction == pytest.approx(contact["mu"], abs=0.005)
    assert abs((found.surface.point - truth.point) @ truth.normal) < 1e-4
    assert found.surface.normal @ truth.normal > np.cos(np.radians(0.01))
