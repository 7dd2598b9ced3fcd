"""Compiled linear algebra: factorization and solution agree with NumPy, for all and for some rows and columns."""

import numpy as np

from r2s.physics.linear_algebra import factor, packed_element, solve, unpack


def test_solutions_are_numpys():
    """Random positive definite systems of 1 to 8 unknowns, to round-off."""
    rng = np.random.default_rng(0)
    for _ in range(50):
        n = int(rng.integers(1, 9))
        a = rng.normal(size=(n, n))
        a, diagonal, b = a @ a.T + 0.3 * np.eye(n), rng.uniform(0, 1, n), rng.normal(size=n)
        packed = a[np.tril_indices(n)]
        assert all(packed_element(packed, i, k) == a[max(i, k), min(i, k)] for i in range(n) for k in range(n))
        root, x = np.empty((n, n)), b.copy()
        unpack(packed, 2.0, diagonal, root)
        factor(root, root)
        solve(root, x)
        np.testing.assert_allclose(x, np.linalg.solve(a + 2 * np.diag(diagonal), b), rtol=1e-9)
        active, x = (rng.random(n) < 0.6).astype(float), b.copy()
        factor(a, root, active)
        solve(root, x, active)
        rows = np.flatnonzero(active)
        expected = np.zeros(n)
        expected[rows] = np.linalg.solve(a[np.ix_(rows, rows)], b[rows])
        np.testing.assert_allclose(x, expected, rtol=1e-9)
