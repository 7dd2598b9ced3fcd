"""How noisy the speeds are that an arm's sensors tell: what a policy is shown on the arm, and so in its training."""

from collections.abc import Sequence

import numpy as np
from scipy.signal import savgol_filter

from r2s.errors import UserError
from r2s.recordings.recording import Recording

HALF_S = 0.02  # of the cubic to either side that gives a speed from angles: of 1e-5 rad it leaves 3e-4 rad/s
PIECE_S = 0.05
CALM = 0.1  # share of the pieces that is looked at
MOST_NOISE = 1.0  # rad/s: no sensor is that noisy, and no policy can use it
FEWEST = 8  # rows in a cubic, below which angles say nothing of a speed between them


def speed_noise(recordings: Sequence[Recording]) -> np.ndarray:
    """Return (n,) rad/s, standard deviation of dq less the true speeds; 0 where a recording is too coarse to say.

    The true speed is the slope of a cubic through the angles (Savitzky and Golay, Analytical Chemistry 36(8), 1964).
    It is right where the arm hardly accelerates, and there a speed that a filter has made late is right, too. So only
    the calmest tenth of all pieces of 50 ms counts, calm by the angles: dq itself does not choose. Theirs is the
    median.

    Raises:
        UserError: a joint's is above MOST_NOISE, so dq is not the speed of q.
    """
    found: list[tuple[np.ndarray, np.ndarray]] = []
    joints = recordings[0].n_joints
    for recording in recordings:
        for rows in recording.stretches:
            t, q, dq = recording.t[rows], recording.q[rows], recording.dq[rows]
            if len(t) < FEWEST:
                continue
            step = (t[-1] - t[0]) / (len(t) - 1)
            half, piece = round(HALF_S / step), round(PIECE_S / step)
            if 2 * half < FEWEST or len(t) < 2 * half + 1 + piece or np.ptp(np.diff(t)) > 0.5 * step:
                continue
            slope, bend = (savgol_filter(q, 2 * half + 1, 3, deriv=k, delta=step, axis=0) for k in (1, 2))
            count = (len(t) - 2 * half) // piece
            whole = slice(half, half + count * piece)
            wrong = (dq - slope)[whole].reshape(count, piece, -1)
            found.append((np.abs(bend[whole]).reshape(count, piece, -1).max(1), wrong))
    if not found:
        return np.zeros(joints)
    bends, squares = np.concatenate([b for b, _ in found]), [np.square(w).mean(1) for _, w in found]
    calm = bends <= np.quantile(bends, CALM, axis=0)
    noise = np.sqrt(np.nanmedian(np.where(calm, np.concatenate(squares), np.nan), axis=0))
    if (noise > MOST_NOISE).any():
        j = int(noise.argmax())
        raise UserError(
            f"dq of joint {j + 1} is {noise[j]:.3g} rad/s off the slope of its q where the arm hardly accelerates; "
            f"at most {MOST_NOISE:g} is allowed: is dq in rad/s, and in the order of q?"
        )
    return noise
