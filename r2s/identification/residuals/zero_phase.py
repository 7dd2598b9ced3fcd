"""A recording low-pass filtered without phase lag, for differentiation; friction passes the same filter."""

from dataclasses import dataclass

import numpy as np
from scipy.signal import butter, sosfiltfilt
from scipy.sparse import csr_array

from r2s.errors import UserError
from r2s.physics.friction import PRESLIDING, presliding
from r2s.physics.robot import SIM_DT
from r2s.recordings.recording import Recording

FRICTION_HZ = 500  # rate at which friction is evaluated before filtering
HOLD_STEPS = 0.5  # mean latency of a command that is held for one step
FRICTION_CUTOFF = 4.0  # cutoff of the velocity in the friction law over that of the torque: keeps reversals sharp
EDGE_S = 0.05  # s, dropped at both ends of a trajectory, where the filter has transients


@dataclass(frozen=True)
class SmoothMotion:
    """A recording low-pass filtered at T moments.

    Attributes:
        t: (T,) s. q, dq, ddq, tau: (T, n), low-passed forward and backward.
        friction_dq: (F, n) rad/s at FRICTION_HZ, with the higher cutoff. bristle: (F, n), its presliding state.
        low_pass: (T, F), sparse matrix of `filtered`.
        delayed: (T, L, n) Nm, tau at the moment and each ms before it.
    """

    t: np.ndarray
    q: np.ndarray
    dq: np.ndarray
    ddq: np.ndarray
    tau: np.ndarray
    friction_dq: np.ndarray
    bristle: np.ndarray
    low_pass: csr_array
    delayed: np.ndarray

    @staticmethod
    def of(
        recording: Recording, cutoff_hz: float, rate_hz: float, presliding_rad: np.ndarray | float = PRESLIDING
    ) -> "SmoothMotion":
        """Resample to 1 kHz, low-pass forward and backward, differentiate, and keep `rate_hz` without the edges.

        Raises:
            UserError: no trajectory is long enough.
        """
        grid = recording.resample(SIM_DT)
        smooth, quick = grid.smooth(cutoff_hz), grid.smooth(min(FRICTION_CUTOFF * cutoff_hz, 0.4 / SIM_DT))
        kernel = _impulse_response(cutoff_hz, FRICTION_HZ)
        every, reach = round(1 / (FRICTION_HZ * SIM_DT)), len(kernel) // 2
        dq, fastest = smooth.dq, quick.dq
        if recording.torque == "commanded":  # delay is estimated, and logged velocities lag by a filter or a step
            dq, fastest = smooth.derivative(smooth.q), quick.derivative(quick.q)
        ddq, keep, rows, friction_dq, bristle = smooth.derivative(dq), [], [], [], []
        step, edge, base = round(1 / (rate_hz * SIM_DT)), round(EDGE_S / SIM_DT), 0
        for s in smooth.stretches:
            some = np.arange(s.start + edge, s.stop - edge, step)
            at = np.arange(s.start, s.stop, every)
            near = np.clip((some[:, None] - s.start) // every + np.arange(-reach, reach + 1), 0, len(at) - 1)
            keep.append(some)
            rows.append(base + near)
            friction_dq.append(fastest[at])
            bristle.append(presliding(fastest[s], SIM_DT, presliding_rad)[::every])
            base += len(at)
        kept = np.concatenate(keep)
        if not len(kept):
            raise too_short(recording)
        columns = np.concatenate(rows)
        ends = len(kernel) * np.arange(len(kept) + 1)
        low_pass = csr_array((np.tile(kernel, len(kept)), columns.ravel(), ends), shape=(len(kept), base))
        delayed = np.stack([smooth.tau[np.maximum(kept - k, 0)] for k in range(edge)], 1)
        return SmoothMotion(
            smooth.t[kept], smooth.q[kept], dq[kept], ddq[kept], smooth.tau[kept],
            np.concatenate(friction_dq), np.concatenate(bristle), low_pass, delayed,
        )  # fmt: skip

    def filtered(self, x: np.ndarray) -> np.ndarray:
        """Return (T, n): the low-pass of x (F, n) at the moments."""
        return self.low_pass @ x

    def rows(self, x: np.ndarray) -> np.ndarray:
        """Return (T, n, ...), a function of q, dq, ddq at the moments; its arguments are already filtered."""
        return x

    def command(self, delay: float, lag: float) -> np.ndarray:
        """Return (T, n) Nm: the command at the joints; below the cutoff a lag acts like a delay."""
        at = min(max((delay + lag + HOLD_STEPS * SIM_DT) / SIM_DT, 0.0), self.delayed.shape[1] - 2)
        k = int(at)
        return self.delayed[:, k] + (at - k) * (self.delayed[:, k + 1] - self.delayed[:, k])


def too_short(recording: Recording) -> UserError:
    """Return the error for a recording whose trajectories are shorter than both edges."""
    return UserError(f"no trajectory is longer than {2 * EDGE_S:g} s; the recording lasts {recording.duration:g} s")


def _impulse_response(cutoff_hz: float, rate_hz: float) -> np.ndarray:
    """Return the two-sided kernel of `Recording.smooth` at a rate, truncated and normalized to a sum of 1."""
    reach = int(3.0 * rate_hz / cutoff_hz)  # a shorter kernel biases friction by 0.3 % of its level
    pulse = np.zeros(8 * reach + 1)
    pulse[4 * reach] = 1.0
    kernel = sosfiltfilt(butter(4, cutoff_hz, fs=rate_hz, output="sos"), pulse)[3 * reach : 5 * reach + 1]
    return kernel / kernel.sum()
