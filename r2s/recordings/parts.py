"""Process a long recording in parts: in successive pieces, or in stretches spread over the recording."""

import ctypes
import sys
from collections.abc import Iterable, Iterator, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from r2s.recordings.recording import Recording

M_MMAP_THRESHOLD, MAPPED = -3, 4 << 20  # option of glibc's mallopt(3); bytes
LONG_S = 600.0  # s; intermediate results of longer recordings take hundreds of MB
MANY = 10  # number of parts; only recordings longer than LONG_S have more parts than this


def give_back(recording: Recording) -> None:
    """Return freed memory to the operating system after a long recording: glibc retains blocks of up to 32 MB."""
    if recording.duration > LONG_S:
        _trim()


def _trim() -> None:
    """Return freed memory to the operating system, now and whenever a block above MAPPED bytes is freed later."""
    libc: Any = ctypes.CDLL(None) if sys.platform == "linux" else None
    if hasattr(libc, "malloc_trim"):  # musl has no malloc_trim
        libc.mallopt(M_MMAP_THRESHOLD, MAPPED)
        libc.malloc_trim(0)


def joined_arrays(parts: Sequence[object], names: Iterable[str]) -> dict[str, np.ndarray]:
    """Return {name: array joined from all parts}; delete these arrays from the parts to save memory."""
    out = {}
    for name in names:
        out[name] = np.concatenate([vars(part).pop(name) for part in parts])
        if len(parts) > MANY and out[name].nbytes > MAPPED:
            _trim()  # only for many parts: mapping large blocks one by one slows a short identification
    return out


def pieces(recording: Recording, seconds: float, overlap_s: float = 0.0) -> Iterator[Recording]:
    """Yield pieces of about `seconds` s in the order of the log; in a trajectory, pieces overlap by `overlap_s` s.

    The last piece includes the remaining rows, which alone may be too few to filter.
    """
    if recording.duration <= 1.5 * seconds:
        yield recording
        return
    groups: list[list[np.ndarray]] = []
    group: list[np.ndarray] = []
    held = 0.0
    for s in recording.stretches:
        t = recording.t[s]
        edges = np.linspace(t[0], t[-1], max(1, round((t[-1] - t[0]) / seconds)) + 1)
        for low, high in pairwise(edges):
            first, last = np.searchsorted(t, low - overlap_s * (low > t[0])), np.searchsorted(t, high, "right")
            group.append(s.start + np.arange(first, last))
            held += high - low
            if held >= 0.5 * seconds:  # several short trajectories make one piece
                groups.append(group)
                group, held = [], 0.0
    groups[-1] += group
    for rows in map(np.concatenate, groups):
        yield recording.rows(rows, recording.trajectory[rows])


def spread(recording: Recording, seconds: float, each_s: float = 10.0) -> Recording:
    """Return stretches of `each_s` s, `seconds` s in total, at equal distances over the whole recording.

    A recording of at most `seconds` s is returned unchanged.
    """
    if recording.duration <= seconds:
        return recording
    clock = np.concatenate(
        [np.diff(recording.t[s], prepend=recording.t[s.start]) for s in recording.stretches]
    ).cumsum()
    count = max(1, round(seconds / each_s))
    phase = clock * (count / recording.duration)
    return recording.select((phase % 1.0 < seconds / recording.duration) & (phase < count * (1.0 - 1e-9)))
