"""Cable torque far beyond its prior, in link-side torque, is identified and not taken for friction."""

import sys
from dataclasses import replace

import numpy as np
import pytest
from conftest import ROOT

sys.path.insert(0, str(ROOT / "benchmarks"))
from scaling import arm, found_in, log, truth_of

SHARE = np.array(
    [0.05, 0.04]
)  # of tau_max, amplitudes of sine and cosine: a hundred standard deviations of the prior


@pytest.mark.long
@pytest.mark.parametrize("seed", [1, 2])
def test_large_cable_torque_is_not_friction(seed):
    """The first joint's axis is vertical, so that gravity has no part in its cable torque."""
    robot = arm(2, 5.0)
    truth = truth_of(robot)
    clean = log(robot, truth, "measured", seed=seed)
    drag = SHARE * robot.tau_max[:, None]
    tau = clean.tau - drag[:, 0] * np.sin(clean.q) - drag[:, 1] * np.cos(clean.q)
    found = found_in(robot, replace(clean, tau=tau)).dynamics
    coulomb, _, viscous = found.phi[0] / truth.phi[0]
    assert coulomb == pytest.approx(1.0, abs=0.02)
    assert viscous == pytest.approx(1.0, abs=0.05)
    np.testing.assert_allclose(found.drag[0], drag[0], rtol=0.05)
