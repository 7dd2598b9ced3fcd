"""Low-pass a recording without phase shift before differentiation, and pass friction through the same filter."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.signal import butter, sosfiltfilt

from r2s.errors import UserError
from r2s.physics.friction import PRESLIDING, presliding
from r2s.physics.robot import SIM_DT
from r2s.recordings.lateness import Lateness
from r2s.recordings.parts import joined_arrays
from r2s.recordings.recording import Recording

FRICTION_HZ = 500  # rate at which friction is evaluated before filtering
HOLD_STEPS = 0.5  # in steps, mean latency of a command that is constant over a step
FRICTION_CUTOFF = 4.0  # cutoff of friction's velocity / cutoff of torque; large, so that reversals stay sharp
SHIFT = 0.05  # step between stored time shifts, in cutoff periods; cubic interpolation then errs by 2e-4
SHIFTS = -0.03, 0.05  # s, range of the stored time shifts of torque
MOST_SHIFT = 20  # ms, largest step between shifts; interpolation needs four shifts within SHIFTS
AT_ONCE = 1024  # number of rows filtered at once, to limit memory
EDGE_S = 0.05  # s, length removed from both ends of a trajectory, where the filter has transients


@dataclass(frozen=True)
class SmoothMotion:
    """A low-pass filtered recording, sampled at T times.

    Attributes:
        t: (T,) s, sample times. q, dq, ddq, tau: (T, n), filtered forward and backward.
        friction_dq: (F, n) rad/s, velocity at FRICTION_HZ, with a higher cutoff than dq. bristle: (F, n), presliding
            state. friction_dq and bristle are padded with half a kernel of constant rows at both ends of a
            trajectory.
        kernel: (K,), weights of the low-pass. spans: for each sample, the first row of friction_dq under the kernel.
        delayed: (T, L, n) Nm, tau at L time shifts in the range SHIFTS, `shift_s` s apart.
    """

    t: np.ndarray
    q: np.ndarray
    dq: np.ndarray
    ddq: np.ndarray
    tau: np.ndarray
    friction_dq: np.ndarray
    bristle: np.ndarray
    kernel: np.ndarray
    spans: tuple[range, ...]
    delayed: np.ndarray
    shift_s: float

    @staticmethod
    def of(
        recording: Recording,
        cutoff_hz: float,
        rate_hz: float,
        presliding_rad: np.ndarray | float = PRESLIDING,
        late: Lateness | None = None,
    ) -> "SmoothMotion":
        """Resample to 1 kHz, filter forward and backward, differentiate, remove EDGE_S at ends, sample at `rate_hz`.

        rate_hz: rows per second, at most FRICTION_HZ. late: lateness of dq, which this function corrects; None means
        no correction.

        Raises:
            UserError: no trajectory is longer than 2 EDGE_S.
        """
        grid = recording.resample(SIM_DT)
        smooth, quick = grid.smooth(cutoff_hz), grid.smooth(min(FRICTION_CUTOFF * cutoff_hz, 0.4 / SIM_DT))
        kernel = _impulse_response(cutoff_hz, FRICTION_HZ)
        every, reach = round(1 / (FRICTION_HZ * SIM_DT)), len(kernel) // 2
        dq, fastest = (x.dq if late is None else late.corrected(x) for x in (smooth, quick))
        ddq, keep = smooth.derivative(dq), []
        spans: list[range] = []
        friction_dq: list[np.ndarray] = []
        bristle: list[np.ndarray] = []
        step, edge, base = every * round(1 / (rate_hz * SIM_DT) / every), round(EDGE_S / SIM_DT), 0
        for s in smooth.stretches:
            some = np.arange(s.start + edge, s.stop - edge, step)
            if not len(some):
                continue
            keep.append(some)
            for out, x in (friction_dq, fastest[s]), (bristle, presliding(fastest[s], SIM_DT, presliding_rad)):
                out.append(np.pad(x[::every], ((reach, reach), (0, 0)), mode="edge"))
            first = base + edge // every
            own = range(first, first + len(some) * (step // every), step // every)
            spans += [own[k : k + AT_ONCE] for k in range(0, len(own), AT_ONCE)]
            base += len(friction_dq[-1])
        if not keep:
            raise too_short(recording)
        kept = np.concatenate(keep)
        shift = min(max(1, round(SHIFT / cutoff_hz / SIM_DT)), MOST_SHIFT)
        first, last = (round(s / SIM_DT) for s in SHIFTS)
        delayed = np.stack([smooth.tau[kept - k] for k in range(first, last, shift)], 1)
        return SmoothMotion(
            smooth.t[kept], smooth.q[kept], dq[kept], ddq[kept], smooth.tau[kept],
            np.concatenate(friction_dq), np.concatenate(bristle), kernel, tuple(spans), delayed, shift * SIM_DT,
        )  # fmt: skip

    @staticmethod
    def joined(parts: "Sequence[SmoothMotion]") -> "SmoothMotion":
        """Join consecutive parts of a recording, and delete the arrays of the parts to save memory."""
        if len(parts) == 1:
            return parts[0]
        names = ("t", "q", "dq", "ddq", "tau", "friction_dq", "bristle", "delayed")
        base = np.cumsum([0, *(len(m.friction_dq) for m in parts)]).tolist()
        arrays = joined_arrays(parts, names)
        spans = [range(b + s.start, b + s.stop, s.step) for b, m in zip(base, parts, strict=False) for s in m.spans]
        return SmoothMotion(kernel=parts[0].kernel, spans=tuple(spans), shift_s=parts[0].shift_s, **arrays)

    def filtered(self, x: "np.ndarray | Callable[[slice], np.ndarray]") -> np.ndarray:
        """Low-pass x (F, n), and return its values (T, n) at the sample times.

        To save memory and time, x can also be a function that returns the rows of a slice.
        """
        parts = []
        for s in self.spans:
            rows = slice(s[0], s[-1] + len(self.kernel))
            own = x(rows) if callable(x) else x[rows]
            parts.append(sliding_window_view(own, len(self.kernel), axis=0)[:: s.step] @ self.kernel)
        return parts[0] if len(parts) == 1 else np.concatenate(parts)

    def rows(self, x: np.ndarray) -> np.ndarray:
        """Return x (T, n, ...) unchanged: x is computed from q, dq and ddq, which are already filtered."""
        return x

    def command(self, delay: float, lag: float) -> np.ndarray:
        """Return the command (T, n) Nm after hold, `delay` (s) and `lag` (s); a short lag acts like a delay."""
        return self.earlier(delay + lag + HOLD_STEPS * SIM_DT)

    def earlier(self, seconds: float) -> np.ndarray:
        """Return the torque (T, n) Nm at `seconds` before each sample time; `seconds` can be negative."""
        at = (seconds - SHIFTS[0]) / self.shift_s
        k = int(np.clip(at, 1, self.delayed.shape[1] - 3))
        weights = cubic(min(max(at - k, -1.0), 2.0))
        return np.einsum("tkn,k->tn", self.delayed[:, k - 1 : k + 3], weights)


def too_short(recording: Recording) -> UserError:
    """Return the error for a recording that has no rows left after both ends of every trajectory are removed."""
    return UserError(f"no trajectory is longer than {2 * EDGE_S:g} s; the recording lasts {recording.duration:g} s")


def cubic(x: float | np.ndarray) -> np.ndarray:
    """Return the weights (4, ...) of samples at -1, 0, 1 and 2 for cubic Lagrange interpolation at x in [0, 1]."""
    return np.stack([
        -x * (x - 1) * (x - 2) / 6,
        (x + 1) * (x - 1) * (x - 2) / 2,
        -(x + 1) * x * (x - 2) / 2,
        (x + 1) * x * (x - 1) / 6,
    ])  # fmt: skip


def _impulse_response(cutoff_hz: float, rate_hz: float) -> np.ndarray:
    """Return the two-sided impulse response of `Recording.smooth` at `rate_hz`, truncated and scaled to sum 1."""
    reach = int(3.0 * rate_hz / cutoff_hz)  # a shorter kernel biases friction by 0.3 % of its level
    pulse = np.zeros(8 * reach + 1)
    pulse[4 * reach] = 1.0
    kernel = sosfiltfilt(butter(4, cutoff_hz, fs=rate_hz, output="sos"), pulse)[3 * reach : 5 * reach + 1]
    return kernel / kernel.sum()
