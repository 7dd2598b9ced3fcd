"""What a stage does with the user's files: it prints repairs, and names an option that does not fit the data."""

from dataclasses import replace

import numpy as np
import pytest
from test_readers import PANDA, joint_states

from r2s.errors import UserError
from r2s.recordings.clock import check_clock, speed_factors
from r2s.recordings.recording import Recording
from r2s.recordings.repairs import held, repair_rows
from r2s.stages.data import FileData, check_cutoff, read_file


def sines(rate, seconds=8.0, n=3):
    t = np.arange(0, seconds, 1 / rate)
    angle = np.outer(t, [1.1, 1.7, 2.3][:n])
    q, dq = 0.5 * np.sin(angle), 0.5 * np.array([1.1, 1.7, 2.3][:n]) * np.cos(angle)
    return Recording(t, q, dq, q - dq, "measured")


@pytest.mark.parametrize("share", [1.0, 1.01, 4.0])
def test_a_cutoff_at_or_above_the_nyquist_rate_is_named(share):
    slow = replace(sines(30), name="slow")
    with pytest.raises(UserError) as caught:
        check_cutoff(15 * share, [sines(1000), slow])
    assert str(caught.value) == (
        f"identify.cutoff_hz: expected less than 15 Hz, half the rate of slow (30 Hz), got {15 * share:g}"
    )
    check_cutoff(14.9, [slow])
    with pytest.raises(UserError, match=r"identify\.cutoff_hz: expected a number in \(0, 500\), got 600"):
        check_cutoff(600, [])


@pytest.mark.parametrize("factor", [1.2, 2.0, 3.9, 33.0])
@pytest.mark.parametrize("inverse", [False, True])
def test_a_wrong_clock_is_named_by_its_factor(factor, inverse):
    """Also if dq is noisy and biased; a right clock passes."""
    r = sines(250, seconds=20.0)
    noisy = replace(r, dq=r.dq + 0.02 * np.random.default_rng(0).standard_normal(r.dq.shape) + 0.05)
    check_clock(noisy)
    np.testing.assert_allclose(speed_factors(noisy), 1.0, atol=0.01)
    factor = 1 / factor if inverse else factor
    with pytest.raises(UserError, match=rf"q changes {1 / factor:.3g}\d* times as much as dq integrates to over t"):
        check_clock(replace(noisy, t=noisy.t * factor))


def test_one_joints_speed_of_another_scale_is_named():
    r = sines(250)
    with pytest.raises(UserError, match=r"q of joint 2 changes 0\.667 times as much as its dq"):
        check_clock(replace(r, dq=r.dq * [1, 1.5, 1]))


@pytest.mark.parametrize("every", [2, 3, 33])
def test_held_values_are_found_and_coarse_encoders_are_not(every):
    """A hold has one length; an encoder's steps come with the speed, and other joints move between them."""
    r = sines(1000)
    at = (np.arange(len(r.t)) // every) * every
    rows = held(r.t, r.q[at], r.dq[at], r.stretches)
    np.testing.assert_array_equal(np.flatnonzero(rows), np.arange(0, len(r.t), every))
    assert held(r.t, r.q, r.dq, r.stretches) is None
    coarse = np.round(r.q[:, :1] / 1.5e-3) * 1.5e-3  # rad, an encoder of 12 bits
    assert held(r.t, coarse, 0 * coarse, r.stretches) is None


@pytest.mark.parametrize("rate", [10, 30, 1000])
def test_fast_motion_is_no_failed_reading(rate):
    """A joint that swings for a moment and stands before and after keeps its rows; a spike does not."""
    t = np.arange(0, 20, 1 / rate)
    q = np.where((t > 9) & (t < 11), 0.4 * np.sin(2 * np.pi * (t - 9)), 0.0)[:, None]
    arrays = {"t": t, "q": q, "dq": 0 * q + t[:, None], "tau": q}
    assert repair_rows(arrays)[1] == []
    spiked = q.copy()
    spiked[50] += 2.0
    rows, notes = repair_rows(arrays | {"q": spiked})
    assert len(rows["t"]) == len(t) - 1
    assert notes == ["1 rows in which q jumps away and back are left out (row 50)"]


def test_the_joints_of_a_bag_are_not_asked_of_its_validation(tmp_path, panda, capsys):
    """A bag needs data.joints, its validation in .npz has the robot's order."""
    bag = joint_states(tmp_path)
    path = tmp_path / "validation.npz"
    r = sines(100, n=3)
    np.savez(path, t=r.t, q=np.tile(r.q[:, :1], 7), dq=np.tile(r.dq[:, :1], 7), tau_J=np.tile(r.tau[:, :1], 7))
    empty = dict.fromkeys(("torque_constant", "ramps", "period"))
    file = FileData(
        kind="recording", path=str(bag), torque="measured", validation=str(path), max_gap_s=0.05, columns={},
        topic="/joint_states", joints=PANDA, **empty,
    )  # fmt: skip
    assert read_file(panda, file, file.path).n_joints == 7
    assert read_file(panda, file, file.validation).n_joints == 7
    assert capsys.readouterr().out == ""
    np.savez(path, t=r.t, q=r.q, dq=r.dq, tau_J=r.tau)
    with pytest.raises(UserError, match="q: expected 7 joints, got 3"):
        read_file(panda, file, file.validation)


def test_a_repair_is_printed(tmp_path, panda, capsys):
    r = sines(100, n=1)
    rows = np.sort(np.r_[np.arange(len(r.t)), 50])
    path = tmp_path / "log.npz"
    np.savez(path, t=r.t[rows], **{k: np.tile(getattr(r, k)[rows], 7) for k in ("q", "dq", "tau")})
    empty = dict.fromkeys(("torque_constant", "validation", "ramps", "period", "topic", "joints"))
    file = FileData(kind="recording", path=str(path), torque="measured", max_gap_s=0.05, columns={}, **empty)
    read_file(panda, file, file.path)
    assert capsys.readouterr().out == f"{path}: 1 repeated rows are left out\n"
