"""Factor and solve small symmetric positive definite systems by Cholesky's method, in compiled code.

For 7 joints, compiled loops are faster than a LAPACK call. In this module, the root of a matrix A = L L^T is L with 1
/ L[i, i] on the diagonal, so `solve` multiplies instead of divides (Golub and Van Loan, Matrix Computations, 4th ed.
2013, section 4.2). A packed matrix is an array (n (n + 1) / 2,) of the lower triangle, row by row, as MuJoCo stores
the mass matrix of a serial arm.
"""

import numpy as np

from r2s.compiled import njit


@njit(cache=True, error_model="numpy")
def packed_element(packed, i, k):
    """Return element (i, k) of a packed symmetric matrix."""
    return packed[i * (i + 1) // 2 + k] if i >= k else packed[k * (k + 1) // 2 + i]


@njit(cache=True, error_model="numpy", forceinline=True)
def unpack(packed, scale, diagonal, out):
    """Write the lower triangle of a packed matrix, plus scale * diag(diagonal), into `out` (n, n)."""
    for i in range(len(diagonal)):
        row = i * (i + 1) // 2
        for k in range(i):
            out[i, k] = packed[row + k]
        out[i, i] = packed[row + i] + scale * diagonal[i]


@njit(cache=True, error_model="numpy", forceinline=True)
def factor(matrix, root, active=None):
    """Write the root of a matrix (n, n) from the lower triangle of `matrix`; `root` may be `matrix` itself.

    active: (n,), 0 for rows and columns that the factorization omits; None: omit no row.
    """
    for i in range(len(root)):
        if active is not None and active[i] == 0.0:
            continue
        d = matrix[i, i]
        for k in range(i):
            if active is not None and active[k] == 0.0:
                continue
            r = matrix[i, k]
            for c in range(k):
                if active is None or active[c] != 0.0:
                    r -= root[i, c] * root[k, c]
            r *= root[k, k]
            root[i, k] = r
            d -= r * r
        root[i, i] = 1.0 / np.sqrt(d)


@njit(cache=True, error_model="numpy", forceinline=True)
def solve(root, x, active=None):
    """Replace x (n,) by the solution y of A y = x, given the root of A; y is 0 in rows where `active` is 0."""
    n = len(x)
    for i in range(n):
        s = 0.0
        if active is None or active[i] != 0.0:
            s = x[i]
            for c in range(i):
                if active is None or active[c] != 0.0:
                    s -= root[i, c] * x[c]
            s *= root[i, i]
        x[i] = s
    for i in range(n - 1, -1, -1):
        if active is None or active[i] != 0.0:
            s = x[i]
            for c in range(i + 1, n):
                if active is None or active[c] != 0.0:
                    s -= root[c, i] * x[c]
            x[i] = s * root[i, i]
