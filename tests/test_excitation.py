"""Excitations are safe, informative, run from slow to fast with rests, and can be saved; errors name violations."""

import re
from dataclasses import replace
from functools import cache

import mujoco
import numpy as np
import pytest
from conftest import conf

from r2s.arm.recorder import record
from r2s.arm.twins.rigid_twin import RigidTwin
from r2s.errors import UserError
from r2s.excitation.fourier import fourier
from r2s.excitation.information import information
from r2s.excitation.motion import Excitation, load
from r2s.excitation.motion_checks import (
    CLEARANCE_M,
    TORQUE_SHARE,
    Space,
    check_limits,
    check_motion,
    check_shape,
    check_space,
    check_torque,
    friction_margin,
)
from r2s.physics.rigid_body import LinkInertia, regressor
from r2s.physics.robot import load_robot
from r2s.recordings.recording import Recording


@cache
def arm():
    return load_robot(**conf("robot/panda"))


@cache
def excited(duration=20.0, seed=0, effort=30, **how):
    return fourier(arm(), duration=duration, seed=seed, effort=effort, **how)


def lowest(motion):
    """Return the least height of the end effector, m."""
    model = arm().model(gravity=False)
    data, heights = mujoco.MjData(model), []
    for q in motion.q[::10]:
        data.qpos = q
        mujoco.mj_kinematics(model, data)
        heights.append(data.site(arm().ee_site).xpos[2])
    return min(heights)


def message(function, *arguments, **named):
    """Return the line of a UserError."""
    with pytest.raises(UserError) as caught:
        function(*arguments, **named)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def nats(motion, gravity=False):
    """Return the information of a motion at 10 samples per second."""
    t, q, dq, ddq = (x[::100] for x in (motion.t, motion.q, motion.dq, motion.ddq))
    return information(arm(), t, q[None], dq[None], ddq[None], gravity)[0]


def moves(*postures, seconds=2.0):
    """Return an excitation through postures (., n), each way a polynomial of degree 7: at rest at every posture."""
    u = np.arange(round(seconds * 1000) + 1)[:, None] / (seconds * 1000)
    s = np.array([35 * u**4 - 84 * u**5 + 70 * u**6 - 20 * u**7, 140 * (u**3 - 3 * u**4 + 3 * u**5 - u**6)])
    s = [*s, 140 * (3 * u**2 - 12 * u**3 + 15 * u**4 - 6 * u**5)]
    parts = [
        np.stack([a + s[0] * (b - a), s[1] * (b - a) / seconds, s[2] * (b - a) / seconds**2])[:, :-1]
        for a, b in zip(np.array(postures[:-1]), np.array(postures[1:]), strict=True)
    ]
    end = np.stack([postures[-1], np.zeros(len(postures[-1])), np.zeros(len(postures[-1]))])[:, None]
    q, dq, ddq = np.concatenate([*parts, end], axis=1)
    return Excitation(1e-3 * np.arange(len(q)), q, dq, ddq)


# --- what fourier draws


@pytest.mark.long
@pytest.mark.parametrize(("duration", "seed"), [(2.0, 0), (3.0, 1), (7.0, 2), (20.0, 0), (20.0, 1)])
def test_every_motion_keeps_what_is_allowed(duration, seed):
    """Limits at every sample, torque by another formula, rest at both ends, consistent derivatives."""
    r, e = arm(), excited(duration, seed)
    check_motion(r, e)
    assert len(e.t) == round(1000 * duration) + 1
    half = 0.5 * (r.q_max - r.q_min)
    assert np.all(np.abs(e.q - 0.5 * (r.q_min + r.q_max)) <= 0.8 * half + 1e-12)
    assert np.all(np.abs(e.dq) <= 0.7 * r.dq_max + 1e-12)
    assert np.all(np.abs(e.ddq) <= 0.7 * r.ddq_max + 1e-12)
    assert np.abs([e.dq[[0, -1]], e.ddq[[0, -1]]]).max() < 1e-12
    np.testing.assert_allclose(np.gradient(e.q, e.t, axis=0)[1:-1], e.dq[1:-1], atol=1e-3)
    np.testing.assert_allclose(np.gradient(e.dq, e.t, axis=0)[1:-1], e.ddq[1:-1], atol=0.1)
    links = LinkInertia(r.mass, r.com, r.inertia).standard()
    q, dq, ddq = e.q[::50], e.dq[::50], e.ddq[::50]
    weight = np.einsum("tjkc,kc->tj", regressor(r, q, 0 * dq, 0 * ddq, r.gravity), links)
    inertial = np.einsum("tjkc,kc->tj", regressor(r, q, dq, ddq), links)
    assert np.all(np.abs(weight) + np.abs(inertial) + friction_margin(r) <= TORQUE_SHARE * r.tau_max)


