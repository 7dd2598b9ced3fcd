"""Held-out motion shares neither rows nor phases with the motion that is fitted."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_recording import assert_same, message, sine

from r2s.errors import UserError
from r2s.recordings.readers import read
from r2s.recordings.recording import SPLIT_GUARD_S, Recording

GAZ2019 = Path(__file__).parents[2] / "shared/data/gaz2019_panda/train.npz"


def phase_distance(a, b, period):
    """Return the smallest distance on the circle of phases between two sets of times."""
    d = (a[:, None] - b[None, :]) % period
    return np.minimum(d, period - d).min()


@pytest.mark.parametrize("fraction", [0.1, 0.25, 0.5])
@pytest.mark.parametrize("gap", [(3.6, 6.9), (1.0, 2.0), (8.0, 9.5)])
def test_a_periodic_split_shares_no_phase(fraction, gap):
    """As in gaz2019: a period, logged twice in part, the middle missing."""
    period, t = 6.66, np.arange(0, 13, 5e-3)
    t = t[(t < gap[0]) | (t > gap[1])]
    r = sine(t, period=period).split_at_gaps(0.05)
    train, validation = r.split(fraction)
    assert phase_distance(train.t, validation.t, period) >= SPLIT_GUARD_S - 1e-9
    assert len(validation.t) == pytest.approx(fraction * len(t), rel=0.02)
    assert len(train.t) + len(validation.t) > 0.9 * len(t)
    assert set(train.t) | set(validation.t) <= set(t)
    for part in (train, validation):  # no stretch bridges a cut
        assert max(np.diff(part.t[s]).max() for s in part.stretches) < 0.01
    assert_same(r.split(fraction, period=period)[1], validation)


def test_several_trajectories_are_held_out_whole():
    r = sine(np.arange(1000) * 1e-3, trajectory=np.repeat([0, 1, 2, 3], [400, 300, 200, 100]))
    train, validation = r.split(0.25)
    assert (len(train.t), len(validation.t)) == (700, 300)
    assert len(r.split(0.001)[1].t) == 100  # at least one on each side
    assert len(r.split(0.999)[0].t) == 400


@pytest.mark.parametrize("pause", [40, 4960])
def test_a_pause_near_an_end_does_not_choose_what_is_held_out(pause):
    """The boundary would leave 1 % on one side; the longer trajectory is cut instead, with a gap."""
    r = sine(np.arange(5000) * 1e-3, trajectory=(np.arange(5000) >= pause).astype(int))
    train, validation = r.split(0.25)
    assert len(validation.t) == 1250
    assert len(train.t) == pytest.approx(3750 - 1e3 * SPLIT_GUARD_S, abs=2)
    assert validation.t[0] - train.t[train.t < validation.t[0]][-1] > SPLIT_GUARD_S - 1e-9
    with pytest.raises(UserError, match="for validation, got 1 of 5000"):
        sine(np.arange(5000) * 1e-3, trajectory=(np.arange(5000) >= 40).astype(int)).split(1e-6)


def test_one_trajectory_is_cut_once_with_a_gap():
    train, validation = sine(np.arange(5000) * 1e-3).split(0.2)
    assert validation.t[0] - train.t[-1] > SPLIT_GUARD_S
    assert len(validation.t) == pytest.approx(1000, abs=2)


@pytest.mark.parametrize("late", [0.0, 1.5])
def test_repeats_whose_clock_restarts_are_held_out_by_phase(tmp_path, late):
    """One motion three times, each from t = 0, the second started `late` into it: nothing held out is trained on."""
    t = np.arange(0, 6, 5e-3)
    starts = [t, t[t >= late] - late, t[: len(t) // 2]]
    when = np.concatenate([t, t[t >= late], t[: len(t) // 2]])  # in terms of the motion
    q = np.stack([np.sin(0.4 * when**2), np.cos(0.3 * when**2)], -1)
    rng = np.random.default_rng(0)
    q, dq, tau = (x + 1e-4 * rng.standard_normal(x.shape) for x in (q, 0 * q, q))
    np.savez(tmp_path / "repeats.npz", t=np.concatenate(starts), q=q, dq=dq, tau_J=tau)
    r = read(tmp_path / "repeats.npz", torque="measured")
    assert [s.stop - s.start for s in r.stretches] == [len(x) for x in starts]
    phased = r.in_phase()
    np.testing.assert_allclose(phased.t, when, atol=0.02 if late else 1e-12)
    assert phased.period == pytest.approx(6.0, abs=0.03)
    train, validation = phased.split(0.25)
    motion = dict(zip(q[:, 0].tolist(), when.tolist(), strict=True))
    held, fitted = ([motion[x] for x in part.q[:, 0].tolist()] for part in (validation, train))
    assert min(held) - max(fitted) > SPLIT_GUARD_S - 0.03
    assert len(held) + len(fitted) > 0.9 * len(when)


def test_repetitions_started_by_hand_are_aligned():
    """The same motion at 0, 11.3 and 30 s of one clock has one phase; trajectories of other motion keep the clock."""
    t = np.arange(0, 5, 0.01)
    clock = np.concatenate([t, t + 11.3, t + 30.0])
    q = np.tile(np.stack([np.sin(0.4 * t**2), np.cos(0.3 * t**2)], -1), (3, 1))
    made = {"dq": 0 * q, "tau": q, "torque": "measured", "trajectory": np.repeat([0, 1, 2], len(t))}
    phased = Recording(clock, q, **made).in_phase()
    assert np.ptp((phased.t % phased.period).reshape(3, -1), axis=0).max() < 0.03
    other = np.concatenate([q[: len(t)], q[: len(t)] * [1.0, -1.0] + 0.2, 0.5 * q[: len(t)]])
    apart = Recording(np.tile(t, 3), other, **made)
    assert apart.in_phase() is apart


@pytest.mark.long
@pytest.mark.parametrize("error", [0.005, 0.008, 0.015])
def test_a_soft_arm_repeats_its_motion(error):
    """Six repetitions, each with another tracking error (rad RMS), have a period; no phase is in both parts."""
    period, t, rng = 6.66, np.arange(0, 40, 5e-3), np.random.default_rng(0)
    slow = rng.uniform(0.02, 0.9, (20, 1, 3)) * 2 * np.pi * t[:, None] + rng.uniform(0, 2 * np.pi, (20, 1, 3))
    off = np.sin(slow).sum(0)
    q = 0.5 * np.sin(2 * np.pi * t[:, None] / period + np.arange(3)) + error * off / off.std(0)
    r = Recording(t, q, 0 * q, q, "measured").in_phase()
    assert r.period == pytest.approx(period, abs=0.1)
    train, validation = r.split(0.25)
    assert phase_distance(train.t, validation.t, r.period) >= SPLIT_GUARD_S - 1e-9


def test_slow_motion_has_no_period():
    """At 0.01 rad/s postures half a second apart are equal within the tolerance, but that is no period."""
    t = np.arange(0, 60, 0.02)
    q = 0.01 * t[:, None] * [1.0, -1.0]
    assert Recording(t, q, 0 * q, q, "measured").find_period() is None


def test_overlap_of_two_recordings():
    """Other noise and another clock do not change the overlap; a faster, mirrored or other motion has none."""
    t, rng = np.arange(0, 10, 2e-3), np.random.default_rng(0)

    def moved(when, scale=(1.0, 1.0)):
        q = np.stack([np.sin(0.3 * when**1.7), np.cos(0.2 * when**1.8)], -1) * scale
        return Recording(t, q + 1e-3 * rng.standard_normal(q.shape), 0 * q, q, "measured")

    first = moved(t)
    again = moved(t)
    assert again.overlap(first) == 1.0
    late = again.select(again.t > 3.3)
    assert replace(late, t=late.t + 100.0).overlap(first) == 1.0
    off = 0.015 * np.sqrt(2) * np.stack([np.sin(1.7 * t), np.cos(2.3 * t)], -1)  # tracking error of 15 mrad RMS
    for scale in (1.0, 0.3):
        assert replace(again, q=scale * again.q + off).overlap(moved(t, (scale, scale))) == 1.0
    for other in (moved(1.1 * t), moved(t, (1.0, -1.0)), moved(t + 7.0, (0.8, 1.0))):
        assert other.overlap(first) < 0.2
    assert moved(0 * t).overlap(first) == 0.0


def test_an_impossible_split_is_an_error():
    r = sine(np.arange(500) * 1e-3)
    assert "a number in (0, 1)" in message(r.split, 1.5)
    assert "expected at least 10 rows for validation, got 1 of 500" in message(r.split, 0.001)
    assert "expected at least 10 rows for training" in message(r.split, 0.99)


def test_gaz2019_splits_by_phase():
    if not GAZ2019.exists():
        pytest.skip("the gaz2019 recording is not there (its licence keeps it out of this repository)")
    r = read(GAZ2019, torque="measured", columns={"trajectory": "segment"}, n_joints=7)
    assert (len(r.t), r.n_joints, len(r.stretches)) == (13910, 7, 2)
    train, validation = r.split(0.2, period=13.333)
    assert phase_distance(train.t[::7], validation.t, 13.333) > 0.09
    assert len(validation.t) == pytest.approx(0.2 * 13910, rel=0.02)
    assert len(train.t) > 0.75 * 13910
