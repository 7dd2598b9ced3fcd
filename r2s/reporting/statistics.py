"""What can be said with few seeds: interquartile mean, stratified bootstrap, probability of improvement.

As Agarwal et al., Deep Reinforcement Learning at the Edge of the Statistical Precipice (NeurIPS 2021), propose them.
"""

from collections.abc import Callable, Sequence

import numpy as np

DRAWS = 2000


def interquartile_mean(x: np.ndarray) -> np.ndarray:
    """Return the mean over the last axis of x (..., S) without its lowest and highest quarter.

    Of a quarter that is no whole number of values, the value at its edge counts in part.
    """
    x, s = np.sort(x, axis=-1), x.shape[-1]
    weight = np.clip(np.minimum(np.arange(1, s + 1) - s / 4, s - s / 4 - np.arange(s)), 0.0, 1.0)
    return np.where(weight > 0, x, 0.0) @ (weight / weight.sum())  # what is left out may be infinite


def interval(
    strata: Sequence[np.ndarray], statistic: Callable[[list[np.ndarray]], np.ndarray], seed: int = 0
) -> tuple[float, float]:
    """Return the 95 % interval of a statistic by a bootstrap that draws seeds within each stratum.

    Args:
        strata: arrays (S,), one score per seed.
        statistic: of arrays (D, S) of draws, one per stratum, returns (D,).
        seed: of the bootstrap.
    """
    rng = np.random.default_rng(seed)
    drawn = [x[rng.integers(len(x), size=(DRAWS, len(x)))] for x in strata]
    found, levels = statistic(drawn), [0.025, 0.975]
    if np.isfinite(found).all():
        low, high = np.quantile(found, levels)
    else:  # nothing lies between infinities
        low, high = np.quantile(found, levels, method="inverted_cdf")
    return float(low), float(high)


def paired(each: Sequence[np.ndarray], rng: np.random.Generator) -> np.ndarray:
    """Return (DRAWS, A), means of a bootstrap that is paired: what is drawn is the same for all A that are compared.

    Arms are drawn, and of each arm its episodes.

    Args:
        each: per arm (E, A), a row for each of its episodes. rng: what draws.
    """
    draws = []
    for _ in range(DRAWS):
        arms = [each[i] for i in rng.integers(len(each), size=len(each))]
        draws.append(np.concatenate([a[rng.integers(len(a), size=len(a))] for a in arms]).mean(0))
    return np.array(draws)


def improvement(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return (...): probability that a draw of x (..., S) is above one of y (..., T); a tie counts half."""
    above = x[..., :, None] > y[..., None, :]
    same = x[..., :, None] == y[..., None, :]
    return (above + 0.5 * same).mean((-1, -2))
