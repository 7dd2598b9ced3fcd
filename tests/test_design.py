"""A planned motion narrows the chosen intervals, keeps all limits and obstacles, and is what its files say."""

import re
from dataclasses import replace

import mujoco
import numpy as np
import pytest
import yaml
from conftest import conf
from scipy.interpolate import BPoly
from test_identify import arm  # noqa: F401 (a fixture)
from test_verdict import settings

from r2s.errors import UserError
from r2s.excitation import design as planning
from r2s.excitation.design import EVERY, designed, trajectory_yaml
from r2s.excitation.fourier import checked_center, fourier
from r2s.excitation.motion import load
from r2s.excitation.motion_checks import Space, check_motion
from r2s.identification.expected_width import expected_widths
from r2s.identification.planned_width import PlannedWidths
from r2s.physics.dynamics import nominal_dynamics
from r2s.physics.obstacle import PREFIX, Box, boxes
from r2s.physics.rigid_body import mujoco_inverse_dynamics
from r2s.recordings.readers import read
from r2s.recordings.recording import Recording

TERMS = ["offset", "link", "armature"]
SECONDS, CHOSEN = 8.0, ["viscous", "armature"]
BOX = Box((0.45, 0.0, 0.75), (0.2, 0.6, 0.5), 0.3)


def widths_of(robot, torque="motor", chosen=()):
    nominal = nominal_dynamics(robot, **conf("friction/uniform"))
    return PlannedWidths(robot, nominal, settings(torque, terms=TERMS), torque, chosen=chosen)


def planned(robot, space, seconds=SECONDS, effort=60, chosen=CHOSEN):
    widths = widths_of(robot, chosen=chosen)
    center = checked_center(robot, space, None)
    return designed(robot, widths, space, seconds=seconds, center=center, seed=0, effort=effort), widths


@pytest.fixture(scope="module")
def space(arm):  # noqa: F811
    return Space(arm, table=-np.inf, z_min=-np.inf)


@pytest.fixture(scope="module")
def best(arm, space):  # noqa: F811
    return planned(arm, space)


@pytest.mark.long
def test_the_chosen_widths_are_smaller_than_the_defaults(arm, best):  # noqa: F811
    """Of the planned motion, by its own measure and by that of a recording, than of a default motion as long."""
    motion, widths = best
    default = fourier(arm, duration=SECONDS, seed=0, effort=60, table=-np.inf, z_min=-np.inf)
    other = widths_of(arm)
    other.add(*(x[::EVERY] for x in (default.t, default.q, default.dq, default.ddq)))
    at = np.concatenate([widths.space.where(name) for name in CHOSEN])
    assert np.log(widths.width / other.width)[at].mean() < -0.05
    start = nominal_dynamics(arm, **conf("friction/uniform"))
    noise = 0.02 * arm.tau_max * np.random.default_rng(0).standard_normal(motion.q.shape)
    recorded = []
    for e in (motion, default):
        tau = mujoco_inverse_dynamics(arm.model(gravity=True), e.q, e.dq, e.ddq) + start.friction(e.dq) + noise
        recording = Recording(e.t, e.q, e.dq, tau, "motor")
        how = settings("motor", terms=TERMS)
        recorded.append(expected_widths(arm, start, recording, how).width[at])
    assert np.log(recorded[0] / recorded[1]).mean() < 0


def test_the_file_keeps_every_limit_and_reads_back(arm, best, tmp_path):  # noqa: F811
    motion = best[0]
    motion.save(tmp_path / "excitation.csv")
    e = load(tmp_path / "excitation.csv", arm, table=-np.inf, z_min=-np.inf)
    assert len(e.t) == round(1000 * SECONDS) + 1
    np.testing.assert_allclose(e.q, motion.q, atol=1e-11)
    assert (e.q >= arm.q_min).all()
    assert (e.q <= arm.q_max).all()
    assert (np.abs(e.dq) <= arm.dq_max).all()
    assert (np.abs(e.ddq) <= arm.ddq_max).all()
    assert np.abs(np.concatenate([e.dq[[0, -1]], e.ddq[[0, -1]]])).max() < 1e-9
    with pytest.raises(UserError, match="this is a planned motion; let the arm follow it") as caught:
        read(tmp_path / "excitation.csv", torque="measured", n_joints=3)
    assert "\n" not in str(caught.value)


