"""Ways are checked before they are driven: what forbids one is said, and another one is found where there is one."""

import numpy as np
import pytest
from conftest import conf

from r2s.errors import UserError
from r2s.excitation.paths import approach, check_path
from r2s.excitation.safety import CLEARANCE_M, Space
from r2s.physics.robot import load_robot

ROBOT = load_robot(**conf("robot/panda"))
SPACE = Space(ROBOT)
LOW = np.array([0.0, 1.2, 0, -1.9, 0, 2.2, 0.8])  # the hand far out, a little above the table


def said(path, **more):
    with pytest.raises(UserError) as caught:
        check_path(ROBOT, np.array(path), space=SPACE, **more)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def allowed():
    """Return postures (., 7) that keep their distances."""
    q = np.random.default_rng(0).uniform(ROBOT.q_min, ROBOT.q_max, (400, 7))
    return q[(SPACE.gaps(q) >= 0).all(1)]


def test_a_path_names_joint_or_link_where_and_what_is_allowed():
    home, far, below = ROBOT.q_home, ROBOT.q_home.copy(), ROBOT.q_home.copy()
    far[3], below[1] = 0.5, 1.7
    check_path(ROBOT, np.array([home, home + 0.1]), space=SPACE)
    assert said([home, far]) == "the path: joint 4 would be at 0.5 rad 100 % of the way, allowed -3.0718 to -0.0698"
    line = said([home, home + 0.1, below], what="data.ramp_poses")
    assert line.startswith("data.ramp_poses: the end effector is 0.0")
    assert "% of the way, from posture 2 to 3 of 3, allowed 0.1 m or more" in line
    line = said([home, below])
    assert "% of the way, allowed" in line
    assert "joint 2 of posture 2 is nan" in said([home, np.where(np.arange(7) == 1, np.nan, home)])
    assert "(1, 7)" in said([home])


def test_nothing_between_two_samples_comes_nearer_than_touching():
    """Of every path that is allowed, at more samples, no distance is used up."""
    postures, checked = allowed(), 0
    for a, b in zip(postures[:30:2], postures[1:30:2], strict=True):
        try:
            check_path(ROBOT, np.array([a, b]), space=SPACE)
        except UserError:
            continue
        gaps = SPACE.gaps(a + np.linspace(0, 1, 200)[:, None] * (b - a))
        assert np.all(gaps[:, 1:] > -CLEARANCE_M)
        checked += 1
    assert checked > 8


def test_an_arm_that_is_too_near_may_leave_but_not_come_nearer():
    """The first posture is where the arm is; off the table is allowed from there, towards it is not."""
    near = LOW + np.array([0, 0.12, 0, 0, 0, 0, 0])
    gap = SPACE.gaps(near[None])[0]
    assert gap.min() < 0
    check_path(ROBOT, np.array([near, ROBOT.q_home]), space=SPACE)
    assert "above" in said([near, near + np.array([0, 0.05, 0, 0, 0, 0, 0])])


def test_another_way_is_found_where_the_straight_one_is_forbidden():
    """Between postures left and right of what is in the way, most lead by way of home or joint by joint."""
    postures, ways, refused = allowed(), [], []
    for a, b in zip(postures[:70:2], postures[1:70:2], strict=True):
        try:
            path = approach(ROBOT, a, b, space=SPACE)
        except UserError as error:
            refused.append(str(error))
            continue
        assert np.array_equal(path[[0, -1]], [a, b])
        check_path(ROBOT, path, space=SPACE)
        ways.append(len(path))
    assert len(ways) > 10 * len(refused)
    assert all(line.endswith("by way of home and joint by joint there is no way, either") for line in refused)
    assert max(ways) > 2
    with pytest.raises(UserError, match=r"the way to start 3: joint 4 would be at 0\.5 rad"):
        approach(ROBOT, ROBOT.q_home, np.full(7, 0.5), what="the way to start 3", space=SPACE)
