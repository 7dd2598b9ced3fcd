"""Recordings: what they refuse, and operations on their rows."""

from dataclasses import FrozenInstanceError, replace

import numpy as np
import pandas as pd
import pytest

from r2s.errors import UserError
from r2s.recordings.recording import Recording

OMEGA = 2 * np.pi * 1.3  # rad/s


def sine(t, n=3, **fields):
    """Return joints that follow sines of known derivatives: q = sin, dq = OMEGA cos, ddq = -OMEGA^2 sin."""
    angle = OMEGA * np.asarray(t)[:, None] + np.arange(n)
    q, dq = np.sin(angle), OMEGA * np.cos(angle)
    return Recording(t, q, dq, 3 * q - dq, **{"torque": "measured", **fields})


def jittered_time(rows=2000, seed=0):
    return 5.0 + np.cumsum(np.random.default_rng(seed).uniform(0.3e-3, 1.7e-3, rows))


def assert_same(a, b):
    for field in ("t", "q", "dq", "tau", "trajectory"):
        np.testing.assert_array_equal(getattr(a, field), getattr(b, field), err_msg=field)
    assert (a.torque, a.period, a.name) == (b.torque, b.period, b.name)


def message(call, *args, **kwargs):
    with pytest.raises(UserError) as caught:
        call(*args, **kwargs)
    text = str(caught.value)
    assert "\n" not in text
    return text


def columns_of(recording, tau="tau_J", joint="{name}{j}"):
    """Return per-joint columns as a log would have them."""
    table = {"t": recording.t, "segment": recording.trajectory}
    for field, name in (("q", "q"), ("dq", "dq"), ("tau", tau)):
        for j in range(recording.n_joints):
            table[joint.format(name=name, j=j + 1, i=j)] = getattr(recording, field)[:, j]
    return table


def write(path, table):
    if path.suffix == ".npz":
        np.savez(path, **table)
    elif path.suffix == ".csv":
        pd.DataFrame(table).to_csv(path, index=False)
    else:
        pd.DataFrame(table).to_parquet(path)
    return path


def test_recording_is_a_read_only_copy():
    t = jittered_time()
    r = sine(t)
    t[0] = 0  # the caller's array stays the caller's
    assert r.t[0] > 5
    assert not any(getattr(r, f).flags.writeable for f in ("t", "q", "dq", "tau", "trajectory"))
    assert all(getattr(r, f).dtype == np.float64 for f in ("t", "q", "dq", "tau"))
    with pytest.raises(FrozenInstanceError):
        r.name = "other"


def test_duration_and_rate_leave_out_the_time_between_trajectories():
    t = np.concatenate([np.arange(100) * 1e-3, 50 + np.arange(200) * 1e-3])
    r = sine(t, trajectory=np.repeat([0, 1], [100, 200]))
    assert r.n_joints == 3
    assert r.duration == pytest.approx(0.298)
    assert r.rate_hz == pytest.approx(1000)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (
            lambda x: x["tau"].__setitem__((7, 1), np.nan),
            "tau: expected finite values, got nan at row 7 of joint 2 (1 such value",
        ),
        (
            lambda x: x["q"].__setitem__((slice(4, 6), 0), np.inf),
            "q: expected finite values, got inf at row 4 of joint 1 (2 such values",
        ),
        (lambda x: x["t"].__setitem__(3, np.nan), "t: expected finite values, got nan at row 3"),
        (lambda x: x["t"].__setitem__(9, 0.008), "time does not increase at row 9: t is 0.008, then 0.008 s"),
        (lambda x: x.update(dq=x["dq"][:, :2]), "expected dq of shape (50, 3), got (50, 2)"),
        (lambda x: x.update(q=x["q"][1:]), "expected q of shape (50, 3), got (49, 3)"),
        (lambda x: x.update(q=x["q"][:, 0]), "expected t of shape (T,) and q of shape (T, n), got (50,) and (50,)"),
        (lambda x: x.update(trajectory=np.zeros(3)), "expected trajectory of shape (50,), got (3,)"),
        (
            lambda x: x.update(trajectory=np.full(50, 0.5)),
            "expected whole numbers in trajectory, got 0.5 at row 0",
        ),
        (
            lambda x: x.update(trajectory=np.repeat([0, 1, 0], [20, 20, 10])),
            "trajectory 0 occurs again at row 40",
        ),
        (lambda x: x.update(torque=""), "torque is not declared"),
        (
            lambda x: x.update(torque="mesured"),
            "unknown torque 'mesured'; allowed: measured, commanded, motor; did you mean",
        ),
        (lambda x: x.update(q="abc"), "expected q to be a rectangular array of numbers"),
        (lambda x: x.update(period=-1), "period: expected a positive number of s, got -1"),
        (
            lambda x: x.update({k: v[:4] for k, v in x.items() if k != "torque"}),
            "expected at least 10 rows, got 4",
        ),
    ],
)
def test_a_bad_array_is_named_in_one_line(change, expected):
    t = np.arange(50) * 1e-3
    fields = {
        "t": t,
        "q": np.ones((50, 3)),
        "dq": np.ones((50, 3)),
        "tau": np.ones((50, 3)),
        "torque": "measured",
    }
    change(fields)
    assert expected in message(Recording, **fields)


