"""How sure the edges of the dead zone are, from ramps that were repeated.

What scatters from ramp to ramp is friction itself: with posture, load and cable. A joint and direction is ramped
twice or so, which by itself says next to nothing (Student's t of one degree of freedom: 12.7 deviations). So its
variance is moderated by that of joints of its size, which counts as `LIKE` repeats (Smyth, Stat. Appl. Genet. Mol.
Biol. 3(1), 2004); they are few because like joints are not equal: on twins their scatter differs by factors of 3 and
more. Without any repeat it is a stated one, `REPEATS`.
"""

from typing import NamedTuple

import numpy as np

from r2s.identification.breakaway import Breakaway

LIKE = 2.0  # repeats that the scatter of like joints counts as
REPEATS = 1e-3  # of tau_max, standard deviation from ramp to ramp: seen on twins, 0.8e-3 to 1e-3


class Certainty(NamedTuple):
    """Of each edge: standard error sigma (n, 2) Nm of its mean command, and degrees of freedom (n, 2) of its t.

    sigma is NaN where no ramp got there.
    """

    sigma: np.ndarray
    freedom: np.ndarray


def certainty(found: Breakaway, tau_max: np.ndarray) -> Certainty:
    """Return how sure the mean commands are; joints of one torque limit, tau_max (n,) Nm, are like joints.

    Where like joints have no repeat, those of the others count, in proportion to tau_max.
    """
    more = np.maximum(found.count - 1, 0)
    square = np.nan_to_num(found.spread, nan=0.0) ** 2 / tau_max[:, None] ** 2
    share = REPEATS**2 if not more.any() else (more * square).sum() / more.sum()
    like = np.full(found.count.shape, share)
    for limit in np.unique(tau_max):
        same = tau_max == limit
        if more[same].any():
            like[same] = (more[same] * square[same]).sum() / more[same].sum()
    freedom = LIKE + more
    variance = tau_max[:, None] ** 2 * (LIKE * like + more * square) / freedom
    with np.errstate(divide="ignore", invalid="ignore"):
        sigma = np.sqrt((variance + found.resolution**2) / found.count)
    return Certainty(np.where(found.count > 0, sigma, np.nan), freedom)
