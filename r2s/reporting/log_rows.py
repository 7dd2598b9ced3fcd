"""Which rows of a long log are drawn, and on which clock."""

import numpy as np

MOST_POINTS = 4000  # of a line or a cloud in a figure
PAUSE = 0.1  # s on a figure's axis, for a pause of any length


def thin(count: int, most: int = MOST_POINTS) -> slice:
    """Return what leaves at most `most` of `count` rows."""
    return slice(None, None, max(1, -(-count // most)))


def at_rate(t: np.ndarray, rate: float) -> np.ndarray:
    """Return the rows of t (T,) s that come closest to `rate` Hz, the first and the last among them."""
    grid = np.arange(t[0], t[-1], 1 / rate)
    return np.unique(np.append(np.searchsorted(t, grid).clip(max=len(t) - 1), len(t) - 1))


def without_pauses(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (T,) s from zero, in which every pause of t (T,) s lasts `PAUSE`, and the rows before which they lie.

    A pause is a step of more than five usual ones, or a clock that starts again.
    """
    steps = np.diff(t)
    usual = float(np.median(steps)) if len(steps) else 0.0
    jump = (steps <= 0) | (steps > 5 * usual)
    return np.concatenate([[0.0], np.cumsum(np.where(jump, PAUSE, steps))]), np.flatnonzero(jump) + 1
