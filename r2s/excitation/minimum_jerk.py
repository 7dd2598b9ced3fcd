"""Minimum-jerk motion."""

import numpy as np


def minimum_jerk(
    start: np.ndarray, end: np.ndarray, seconds: float, t: np.ndarray | float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return position, velocity and acceleration of the motion of Flash and Hogan, J. Neurosci. 5(7), 1985.

    Each is (n,) for start, end (n,) rad at one time t, s, and (T, n) for times (T, 1); before 0 and after `seconds`
    the motion rests.
    """
    s = np.clip(t / seconds, 0.0, 1.0)
    away = end - start
    place = 10 * s**3 - 15 * s**4 + 6 * s**5
    speed = (30 * s**2 - 60 * s**3 + 30 * s**4) / seconds
    push = (60 * s - 180 * s**2 + 120 * s**3) / seconds**2
    return start + place * away, speed * away, push * away