@pytest.mark.long
@pytest.mark.parametrize("seed", range(3))
def test_slow_and_fast_in_both_directions_and_still_in_between(seed):
    """Each joint crawls and runs both ways; all stand still for 0.4 s three times; slow rungs reverse slowly."""
    r, e = arm(), excited(20.0, seed)
    for x in (e.dq / r.dq_max).T:
        for direction in (x, -x):
            assert np.mean((direction > 0.01) & (direction < 0.1)) > 0.02
            assert np.mean(direction > 0.2) > 0.01
    still = np.abs(e.dq).max(1) < 1e-9
    rests = np.flatnonzero(np.diff(np.concatenate([[0], still, [0]]))).reshape(-1, 2)
    rests = rests[np.diff(rests).ravel() >= 100]  # not the instant of a reversal
    assert len(rests) == 2 + 4
    assert np.all(np.diff(rests[1:-1]) >= 399)
    rungs = [slice(a, b) for a, b in zip(rests[:-1, 1], rests[1:, 0], strict=True)]
    assert np.all(np.ptp(np.sign(e.dq[rungs[0]]), axis=0) == 2)
    speeds = [np.abs(e.dq[rung] / r.dq_max).max() for rung in rungs]
    assert np.all(np.diff(speeds) > -1e-9)
    assert speeds[0] < 0.15 < 0.5 < speeds[-1]


@pytest.mark.long
@pytest.mark.parametrize("gravity", [False, True])
def test_the_search_increases_the_information(gravity):
    """More information than the median random draw, and than any of them here."""
    chance = [nats(excited(6.0, seed, effort=0), gravity) for seed in range(7)]
    found = nats(excited(6.0, 0, effort=200, gravity=gravity), gravity)
    assert found > np.median(chance) + 2
    assert found > max(chance)


def test_information_counts_what_moves():
    """Rest has no information, a longer motion has more, and a joint at rest gives none about itself."""
    e = excited(3.0, 1)
    still = Excitation(e.t, np.tile(arm().q_home, (len(e.t), 1)), 0 * e.dq, 0 * e.ddq)
    assert nats(still) == pytest.approx(0)
    part = Excitation(*(x[:1500] for x in vars(e).values()))
    frozen = Excitation(e.t, e.q * ([1] * 6 + [0]), e.dq * ([1] * 6 + [0]), e.ddq * ([1] * 6 + [0]))
    assert 0 < nats(part) < nats(e)
    assert nats(frozen) < nats(e) - 5


@pytest.mark.long
def test_the_same_seed_is_the_same_motion_and_never_a_period():
    again, other = fourier(arm(), duration=3.0, seed=1, effort=30), excited(3.0, 2)
    assert all(
        np.array_equal(a, b) for a, b in zip(vars(again).values(), vars(excited(3.0, 1)).values(), strict=True)
    )
    assert np.abs(again.q - other.q).max() > 0.1
    e = excited(20.0, 0)
    assert Recording(e.t, e.q, e.dq, 0 * e.q, "commanded").find_period() is None


