"""Check the clock of a recording against its velocities: dq integrated over t must equal the change of q."""

import numpy as np

from r2s.errors import UserError
from r2s.recordings.recording import Recording

LEAST = 0.02  # rad RMS about a linear trend; a joint that moves less has no speed factor
UNEXPLAINED = 0.03  # largest share of a joint's mean square motion that a valid speed factor leaves unexplained
WRONG = 0.1  # a speed factor this far from 1 is an error; filters of dq and elastic gears cause 1 to 2 %
ALIKE = 0.05  # if all speed factors are wrong and spread less than this (relative), the clock or dq's unit is wrong


def speed_factors(recording: Recording) -> np.ndarray:
    """Return each joint's speed factor (n,): change of q / integral of dq; nan if the motion does not determine it.

    In each trajectory, linear trends of q and of the integral of dq are removed, so that a bias of dq has no effect.
    """
    square, cross, own = np.zeros((3, recording.n_joints))
    for s in recording.stretches:
        t = recording.t[s]
        if len(t) < 3:
            continue
        trend = np.linalg.qr(np.column_stack([np.ones(len(t)), t - t.mean()]))[0]
        for j in range(recording.n_joints):  # one joint at a time saves memory in a long log
            q, dq = recording.q[s, j], recording.dq[s, j]
            area = np.concatenate([[0.0], np.cumsum(0.5 * np.diff(t) * (dq[1:] + dq[:-1]))])
            x, y = (v - trend @ (trend.T @ v) for v in (area, q - q[0]))
            square[j], cross[j], own[j] = square[j] + x @ x, cross[j] + x @ y, own[j] + y @ y
    least = LEAST**2 * len(recording.t)
    with np.errstate(divide="ignore", invalid="ignore"):
        factor, left = cross / square, 1.0 - cross**2 / (square * own)
    return np.where((own > least) & (left < UNEXPLAINED), factor, np.nan)


def check_clock(recording: Recording) -> np.ndarray:
    """Return the joints' speed factors (n,) after checking that every factor is near 1 or nan.

    Raises:
        UserError: the scale of t does not fit the velocities, or a joint's q and dq have different scales.
    """
    factor = speed_factors(recording)
    seen = np.flatnonzero(np.isfinite(factor))
    off = seen[np.abs(np.log(np.abs(factor[seen]))) > np.log1p(WRONG)]
    if not len(off):
        return factor
    middle = float(np.median(factor[seen]))
    if len(off) == len(seen) and np.ptp(factor[seen]) < ALIKE * abs(middle) and middle > 0:
        raise UserError(
            f"the recording: q changes {middle:.3g} times as much as dq integrates to over t, in all moving joints: "
            f"is t wrong ({recording.rate_hz:.4g} Hz by t, {recording.rate_hz / middle:.4g} Hz by dq), or the unit "
            f"of dq? Multiply the wrong one by {middle:.3g}"
        )
    j = off[0]
    raise UserError(
        f"the recording: q of joint {j + 1} changes {factor[j]:.3g} times as much as its dq integrates to over t; "
        "correct the scale of its dq, or leave dq out of the file to derive it from q"
    )
