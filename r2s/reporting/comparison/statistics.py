"""Statistics for few seeds: interquartile mean, stratified bootstrap, probability of improvement.

Source: Agarwal et al., Deep Reinforcement Learning at the Edge of the Statistical Precipice (NeurIPS 2021).
"""

from collections.abc import Callable, Sequence

import numpy as np
from scipy.stats import trim_mean

DRAWS = 2000  # of a bootstrap, as in Agarwal et al.


def interquartile_mean(x: np.ndarray) -> np.ndarray:
    """Return the mean over the last axis of x (..., S) without the lowest and the highest quarter.

    A quarter is S / 4 rounded down, as in rliable: with fewer than four values this is the mean.
    """
    return np.asarray(trim_mean(x, 0.25, axis=-1))


def interval(
    strata: Sequence[np.ndarray], statistic: Callable[[list[np.ndarray]], np.ndarray], seed: int = 0
) -> tuple[float, float]:
    """Return the 95 % interval of a statistic by a stratified bootstrap; nan if a stratum has only one score.

    Args:
        strata: arrays (S,), a score per seed. seed: of the bootstrap.
        statistic: maps the draws (D, S) of each stratum to (D,).
    """
    if min(map(len, strata)) < 2:
        return np.nan, np.nan
    rng = np.random.default_rng(seed)
    drawn = [x[rng.integers(len(x), size=(DRAWS, len(x)))] for x in strata]
    found, levels = statistic(drawn), [0.025, 0.975]
    if np.isfinite(found).all():
        low, high = np.quantile(found, levels)
    else:  # infinities cannot be interpolated
        low, high = np.quantile(found, levels, method="inverted_cdf")
    return float(low), float(high)


def paired(each: Sequence[np.ndarray], rng: np.random.Generator) -> np.ndarray:
    """Return the means (DRAWS, A) of a bootstrap over arms, and over episodes of each drawn arm, paired among the A.

    Args:
        each: per arm (E, A): values of E episodes in A rows of a comparison. rng: of the draws.
    """
    draws = []
    for _ in range(DRAWS):
        arms = [each[i] for i in rng.integers(len(each), size=len(each))]
        draws.append(np.concatenate([a[rng.integers(len(a), size=len(a))] for a in arms]).mean(0))
    return np.array(draws)


def improvement(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the probability (...) that a value of x (..., S) exceeds one of y (..., T); a tie counts half."""
    above = x[..., :, None] > y[..., None, :]
    same = x[..., :, None] == y[..., None, :]
    return (above + 0.5 * same).mean((-1, -2))
