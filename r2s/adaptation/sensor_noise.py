"""Estimate the sensor noise of joint angles and speeds that the wrench observer assumes, from recordings."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.signal import lfilter, savgol_coeffs, savgol_filter

from r2s.adaptation import tuning
from r2s.physics.robot import SIM_DT
from r2s.recordings.parts import spread
from r2s.recordings.recording import Recording
from r2s.recordings.speed_noise import HALF_S, LONGEST_S, PIECE_S, calm_rms, even, in_pieces

HALF, PIECE = round(HALF_S / SIM_DT), round(PIECE_S / SIM_DT)  # rows: half window of the local fits, a piece
ROWS = 2 * HALF + 1


class SensorNoise(NamedTuple):
    """Standard deviations of the white noise of a joint's sensors."""

    speed: float  # rad/s, of dq
    angle: float  # rad, of q

    @property
    def combined(self) -> float:
        """White noise, rad/s, of dq + ANGLE_RATE q: the observer computes speeds from both, see `update_wrench`."""
        return float(np.hypot(self.speed, tuning.ANGLE_RATE * self.angle))


def panda_noise() -> SensorNoise:
    """Return the noise of a Panda's sensors."""
    return SensorNoise(tuning.SPEED_NOISE, tuning.ANGLE_NOISE)


def sensor_noise(recordings: Sequence[Recording]) -> SensorNoise:
    """Return the noise of the noisiest joint; without parts of one row per millisecond, return a Panda's.

    Parts with other or uneven time steps do not count, because interpolation would change their noise.
    The method is that of `speed_noise`: the noise of dq is its difference from the slope of a local cubic fit to q,
    and the noise of q its difference from this fit, both at low acceleration. The noise of dq is low-passed first
    (FAST_RATE), because the observer low-passes speeds, and sensors often low-pass dq themselves. The result is the
    standard deviation of the white noise that has the same variance after the low-pass, and at least LEAST_NOISE of a
    Panda's noise. With each joint's own noise, the observer was less accurate on arms whose gears vibrate.
    """
    gain = SIM_DT * tuning.FAST_RATE
    passed = gain / (2.0 - gain)  # share of the variance of white noise that passes the low-pass
    kept = 1.0 - savgol_coeffs(ROWS, 3)[HALF]  # share of the variance of white noise that the fit leaves
    response = np.pad(savgol_coeffs(ROWS, 3, deriv=1, delta=SIM_DT), (0, 5 * round(1.0 / gain)))
    low_passed = lfilter([gain], [1.0, gain - 1.0], response)
    slope_noise = np.square(low_passed).sum()  # 1/s^2, variance of the low-passed slope / variance of q
    curvatures, speeds, angles = [], [], []
    for recording in (spread(r, LONGEST_S) for r in recordings):
        for rows in even(recording):
            q, dq = recording.q[rows], recording.dq[rows]
            if len(q) < ROWS + PIECE or not np.allclose(np.diff(recording.t[rows]), SIM_DT, atol=1e-6):
                continue
            fit, slope, curvature = (savgol_filter(q, ROWS, 3, deriv=k, delta=SIM_DT, axis=0) for k in range(3))
            slow = lfilter([gain], [1.0, gain - 1.0], dq - slope, axis=0)
            curvatures.append(np.abs(in_pieces(curvature, HALF, PIECE)).max(1))
            speeds.append(np.square(in_pieces(slow, HALF, PIECE)).mean(1))
            angles.append(np.square(in_pieces(q - fit, HALF, PIECE)).mean(1))
    if not curvatures:
        return panda_noise()
    angle = calm_rms(curvatures, angles) / np.sqrt(kept)
    square = (calm_rms(curvatures, speeds) ** 2 - slope_noise * angle**2) / passed
    speed, share, least = np.sqrt(np.maximum(square, 0.0)), tuning.LEAST_NOISE, panda_noise()
    return SensorNoise(max(float(speed.max()), share * least.speed), max(float(angle.max()), share * least.angle))
