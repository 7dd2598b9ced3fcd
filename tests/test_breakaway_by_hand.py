"""Ramps made by hand let go where they were made to, and intervals of repeated ones hold what they promise."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import t as student

from r2s.identification.friction.breakaway import Breakaway, Slide, estimate_breakaway
from r2s.identification.friction.repeatability import REPEATS, certainty
from r2s.recordings.ramps import Ramps
from r2s.recordings.recording import Recording


def by_hand(t, onset, creep=0.0, rate=2.0, far=0.012, noise=1e-5, seed=0, flip=1, wait=0.0):
    """One joint of three: it creeps as Dahl's until `onset` s, then accelerates by 2 + 6 (t - onset) rad/s^2."""
    since = np.maximum(t - onset, 0)
    x = 2 * since**2 / 2 + 6 * since**3 / 6
    left = np.maximum(onset - t, 1e-2)
    x += creep * (-np.log(left / onset) + np.maximum(t - onset + 1e-2, 0) / 1e-2)
    q = np.zeros((len(t), 3))
    q[:, 1] = 0.7 + flip * (x + noise * np.random.default_rng(seed).standard_normal(len(t)))
    tau = np.zeros((len(t), 3))
    tau[:, 1] = flip * rate * np.maximum(t - wait, 0)
    keep = x < far
    return Recording(t[keep], q[keep], np.zeros_like(q[keep]), tau[keep], "commanded")


@pytest.mark.long
@pytest.mark.parametrize("flip", [1, -1])
@pytest.mark.parametrize("hz", [250, 1000])
@pytest.mark.parametrize("onset", [0.06, 0.301])
def test_an_onset_that_is_known(onset, hz, flip):
    """No arm is needed: t, q, tau of any clock; what is seen 70 ms later is traced back to within 2 ms."""
    t = np.arange(0, 1, 1 / hz)
    t[1:] += 0.3 / hz * np.random.default_rng(1).uniform(-1, 1, len(t) - 1)
    # the ramp is smooth whatever the log's rate
    ramps = Ramps(replace(by_hand(t, onset, flip=flip), command_period=1e-3), joint=1, sign=flip)
    found = estimate_breakaway(ramps)
    assert found.value[0] == pytest.approx(flip * 2 * onset, abs=4e-3)
    assert found.count.tolist() == [[0, 0], [int(flip < 0), int(flip > 0)], [0, 0]]
    early = estimate_breakaway(ramps, delay=10e-3)
    assert flip * (found.value[0] - early.value[0]) == pytest.approx(0.02, abs=2e-3)


def test_creep_is_not_taken_for_letting_go():
    """2 mrad and more of creep over 0.6 s, faster and faster, shift the onset by a few percent of the ramp."""
    t = np.arange(0, 1.5, 1e-3)
    for creep in (2e-4, 5e-4):
        ramps = Ramps(by_hand(t, 0.6, creep), joint=1, sign=1)
        x = ramps.recording.q[:, 1] - ramps.recording.q[0, 1]
        assert t[np.argmax(x > 3e-4)] < 0.5  # where a threshold would see motion
        assert estimate_breakaway(ramps).value[0] == pytest.approx(1.2, rel=0.05)


def falling(U=0.9, level=0.6, viscous=0.3, fall=0.04, inertia=0.8, rate=0.15):
    """One joint whose friction falls from U to level over `fall` rad/s, by steps of 0.02 ms; and how it slides."""
    fine, every = 2e-5, 50
    u = np.maximum(np.arange(0.0, U / rate + 2.5, fine) - 0.5, 0.0) * rate
    v, x = 0.0, 0.0
    angles = []
    for now in u:
        if now > U:
            v += fine * (now - level - (U - level) * np.exp(-((v / fall) ** 2)) - viscous * v) / inertia
            x += fine * v
        angles.append(x)
        if x > 0.012:
            break
    seen = np.array(angles)[::every]
    seen = np.round((seen + 2e-5 * np.random.default_rng(3).standard_normal(len(seen))) / 2e-5) * 2e-5
    t, q = 1e-3 * np.arange(len(seen)), np.zeros((len(seen), 2))
    q[:, 1] = -seen
    tau = np.zeros_like(q)
    tau[:, 1] = -u[::every][: len(seen)]
    known = Slide(*(np.array([k]) for k in (1.05 / inertia, level, viscous, fall, 1.0)))
    return Ramps(Recording(t, q, 0 * q, tau, "commanded"), joint=1, sign=-1), known


