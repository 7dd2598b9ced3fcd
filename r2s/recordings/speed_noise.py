"""Estimate the noise of an arm's measured velocity from recordings; a training adds such noise to simulated dq."""

from collections.abc import Iterator, Sequence

import numpy as np
from scipy.signal import savgol_filter

from r2s.errors import UserError
from r2s.recordings.parts import spread
from r2s.recordings.recording import Recording

HALF_S = 0.02  # s, half window of the Savitzky-Golay cubic; position noise of 1e-5 rad then causes 3e-4 rad/s
MAX_HALF_S = 0.05  # s, largest half window: at 80 Hz the slope of a 2 Hz oscillation then errs by 0.04 %
PIECE_S = 0.05  # s, length of the pieces from which the calmest are chosen
CALM = 0.1  # share of the pieces that are used, namely those with the smallest acceleration
LONGEST_S = 600.0  # s; of a longer recording, parts of this total length are used
MAX_NOISE = 1.0  # rad/s, more than any velocity sensor adds
MIN_ROWS = 8  # least number of samples for the slope of a cubic
UNEVEN = 0.25  # share of the median step; a step that differs by more, as after a lost sample, ends a piece


def speed_noise(recordings: Sequence[Recording]) -> np.ndarray:
    """Return the standard deviation (n,) rad/s of the velocity noise; 0 if no recording has a rate of at least 80 Hz.

    The noise is dq minus a reference velocity, the slope of a cubic fit to q (Savitzky and Golay, Analytical
    Chemistry 36(8), 1964). At low acceleration, the fitted slope is accurate, and a delay of dq has no effect. The
    result is the median RMS noise over 50 ms pieces, but only over the 10 % with the smallest acceleration (second
    derivative of q).

    Raises:
        UserError: the noise of a joint exceeds MAX_NOISE, so dq is not the velocity of q.
    """
    curvatures, squares = list[np.ndarray](), list[np.ndarray]()
    joints = recordings[0].n_joints
    for recording in (spread(r, LONGEST_S) for r in recordings):
        for rows in even(recording):
            t, q, dq = recording.t[rows], recording.q[rows], recording.dq[rows]
            step = (t[-1] - t[0]) / (len(t) - 1)
            half, piece = max(round(HALF_S / step), MIN_ROWS // 2), max(round(PIECE_S / step), 1)
            if half * step > MAX_HALF_S or len(t) < 2 * half + 1 + piece:
                continue
            slope, curvature = (savgol_filter(q, 2 * half + 1, 3, deriv=k, delta=step, axis=0) for k in (1, 2))
            curvatures.append(np.abs(in_pieces(curvature, half, piece)).max(1))
            squares.append(np.square(in_pieces(dq - slope, half, piece)).mean(1))
    if not curvatures:
        return np.zeros(joints)
    noise = calm_rms(curvatures, squares)
    if (noise > MAX_NOISE).any():
        j = int(noise.argmax())
        raise UserError(
            f"dq of joint {j + 1} is {noise[j]:.3g} rad/s off the slope of its q at low acceleration; at most "
            f"{MAX_NOISE:g} is allowed: is dq in rad/s, and in the order of q?"
        )
    return noise


def in_pieces(x: np.ndarray, half: int, piece: int) -> np.ndarray:
    """Return x (T, n) without `half` rows at both ends as an array (pieces, `piece` rows, n); drop what remains."""
    count = (len(x) - 2 * half) // piece
    return x[half : half + count * piece].reshape(count, piece, -1)


def calm_rms(curvatures: Sequence[np.ndarray], squares: Sequence[np.ndarray]) -> np.ndarray:
    """Return the root (n,) of the median of `squares` over the pieces with the smallest curvature, per joint.

    Args:
        curvatures, squares: per recording, arrays (pieces, n): largest |d2q/dt2|, mean squared error of each piece.
    """
    curvature, square = np.concatenate(curvatures), np.concatenate(squares)
    calm = curvature <= np.quantile(curvature, CALM, axis=0)
    return np.sqrt(np.nanmedian(np.where(calm, square, np.nan), axis=0))


def even(recording: Recording) -> Iterator[slice]:
    """Yield slices of a recording: pieces of at least MIN_ROWS rows with even time steps."""
    for rows in recording.stretches:
        steps = np.diff(recording.t[rows])
        if len(steps) < MIN_ROWS:
            continue
        usual = np.median(steps)
        cuts = np.flatnonzero(np.abs(steps - usual) > UNEVEN * usual) + 1
        for piece in np.split(np.arange(rows.start, rows.stop), cuts):
            if len(piece) >= MIN_ROWS:
                yield slice(int(piece[0]), int(piece[-1]) + 1)
