"""Find repeated motion in recordings, so that training and validation share no motion.

A correlation by FFT compares two motions a and b at all lags at once. The squared distance |a|^2 + |b|^2 - 2 a b
between a and b is summed over the rows that both motions contain.
"""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

STEP = 0.02  # s, grid of the comparison
MIN_MOTION = 3.0  # least standard deviation of a joint's motion, in tolerances; the range is then about 10 tolerances
OVERLAP_S = 0.5  # s, minimum length of a repetition
PAUSE_S = 60.0  # s, a longer pause in a log separates two motions
MAX_COMPARED = 60  # largest number of tracks compared with one track, and of pieces in `overlap`, to save time
PIECE_S, PIECE_MOTION = 1.0, 2.0  # least duration (s) and range (standard deviations of the motion) of a piece
TRACKING = 0.03  # rad RMS, difference between two repetitions, each with 15 to 20 mrad of tracking error
# smallest and largest tolerance, in standard deviations of an angle; at 0.2, unrelated motions of a joint match
SIMILAR = 0.04, 0.12
STILL = 0.25  # lower bound on a joint's standard deviation, relative to the largest of all joints


class Track:
    """Motion between two restarts of the clock, resampled to time steps of STEP; q is NaN in gaps of the log."""

    def __init__(self, t: np.ndarray, q: np.ndarray, stretches: Sequence[slice]):
        """Resample q (T, n) rad, logged at t (T,) s, within `stretches`: slices of rows with increasing t."""
        self.stretches = list(stretches)
        self.start = float(t[stretches[0].start])
        grid = np.arange(self.start, t[stretches[-1].stop - 1] + 1e-9, STEP)
        self.q = np.full((len(grid), q.shape[1]), np.nan)
        for s in stretches:
            inside = (grid >= t[s.start]) & (grid <= t[s.stop - 1])
            self.q[inside] = np.stack([np.interp(grid[inside], t[s], x) for x in q[s].T], axis=1)

    @property
    def end(self) -> float:
        """Time of the last row, s."""
        return self.start + STEP * (len(self.q) - 1)


def tracks_of(t: np.ndarray, q: np.ndarray, stretches: Sequence[slice], each: bool = False) -> list[Track]:
    """Return tracks that last at least OVERLAP_S s.

    If `each`, every stretch is a track. Otherwise, a new track begins only at a clock restart or after a long pause.
    """
    cut = [0, *(k for k in range(1, len(stretches)) if each or _new_run(t, stretches[k - 1 : k + 1])), len(stretches)]
    tracks = [Track(t, q, stretches[a:b]) for a, b in pairwise(cut)]
    return [track for track in tracks if len(track.q) * STEP >= OVERLAP_S]


def _new_run(t: np.ndarray, two: Sequence[slice]) -> bool:
    """Return whether the clock restarts, or the log pauses for more than PAUSE_S, between two stretches."""
    pause = t[two[1].start] - t[two[0].stop - 1]
    return bool(pause <= 0 or pause > PAUSE_S)


def find_period(tracks: Sequence[Track]) -> tuple[float | None, np.ndarray]:
    """Return the period (s) of the motion, and time shifts (K,) s that align repeated motion in K tracks.

    The period is None if no motion repeats. If no track contains a repetition, but tracks repeat each other, the
    period is the duration of all aligned tracks.
    """
    shift, found, period, tolerance = np.zeros(len(tracks)), False, None, _tolerance(tracks)
    for k, b in enumerate(tracks if tolerance.any() else []):
        if period is None and (lag := _own_lag(b, tolerance)):
            period = lag * STEP
        for i, a in enumerate(tracks[: min(k, MAX_COMPARED)]):
            if (other := _lag(a, b, tolerance)) is not None:
                shift[k] = shift[i] + a.start + other * STEP - b.start
                found = True
                break
    if period is None and found:
        starts, ends = (np.array([getattr(x, name) for x in tracks]) + shift for name in ("start", "end"))
        period = float(ends.max() - starts.min()) + STEP
    return period, np.where(np.abs(shift) > 2 * STEP, shift, 0.0)  # smaller shifts are below the grid's resolution


