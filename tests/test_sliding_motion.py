"""Rows that feel one slide of a joint: their windows, their noise, and when a command is felt."""

import numpy as np
import pytest

from r2s.identification.residuals.modulating_functions import LONGEST, RATE_HZ, SHORTEST, STEADY, SlidingMotion
from r2s.physics.friction import PRESLIDING
from r2s.recordings.recording import Recording

DT = 1e-3


def swinging(noise: float = 0.0, seconds: float = 8.0) -> Recording:
    """Return two joints that swing at 0.5 and 0.8 Hz under a command of 12 Hz."""
    t = np.arange(int(seconds / DT)) * DT
    rate = 2 * np.pi * np.array([0.5, 0.8])
    q = 0.3 * np.sin(rate * t[:, None]) + np.random.default_rng(0).normal(0.0, noise, (len(t), 2))
    tau = np.sin(2 * np.pi * 12 * t[:, None] + [0.0, 1.0])
    return Recording(t, q, 0.3 * rate * np.cos(rate * t[:, None]), tau, "commanded")


@pytest.fixture(scope="module")
def motion():
    return SlidingMotion.of(swinging(), 100.0, 0.02)


def test_no_window_reaches_a_turn(motion):
    """Every weight is of an instant in which the joint is faster, and goes the way that it goes at the moment."""
    for j, means in enumerate(motion.means[0]):
        assert motion.seen[:, j].any()
        assert not motion.seen[:, j].all()
        for row in np.flatnonzero(motion.seen[:, j]):
            own = slice(means.indptr[row], means.indptr[row + 1])
            v = motion.dq[means.indices[own], j]
            assert np.abs(v).min() > 0.02
            assert (v > 0).all() or (v < 0).all()
            assert round(2 * SHORTEST * RATE_HZ) < len(v) <= round(2 * LONGEST * RATE_HZ) + 1
            np.testing.assert_allclose(means.data[own].sum(), 1.0, rtol=1e-12)


def test_no_window_crosses_from_a_trajectory_to_the_next():
    """Even if the first trajectory is shorter than the margin without windows at its two ends."""
    r = swinging()
    cut = Recording(r.t, r.q, r.dq, r.tau, r.torque, trajectory=np.digitize(r.t, [0.03, *np.arange(0.8, 8.0, 0.8)]))
    found = SlidingMotion.of(cut, 100.0, 0.02)
    trajectory = np.cumsum(found.starts)
    for means in found.means[0]:
        own = [trajectory[means.indices[a:b]] for a, b in zip(means.indptr, means.indptr[1:], strict=False) if b > a]
        assert len(own) > 50
        assert all(len(set(rows)) == 1 for rows in own)


def test_a_window_starts_where_the_joint_has_slid_far_enough(motion):
    """`slid` rad from where it turned, at 0.3 rad; rows are lost by it and none is new."""
    later = SlidingMotion.of(swinging(), 100.0, 0.02, slid=0.02)
    for j, means in enumerate(later.means[0]):
        for row in np.flatnonzero(later.seen[:, j]):
            first = means.indices[means.indptr[row]]
            turned = later.q[first, j] * later.dq[first, j] < 0
            assert not turned or 0.3 - abs(later.q[first, j]) > 0.02 - 1e-4
            own = means.indices[means.indptr[row] : means.indptr[row + 1]]
            v, a = later.dq[own, j], later.ddq[own, j]
            assert (np.abs(a) * PRESLIDING <= 1.01 * STEADY * v**2).all()  # bristles keep up with the speed
    assert (later.seen <= motion.seen).all()
    assert later.seen.sum() < motion.seen.sum()


def test_the_mean_of_an_acceleration_is_as_noisy_as_said():
    """White noise of the angles: standardised by what is said, the rows' errors have a deviation of 1 within 15 %."""
    quiet, loud = (SlidingMotion.of(swinging(noise, 40.0), 100.0, 0.02) for noise in (0.0, 2e-5))
    np.testing.assert_allclose(loud.encoder, 2e-5, rtol=0.05)
    both = quiet.seen & loud.seen & (quiet.noise == loud.noise)
    off = (loud.filtered(loud.ddq) - quiet.filtered(quiet.ddq))[both] / (2e-5 * loud.noise[both])
    np.testing.assert_allclose(np.std(off), 1.0, atol=0.15)


@pytest.mark.parametrize(("delay", "lag"), [(0.0, 0.0), (2.3e-3, 0.0), (4.6e-3, 1.7e-3), (1e-3, 5e-3)])
def test_a_command_is_felt_held_late_and_behind_a_lag(motion, delay, lag):
    """Of a sine the answer is known: sinc of the step, exp(-i w delay), 1 / (1 + i w lag). Within 0.1 %."""
    w = 2 * np.pi * 12
    gain = np.sinc(w * DT / 2 / np.pi) * np.exp(-1j * w * (delay + DT / 2)) / (1 + 1j * w * lag)
    t = np.arange(len(motion.q)) / RATE_HZ
    wave = np.exp(1j * (w * t[:, None] + [0.0, 1.0]))
    expected = motion.filtered((gain * wave).imag)
    seen = motion.seen & (motion.t > 0.5)[:, None] & (motion.t < 7.5)[:, None]
    np.testing.assert_allclose(motion.command(delay, lag)[seen], expected[seen], atol=1e-3)
