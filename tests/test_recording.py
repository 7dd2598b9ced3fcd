import re
from dataclasses import FrozenInstanceError, replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from r2s.errors import UserError
from r2s.recordings.readers import read
from r2s.recordings.recording import SPLIT_GUARD_S, Recording

GAZ2019 = Path(__file__).parents[2] / "shared/data/gaz2019_panda/train.npz"
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


# --- the recording itself


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


# --- operations


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


# --- the split


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


# --- files


@pytest.mark.parametrize("suffix", [".csv", ".npz", ".parquet"])
@pytest.mark.parametrize("joint", ["{name}{j}", "{name}_{j}", "{name}[{i}]", "{name}_{i}"])
@pytest.mark.parametrize(("torque", "tau"), [("measured", "tau_J"), ("commanded", "tau_J_d"), ("measured", "tau")])
def test_every_format_reads_back_the_same(tmp_path, suffix, joint, torque, tau):
    r = sine(jittered_time(300), n=7, torque=torque, name="log", trajectory=np.repeat([0, 1], 150))
    path = write(tmp_path / f"log{suffix}", columns_of(r, tau, joint))
    assert_same(read(path, torque=torque, n_joints=7), r)


def test_two_dimensional_columns(tmp_path):
    r = sine(jittered_time(300), name="log")
    arrays = {"t": r.t, "q": r.q, "dq": r.dq, "tau_J": r.tau}
    assert_same(read(write(tmp_path / "log.npz", arrays), torque="measured"), r)
    assert_same(read(write(tmp_path / "log.parquet", {k: list(v) for k, v in arrays.items()}), torque="measured"), r)


@pytest.mark.parametrize("period", [None, 13.33])
def test_a_saved_recording_is_restored(tmp_path, period):
    t = np.concatenate([jittered_time(200), 40 + jittered_time(200)])  # a gap inside trajectory 3 stays inside
    r = sine(t, torque="commanded", trajectory=np.full(400, 3), period=period, name="a name")
    path = tmp_path / "saved.npz"
    r.save(path)
    for torque in (None, "???", "commanded"):
        assert_same(read(path, torque=torque), r)
    assert "expected torque=commanded, as the file declares, got data.torque=measured" in message(
        read, path, torque="measured"
    )
    assert "did you mean 'measured'" in message(read, path, torque="mesured")
    assert "expected a file name ending in .npz, got 'saved.txt'" in message(r.save, tmp_path / "saved.txt")
    assert [p.name for p in tmp_path.iterdir()] == ["saved.npz"]


def with_signals(t, **fields):
    """Return a recording with flags (T, 3) and a load (T,) that tell the row."""
    row = np.arange(len(t))
    known = {"joint_contact": np.stack([row, row % 2, 0 * row], axis=1), "m_load": row + 0.5}
    return sine(t, signals=known, **fields)


def test_signals_follow_their_rows(tmp_path):
    """File, selection and split keep each row's signals; resampling keeps the last logged ones, never a mean."""
    r = with_signals(jittered_time())
    r.save(tmp_path / "known.npz")
    back = read(tmp_path / "known.npz", torque=None)
    assert_same(back, r)
    assert back.signals.keys() == r.signals.keys()
    for kept in (back.select(back.t > 5.5), *back.split(0.3), back):
        row = np.searchsorted(r.t, kept.t)
        np.testing.assert_array_equal(kept.signals["m_load"], row + 0.5)
        np.testing.assert_array_equal(kept.signals["joint_contact"][:, 1], row % 2)
    grid = r.resample(1e-3)
    np.testing.assert_array_equal(grid.signals["m_load"], np.searchsorted(r.t, grid.t + 1e-12, side="right") - 0.5)
    np.testing.assert_array_equal(grid.smooth(50.0).signals["m_load"], grid.signals["m_load"])


def test_wrong_signals_are_one_line():
    t = jittered_time(100)
    assert "got 'force'" in message(sine, t, signals={"force": np.zeros(100)})
    assert "expected 100 rows" in message(sine, t, signals={"m_ee": np.zeros(99)})
    assert "m_ee: expected finite values" in message(sine, t, signals={"m_ee": np.full(100, np.nan)})


def test_explicit_columns(tmp_path):
    r = sine(jittered_time(300), name="log")
    table = {"stamp": r.t}
    for j, side in enumerate("abc"):
        table |= {f"pos_{j}_rad": r.q[:, j], f"vel.{j + 1}": r.dq[:, j], f"effort {side}": r.tau[:, j]}
    columns = {
        "t": "stamp",
        "q": "pos_{i}_rad",
        "dq": "vel.{j}",
        "tau": ["effort a", "effort b", "effort c"],
        "trajectory": None,
    }
    for suffix in (".csv", ".npz", ".parquet"):
        assert_same(read(write(tmp_path / f"log{suffix}", table), torque="measured", columns=columns), r)


def test_missing_velocity_is_derived_on_the_logged_time_of_each_trajectory(tmp_path):
    t = jittered_time()
    t[1000:] += 0.2  # a gap, nowhere marked in the file
    r = sine(t)
    table = {k: v for k, v in columns_of(r).items() if not k.startswith("dq") and k != "segment"}
    for columns in (None, {"dq": "dq"}):
        got = read(write(tmp_path / "log.csv", table), torque="measured", columns=columns)
        assert len(got.stretches) == 2
        assert np.abs(got.dq - r.dq).max() < 0.01 * OMEGA
    whole = read(tmp_path / "log.csv", torque="measured", max_gap_s=np.inf)
    assert len(whole.stretches) == 1
    assert "no column 'speed' for dq" in message(
        read, tmp_path / "log.csv", torque="measured", columns={"dq": "speed"}
    )


