"""Intervals hold what they promise where errors last or repeat, and a long recording needs no more than its parts."""

import tracemalloc
from types import SimpleNamespace

import numpy as np
import pytest
from test_identify import BOUNDS, arm, truth, wrong  # noqa: F401
from test_identify_torque import clean  # noqa: F401

import r2s.identification.residuals.torque_residual as torque_residual
from r2s.identification.blocks import BLOCK_S, blocks_of
from r2s.identification.posterior import posterior
from r2s.identification.problem import Problem
from r2s.identification.residuals.torque_residual import TorqueResidual
from r2s.identification.search.levenberg_marquardt import normal_equations
from r2s.identification.terms import search_space
from r2s.physics.dynamics import with_family
from r2s.recordings.recording import Recording

RATE_HZ, SECONDS = 100.0, 12.0
NOISE, RIPPLE, PITCH = 0.2, 1.0, 25.0  # Nm, Nm, 1/rad
DRAWS = 50


def coverage(times: int, slower: float, ripple: float) -> float:
    """Return the share of 95 % intervals that hold the truth, of a friction model fitted by linear least squares."""
    t = np.arange(0.0, SECONDS * slower, 1 / RATE_HZ)
    phase = 2 * np.pi * t / SECONDS / slower
    q = 0.8 * np.sin(phase) + 0.5 * np.sin(3 * phase + 1.0)
    dq = np.gradient(q, t)
    t = np.concatenate([t + k * SECONDS * slower for k in range(times)])
    x = np.tile(np.stack([np.tanh(dq / 0.02), dq, np.ones_like(q), np.sin(q)], 1), (times, 1))
    q, inside = np.tile(q, times)[:, None], []
    for seed in range(DRAWS):
        rng = np.random.default_rng(seed)
        error = ripple * np.sin(PITCH * rng.uniform(0.5, 1.5) * q[:, 0] + rng.uniform(0, 2 * np.pi))
        error += NOISE * rng.standard_normal(len(t))
        found = np.linalg.lstsq(x, error, rcond=None)[0]
        r = error - x @ found
        clusters = blocks_of(t, q, SECONDS * slower if times > 1 else None, r[:, None])
        scale = 0.01 / r.std()  # of the unit cube, far from its bounds
        parts = [(-r / r.std(), x / scale / 100), (np.zeros(4), 1e-3 * np.eye(4))]
        problem = SimpleNamespace(clusters=clusters, linearize=lambda u, parts=parts: parts)
        low, high = np.quantile(posterior(problem, np.full(4, 0.5), 0).steps, [0.025, 0.975], axis=0)
        off = -found * scale * 100 / r.std()
        inside.append((low <= off) & (off <= high))
    return float(np.mean(inside))


@pytest.mark.long
@pytest.mark.parametrize(("times", "slower"), [(1, 1.0), (6, 1.0), (1, 4.0)])
def test_intervals_under_torque_ripple(times, slower):
    """Ripple repeats with the motion and lasts with its slowness: at least 85 % of 95 % intervals hold the truth."""
    assert coverage(times, slower, RIPPLE) >= 0.85


@pytest.mark.long
@pytest.mark.parametrize("times", [1, 6])
def test_intervals_under_white_noise(times):
    """90 to 98 %, within two standard errors of the draws."""
    assert 0.90 - 0.015 <= coverage(times, 1.0, 0.0) <= 0.98 + 0.01


def test_a_clock_that_restarts_makes_new_blocks():
    """Thirty motions of 2 s are 120 blocks of half a second; where errors repeat, repetitions are one."""
    one = np.arange(0.0, 2.0, 0.01)
    t, rng = np.tile(one, 30), np.random.default_rng(0)
    q = np.tile(np.sin(3 * one), 30)[:, None]
    assert blocks_of(t, q, None).max() + 1 == round(30 * 2.0 / BLOCK_S)
    white, same = rng.standard_normal((len(t), 1)), np.tile(np.sin(40 * one), 30)[:, None]
    assert blocks_of(t, q, 2.0, white).max() + 1 == round(30 * 2.0 / BLOCK_S)
    assert blocks_of(t, q, 2.0, same).max() + 1 == round(2.0 / BLOCK_S)
    other = np.where(np.arange(len(t)) < 200, q[:, 0] + 1.0, q[:, 0])[:, None]  # the first motion is elsewhere
    assert blocks_of(t, other, 2.0, same).max() + 1 == 2 * round(2.0 / BLOCK_S)