@pytest.mark.long
def test_a_long_motion_is_of_segments_with_ways_between(arm, space, monkeypatch):  # noqa: F811
    """As a whole it passes the checks of any motion, repeats nothing, and each segment adds information."""
    monkeypatch.setattr(planning, "SEGMENT_S", 3.0)
    motion, widths = planned(arm, space, seconds=9.0, effort=5)
    check_motion(arm, motion, space=space)
    assert 9.0 < motion.t[-1] < 20.0
    one, alone = planned(arm, space, seconds=3.0, effort=5)
    np.testing.assert_allclose(one.q, motion.q[: len(one.q)], atol=1e-12)
    assert (widths.width < alone.width).mean() > 0.9
    assert Recording(motion.t, motion.q, motion.dq, 0 * motion.q, "motor").find_period() is None


@pytest.mark.long
def test_obstacles_are_kept_clear_of(arm):  # noqa: F811
    """By MuJoCo's own distances of a model with capsules; without the box the same motion would hit it."""
    robot = with_bodies(arm)
    free, kept = (Space(robot, table=-np.inf, z_min=-np.inf, obstacles=o) for o in ((), (BOX,)))
    model = robot.model(gravity=False, obstacles=(BOX,))
    box = next(g for g in range(model.ngeom) if model.geom(g).name.startswith(PREFIX))
    least = []
    for space in (free, kept):
        motion, data = planned(robot, space, seconds=4.0, effort=0)[0], mujoco.MjData(model)
        distances = []
        for q in motion.q[::20]:
            data.qpos[:] = q
            mujoco.mj_kinematics(model, data)
            others = [g for g in range(model.ngeom) if g != box and model.geom_bodyid[g]]
            distances.append(min(mujoco.mj_geomDistance(model, data, box, g, 1.0, None) for g in others))
        least.append(min(distances))
    assert least[0] < 0 < 0.02 < least[1]
    with pytest.raises(UserError, match=r"obstacle 1 is -?0\.\d+ m from the link of body|link"):
        check_motion(robot, planned(robot, free, seconds=4.0, effort=0)[0], space=kept)


def with_bodies(robot):
    """Return the arm with capsules along its links."""
    path = robot.mjcf.parent / "bodies.xml"
    geom = '<geom type="capsule" size="0.03" fromto="0 0 0 0 0 {}"/>'
    text = robot.mjcf.read_text()
    for name, length in (("pitch", 0.3), ("elbow", 0.25)):
        text = re.sub(rf'(<joint name="{name}"[^>]*/>)', rf"\1{geom.format(length)}", text)
    path.write_text(text)
    return replace(robot, mjcf=path)


def test_the_trajectory_is_the_motion(best):
    """Quintic polynomials through the points of the YAML are the motion within 1e-6 rad."""
    motion = best[0]
    document = yaml.load(trajectory_yaml(motion, ["a", "b", "c"], 100), yaml.CSafeLoader)
    points = document["points"]
    assert document["joint_names"] == ["a", "b", "c"]
    times = [p["time_from_start"]["sec"] + 1e-9 * p["time_from_start"]["nanosec"] for p in points]
    states = np.stack([[p[k] for p in points] for k in ("positions", "velocities", "accelerations")], 1)
    again = BPoly.from_derivatives(times, states)(motion.t)
    np.testing.assert_allclose(again, motion.q, atol=1e-6)


@pytest.mark.parametrize(
    ("given", "line"),
    [
        ([{"center": [0, 0, 1], "sise": [1, 1, 1]}], "o[0]: unknown key 'sise'; allowed: center, size, yaw"),
        ([{"center": [0, 0, 1]}], "o[0].size: expected 3 numbers, got None"),
        ([{"center": [0, 0], "size": [1, 1, 1]}], "o[0].center: expected 3 numbers, got [0, 0]"),
        ([{"center": [0, 0, 1], "size": [1, 0, 1]}], "o[0].size: expected edges above 0 m, got [1, 0, 1]"),
        ([3], "o[0]: expected {center: [x, y, z], size: [x, y, z]}, got 3"),
    ],
)
def test_a_wrong_box_is_one_line(given, line):
    with pytest.raises(UserError, match=re.escape(line)):
        boxes("o", given)


def test_an_unknown_parameter_is_one_line(arm):  # noqa: F811
    with pytest.raises(UserError, match=r"parameters: 'ofset' is not estimated; allowed: .*did you mean 'offset'\?"):
        widths_of(arm, chosen=["ofset"])
    assert len(widths_of(arm, chosen=["offset[2]"])._chosen) == 1