def test_undeclared_torque_is_explained():
    text = message(sine, jittered_time(), torque=None)
    assert all(word in text for word in ("measured", "commanded", "gravity", "tau_J ", "tau_J_d"))


def test_select_makes_every_run_of_rows_a_trajectory():
    r = sine(np.arange(60) * 1e-3, trajectory=np.repeat([0, 1], 30))
    mask = np.ones(60, bool)
    mask[[10, 11, 45]] = False
    kept = r.select(mask)
    np.testing.assert_array_equal(kept.t, r.t[mask])
    np.testing.assert_array_equal(np.bincount(kept.trajectory), [10, 18, 15, 14])
    assert_same(r.select(np.ones(60, bool)), r)
    assert "(60,) bool" in message(r.select, np.arange(60))


def test_gaps_split_and_lone_rows_go():
    t = np.concatenate([np.arange(20) * 1e-3, [1.0], 2 + np.arange(20) * 1e-3])
    r = sine(t).split_at_gaps(0.05)
    np.testing.assert_array_equal(np.bincount(r.trajectory), [20, 20])
    assert 1.0 not in r.t
    assert "t must be in seconds" in message(sine(np.arange(50) * 1e6).split_at_gaps, 0.05)


@pytest.mark.parametrize("rate", [10, 20, 30, 60, 1000])
def test_a_lost_frame_is_no_pause_and_a_second_is_one(rate):
    """At any rate of the log, with a clock that is rounded; a limit of the user's counts up to round-off."""
    t = 7.3 + np.arange(5 * rate) / rate
    t = np.delete(t, [2 * rate])
    assert len(sine(t).split_at_gaps().stretches) == 1
    t[3 * rate :] += 1.0
    assert len(sine(t).split_at_gaps().stretches) == 2
    whole = sine(7.3 + np.arange(5 * rate) / rate)
    assert len(whole.split_at_gaps(1 / rate).stretches) == 1
    assert "t must be in seconds" in message(sine(1e3 * np.arange(50) / 1e3).split_at_gaps)


def test_resample_keeps_to_the_logged_clock_and_to_its_trajectory():
    t = jittered_time()
    r = sine(t, trajectory=np.arange(len(t)) // 1000)
    even = r.resample(1e-3)
    for s, logged in zip(even.stretches, r.stretches, strict=True):
        assert even.t[s][0] == t[logged][0]
        assert even.t[s][-1] <= t[logged][-1]
        np.testing.assert_allclose(np.diff(even.t[s]), 1e-3, rtol=1e-6)
    np.testing.assert_allclose(even.q, sine(even.t).q, atol=5e-5)  # (1.7 ms)^2 OMEGA^2 / 8 = 2.4e-5
    assert "as long as dt=60" in message(r.resample, 60)
    assert_same(even.resample(1e-3), even)


def test_acceleration_follows_logged_time():
    """Timestamps jitter by 70 %: index * 1 ms is wrong by tens of percent, logged time by less than one."""
    r = sine(jittered_time())
    true = -(OMEGA**2) * r.q
    by_index = np.gradient(r.dq, 1e-3, axis=0)
    assert np.abs(r.acceleration() - true).max() < 0.01 * OMEGA**2
    assert np.abs(by_index - true).max() > 0.3 * OMEGA**2


def test_nothing_bridges_two_trajectories():
    """Two trajectories with different constants stay constant under every operation."""
    t = np.arange(400) * 1e-3
    step = np.repeat([0.0, 1.0], 200)[:, None]
    r = Recording(t, step, step, step, "commanded", np.repeat([0, 1], 200))
    np.testing.assert_allclose(r.acceleration(), 0, atol=1e-9)
    np.testing.assert_allclose(r.smooth(20).tau, step, atol=1e-12)
    assert set(r.resample(0.7e-3).q.ravel()) == {0.0, 1.0}


def test_smooth_has_no_phase_and_removes_what_is_above_the_cutoff():
    r = sine(np.arange(4000) * 1e-3)
    noisy = replace(r, tau=r.tau + np.sin(2 * np.pi * 100 * r.t)[:, None])
    middle = slice(500, -500)
    assert np.abs(noisy.smooth(20).tau - r.tau)[middle].max() < 2e-3
    assert np.abs(noisy.smooth(20).q - r.q)[middle].max() < 1e-4
    assert "resample first" in message(sine(jittered_time()).smooth, 20)
    assert "below half the rate, 500" in message(r.smooth, 700)


def test_a_single_row_has_no_acceleration():
    mask = np.arange(60) % 2 == 0
    assert "1 row" in message(sine(np.arange(60) * 1e-3).select(mask).acceleration)