@pytest.mark.long
@pytest.mark.parametrize(("duration", "seed"), [(3.0, 1), (10.0, 0)])
def test_an_arm_follows(duration, seed):
    """The twin runs it without a stop, within the clearance of the checks, except for the light wrist."""
    e = excited(duration, seed)
    off = np.abs(record(RigidTwin(arm(), 0), e).q - e.q)
    assert off[:, :6].max() < 0.08
    assert off.max() < 0.15


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"q_center": np.zeros(7)}, ["q_center", "-3.0718 to -0.0698", "got 0 (joint 4)"]),
        ({"q_center": np.zeros(3)}, ["q_center", "expected 7 values, got 3"]),
        ({"duration": 0.1}, ["duration: expected 2 to 120 s, got 0.1"]),
        ({"duration": np.nan}, ["got nan"]),
        ({"effort": -1}, ["effort: expected", "got -1"]),
        ({"z_min": 2.0}, ["the end effector is 0.5", "above the base plane at robot.q_home", "2 m or more"]),
        ({"q_center": [0, 1.7, 0, -0.4, 0, 1.5, 0]}, ["m above the base plane at excitation.q_center"]),
        ({"table": 0.3}, ["'link2' reaches", "below the table at 0.3 m already at robot.q_home", "-inf"]),
    ],
)
def test_wrong_arguments_are_errors(arguments, words):
    text = message(fourier, arm(), **({"duration": 5.0, "seed": 0} | arguments))
    for word in words:
        assert word in text


def test_obstacles_reduce_the_amplitude():
    """Under a floor higher than it went the same draw shrinks, and stays above it."""
    low = excited(6.0, 3, effort=0, z_min=0.1)
    floor = lowest(low) + 0.05
    high = excited(6.0, 3, effort=0, z_min=floor)
    check_space(arm(), high, z_min=floor)
    assert "above the base plane" in message(check_space, arm(), low, z_min=floor)
    assert np.ptp(high.q, axis=0).sum() < np.ptp(low.q, axis=0).sum()


# --- what the checks find


def home(**change):
    """Return q_home with joints (from 1) put elsewhere."""
    q = arm().q_home.copy()
    for joint, angle in change.items():
        q[int(joint[1:]) - 1] = angle
    return q


@pytest.mark.parametrize(
    ("postures", "words"),
    [
        ([home(), home(q1=3.0)], ["position of joint 1 is 2.897 rad at 1.", "-2.8973 to 2.8973"]),
        ([home(), home(q1=2.8)], ["velocity of joint 1 is 2.1", "at 0.", "-2.175 to 2.175"]),
        (
            [home(), home(q2=0.9, q4=-2.0)],
            ["the end effector is 0.09", "above the base plane at 1.", "0.1 m or more"],
        ),
        ([home(), home(q6=3.6)], ["'link5' is 0.02", "m from link 'link7' at 1.", "0.03 m or more"]),
    ],
)
def test_violations_are_named(postures, words):
    """Joint or link, the value, when, and what is allowed, in one line."""
    e = moves(*postures)
    text = message(check_motion, arm(), e)
    assert text.startswith("excitation: ")
    for word in words:
        assert word in text


def test_links_above_the_table_and_links_apart():
    """All links are checked: an arm that lies down touches the table, a folded one its own base."""
    down = moves(home(), home(q2=0.9, q4=-2.0))
    text = message(check_space, arm(), down, z_min=-np.inf)
    found = re.fullmatch(
        r"excitation: link 'link7' is (.*) m above the table at [01]\.\d* s, allowed (.*) m or more", text
    )
    assert found
    assert float(found[2]) > CLEARANCE_M  # a deviation of 0.05 rad of a stretched arm is more
    assert float(found[1]) <= float(found[2])
    check_space(arm(), down, z_min=-np.inf, table=-0.2)
    inwards = moves(home(), home(q2=0.3, q4=-3.0, q6=0.6))
    text = message(check_space, arm(), inwards, z_min=-np.inf, table=-np.inf)
    assert "link 'link0' is 0.0" in text
    assert " m from link 'link" in text


def test_torque_counts_gravity_dynamics_and_friction():
    """A motion of the strong arm exceeds the limits of a weaker one; at rest only gravity counts."""
    out = moves(home(), home(q2=0.9, q4=-0.3), seconds=5.0)
    check_torque(arm(), out)
    weak = replace(arm(), tau_max=arm().tau_max * [1, 0.6, 1, 1, 1, 1, 1])
    text = message(check_torque, weak, out)
    assert "torque of joint 2 is 41.8" in text
    assert "allowed 41.76 Nm, 80 % of tau_max" in text
    still = replace(out, q=np.tile(out.q[-1], (len(out.t), 1)), dq=0 * out.dq, ddq=0 * out.ddq)
    assert "at 0.000 s" in message(check_torque, weak, still)