def overlap(training: Sequence[Track], other: Sequence[Track]) -> float:
    """Return the share (0 to 1) of the motion in `other` that also occurs in `training`, in all joints at once.

    The function cuts `other` into pieces, and compares each piece with all equally long parts of `training`. A piece
    occurs in `training` if its RMS distance from one part is below `_tolerance(other)` in every joint.
    """
    tolerance, deviation = _tolerance(other), _deviation(other)
    pieces = [piece for track in other for piece in _pieces(track.q, PIECE_MOTION * deviation.max())]
    pieces = pieces[:: 1 + len(pieces) // MAX_COMPARED]
    repeated = 0
    for piece in pieces:
        for track in training:
            square, _, count = _distances(track.q, piece)
            if ((square < tolerance**2).all(1) & (count >= 0.9 * len(piece))).any():
                repeated += 1
                break
    return repeated / max(len(pieces), 1)


def _deviation(tracks: Sequence[Track]) -> np.ndarray:
    """Return the standard deviation (n,) rad of each joint's angle over all tracks."""
    return np.nanstd(np.concatenate([track.q for track in tracks]), axis=0) if tracks else np.zeros(1)


def _tolerance(tracks: Sequence[Track]) -> np.ndarray:
    """Return the RMS distance (n,) rad of each joint below which two pieces of motion are treated as equal.

    With a joint's standard deviation d in `tracks` and the largest standard deviation D of all joints, let s be the
    larger of d and STILL D. The joint's tolerance is TRACKING, clipped to the range SIMILAR[0] s to SIMILAR[1] s.
    """
    deviation = _deviation(tracks)
    return np.clip(TRACKING, *np.outer(SIMILAR, np.maximum(deviation, STILL * deviation.max())))


def _pieces(q: np.ndarray, motion: float) -> list[np.ndarray]:
    """Cut q (S, n) rad at NaN into pieces of at least PIECE_S s in which a joint moves by more than `motion` rad."""
    pieces, start, shortest = [], 0, round(PIECE_S / STEP)
    low = high = q[0]
    for k, x in enumerate(q):
        if k == start:
            low = high = x
        low, high = np.minimum(low, x), np.maximum(high, x)
        if np.isnan(x[0]):
            start = k + 1
        elif k + 1 - start >= shortest and (high - low).max() > motion:
            pieces.append(q[start : k + 1])
            start = k + 1
    return pieces


def _distances(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compare angles a (A, n) and b (B, n) rad, NaN in gaps, at all L lags from -(B - 1) to A - 1.

    At each lag, the common rows are the k for which a[k + lag] and b[k] exist. Return the mean square of
    a[k + lag] - b[k] (L, n), the variance of b[k] (L, n) over the common rows, and the number of common rows (L,).
    """
    size = 1 << int(len(a) + len(b) - 1).bit_length()
    middle = np.nanmean(a, axis=0)  # centering reduces the round-off of the differences
    spectra = []
    for x in (a, b):
        seen = ~np.isnan(x[:, :1])
        filled = np.where(seen, x - middle, 0.0)
        spectra.append([np.fft.rfft(part, size, axis=0) for part in (seen.astype(float), filled, filled**2)])
    (seen_a, a1, a2), (seen_b, b1, b2) = spectra
    lags = np.arange(1 - len(b), len(a))

    def summed(spectrum: np.ndarray) -> np.ndarray:
        return np.fft.irfft(spectrum, size, axis=0)[lags]

    count = np.round(summed(seen_a * seen_b.conj())[:, 0]).astype(int)
    rows = np.maximum(count, 1)[:, None]
    square = summed(a2 * seen_b.conj() + seen_a * b2.conj() - 2 * a1 * b1.conj()) / rows
    variance = summed(seen_a * b2.conj()) / rows - (summed(seen_a * b1.conj()) / rows) ** 2
    return np.maximum(square, 0.0), variance, count


def _errors(a: np.ndarray, b: np.ndarray, tolerance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the distance (L,) of a and b at each of L lags: the largest RMS distance of a joint, in tolerances.

    The second result is the number of common rows (L,). The distance is inf if the common rows last less than
    OVERLAP_S, or if no joint's standard deviation exceeds MIN_MOTION tolerances.
    """
    square, variance, count = _distances(a, b)
    counts = (count >= OVERLAP_S / STEP) & ((variance / tolerance**2).max(1) > MIN_MOTION**2)
    return np.where(counts, np.sqrt((square / tolerance**2).max(1)), np.inf), count


def _own_lag(track: Track, tolerance: np.ndarray) -> int | None:
    """Return the first lag (in rows) at which a track repeats itself, or None if the track does not repeat."""
    q, least = track.q, round(OVERLAP_S / STEP)
    error = _errors(q, q, tolerance)[0][len(q) - 1 :]  # from lag 0
    error[:least] = np.inf
    for run in _runs(error < 1.0):
        best = run.start + int(error[run].argmin())
        if best > least:  # a match at the smallest lag indicates slow motion, not a repetition
            return best
    return None


def _lag(a: Track, b: Track, tolerance: np.ndarray) -> int | None:
    """Return the lag (in rows) at which b repeats a with the longest overlap, or None if b does not repeat a."""
    error, count = _errors(a.q, b.q, tolerance)
    runs = _runs(error < 1.0)
    if not runs:
        return None
    longest = max(runs, key=lambda run: count[run].max())
    return longest.start + int(error[longest].argmin()) - (len(b.q) - 1)


def _runs(mask: np.ndarray) -> list[slice]:
    """Return a slice for each uninterrupted sequence of True in a mask (L,)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(int)))
    return [slice(int(a), int(b)) for a, b in edges.reshape(-1, 2)]
