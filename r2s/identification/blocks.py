"""Divide a recording into blocks whose errors are independent, for the posterior's cluster-robust covariance.

Unlike noise, model error is correlated in time: torque ripple at low speed lasts seconds. Each block lasts several
correlation times of the residual. A repeated motion also repeats the model error. If the residual of a periodic
motion repeats, a block contains the same interval of all repetitions.
"""

import numpy as np

BLOCK_S = 0.5  # s, shortest block
BLOCKS = 20, 400  # fewest and most blocks; few blocks make the covariance uncertain, many blocks cost time
# correlation times per block; (variance of a block's sum) / (block length) is then 90 % of its limit for long blocks
LENGTH = 5.0
WINDOW = 5.0  # lag in correlation times beyond which autocorrelation is noise (Sokal, Monte Carlo Methods, 1989)
LONGEST_S = 60.0  # s, longest lag of the autocorrelation
REPEATED = 0.3  # blocks join repetitions if repetition raises the variance by more than this share
SAME = 0.1  # largest deviation of a repetition's mean angle from the median, in standard deviations of the motion


def blocks_of(
    t: np.ndarray,
    q: np.ndarray,
    period: float | None,
    residual: np.ndarray | None = None,
    shortest_s: float = BLOCK_S,
) -> np.ndarray:
    """Return the number (T,) of the block to which each row belongs; the first block has the number 0.

    Args:
        t: (T,) s, times, increasing within a trajectory. q: (T, n) rad, joint angles. period: s, period of the
            motion, or None.
        residual: (T, n), residual of a fit. If None, blocks last at least `shortest_s` s and do not join repetitions
            of the motion.
    """
    # number of the trajectory; t starts anew in each trajectory
    run = np.concatenate([[0], np.cumsum(np.diff(t) <= 0)])
    steps = np.diff(t)[np.diff(run) == 0]
    step = float(np.median(steps)) if len(steps) else shortest_s
    seconds, visit, at = step * len(t), run, run
    if residual is None:
        return _labels(run, np.floor(t / max(shortest_s, seconds / BLOCKS[1])))
    if period is not None:
        visit, at = _labels(run, np.floor(t / period)), np.round(t % period / step).astype(int)
    repeats = period is not None and _repeats(at, visit, residual)
    seconds = step * len(np.unique(at)) if repeats else seconds
    length = min(LENGTH * step * correlation_time(t, step, residual), seconds / BLOCKS[0])
    length = max(length, shortest_s, seconds / BLOCKS[1])
    if repeats:
        return _merged(_labels(np.floor(t % period / length)), visit, q)
    return _labels(run, np.floor(t / length))


def _merged(block: np.ndarray, visit: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Join the rows of the same part of the period over all repetitions; return the block number (T,) of each row.

    A part of one repetition is a separate block if a joint's mean angle deviates from the median by more than SAME.

    Args:
        block: (T,), part of the period to which each row belongs. visit: (T,), repetition of each row.
        q: (T, n) rad, joint angles.
    """
    own = _labels(block, visit)
    mean = np.stack([np.bincount(own, x) for x in q.T], 1) / np.bincount(own)[:, None]
    place = block[np.unique(own, return_index=True)[1]]
    usual = np.stack([np.median(mean[place == k], axis=0) for k in range(block.max() + 1)])
    other = (np.abs(mean - usual[place]) > SAME * q.std(0)).any(1)
    return _labels(block, np.where(other[own], own + 1, 0))


def correlation_time(t: np.ndarray, step: float, residual: np.ndarray) -> float:
    """Return the correlation time, in rows, of a residual (T, n) at times t (T,) s: the longest of all joints.

    The correlation time is the integral of the squared autocorrelation. The product of residual and Jacobian has at
    most this correlation time.
    """
    lags = min(len(t), round(LONGEST_S / step) + 1)
    total = np.zeros((lags, residual.shape[1]))
    for part in np.split(residual - residual.mean(0), np.flatnonzero(np.abs(np.diff(t) - step) > 0.5 * step) + 1):
        power = np.abs(np.fft.rfft(part, 2 * len(part), axis=0)) ** 2
        own = np.fft.irfft(power, axis=0)[: min(len(part), lags)]
        total[: len(own)] += own
    correlation = total / np.maximum(total[0], 1e-300)
    integral = 2 * np.cumsum(correlation**2, axis=0) - 1.0
    enough = np.arange(lags)[:, None] >= WINDOW * integral
    last = np.where(enough.any(0), enough.argmax(0), lags - 1)
    return float(integral[last, np.arange(len(last))].max())


def _repeats(at: np.ndarray, visit: np.ndarray, residual: np.ndarray) -> bool:
    """Return whether the residual (T, n) of a joint repeats. at, visit: (T,), phase and repetition of each row."""
    cell = _labels(at, visit)
    count = np.bincount(cell)
    phase = at[np.unique(cell, return_index=True)[1]]
    more = np.bincount(phase)  # number of repetitions of each phase
    if (often := more.max()) < 2:
        return False
    for x in (residual - residual.mean(0)).T:
        mean = np.bincount(cell, x) / count
        square = np.bincount(phase, mean**2)[more > 1]
        between = np.bincount(phase, mean)[more > 1] ** 2 - square  # twice the sum of products of all pairs
        growth = between.sum() / max(square.sum(), 1e-300)  # (often - 1) times the mean correlation of pairs
        if growth > max(REPEATED, 2.0 / np.sqrt(len(square) / often)):
            return True
    return False


def _labels(*keys: np.ndarray) -> np.ndarray:
    """Return a number (T,) per row; rows have the same number if all `keys`, each (T,), are equal in these rows."""
    out = np.zeros(len(keys[0]), dtype=int)
    for key in keys:
        index = np.unique(key, return_inverse=True)[1]
        out = np.unique(out * (index.max() + 1) + index, return_inverse=True)[1]
    return out