def test_a_motion_must_be_one():
    e = excited(3.0, 1)
    jump = replace(e, q=e.q + 0.01 * (np.arange(len(e.t)) >= 1000)[:, None] * np.eye(7)[2])
    text = message(check_motion, arm(), jump)
    assert "dq of joint 3" in text
    assert "off the slope of q at 0.999 s" in text
    cut = Excitation(*(x[: len(e.t) // 2] for x in vars(e).values()))
    assert "expected 0 at both ends" in message(check_motion, arm(), cut)
    holed = e.q.copy()
    holed[5, 1] = np.nan
    assert "q of joint 2 is nan at 0.005 s" in message(check_shape, arm(), replace(e, q=holed))
    assert "a time step of 0.001 s, got 0.002 s" in message(check_shape, arm(), replace(e, t=2 * e.t))
    assert "(3001, 6)" in message(check_shape, arm(), replace(e, ddq=e.ddq[:, :6]))
    check_limits(arm(), e)


SHAPES = """
<mujoco>
  <asset><mesh name="wedge" vertex="0 0 0  0.2 0 0  0 0.1 0  0 0 0.3  0.1 0.1 0.1"/></asset>
  <worldbody>
    <body pos="0 0 1"><joint axis="0 0 1" range="-2 2"/><geom size="0.05" mass="1"/>
      <body pos="0.1 0 0"><joint axis="1 1 0" range="-2 2"/>
        <geom size="0.05" mass="1"/>
        <geom type="capsule" size="0.03 0.1" pos="0 0.1 0" euler="20 30 0"/>
        <geom type="cylinder" size="0.03 0.1" pos="0 0.2 0" euler="50 -30 10"/>
        <geom type="box" size="0.03 0.05 0.1" pos="0.1 0.2 0" euler="10 70 10"/>
        <body pos="0 0 0.2"><joint axis="0 1 0" range="-2 2"/>
          <geom type="ellipsoid" size="0.03 0.05 0.1" pos="0.1 0.1 0" euler="10 70 10"/>
          <geom type="mesh" mesh="wedge" pos="0 0 0.1"/>
          <site name="tip"/>
        </body>
      </body>
    </body>
    {table}
  </worldbody>
</mujoco>
"""
TABLE = '<geom name="table" type="box" size="9 9 1" pos="0 0 -1"/>'


def test_the_lowest_point_of_every_shape_is_mujocos(tmp_path):
    """Heights equal MuJoCo's distance to a box below the plane; links at constant height do not count."""
    path = tmp_path / "shapes.xml"
    path.write_text(SHAPES.format(table=""))
    robot = load_robot(str(path), tau_max=[50, 50, 50])
    space = Space(robot, table=0.0, deviation=0.0)
    assert len(space.above) == 6
    model = mujoco.MjModel.from_xml_string(SHAPES.format(table=TABLE))
    data, table = mujoco.MjData(model), model.geom("table").id
    links = [g for g in range(model.ngeom) if model.geom_bodyid[g] >= 2]
    q = np.random.default_rng(0).uniform(-2, 2, (30, 3))
    heights = space.gaps(q)[:, 1:7] + space.clearance[1:7]
    for posture, seen in zip(q, heights, strict=True):
        data.qpos[:] = posture
        mujoco.mj_kinematics(model, data)
        expected = [mujoco.mj_geomDistance(model, data, g, table, 9.0, None) for g in links]
        np.testing.assert_allclose(seen, expected, atol=2e-5)


def test_the_checked_pairs_of_a_panda():
    """All of links 2 to 7 above the table; of the pairs only joint housings are left out; home is clear of all."""
    space = Space(arm())
    watched = {space.model.body(space.model.geom_bodyid[g]).name for g in space.above}
    assert watched == {f"link{k}" for k in range(2, 8)}
    pairs = {tuple(space.model.body(space.model.geom_bodyid[g]).name[-1] for g in pair) for pair in space.pairs}
    apart = {(str(a), str(b)) for a in range(8) for b in range(a + 2, 8)}
    assert pairs == apart - {("2", "4")}  # the upper arm and the elbow keep their distance whatever joint 3 does
    assert space.gaps(arm().q_home[None]).min() > 0


# --- the file


def test_a_saved_excitation_comes_back(tmp_path):
    """Header and rows that any controller can replay; the same motion after loading; nothing half-written."""
    e, path = excited(3.0, 1), tmp_path / "motion.csv"
    e.save(path)
    lines = path.read_text().splitlines()
    assert lines[0].split(",")[:3] == ["t", "q1", "q2"]
    assert lines[0].split(",")[-1] == "ddq7"
    assert len(lines) == len(e.t) + 1
    back = load(path, arm())
    for name in ("t", "q", "dq", "ddq"):
        np.testing.assert_allclose(getattr(back, name), getattr(e, name), rtol=1e-11, atol=1e-14)
    assert [p.name for p in tmp_path.iterdir()] == ["motion.csv"]
    assert "a file name ending in .csv, got 'motion.txt'" in message(e.save, tmp_path / "motion.txt")


def edited(lines, row, column, value):
    cells = lines[row].split(",")
    cells[column] = value
    return [*lines[:row], ",".join(cells), *lines[row + 1 :]]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda x: edited(x, 0, 2, "q_2"), ["got no 'q2'", "t, q1..q7, dq1..dq7, ddq1..ddq7"]),
        (lambda x: edited(x, 0, 2, "Q2"), ["got no 'q2'", "did you mean 'Q2'?"]),
        (lambda x: edited(x, 10, 2, "fast"), ["not a table of numbers", "fast"]),
        (lambda x: [*x[:50], x[50] + ",1", *x[51:]], ["not a table of numbers", "columns"]),
        (lambda x: edited(x, 10, 2, "nan"), ["q of joint 2 is nan at 0.009 s"]),
        (lambda x: edited(x, 10, 0, "0.0095"), ["got 0.0015 s at 0.008 s"]),
        (lambda x: edited(x, 1000, 3, "4"), ["position of joint 3 is 4 rad at 0.999 s"]),
        (lambda x: edited(x, 1000, 3, "0.3"), ["dq of joint 3", "off the slope of q at 0.99"]),
        (lambda x: x[:1000], ["at 0.998 s; expected 0 at both ends"]),
        (lambda x: x[:1], ["0 rows"]),
        (lambda x: [], ["got no 't'"]),
        (lambda x: [x[0] + ",q8", *(y + ",0" for y in x[1:])], ["expected 7 joints", "got joint 8"]),
        (lambda x: [x[0], *(y + ",0" for y in x[1:])], ["expected 22 columns, got 23"]),
    ],
)
def test_a_bad_file_gets_one_line(tmp_path, change, words):
    """The error names the file and the problem."""
    path = tmp_path / "motion.csv"
    excited(3.0, 1).save(path)
    path.write_text("\n".join(change(path.read_text().splitlines())) + "\n")
    text = message(load, path, arm())
    for word in [str(path), *words]:
        assert word in text


def test_no_file_and_no_text(tmp_path):
    excited(3.0, 1).save(tmp_path / "motion.csv")
    assert "did you mean 'motion.csv'?" in message(load, tmp_path / "motoin.csv", arm())
    assert "no such file" in message(load, tmp_path / "nowhere" / "motion.csv", arm())
    (tmp_path / "noise.csv").write_bytes(b"\xff\xfe\x00\n" * 99)
    assert "not a table of numbers" in message(load, tmp_path / "noise.csv", arm())


def test_a_file_is_checked_for_the_present_robot(tmp_path):
    """`load` checks a motion for the present table and robot."""
    excited(3.0, 1).save(tmp_path / "motion.csv")
    floor = lowest(excited(3.0, 1)) + 0.02
    assert "above the base plane" in message(load, tmp_path / "motion.csv", arm(), z_min=floor)
    slower = replace(arm(), dq_max=0.5 * arm().dq_max)
    assert "velocity of joint" in message(load, tmp_path / "motion.csv", slower)
