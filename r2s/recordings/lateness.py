"""Estimate and correct lateness: the delay of logged dq relative to logged q in a recording."""

from dataclasses import dataclass, replace

import numpy as np

from r2s.physics.robot import SIM_DT
from r2s.recordings.parts import spread
from r2s.recordings.recording import Recording

COMPARED_S = 60.0  # s, total length of the parts of a recording in which dq is compared with q
EDGE = 100  # ms that are ignored at both ends of a trajectory, where the filter has transients
BLOCK = 500  # ms, length of blocks whose errors are treated as independent
LATE_S, SURE = 5e-4, 3.0  # s (half a step), standard deviations; a lateness below either limit stays uncorrected
OFF = 0.05  # share of the RMS speed; if the error of corrected dq is larger, dq is not the derivative of q


@dataclass(frozen=True)
class Lateness:
    """Delay of the logged dq relative to the derivative of q.

    Attributes:
        s: (n,) s, lateness; nan if dq is not the derivative of q or the joint does not move. sigma: (n,) s, standard
            deviation of `s`. filtered: if True, `s` is the time constant of a first-order filter, otherwise a delay.
    """

    s: np.ndarray
    sigma: np.ndarray
    filtered: bool = False

    @property
    def sure(self) -> np.ndarray:
        """Lateness (n,) s to correct: 0 if `s` is too small or too uncertain, nan if `s` is nan, otherwise `s`."""
        seen = (np.abs(self.s) > LATE_S) & (np.abs(self.s) > SURE * self.sigma)
        return np.where(np.isnan(self.s), np.nan, np.where(seen, self.s, 0.0))

    @property
    def as_logged(self) -> "Lateness":
        """Copy of this lateness with 0 for finite values of `s`, so that dq is not corrected; nan stays nan."""
        return replace(self, s=0.0 * self.s)

    def corrected(self, smooth: Recording) -> np.ndarray:
        """Return the corrected dq (T, n) rad/s; for a joint with a lateness of nan, return the derivative of q."""
        return _corrected(smooth, self.sure, self.filtered)


def from_q(joints: int) -> Lateness:
    """Return a lateness of nan for all joints, so that the derivative of q replaces the logged dq."""
    return Lateness(np.full(joints, np.nan), np.zeros(joints))


def lateness(recording: Recording, cutoff_hz: float) -> Lateness:
    """Estimate the lateness of dq by least squares on motion below `cutoff_hz`, where a lag acts like a delay.

    Correcting dq is better than differentiating q, because the logged dq is often smoother. The correction inverts a
    first-order filter or a delay, whichever model fits the data better.
    """
    smooth = spread(recording, COMPARED_S).resample(SIM_DT).smooth(cutoff_hz)
    slope, ddq, n = smooth.derivative(smooth.q), smooth.derivative(smooth.dq), recording.n_joints
    block, rows = np.full(len(smooth.t), -1), 0
    for s in smooth.stretches:
        inside = np.arange(s.start + EDGE, s.stop - EDGE)
        block[inside] = rows + np.arange(len(inside)) // BLOCK
        rows += -(-len(inside) // BLOCK)
    inside = block >= 0
    if not rows:
        return Lateness(np.zeros(n), np.zeros(n))

    def sums(x: np.ndarray) -> np.ndarray:
        return np.stack([np.bincount(block[inside], column) for column in x[inside].T], 1)

    square = np.maximum(sums(ddq**2).sum(0), 1e-12)
    late = sums((slope - smooth.dq) * ddq).sum(0) / square
    left = slope - smooth.dq - late * ddq
    sigma = np.sqrt((sums(left * ddq) ** 2).sum(0)) / square
    off = (left[inside] ** 2).sum(0) > OFF**2 * (slope[inside] ** 2).sum(0)
    late = np.where(off, np.nan, late)
    filtered, delayed = (((slope - _corrected(smooth, late, x))[inside] ** 2).sum() for x in (True, False))
    return Lateness(late, sigma, bool(filtered < delayed))


def _corrected(smooth: Recording, late: np.ndarray, filtered: bool) -> np.ndarray:
    """Return dq (T, n) rad/s with the lateness `late` (n,) s removed, or the derivative of q where `late` is nan."""
    if filtered:
        out = smooth.dq + np.nan_to_num(late) * smooth.derivative(smooth.dq)
    else:
        out = smooth.dq.copy()
        for s in smooth.stretches:
            for j in np.flatnonzero(np.nan_to_num(late)):
                out[s, j] = np.interp(smooth.t[s] + late[j], smooth.t[s], smooth.dq[s, j])
    return np.where(np.isnan(late), smooth.derivative(smooth.q), out) if np.isnan(late).any() else out
