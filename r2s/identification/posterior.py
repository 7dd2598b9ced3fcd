"""Posterior of an identification: a normal approximation about the fit, with draws inside the bounds."""

from collections.abc import Iterable
from typing import NamedTuple, Protocol

import numpy as np
from scipy.stats import norm
from scipy.stats import t as student

DRAWS = 512  # number of samples from the joint distribution
Z_95 = 1.96  # half the width of a 95 % interval, in standard deviations
FLAT = 12.0  # information of a flat prior on the unit cube, whose uniform distribution has a variance of 1/12
LEAST_LEFT = 0.1  # least value of 1 - (a block's share of the information in a direction)


class Linearized(Protocol):
    """Interface of a least-squares problem on the unit cube, as `posterior` requires it; `Problem` implements it."""

    @property
    def clusters(self) -> np.ndarray:
        """(R,) index of the block that contains each data row."""
        ...

    def linearize(self, u: np.ndarray) -> Iterable[tuple[np.ndarray, np.ndarray]]:
        """Yield residual and Jacobian at u (P,), part by part: the R rows of data first, then the prior's rows."""
        ...


class Posterior(NamedTuple):
    """Fit u (P,) on the unit cube, `steps` (S, P) from u to S draws, and information (P, P) from the data."""

    u: np.ndarray
    steps: np.ndarray
    information: np.ndarray


def posterior(problem: Linearized, u: np.ndarray, seed: int) -> Posterior:
    """Return draws about the fit u (P,) from a normal distribution with a cluster-robust covariance.

    Because errors within a block are correlated, the covariance is H^-1 (sum of s s^T + prior) H^-1, with the total
    information H and a score s per block. A block's score is the block's contribution to the gradient (White,
    Econometrica 48(4), 1980; clusters: Liang and Zeger, Biometrika 73(1), 1986) minus the mean contribution of all
    blocks. The mean is not 0 if the fit is at a bound. If there are few blocks, the fit makes each block's residual
    too small; a factor from the block's share of the information corrects the score (CR2 of Bell and McCaffrey,
    Survey Methodology 28(2), 2002). For few blocks, Student's t widens the draws. If one block alone determines a
    direction, the scatter of the scores underestimates the variance in this direction. The returned covariance is
    therefore at least that of independent rows. A bootstrap over blocks would yield unrealistic tails if few blocks
    determine a value, because many bootstrap samples would lack these blocks.
    """
    gram, score, prior, factor = _sums(problem, u)
    information, few = gram.sum(0), max(len(gram) - 1, 1)
    covariance, root = _inverse(information + prior)
    for own, s in zip(gram, score, strict=True):
        share, axes = np.linalg.eigh(root.T @ own @ root)  # a block's share of the information, by direction
        left = np.sqrt(np.maximum(1.0 - share, LEAST_LEFT))
        s[:] = np.linalg.solve(root.T, axes @ (axes.T @ (root.T @ s) / left))
    score = (score - score.mean(0)) * np.sqrt((few + 1) / few) * student.ppf(0.975, few) / norm.ppf(0.975)
    least, robust = (covariance @ _root(m + prior) for m in (factor**2 * information, score.T @ score))
    normal = np.random.default_rng(seed).standard_normal((DRAWS, len(u)))
    normal -= normal.mean(0)
    normal = np.linalg.solve(np.linalg.cholesky(normal.T @ normal / DRAWS), normal.T).T  # its covariance is exactly I
    steps = normal @ _at_least(least, robust).T
    return Posterior(u, inside_cube(u, steps, information + prior), information)


def _root(matrix: np.ndarray) -> np.ndarray:
    """Return a square root (P, P) of a positive matrix, also if rounding made it indefinite.

    Rounding matters for noise-free recordings, whose information exceeds that of a wide prior by more than float
    precision.
    """
    try:
        return np.linalg.cholesky(matrix)
    except np.linalg.LinAlgError:
        scale, values, axes = _resolved(matrix)
        return scale[:, None] * axes * np.sqrt(values)


def _inverse(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the inverse (P, P) of a positive matrix, and a square root of the inverse; see `_root`."""
    try:
        inverse = np.linalg.inv(matrix)
        return inverse, np.linalg.cholesky(inverse)
    except np.linalg.LinAlgError:
        scale, values, axes = _resolved(matrix)
        root = axes / scale[:, None] / np.sqrt(values)
        return root @ root.T, root


def _resolved(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Scale a matrix to unit diagonal; return scale (P,), eigenvalues (P,), axes (P, P) of matrix / (scale scale^T).

    Eigenvalues smaller than the rounding error of the largest eigenvalue are set to this error.
    """
    scale = np.sqrt(np.diag(matrix))
    values, axes = np.linalg.eigh(matrix / np.outer(scale, scale))
    return scale, np.maximum(values, len(values) * np.finfo(float).eps * values[-1]), axes


def _sums(problem: Linearized, u: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Return sums over each of K blocks of data rows, the prior's information (P, P), and the RMS of the data rows.

    For residuals r with Jacobian J, the sums are the information J^T J (K, P, P) and the score J^T r (K, P). The RMS
    is in standard deviations; the function replaces an RMS below 1 by 1.
    """
    clusters, p = problem.clusters, len(u)
    count, square, seen, row = int(clusters.max()) + 1, 0.0, 0, 0
    gram, score, prior = np.zeros((count, p, p)), np.zeros((count, p)), np.zeros((p, p))
    for r, j in problem.linearize(u):
        own = clusters[row : row + len(r)]
        row, rest, j, r = row + len(r), j[len(own) :], j[: len(own)], r[: len(own)]
        prior += rest.T @ rest
        for block in np.unique(own):
            some = np.flatnonzero(own == block)
            gram[block] += j[some].T @ j[some]
            score[block] += j[some].T @ r[some]
        counts = j.any(1)  # padding rows, with residual and slope 0, do not count
        square, seen = square + float((r[counts] ** 2).sum()), seen + int(counts.sum())
    prior += np.diag(np.where(prior.any(0), 0.0, FLAT))  # flat priors have no rows
    return gram, score, prior, float(np.sqrt(max(1.0, square / max(seen, 1))))


def _at_least(least: np.ndarray, root: np.ndarray) -> np.ndarray:
    """Return a square root (P, P) of root root^T, increased in all directions in which least least^T is larger.

    Comparing variances of single values would not suffice, because data can determine the sum of two values far
    better than each value.
    """
    axes, seen, _ = np.linalg.svd(np.linalg.solve(least, root))
    return least @ (axes * np.maximum(seen, 1.0))


def inside_cube(u: np.ndarray, steps: np.ndarray, h: np.ndarray) -> np.ndarray:
    """Return `steps` (S, P) with values changed so that u + steps lies in the unit cube.

    The function clips values outside the cube, and changes values inside the cube to minimize the sum of squares,
    whose Hessian is 2 h (P, P). Without this change, sums of correlated values would be biased, for example an offset
    plus an asymmetry at its bound. The value farthest outside is clipped first, because the change often moves
    correlated values into the cube.
    """
    steps = steps.copy()
    for step in steps:
        stopped = np.zeros(len(u), dtype=bool)
        for _ in range(len(u)):
            out = np.abs(u + step - 0.5) - 0.5
            k = int(out.argmax())
            if out[k] < 1e-12:
                break
            stopped[k] = True
            free = ~stopped
            change = np.clip(u[k] + step[k], 0.0, 1.0) - u[k] - step[k]
            step[k] += change
            step[free] -= np.linalg.solve(h[np.ix_(free, free)], h[free, k] * change)
    return np.clip(u + steps, 0.0, 1.0) - u