def test_blocks_last_as_long_as_errors_do():
    """A residual with a correlation of a second has blocks of seconds, however it was logged."""
    t, rng = np.arange(0.0, 200.0, 0.01), np.random.default_rng(0)
    x = np.convolve(rng.standard_normal(len(t) + 99), np.ones(100), mode="valid")[:, None]
    count = blocks_of(t, 0 * x, None, x).max() + 1
    assert 40 <= count <= 100


def test_parts_are_the_whole(arm, wrong, clean, monkeypatch):  # noqa: F811
    """Filtered in pieces and linearized in parts, a recording has the same rows and normal equations."""
    space = search_space(arm, wrong, BOUNDS, ["offset", "link"], clean)
    u = space.to_unit(space.start)
    for slowest in (0.0, 0.02):
        whole = TorqueResidual(space, clean, slowest=slowest)
        expected = normal_equations(whole.linearize(u))
        with monkeypatch.context() as patch:
            patch.setattr(torque_residual, "PART", 37)
            parts = normal_equations(whole.linearize(u))
            for a, b in zip(parts, expected, strict=True):
                np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9 * np.abs(b).max())
            patch.setattr(torque_residual, "PIECE_S", 2.0)
            cut = TorqueResidual(space, clean, slowest=slowest)
        assert len(cut.motion.t) == pytest.approx(len(whole.motion.t), rel=0.01)
        np.testing.assert_array_equal(np.diff(cut.motion.t) > 0, True)
        rows = np.searchsorted(cut.motion.t, whole.motion.t).clip(0, len(cut.motion.t) - 1)
        near = np.abs(cut.motion.t[rows] - whole.motion.t) < 1e-9
        both = [r.predict(wrong)[k] for r, k in ((cut, rows[near]), (whole, near))]
        assert near.mean() > 0.4
        assert np.median(np.abs(both[0] - both[1])) < 1e-3 * np.std(both[1])


@pytest.mark.parametrize("slowest", [0.0, 0.02])
def test_another_presliding_distance_changes_only_the_bristles(arm, wrong, clean, monkeypatch, slowest):  # noqa: F811
    """A residual with another presliding distance equals one that is built with it, also in pieces."""
    space = search_space(arm, with_family(wrong, "bristle"), BOUNDS, ["offset"], clean)
    monkeypatch.setattr(torque_residual, "PIECE_S", 2.0)
    distance = np.array([2e-3, 1e-3, 4e-3])
    other = TorqueResidual(space, clean, slowest=slowest, presliding_rad=distance)
    same = TorqueResidual(space, clean, slowest=slowest).with_presliding(clean, distance)
    x = space.start[None]
    np.testing.assert_array_equal(same(x), other(x))
    np.testing.assert_array_equal(same.clusters, other.clusters)
    assert not np.array_equal(other(x), TorqueResidual(space, clean, slowest=slowest)(x))


def test_a_fit_needs_less_memory_than_a_jacobian(arm, wrong):  # noqa: F811
    """The normal equations of two minutes of rows take less memory than their Jacobian."""
    t = np.arange(0.0, 120.0, 0.01)
    q = 0.5 * np.sin(t[:, None] * [0.9, 1.3, 1.7])
    dq = 0.5 * np.cos(t[:, None] * [0.9, 1.3, 1.7]) * [0.9, 1.3, 1.7]
    recording = Recording(t, q, dq, 10 * q, "measured")
    space = search_space(arm, wrong, BOUNDS, ["offset", "link", "drag"], recording)
    residual = TorqueResidual(space, recording)
    problem = Problem.of(residual, residual, {})
    tracemalloc.start()
    normal_equations(problem.linearize(problem.start))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 8 * len(residual.clusters) * len(problem.start)
