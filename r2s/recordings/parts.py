"""Process a long recording in parts: in successive pieces, or in stretches spread over the recording."""

import ctypes
import sys
from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from r2s.recordings.recording import Recording

LONG_S = 600.0  # s; intermediate results of longer recordings take hundreds of MB
MANY = 9  # number of one-minute pieces; the arrays of more pieces take hundreds of MB, too


def trim() -> None:
    """Return freed memory to the operating system; otherwise glibc may retain blocks of up to 32 MB."""
    free = getattr(ctypes.CDLL(None), "malloc_trim", None) if sys.platform == "linux" else None  # musl has none
    if free is not None:
        free(0)


def give_back(recording: Recording) -> None:
    """Return freed memory to the operating system if the recording is longer than LONG_S."""
    if recording.duration > LONG_S:
        trim()


def concatenated(parts: Sequence[Any], name: str) -> np.ndarray:
    """Join the array attribute `name` of consecutive parts, and delete it from the parts to save memory."""
    out = np.concatenate([vars(part).pop(name) for part in parts])
    if len(parts) > MANY:
        trim()
    return out


def pieces(recording: Recording, seconds: float, overlap_s: float = 0.0) -> Iterator[Recording]:
    """Yield pieces of about `seconds` s in the order of the log; in a trajectory, they overlap by `overlap_s` s.

    A remainder is appended to the last piece, because it may be too short to be filtered alone.
    """
    if recording.duration <= 1.5 * seconds:
        yield recording
        return
    groups: list[list[tuple[int, int]]] = []
    group: list[tuple[int, int]] = []
    held = 0.0
    for s in recording.stretches:
        t = recording.t[s]
        edges = np.linspace(t[0], t[-1], max(1, round((t[-1] - t[0]) / seconds)) + 1)
        for low, high in pairwise(edges):
            first, last = np.searchsorted(t, low - overlap_s * (low > t[0])), np.searchsorted(t, high, "right")
            group.append((s.start + int(first), s.start + int(last)))
            held += high - low
            if held >= 0.5 * seconds:  # several short trajectories make one piece
                groups.append(group)
                group, held = [], 0.0
    groups[-1] += group
    for group in groups:
        rows = np.concatenate([np.arange(first, last) for first, last in group])
        yield recording.rows(rows, recording.trajectory[rows])


def spread(recording: Recording, seconds: float, each_s: float = 10.0) -> Recording:
    """Return stretches of `each_s` s, evenly spread over the recording, with a total length of `seconds` s.

    A recording of at most `seconds` s is returned unchanged.
    """
    if recording.duration <= seconds:
        return recording
    phase = np.zeros(len(recording.t))  # in place: an array of an hour takes 29 MB
    for s in recording.stretches:
        np.subtract(recording.t[s][1:], recording.t[s][:-1], out=phase[s][1:])
    np.cumsum(phase, out=phase)
    count = max(1, round(seconds / each_s))
    phase *= count / recording.duration
    some = phase < count * (1.0 - 1e-9)
    phase %= 1.0
    some &= phase < seconds / recording.duration
    return recording.select(some)
