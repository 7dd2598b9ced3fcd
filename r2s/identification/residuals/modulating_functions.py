"""Compute weighted means of a recording over short windows in which a joint slides in one direction.

When a joint rests or reverses, its friction is not a function of velocity, and a low-pass spreads this friction over
a tenth of a second. A row of the torque residual is therefore a weighted mean over a window in which the joint always
slides (modulating functions: Shinbrot, Trans. ASME 79, 1957). Rigid-body torque, friction and command are averaged
with the same weights. Short windows between close reversals make rows noisier; r2s computes the noise of each row.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from itertools import pairwise

import numpy as np
from scipy.signal import savgol_filter
from scipy.sparse import csr_array

from r2s.identification.residuals.zero_phase import EDGE_S, cubic, too_short
from r2s.physics.friction import PRESLIDING, presliding
from r2s.physics.robot import SIM_DT
from r2s.recordings.parts import joined_arrays
from r2s.recordings.recording import Recording

RATE_HZ = 250  # rate at which torques are evaluated before averaging
CUTOFF_HZ = 40.0  # cutoff of angles before differentiation: noisy velocities would bias mean friction
NORMAL = 0.6745  # median magnitude of a normal variable / its standard deviation
SHORTEST, LONGEST = 0.024, 0.1  # s, limits of half the length of a window
GUARD = 8e-3  # s between a window and a stop, because the low-pass spreads the stop over this time
STEADY = 0.2  # largest relative change of velocity over the distance PRESLIDING, for a friction law with memory
STEADY_ROWS = 101  # rows per polynomial in the test of STEADY; with only five rows, noise looks like acceleration
MAX_LATENCY = 0.04  # s, longest latency of a command
HOLD_STEPS = (np.arange(8) + 0.5) / 8  # midpoints of eight equal parts of a command's hold, in steps
# Gauss-Laguerre quadrature for a first-order lag; the omitted four points have less than 1e-10 of the weight
LAG_POINTS, LAG_WEIGHTS = (x[:12] for x in np.polynomial.laguerre.laggauss(16))


@dataclass(frozen=True)
class SlidingMotion:
    """A recording of F samples, and T moments with an averaging window around each at which a joint slides.

    Attributes:
        t: (T,) s, moments. q, dq, ddq: (F, n) rad, rad/s, rad/s^2, motion. bristle: (F, n), presliding state.
        means: for each piece of the recording, n sparse matrices (moments, samples) with the window weights of each
            joint. If no window covers a moment, its matrix row is zero.
        seen: (T, n) bool, whether the moment has a window; in a window, the joint slides in one direction.
        noise: (T, n) 1/s^2, standard deviation of a window's mean acceleration for white encoder noise of 1 rad.
        encoder: (n,) rad, standard deviation of the encoder noise.
        delayed: (T, L, n) Nm, window means of the command after each of L delays: -1 ms, 0, 1 ms, ...
        instants: (F,) s, times of the F samples. starts: (F,) bool, whether a trajectory starts at the sample.
    """

    t: np.ndarray
    q: np.ndarray
    dq: np.ndarray
    ddq: np.ndarray
    bristle: np.ndarray
    means: tuple[tuple[csr_array, ...], ...]
    seen: np.ndarray
    noise: np.ndarray
    encoder: np.ndarray
    delayed: np.ndarray
    instants: np.ndarray
    starts: np.ndarray

    @staticmethod
    def of(
        recording: Recording,
        rate_hz: float,
        slowest: float,
        slid: float = 0.0,
        presliding_rad: np.ndarray | float = PRESLIDING,
    ) -> "SlidingMotion":
        """Find windows, centered every 1 / `rate_hz` s, in which a joint is faster than `slowest` rad/s.

        For a friction law with memory (`slid` > 0), bristles bend over `presliding_rad` (a number or (n,)) after a
        reversal. After a reversal, a window starts only when the joint has slid by `slid` rad. In a window, velocity
        must be nearly constant over the distance PRESLIDING, because bristle friction depends on earlier velocities.

        Raises:
            UserError: no trajectory is longer than 2 EDGE_S.
        """
        grid = recording.resample(SIM_DT)
        smooth = grid.smooth(CUTOFF_HZ)
        # central differences would underestimate accelerations near CUTOFF_HZ by half a percent
        dq, ddq = (_derivative(smooth, order) for order in (1, 2))
        above = 1.0 - 2.0 * CUTOFF_HZ * SIM_DT  # share of white noise above the cutoff
        encoder = np.median(np.abs(grid.q - smooth.q), axis=0) / NORMAL / np.sqrt(above)
        slides = np.abs(dq) >= slowest
        if slid:
            change = np.abs(_derivative(smooth, 2, STEADY_ROWS)) * PRESLIDING
            slides &= change <= STEADY * dq**2
        every, step, edge = round(1 / (RATE_HZ * SIM_DT)), round(RATE_HZ / rate_hz), round(EDGE_S * RATE_HZ)
        instants, moments, places, bristle, base = [], [], [], [], 0
        for s in smooth.stretches:
            own = np.arange(s.start, s.stop, every)
            some = np.arange(edge, len(own) - edge, step)
            instants.append(own)
            moments.append(own[some])
            places.append(base + some)
            bristle.append(presliding(dq[s], SIM_DT, presliding_rad)[::every])
            base += len(own)
        own, kept, at = (np.concatenate(parts) for parts in (instants, moments, places))
        if not len(kept):
            raise too_short(recording)
        inside = np.zeros(len(own), dtype=bool)  # false near the ends of a trajectory
        for begin, part in zip(np.cumsum([0, *map(len, instants)]), instants, strict=False):
            inside[begin + edge : max(begin + len(part) - edge, begin)] = True
        q, way = smooth.q[own], np.where(slides[own] & inside[:, None], np.sign(dq[own]), 0.0)
        found = [_windows(q[:, j], way[:, j], at, slid) for j in range(q.shape[1])]
        means, half = tuple(m for m, _ in found), np.stack([w for _, w in found], 1)
        gain = np.array([0.0, *(_noise(w) for w in range(1, round(LONGEST * RATE_HZ) + 1))])
        began, ended = (np.concatenate([np.full(len(p), p[end]) for p in instants]) for end in (0, -1))
        ago = [np.clip(own - k, began, ended) for k in range(-1, round(MAX_LATENCY / SIM_DT))]
        delayed = np.stack([_averaged(means, smooth.tau[rows]) for rows in ago], 1)
        return SlidingMotion(
            smooth.t[kept], q, dq[own], ddq[own], np.concatenate(bristle),
            (means,), half > 0, gain[half], encoder, delayed, smooth.t[own], own == began,
        )  # fmt: skip

    @staticmethod
    def joined(parts: "Sequence[SlidingMotion]") -> "SlidingMotion":
        """Join consecutive parts of a recording, and delete the arrays of the parts to save memory."""
        if len(parts) == 1:
            return parts[0]
        names = [f.name for f in fields(SlidingMotion) if f.name not in ("means", "encoder")]
        arrays = joined_arrays(parts, names)
        means = tuple(own for m in parts for own in m.means)
        return SlidingMotion(means=means, encoder=np.median([m.encoder for m in parts], axis=0), **arrays)

    @property
    def friction_dq(self) -> np.ndarray:
        """(F, n) rad/s, velocity at which friction is evaluated."""
        return self.dq

    @property
    def tau(self) -> np.ndarray:
        """(T, n) Nm, window means of the recorded command without delay."""
        return self.delayed[:, 1]

    def filtered(self, x: np.ndarray | Callable[[slice], np.ndarray]) -> np.ndarray:
        """Return the weighted means (T, n, ...) of x over the windows of each joint.

        x is an array (F, n, ...) or, to save memory, a function that returns the rows of a slice.
        """
        ends = np.cumsum([0, *(means[0].shape[1] for means in self.means)]).tolist()
        parts = [
            _averaged(means, x(slice(*rows)) if callable(x) else x[slice(*rows)])
            for means, rows in zip(self.means, pairwise(ends), strict=True)
        ]
        return parts[0] if len(parts) == 1 else np.concatenate(parts)

    rows = filtered  # unlike in `SmoothMotion`, functions of q, dq, ddq are averaged, too

    def command(self, delay: float, lag: float) -> np.ndarray:
        """Return window means (T, n) Nm of the command after the hold, the `delay` in s and the `lag` in s.

        The result is the mean of the command u(t - delay - hold - x), where `hold` is uniform over a step and x is
        exponential with mean `lag`.
        """
        late = (delay + HOLD_STEPS[:, None] * SIM_DT + lag * LAG_POINTS) / SIM_DT + 1.0
        late = np.clip(late, 1.0, self.delayed.shape[1] - 3)
        at = late.astype(int)
        first = int(at.min()) - 1
        weights = np.zeros(int(at.max()) + 3 - first)
        for k, weight in enumerate(cubic(late - at), start=-1):
            np.add.at(weights, at + k - first, weight * LAG_WEIGHTS / len(HOLD_STEPS))
        return np.einsum("tkn,k->tn", self.delayed[:, first : first + len(weights)], weights)


def _derivative(recording: Recording, order: int, most: int = 5) -> np.ndarray:
    """Return the `order`-th derivative (T, n) of q from polynomials of order <= 4, each fitted to <= `most` rows."""
    out = np.zeros_like(recording.q)
    for s in recording.stretches:
        rows = min(most, s.stop - s.start - (s.stop - s.start + 1) % 2)
        if rows > 2:
            out[s] = savgol_filter(recording.q[s], rows, min(rows - 1, 4), deriv=order, delta=SIM_DT, axis=0)
    return out


def _averaged(means: tuple[csr_array, ...], x: np.ndarray) -> np.ndarray:
    return np.stack([(m @ x[:, j].reshape(len(x), -1)).reshape(-1, *x.shape[2:]) for j, m in enumerate(means)], 1)


def _weights(half: int) -> np.ndarray:
    """Return the weights (2 half + 1,) of a window; the weights and two of their derivatives vanish at its ends."""
    weights = (1.0 - (np.arange(-half, half + 1) / (half + 1)) ** 2) ** 3
    return weights / weights.sum()


def _noise(half: int) -> float:
    """Return the standard deviation of the mean acceleration, 1/s^2, for white angle noise of 1 rad.

    Integration by parts moves the angle's two time derivatives to the weights. Each weight multiplies the mean of 1 /
    (RATE_HZ SIM_DT) angle samples, which has less noise than one sample.
    """
    second = np.diff(np.pad(_weights(half), 2), 2) * RATE_HZ**2
    return float(np.linalg.norm(second) * np.sqrt(SIM_DT * RATE_HZ))


def _windows(q: np.ndarray, way: np.ndarray, at: np.ndarray, slid: float) -> tuple[csr_array, np.ndarray]:
    """Return weights (T, F) and half the widths (T,) of a joint's windows around the instants `at` (T,).

    `way` (F,) is the sliding direction, or 0 if the joint may stick. A width of 0 means that there is no window.
    """
    first, last = np.zeros(len(q), dtype=int), np.full(len(q), -1)
    changes = np.flatnonzero(np.diff(way, prepend=np.nan) != 0)
    for a, b in pairwise([*changes.tolist(), len(q)]):
        if way[a] != 0.0:
            far = np.flatnonzero(np.abs(q[a:b] - q[a]) >= slid)
            first[a:b], last[a:b] = (a + far[0] if len(far) else b), b - 1
    guard, least, most = (round(seconds * RATE_HZ) for seconds in (GUARD, SHORTEST, LONGEST))
    half = np.minimum(np.minimum(at - first[at], last[at] - at) - guard, most)
    half = np.where(half >= least, half, 0)
    windows = {w: _weights(w) for w in range(least, most + 1)}
    some = np.flatnonzero(half)
    values = [windows[half[k]] for k in some]
    columns = [np.arange(at[k] - half[k], at[k] + half[k] + 1, dtype=np.int32) for k in some]
    ends = np.concatenate([[0], np.cumsum(np.where(half > 0, 2 * half + 1, 0))]).astype(np.int32)
    entries = np.concatenate([np.zeros(0), *values]), np.concatenate([np.zeros(0, dtype=np.int32), *columns]), ends
    return csr_array(entries, shape=(len(at), len(q))), half
