"""A recording made smooth enough to differentiate, and friction filtered as its torque was."""

from dataclasses import dataclass

import numpy as np
from scipy.signal import butter, sosfiltfilt
from scipy.sparse import csr_array

from r2s.errors import UserError
from r2s.physics.friction import PRESLIDING, presliding
from r2s.physics.robot import SIM_DT
from r2s.recordings.recording import Recording

FRICTION_HZ = 500  # friction is evaluated this often, then filtered as the torque is
HELD = 0.5  # steps: a command that is held for a step is that late on average
FRICTION_CUTOFF = 4.0  # of the velocity that friction is evaluated at, over that of the torque


@dataclass(frozen=True)
class SmoothMotion:
    """A recording made smooth enough to differentiate, on T moments.

    Attributes:
        t: (T,) s. q, dq, ddq, tau: (T, n), low-passed both ways.
        fast: (F, n) rad/s at FRICTION_HZ, less smoothed. bristle: (F, n), its presliding sign.
        low_pass: (T, F), sparse: what `filtered` multiplies with.
        late: (T, L, n) Nm, tau at the moment and each ms before it.
    """

    t: np.ndarray
    q: np.ndarray
    dq: np.ndarray
    ddq: np.ndarray
    tau: np.ndarray
    fast: np.ndarray
    bristle: np.ndarray
    low_pass: csr_array
    late: np.ndarray

    @staticmethod
    def of(
        recording: Recording, cutoff_hz: float, rate_hz: float, presliding_rad: np.ndarray | float = PRESLIDING
    ) -> "SmoothMotion":
        """Resample on logged time, low-pass both ways, differentiate, keep `rate_hz`; edges are dropped.

        Raises:
            UserError: nothing is left.
        """
        grid = recording.resample(SIM_DT)
        smooth, quick = grid.smooth(cutoff_hz), grid.smooth(min(FRICTION_CUTOFF * cutoff_hz, 0.4 / SIM_DT))
        kernel = _impulse_response(cutoff_hz, FRICTION_HZ)
        every, reach = round(1 / (FRICTION_HZ * SIM_DT)), len(kernel) // 2
        dq, fastest = smooth.dq, quick.dq
        if recording.torque == "commanded":  # timing counts, and logged velocities are late, by a filter or a step
            dq, fastest = smooth.derivative(smooth.q), quick.derivative(quick.q)
        ddq, keep, rows, fast, bristle = smooth.derivative(dq), [], [], [], []
        step, edge, base = round(1 / (rate_hz * SIM_DT)), round(0.05 / SIM_DT), 0
        for s in smooth.stretches:
            some = np.arange(s.start + edge, s.stop - edge, step)
            at = np.arange(s.start, s.stop, every)
            near = np.clip((some[:, None] - s.start) // every + np.arange(-reach, reach + 1), 0, len(at) - 1)
            keep.append(some)
            rows.append(base + near)
            fast.append(fastest[at])
            bristle.append(presliding(fastest[s], SIM_DT, presliding_rad)[::every])
            base += len(at)
        kept = np.concatenate(keep)
        if not len(kept):
            raise UserError(f"no trajectory is longer than 0.1 s; the recording lasts {recording.duration:g} s")
        columns = np.concatenate(rows)
        ends = len(kernel) * np.arange(len(kept) + 1)
        low_pass = csr_array((np.tile(kernel, len(kept)), columns.ravel(), ends), shape=(len(kept), base))
        late = np.stack([smooth.tau[np.maximum(kept - k, 0)] for k in range(edge)], 1)
        return SmoothMotion(
            smooth.t[kept], smooth.q[kept], dq[kept], ddq[kept], smooth.tau[kept],
            np.concatenate(fast), np.concatenate(bristle), low_pass, late,
        )  # fmt: skip

    def filtered(self, x: np.ndarray) -> np.ndarray:
        """Return (T, n): the low-pass of x (F, n) at the moments."""
        return self.low_pass @ x

    def rows(self, x: np.ndarray) -> np.ndarray:
        """Return (T, n, ...), what is evaluated at q, dq, ddq: those are low-passed."""
        return x

    def felt(self, delay: float, lag: float) -> np.ndarray:
        """Return (T, n) Nm: the command as it is felt, held for a step and then late; so slow, a lag is a delay."""
        return self.tau_at(delay + lag + HELD * SIM_DT)

    def tau_at(self, delay: float) -> np.ndarray:
        """Return (T, n) Nm: the torque `delay` s before each moment."""
        at = min(max(delay / SIM_DT, 0.0), self.late.shape[1] - 2)
        k = int(at)
        return self.late[:, k] + (at - k) * (self.late[:, k + 1] - self.late[:, k])


def _impulse_response(cutoff_hz: float, rate_hz: float) -> np.ndarray:
    """Return the two-sided kernel of `Recording.smooth` at a rate, cut where it has faded; its sum is 1."""
    reach = int(3.0 * rate_hz / cutoff_hz)  # what a shorter one leaves out biases friction by 0.3 % of its level
    pulse = np.zeros(8 * reach + 1)
    pulse[4 * reach] = 1.0
    kernel = sosfiltfilt(butter(4, cutoff_hz, fs=rate_hz, output="sos"), pulse)[3 * reach : 5 * reach + 1]
    return kernel / kernel.sum()
