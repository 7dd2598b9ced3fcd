"""Limits of the position and velocity of an FR3's joints; the velocity limit depends on the position.

Source: Franka's FCI documentation, limits for FR3 with system version 5.9 or later.
"""

import numpy as np

Q_MIN = np.array([-2.9007, -1.8361, -2.9007, -3.0770, -2.8763, 0.4398, -3.0508])  # rad
Q_MAX = np.array([2.9007, 1.8361, 2.9007, -0.1169, 2.8763, 4.6216, 3.0508])  # rad
DQ_MAX = np.array([2.62, 2.62, 2.62, 2.62, 5.26, 4.18, 5.26])  # rad/s
# Velocity limit: min(DQ_MAX, max(0, sqrt(2 DECELERATION (Q_MAX - q)) - VELOCITY_OFFSET)); mirrored towards Q_MIN
VELOCITY_OFFSET = np.array([0.6599, 0.2517, 0.2, 0.3533, 0.5757, 0.4878, 0.4628])  # rad/s
DECELERATION = np.array([6, 2.585, 3.5, 4, 17, 5.5, 17])  # rad/s^2


def velocity_bounds(q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the lowest and the highest dq (..., 7) rad/s that an FR3 allows at q (..., 7) rad."""

    def bound(distance: np.ndarray) -> np.ndarray:
        free = np.sqrt(2 * DECELERATION * np.maximum(distance, 0)) - VELOCITY_OFFSET
        return np.minimum(DQ_MAX, np.maximum(0, free))

    return -bound(q - Q_MIN), bound(Q_MAX - q)
