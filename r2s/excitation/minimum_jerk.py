"""Compute minimum-jerk motions (Flash and Hogan, J. Neurosci. 5(7), 1985)."""

import numpy as np


def minimum_jerk(
    start: np.ndarray, end: np.ndarray, seconds: float, t: np.ndarray | float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return position, velocity and acceleration of a motion from `start` to `end` (n,) rad in `seconds`.

    The arrays have the shape (n,) for one time t in s, and (T, n) for times t (T, 1) in s. Outside [0, `seconds`] the
    arm rests.
    """
    s = np.clip(t / seconds, 0.0, 1.0)
    distance = end - start
    position = 10 * s**3 - 15 * s**4 + 6 * s**5
    velocity = (30 * s**2 - 60 * s**3 + 30 * s**4) / seconds
    acceleration = (60 * s - 180 * s**2 + 120 * s**3) / seconds**2
    return start + position * distance, velocity * distance, acceleration * distance
