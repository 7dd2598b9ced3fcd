"""Compute statistics of few seeds: interquartile mean, stratified bootstrap, probability of improvement.

Source: Agarwal et al., Deep Reinforcement Learning at the Edge of the Statistical Precipice (NeurIPS 2021).
"""

from collections.abc import Callable, Sequence

import numpy as np
from scipy.stats import trim_mean

DRAWS = 2000  # number of draws of a bootstrap, as in Agarwal et al.


def interquartile_mean(x: np.ndarray) -> np.ndarray:
    """Return the mean over the last axis of x (..., S) without the lowest and the highest quarter of the values.

    A quarter has S / 4 values, rounded down as in rliable; for S < 4, all values are averaged.
    """
    return np.asarray(trim_mean(x, 0.25, axis=-1))


def interval(
    strata: Sequence[np.ndarray], statistic: Callable[[list[np.ndarray]], np.ndarray], seed: int = 0
) -> tuple[float, float]:
    """Return the 95 % interval of a statistic by a stratified bootstrap; nan if a stratum has only one score.

    Args:
        strata: scores of S seeds in each stratum, as one array (S,) per stratum. seed: random seed of the bootstrap.
        statistic: maps D bootstrap draws, given as one array (D, S) per stratum, to D values (D,).
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
    """Return bootstrap means (DRAWS, A) for the A lines of a comparison table, such as A adapters.

    A draw uses the same resampled arms and episodes for all lines.

    Args:
        each: one array (E, A) per arm: the values in E episodes; column k is for line k of the table.
        rng: random generator.
    """
    draws = []
    for _ in range(DRAWS):
        arms = [each[i] for i in rng.integers(len(each), size=len(each))]
        draws.append(np.concatenate([a[rng.integers(len(a), size=len(a))] for a in arms]).mean(0))
    return np.array(draws)


def improvement(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the probability (...) that a value of x (..., S) exceeds a value of y (..., T); ties have weight 0.5."""
    above = x[..., :, None] > y[..., None, :]
    same = x[..., :, None] == y[..., None, :]
    return (above + 0.5 * same).mean((-1, -2))