@pytest.mark.long
def test_friction_that_falls_slowly_is_let_go_of_in_time_once_the_slide_is_known():
    """An inertia that is 5 % off does not matter; a slide that hardly falls is not taken."""
    ramps, known = falling()
    alone = estimate_breakaway(ramps)
    known = replace(known, misfit=alone.misfit)
    known_slide = estimate_breakaway(ramps, slide=known)
    assert -alone.value[0] > 0.9 + 2e-3
    assert -known_slide.value[0] == pytest.approx(0.9, abs=5e-4)
    for other in (replace(known, level=known.level + 0.29), replace(known, kappa=np.array([np.nan]))):
        assert estimate_breakaway(ramps, slide=other).value[0] == alone.value[0]


def test_what_does_not_move_is_listed_and_the_rest_survives():
    t = np.arange(0, 0.4, 1e-3)
    parts = [
        by_hand(t, 0.2),
        by_hand(t, 9.0),  # nothing moves
        by_hand(t, 0.25),  # labelled the wrong way
        by_hand(t, 0.21),
        by_hand(t, 0.02, wait=0.04),  # gone before the command rises
        by_hand(np.arange(0, 0.4, 0.025), 0.1, far=0.06),  # too few rows
    ]
    whole = {f: np.concatenate([getattr(p, f) for p in parts]) for f in ("t", "q", "dq", "tau")}
    labels = np.repeat(np.arange(6), [len(p.t) for p in parts])
    motion = Recording(**whole, torque="commanded", trajectory=labels)
    found = estimate_breakaway(Ramps(motion, 1, [1, 1, -1, 1, 1, 1], [0, 1, 2, 3, 4, 5]))
    assert np.flatnonzero(np.isnan(found.value)).tolist() == [1, 2, 4, 5]
    np.testing.assert_allclose(found.value[[0, 3]], [0.4, 0.42], atol=4e-3)
    assert found.count[1].tolist() == [0, 2]
    assert found.command[1, 1] == pytest.approx(0.41, abs=3e-3)
    assert found.spread[1, 1] == pytest.approx(0.02 / np.sqrt(2), abs=3e-3)
    assert np.isnan(found.command[0]).all()


# --- how sure it is


def seen(value):
    """Return what ramps with these results (n, 2, K) Nm, NaN where a joint did not let go, say."""
    n, _, repeats = value.shape
    joint, side, pose = (x.ravel() for x in np.meshgrid(*(range(k) for k in value.shape), indexing="ij"))
    count = (~np.isnan(value)).sum(-1)
    spread = np.full((n, 2), np.nan)
    spread[count > 1] = np.nanstd(value[count > 1], -1, ddof=1)
    command = np.where(count > 0, np.nansum(value, -1) / np.maximum(count, 1), np.nan)
    blank = np.zeros((n, 2))
    ramped = np.full((n, 2), repeats)
    return Breakaway(command, spread, count, ramped, blank, blank, value.ravel(), 0 * pose, joint, 2 * side - 1, pose)


@pytest.mark.parametrize(("repeats", "unequal"), [(2, 0.0), (2, 0.5), (2, 0.8), (3, 0.5), (5, 0.5)])
def test_intervals_of_repeated_ramps_hold_what_they_promise(panda, repeats, unequal):
    """95 % of the intervals about the mean of a few ramps hold the truth, also where joints scatter unequally."""
    rng, held = np.random.default_rng(0), []
    for _ in range(400):
        sigma = 1e-3 * panda.tau_max[:, None] * np.exp(unequal * rng.standard_normal((7, 2)))
        found = seen(1.0 + sigma[..., None] * rng.standard_normal((7, 2, repeats)))
        error, freedom = certainty(found, panda.tau_max)
        held.append(np.abs(found.command - 1.0) < student.ppf(0.975, freedom) * error)
    assert 0.94 < np.mean(held) < 0.99  # 5600 intervals: +- 0.003


def test_one_ramp_is_not_a_certainty(panda):
    """Without a repeat the width is the stated one; where only some joints were repeated, theirs in proportion."""
    once = seen(np.ones((7, 2, 1)))
    error, _ = certainty(once, panda.tau_max)
    np.testing.assert_allclose(error, np.repeat(REPEATS * panda.tau_max[:, None], 2, 1))
    value = np.full((7, 2, 2), np.nan)
    value[..., 0] = 1.0
    value[0] = [[0.9, 1.1], [0.9, 1.1]]
    value[6, 1] = np.nan
    error, freedom = certainty(seen(value), panda.tau_max)
    assert np.isnan(error[6, 1])
    spread = 0.2 / np.sqrt(2)
    np.testing.assert_allclose(error[:4, 0], spread / np.sqrt([2, 1, 1, 1]))
    np.testing.assert_allclose(error[4, 0], spread * panda.tau_max[4] / panda.tau_max[0])
    assert freedom[:2, 0].tolist() == [3, 2]
    same = certainty(replace(seen(np.ones((7, 2, 2))), resolution=np.full((7, 2), 3e-3)), panda.tau_max)
    np.testing.assert_allclose(same.sigma, 3e-3 / np.sqrt(2))  # ramps that agree are as good as their fit
