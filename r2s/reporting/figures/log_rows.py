"""Reduce the number of rows of long logs for figures, and shorten the pauses in these logs."""

import numpy as np

MOST_POINTS = 4000  # largest number of points of a line in a figure: about three per pixel of a panel
PAUSE = 0.1  # s, length to which each pause is shortened


def thin(count: int, most: int = MOST_POINTS) -> slice:
    """Return a slice of `count` rows that selects `most` or fewer evenly spaced rows."""
    return slice(None, None, max(1, -(-count // most)))


def at_rate(t: np.ndarray, rate: float) -> np.ndarray:
    """Return indices of rows that sample a log with times t (T,) s at about `rate` Hz, with first and last row."""
    grid = np.arange(t[0], t[-1], 1 / rate)
    return np.unique(np.append(np.searchsorted(t, grid).clip(max=len(t) - 1), len(t) - 1))


def without_pauses(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the times t (T,) s from 0 s, with each pause shortened to `PAUSE`, and the first row after each pause.

    A pause is a time step that is longer than five median time steps, or not positive because the clock restarted.
    """
    steps = np.diff(t)
    usual = float(np.median(steps)) if len(steps) else 0.0
    jump = (steps <= 0) | (steps > 5 * usual)
    return np.concatenate([[0.0], np.cumsum(np.where(jump, PAUSE, steps))]), np.flatnonzero(jump) + 1
