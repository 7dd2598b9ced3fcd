"""Compute the standard error of breakaway commands from repeated ramps.

Friction varies between ramps, because of posture, load and cables. Two ramps per joint and direction hardly determine
a variance: with one degree of freedom, Student's t makes the 95 % interval +-12.7 standard errors. r2s therefore
averages a joint's variance with the mean variance of all joints with the same tau_max (the same size). This mean has
the weight of PRIOR_REPEATS repeats (Smyth, Stat. Appl. Genet. Mol. Biol. 3(1), 2004). PRIOR_REPEATS is small, because
joints of the same size differ in scatter, on twins by factors of 3 and more. If no ramp is repeated, r2s assumes the
standard deviation REPEATS, relative to tau_max.
"""

from typing import NamedTuple

import numpy as np

from r2s.identification.friction.breakaway import Breakaway

PRIOR_REPEATS = 2.0  # weight of the mean variance of all joints of the same size, in repeats
REPEATS = 1e-3  # standard deviation between repeated ramps, relative to tau_max; 0.8e-3 to 1e-3 on twins


class Certainty(NamedTuple):
    """Standard error (n, 2) Nm of mean breakaway commands (NaN: no breakaway), with degrees of freedom (n, 2)."""

    sigma: np.ndarray
    freedom: np.ndarray


def certainty(found: Breakaway, tau_max: np.ndarray) -> Certainty:
    """Return standard errors of mean breakaway commands; joints with equal tau_max (n,) Nm have the same size.

    If no joint of a size has repeated ramps, r2s assumes the mean scatter of all joints, in proportion to tau_max.
    """
    more = np.maximum(found.count - 1, 0)
    square = np.nan_to_num(found.spread, nan=0.0) ** 2 / tau_max[:, None] ** 2
    share = REPEATS**2 if not more.any() else (more * square).sum() / more.sum()
    like = np.full(found.count.shape, share)
    for limit in np.unique(tau_max):
        same = tau_max == limit
        if more[same].any():
            like[same] = (more[same] * square[same]).sum() / more[same].sum()
    freedom = PRIOR_REPEATS + more
    variance = tau_max[:, None] ** 2 * (PRIOR_REPEATS * like + more * square) / freedom
    with np.errstate(divide="ignore", invalid="ignore"):
        sigma = np.sqrt((variance + found.resolution**2) / found.count)
    return Certainty(np.where(found.count > 0, sigma, np.nan), freedom)
