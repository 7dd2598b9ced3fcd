"""A recording is read back as it was written; a bad file gives one line."""

import re
from dataclasses import replace

import numpy as np
import pytest
from test_recording import assert_same, columns_of, jittered_time, message, sine, write

from r2s.recordings.readers import read
from r2s.recordings.recording import Recording

OMEGA = 2 * np.pi * 1.3  # rad/s


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
    r = replace(r, notes=("2 repeated rows are left out", "the last row is incomplete and left out"))
    path = tmp_path / "saved.npz"
    r.save(path)
    for torque in (None, "???", "commanded"):
        assert_same(read(path, torque=torque), r)
        assert read(path, torque=torque).notes == r.notes
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
