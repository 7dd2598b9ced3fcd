"""Draws about a fit."""

from types import SimpleNamespace

import numpy as np
import pytest

from r2s.identification.posterior import posterior

PRIOR = 20.0  # 1 / standard deviation of each value


@pytest.mark.parametrize("certain", [1e2, 1e8, 1e12])
def test_rows_without_noise_have_draws(certain):
    """The sum of two values is sharp; a value that no row contains has its prior."""
    rows, u = 40, np.full(3, 0.5)
    j = certain * np.tile([[1.0, 1.0, 0.0]], (rows, 1))
    parts = [(np.zeros(rows), j), (np.zeros(3), PRIOR * np.eye(3))]
    problem = SimpleNamespace(clusters=np.arange(rows), linearize=lambda u: parts)
    steps = posterior(problem, u, 0).steps
    assert np.isfinite(steps).all()
    assert steps[:, :2].sum(1).std() < 2.0 / (certain * np.sqrt(rows)) + 1e-9
    assert steps[:, 2].std() == pytest.approx(1 / PRIOR, rel=0.05)
