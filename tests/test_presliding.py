"""Replays find the distance over which bristles bend, also far from the nominal one."""

from dataclasses import replace

import numpy as np
import pytest
from test_identify import DELAY, TORQUE, arm, recorded, run, wrong  # noqa: F401 # fixtures

from r2s.identification.friction.presliding import MIN_SIGMA
from r2s.identification.residuals.windows import cut_windows
from r2s.physics.dynamics import Dynamics, with_family
from r2s.physics.friction import BRISTLE

DISTANCE = np.array([5e-3, 2e-4, 1e-3])  # rad


def bristly(robot):
    """Return a true arm with bristles that bend over DISTANCE."""
    phi = [[0.9, 0.05, 0.3, 0.2, 0.05], [0.7, -0.05, 0.2, 0.1, 0.08], [0.45, 0.1, 0.1, 0.3, 0.04]]
    truth = Dynamics.of(robot, np.column_stack([phi, DISTANCE]), BRISTLE)
    return replace(truth, offset=np.array([0.3, -0.4, 0.1]), delay=DELAY)


@pytest.mark.long
def test_a_presliding_distance_is_found_within_its_interval_also_five_times_off(arm, wrong):  # noqa: F811
    """Nominal is 1 mrad; a search from there ended 30 % off. Errors of 3 MIN_SIGMA are 6 %."""
    recording = recorded(arm, bristly(arm), 8.0, seed=2)
    nominal = with_family(wrong, "bristle")
    result = run(arm, nominal, recording, [TORQUE], family="bristle", terms=["offset", "inertia_scale", "delay"])
    at, found = result.space.where("presliding"), result.found
    assert np.abs(np.log(found.x[at] / DISTANCE)).max() < 3 * MIN_SIGMA
    assert (found.low[at] < DISTANCE).all()
    assert (found.high[at] > DISTANCE).all()


@pytest.mark.long
def test_windows_start_with_bristles_that_bent_over_the_distance_of_the_arm(arm):  # noqa: F811
    """Far from reversals the state is +-1; the shorter the distance, the more windows start like this."""
    windows = cut_windows(recorded(arm, bristly(arm), 6.0, seed=2), 0.2)
    phi = np.tile([0.9, 0.0, 0.3, 0.0, 0.05, 1e-5], (3, 1))
    short = replace(bristly(arm), phi=phi)
    long = replace(short, phi=phi * [1, 1, 1, 1, 1, 1000])
    batch = replace(short, phi=np.stack([short.phi, long.phi]))
    z = windows.bristles(batch)
    assert z.shape == (2, len(windows.t), 3)
    assert np.array_equal(z[0], windows.bristles(short))
    assert np.array_equal(z[1], windows.bristles(long))
    assert (np.abs(z[0]) > 0.99).mean() > (np.abs(z[1]) > 0.99).mean()
    assert not windows.bristles(Dynamics.of(arm, np.ones((3, 3)))).any()
    assert (np.abs(z) <= 1).all()
