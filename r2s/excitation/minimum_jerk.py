"""Minimum-jerk motion."""

import numpy as np


def minimum_jerk(start: np.ndarray, end: np.ndarray, seconds: float, t: float) -> tuple[np.ndarray, ...]:
    """Return position, velocity and acceleration at t of the motion of Flash and Hogan, J. Neurosci. 5(7), 1985."""
    s = min(max(t / seconds, 0.0), 1.0)
    away = end - start
    place = 10 * s**3 - 15 * s**4 + 6 * s**5
    speed = (30 * s**2 - 60 * s**3 + 30 * s**4) / seconds
    gain = (60 * s - 180 * s**2 + 120 * s**3) / seconds**2
    return start + place * away, speed * away, gain * away
