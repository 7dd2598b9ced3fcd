"""The simulator of benchmarks/independent_arms.py and the scores of its judge."""

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent.parent / "benchmarks"))

pytestmark = pytest.mark.slow  # it takes half a minute to compile


def still(seed: int, **changes):
    """Return an arm of a seed without delay and lag, its truth, and its state at rest."""
    from independent_arms import CENTRE, draw, make_arm
    from independent_dynamics import at_rest

    truth = draw(seed)
    arm = make_arm(truth)._replace(delay=0.0, lag=0.0, **changes)
    return arm, truth, at_rest(arm, CENTRE)


def test_rigid_bodies_agree_with_mujoco():
    from independent_arms import rigid_body_error

    assert rigid_body_error() < 1e-10


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_joint_holds_up_to_its_breakaway_torque(seed):
    from independent_dynamics import cycle

    arm, truth, state = still(seed)
    start, joint = state.q.copy(), 3
    edge = truth["breakaway_command_pos"][joint]
    u = np.zeros(7)
    for u[joint] in (0.9 * edge, edge - 1e-9):
        for _ in range(50):
            cycle(arm, state, u)
        assert (state.q == start).all()  # to the bit
    u[joint] = edge + 1e-6
    for _ in range(50):
        cycle(arm, state, u)
    assert state.q[joint] > start[joint]


def test_a_joint_that_another_one_pulls_slips():
    from independent_dynamics import cycle

    arm, _, state = still(1)
    u = np.array([0.0, 60.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    for _ in range(20):
        cycle(arm, state, u)
    assert not state.stuck[3]  # the elbow has no command of its own


@pytest.mark.parametrize("seed", [0, 1, 2, 3])
def test_half_the_step_moves_the_arm_the_same_way(seed):
    """Through stops, reversals and releases: within a tenth of the encoder resolution."""
    from independent_dynamics import cycle

    arm, _, _ = still(seed)
    ends = []
    for step in (arm.step, 0.5 * arm.step):
        _, _, state = still(seed)
        for k in range(1500):
            cycle(arm._replace(step=step), state, 3.0 * arm.high * np.sin(2 * np.pi * k / 500 + np.arange(7)))
        ends.append(state.q.copy())
    np.testing.assert_allclose(ends[0], ends[1], rtol=0, atol=2e-6)


def test_delay_and_lag_are_exact():
    from independent_dynamics import cycle

    arm, _, state = still(0)
    arm = arm._replace(delay=2.3e-3, lag=1.5e-3, low=np.full(7, -10.0), high=np.full(7, 10.0))
    for k in range(20):
        cycle(arm, state, np.ones(7))
        since = max(1e-3 * (k + 1) - arm.delay, 0.0)
        np.testing.assert_allclose(state.drive, 1 - np.exp(-since / arm.lag), atol=1e-12)


def test_the_truth_itself_has_no_error():
    """Friction minus offset of eq. (5) is exact in r2s's family; breakaway torques are those of the truth."""
    from independent_arms import CENTRE, draw, friction
    from independent_judge import SPEEDS, OtherTorques, drags, edges, speeds, true_dynamics

    truth = draw(0)
    found, v = true_dynamics(truth), speeds(np.ones((2, 7)), SPEEDS)
    true_edges = np.stack([truth["breakaway_command_neg"], truth["breakaway_command_pos"]], -1)
    for at in (None, OtherTorques(CENTRE[None])):  # the truth has friction and offset only
        np.testing.assert_allclose(drags(found, v, at), friction(truth, v) - truth["offset"], atol=1e-12)
        np.testing.assert_allclose(edges(found, at), true_edges, atol=1e-12)


def test_scored_speeds_are_those_of_each_direction():
    from independent_judge import speeds, visited

    t = np.arange(0, 10, 1e-3)[:, None]
    top = visited(np.where(t % 2 < 1, 0.8 * (t % 1), 0.8 - 0.8 * (t % 1)) * np.linspace(0.5, 1.0, 7))
    np.testing.assert_allclose(top, np.tile(0.8 * np.linspace(0.5, 1.0, 7), (2, 1)), rtol=1e-6)
    v = speeds(top, 5)
    np.testing.assert_allclose(v[:, 0], [[0.05] * 7, [-0.05] * 7])
    np.testing.assert_allclose(v[:, -1], [top[0], -top[1]])


def test_plain_regression_finds_coulomb_friction(tmp_path):
    """Within 1 % of the level: its columns contain the offset and a level per direction."""
    from independent_arms import draw, friction, make_arm, record_motion
    from independent_judge import plain_regression, speeds

    truth = draw(1)
    np.savez(tmp_path / "train.npz", **record_motion(make_arm(truth), np.array(truth["friction"]["fc_pos"]), 1, 1))
    v = speeds(np.full((2, 7), 0.8), 10)
    right = friction(truth, v)
    error = plain_regression(tmp_path / "train.npz")(v) - (right - truth["offset"])
    assert (np.abs(error).max((0, 1)) < 0.01 * np.abs(right).mean((0, 1))).all()


@pytest.mark.parametrize(("seed", "all_rows", "family"), [(27, "coulomb", "stribeck"), (31, "stribeck", "coulomb")])
def test_slow_sliding_shows_whether_friction_falls_with_velocity(seed, all_rows, family, tmp_path):
    """It does on arm 27 below 0.1 rad/s, not on arm 31. Fits of all rows take one for the other."""
    from common import OLD, ROBOT, identify_settings
    from independent_arms import write_arm

    from r2s.identification.identify import STANDSTILL
    from r2s.identification.structure.cross_validation import CrossValidation
    from r2s.identification.structure.family_selection import compare_families
    from r2s.identification.terms import scaled_prior
    from r2s.physics.friction import FAMILIES
    from r2s.recordings.readers import read

    write_arm(tmp_path / "arm", seed)
    recording = read(tmp_path / "arm" / "train.npz", torque="commanded", n_joints=ROBOT.n, name="train")
    settings = identify_settings()
    prior = scaled_prior(settings.prior, ROBOT, recording)
    given = ROBOT, OLD, recording, settings.bounds, prior, settings.folds, settings.cutoff_hz
    cv = CrossValidation(*given, report=lambda row: None)
    for slowest, picked in ((0.0, all_rows), (STANDSTILL, family)):
        chosen = compare_families(cv, settings.terms, slowest)
        assert FAMILIES[chosen["best"]].name == picked
