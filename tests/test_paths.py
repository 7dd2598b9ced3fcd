"""Paths: the error names the violation, and `approach` finds a free path."""

import numpy as np
import pytest
from conftest import conf

from r2s.errors import UserError
from r2s.excitation.motion_checks import CLEARANCE_M, Space
from r2s.excitation.paths import approach, path_violation
from r2s.physics.robot import load_robot

ROBOT = load_robot(**conf("robot/panda"))
SPACE = Space(ROBOT)
LOW = np.array([0.0, 1.2, 0, -1.9, 0, 2.2, 0.8])  # the hand far out, a little above the table


def violation(path):
    return path_violation(ROBOT, np.array(path), SPACE)


def allowed():
    """Return postures (., 7) that keep their distances."""
    q = np.random.default_rng(0).uniform(ROBOT.q_min, ROBOT.q_max, (400, 7))
    return q[(SPACE.gaps(q) >= 0).all(1)]


def test_violations_of_a_path_are_named():
    home, far, below = ROBOT.q_home, ROBOT.q_home.copy(), ROBOT.q_home.copy()
    far[3], below[1] = 0.5, 1.7
    assert violation([home, home + 0.1]) == ""
    assert violation([home, far]) == "joint 4 would be at 0.5 rad 100 % of the way, allowed -3.0718 to -0.0698"
    line = violation([home, home + 0.1, below])
    assert line.startswith("the end effector is 0.0")
    assert "% of the way, from posture 2 to 3 of 3, allowed 0.1 m or more" in line
    line = violation([home, below])
    assert "% of the way, allowed" in line
    assert "joint 2 of posture 2 is nan" in violation([home, np.where(np.arange(7) == 1, np.nan, home)])
    assert "(1, 7)" in violation([home])


@pytest.mark.long
def test_nothing_touches_between_two_samples():
    """On every allowed path all distances stay positive at a finer sampling."""
    postures, checked = allowed(), 0
    for a, b in zip(postures[:30:2], postures[1:30:2], strict=True):
        if violation([a, b]):
            continue
        gaps = SPACE.gaps(a + np.linspace(0, 1, 200)[:, None] * (b - a))
        assert np.all(gaps[:, 1:] > -CLEARANCE_M)
        checked += 1
    assert checked > 8


def test_an_arm_that_is_too_near_may_leave_but_not_come_nearer():
    """From a start too near to the table an arm may move away from it, but not towards it."""
    near = LOW + np.array([0, 0.12, 0, 0, 0, 0, 0])
    gap = SPACE.gaps(near[None])[0]
    assert gap.min() < 0
    assert violation([near, ROBOT.q_home]) == ""
    assert "above" in violation([near, near + np.array([0, 0.05, 0, 0, 0, 0, 0])])


@pytest.mark.long
def test_a_detour_is_found_if_the_straight_path_is_blocked():
    """Around an obstacle most paths lead through home or joint by joint."""
    postures, ways, refused = allowed(), [], []
    for a, b in zip(postures[:70:2], postures[1:70:2], strict=True):
        try:
            path = approach(ROBOT, a, b, what="the way", space=SPACE)
        except UserError as error:
            refused.append(str(error))
            continue
        assert np.array_equal(path[[0, -1]], [a, b])
        assert violation(path) == ""
        ways.append(len(path))
    assert len(ways) > 10 * len(refused)
    assert all(line.endswith("no path through q_home or joint by joint is free either") for line in refused)
    assert max(ways) > 2
    with pytest.raises(UserError, match=r"the way to start 3: joint 4 would be at 0\.5 rad"):
        approach(ROBOT, ROBOT.q_home, np.full(7, 0.5), what="the way to start 3", space=SPACE)