def drop(table, *names):
    return {k: v for k, v in table.items() if k not in names}


@pytest.mark.parametrize(
    ("change", "arguments", "expected"),
    [
        (lambda x: x, {"torque": None}, "torque is not declared; set data.torque=measured"),
        (lambda x: x, {"torque": "???"}, "data.torque=commanded"),
        (
            lambda x: x,
            {"torque": "comanded"},
            "unknown torque 'comanded'; allowed: measured, commanded, motor; did you mean",
        ),
        (lambda x: x, {"columns": {"ta": "tau"}}, "unknown key 'ta' in data.columns; allowed: t, q, dq, tau"),
        (lambda x: x, {"columns": {"t": "tt"}}, "no column 'tt' for t; columns: t, segment, q1"),
        (lambda x: x, {"columns": {"t": "segmnt"}}, "did you mean 'segment'?"),
        (lambda x: x, {"columns": {"tau": ["tau_J1", "tau_J9"]}}, "no column 'tau_J9' for tau"),
        (lambda x: x, {"columns": {"t": ["t", "q1"]}}, "expected one column for t and for trajectory, got 2: t, q1"),
        (lambda x: x, {"columns": {"trajectory": "run"}}, "no column 'run' for trajectory"),
        (lambda x: x, {"torque": "commanded"}, "no column 'tau_J_d' for tau (commanded torque)"),
        (lambda x: x, {"torque": "commanded"}, "tau_J is measured torque"),
        (lambda x: x, {"n_joints": 7}, "q: expected 7 joints, got 3 (q1, q2, q3)"),
        (lambda x: drop(x, "tau_J3"), {}, "expected tau of shape (50, 3), got (50, 2)"),
        (lambda x: drop(x, "q2"), {}, "expected column 'q2' before 'q3'"),
        (lambda x: x | {"q2": ["a b"] * 50}, {}, "column 'q2': expected numbers, got 'a b' at row 0"),
        (
            lambda x: x | {"q2": np.where(np.arange(50) == 3, np.nan, 1)},
            {},
            "q: expected finite values, got nan at row 3 of joint 2",
        ),
        (lambda x: x | {"t": (x["t"] * 1e9).astype(np.int64)}, {}, "t must be in seconds"),
        (lambda x: x | {"t": np.zeros(50)}, {}, "time does not increase at row 1"),
    ],
)
@pytest.mark.parametrize("suffix", [".csv", ".npz", ".parquet"])
def test_a_bad_file_is_named_in_one_line(tmp_path, suffix, change, arguments, expected):
    path = write(tmp_path / f"log{suffix}", change(columns_of(sine(np.arange(50) * 1e-3))))
    text = message(read, path, **{"torque": "measured", **arguments})
    assert text.startswith(str(path))
    assert expected in text


def test_a_zero_based_file_does_not_lose_its_first_joint(tmp_path):
    """q_0 q_1 q_2 also holds q_1 q_2: numbering starts where the file starts."""
    table = columns_of(sine(jittered_time(50), n=3), joint="{name}_{i}")
    assert read(write(tmp_path / "log.csv", table), torque="measured").n_joints == 3


def test_a_path_that_is_no_recording(tmp_path):
    good = write(tmp_path / "swing.csv", columns_of(sine(jittered_time(50))))
    (tmp_path / "log.pkl").write_bytes(b"")
    (tmp_path / "empty.csv").write_bytes(b"")
    (tmp_path / "noise.npz").write_bytes(b"\x00\x01" * 99)
    (tmp_path / "noise.csv").write_bytes(b"\xff\xfe\x00\n" * 99)
    (tmp_path / "noise.parquet").write_bytes(b"\x00\x01" * 99)
    np.savez(tmp_path / "whole.npz", t=np.arange(9999.0))
    (tmp_path / "half.npz").write_bytes((tmp_path / "whole.npz").read_bytes()[:5000])
    np.savez(tmp_path / "pickled.npz", meta=np.array([{}], dtype=object))
    for name, expected in {
        "swin.csv": "no file .*did you mean 'swing.csv'",
        "nowhere/swing.csv": "no folder",
        "": "got another folder",
        "log.pkl": r"unknown suffix '.pkl'; allowed: .csv, .npz, .parquet",
        "empty.csv": "cannot be read as csv: No columns",
        "noise.npz": "expected an .npz archive",
        "noise.csv": "cannot be read as csv|no column",
        "noise.parquet": "cannot be read as parquet",
        "half.npz": "cannot be read as npz|expected an .npz archive",
        "pickled.npz": "'meta' is pickled",
    }.items():
        text = message(read, tmp_path / name, torque="measured")
        assert re.search(expected, text), text
        assert str(tmp_path / name) in text
    assert read(good, torque="measured").name == "swing"
    assert read(good, torque="measured", name="mine", period=2).name == "mine"


def test_find_period():
    """`find_period` finds the period of an excitation across a gap in the log, and None without a repetition."""
    t = np.arange(0, 12, 0.01)
    t = t[(t < 3.0) | (t > 4.4)]
    q = np.stack([np.sin(2 * np.pi * t / 5.0), 0.5 * np.cos(4 * np.pi * t / 5.0)], -1)
    made = {"t": t, "dq": np.zeros_like(q), "tau": np.zeros_like(q), "torque": "commanded"}
    assert Recording(q=q, **made).split_at_gaps(0.05).find_period() == pytest.approx(5.0, abs=0.03)
    chirp = np.stack([np.sin(0.4 * t**2), np.cos(0.3 * t**2)], -1)
    assert Recording(q=chirp, **made).find_period() is None
    still = np.zeros_like(q)
    assert Recording(q=still, **made).find_period() is None
