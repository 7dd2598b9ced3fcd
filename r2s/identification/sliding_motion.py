"""A recording in rows that feel one slide of a joint each, as short as it may be.

What friction is of a joint that stands, or turns, its velocity does not tell, and a low-pass spreads such moments
over a tenth of a second. So each row of a joint is a weighted mean over a window of its own, which ends before the
joint stops or turns (modulating functions: Shinbrot, Trans. ASME 79, 1957): the same mean of the rigid bodies'
torque, of friction and of the command. Between two turns rows get shorter, and noisier: how much, the encoder's noise
says.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.signal import savgol_filter
from scipy.sparse import csr_array

from r2s.errors import UserError
from r2s.physics.friction import PRESLIDING, presliding
from r2s.physics.robot import SIM_DT
from r2s.recordings.recording import Recording

RATE_HZ = 250  # torques are evaluated this often, then averaged
CUTOFF_HZ = 40.0  # of the angles before they are differentiated; a law that bends turns noise of velocity into a bias
NORMAL = 0.6745  # median of the magnitude of a normal variable, in standard deviations
SHORTEST, LONGEST = 0.024, 0.1  # s, half a window
GUARD = 8e-3  # s, within which the low-pass feels a stop
EDGE = 0.05  # s, within which it feels the end of a trajectory
STEADY = 0.2  # share of its speed that a joint with a memory may win or lose over PRESLIDING
CALM = 101  # rows, of the polynomials that tell so; over five of them noise looks like it
LATEST = 0.04  # s, of a command before it is felt
HELD = (np.arange(8) + 0.5) / 8  # steps, for which a command is held
LAGGED, SHARE = np.polynomial.laguerre.laggauss(16)  # quadrature over exp(-x)


@dataclass(frozen=True)
class SlidingMotion:
    """A recording on F instants, and T moments with windows about them.

    Attributes:
        t: (T,) s. q, dq, ddq: (F, n) rad, rad/s, rad/s^2. bristle: (F, n), the presliding sign of dq.
        means: n matrices (T, F), sparse: the weights of a joint's windows; rows of those not `seen` are empty.
        seen: (T, n) bool, moments with a window in which the joint slides in one direction.
        noise: (T, n), by which a window multiplies the standard deviation of angles, rad, to that of accelerations.
        encoder: (n,) rad, standard deviation of the angles' noise.
        late: (T, L, n) Nm, the mean of the command of 1 ms later, of the moment, and of each ms before.
    """

    t: np.ndarray
    q: np.ndarray
    dq: np.ndarray
    ddq: np.ndarray
    bristle: np.ndarray
    means: tuple[csr_array, ...]
    seen: np.ndarray
    noise: np.ndarray
    encoder: np.ndarray
    late: np.ndarray

    @staticmethod
    def of(
        recording: Recording,
        rate_hz: float,
        slowest: float,
        slid: float = 0.0,
        presliding_rad: np.ndarray | float = PRESLIDING,
    ) -> "SlidingMotion":
        """Find the windows about moments at `rate_hz`, in which a joint is faster than `slowest` rad/s.

        With `slid`, rad, a window starts when the joint has slid that far since it turned: bristles bend first, over
        `presliding_rad`, one distance or (n,). Then rows are only where speed hardly changes over PRESLIDING, too:
        as far as that bristles remember the friction of the speed before.

        Raises:
            UserError: nothing is left.
        """
        grid = recording.resample(SIM_DT)
        smooth = grid.smooth(CUTOFF_HZ)
        # at such rates central differences lose half a percent of an acceleration
        dq, ddq = (_derivative(smooth, order) for order in (1, 2))
        left = 1.0 - 2.0 * CUTOFF_HZ * SIM_DT  # of white noise is above the cutoff
        encoder = np.median(np.abs(grid.q - smooth.q), axis=0) / NORMAL / np.sqrt(left)
        every, step = round(1 / (RATE_HZ * SIM_DT)), round(RATE_HZ / rate_hz)
        instants, moments, places, bristle, base = [], [], [], [], 0
        slides = np.abs(dq) >= slowest
        if slid:
            change = np.abs(_derivative(smooth, 2, CALM)) * PRESLIDING
            slides &= change <= STEADY * dq**2
        for s in smooth.stretches:
            own = np.arange(s.start, s.stop, every)
            edge = round(EDGE * RATE_HZ)
            some = np.arange(edge, len(own) - edge, step)
            instants.append(own)
            moments.append(own[some])
            places.append(base + some)
            bristle.append(presliding(dq[s], SIM_DT, presliding_rad)[::every])
            base += len(own)
        own, kept, at = (np.concatenate(parts) for parts in (instants, moments, places))
        if not len(kept):
            raise UserError(f"no trajectory is longer than 0.1 s; the recording lasts {recording.duration:g} s")
        inside = np.zeros(len(own), dtype=bool)
        for begin, part in zip(np.cumsum([0, *map(len, instants)]), instants, strict=False):
            inside[begin + edge : begin + len(part) - edge] = True
        q, way = smooth.q[own], np.where(slides[own] & inside[:, None], np.sign(dq[own]), 0.0)
        found = [_windows(q[:, j], way[:, j], at, slid) for j in range(q.shape[1])]
        means, half = tuple(m for m, _ in found), np.stack([w for _, w in found], 1)
        gain = np.array([0.0, *(_noise(w) for w in range(1, round(LONGEST * RATE_HZ) + 1))])
        began, ended = (np.concatenate([np.full(len(p), p[end]) for p in instants]) for end in (0, -1))
        ago = [np.clip(own - k, began, ended) for k in range(-1, round(LATEST / SIM_DT))]
        late = np.stack([_averaged(means, smooth.tau[rows]) for rows in ago], 1)
        return SlidingMotion(
            smooth.t[kept], q, dq[own], ddq[own], np.concatenate(bristle), means, half > 0, gain[half], encoder, late
        )

    @property
    def fast(self) -> np.ndarray:
        """(F, n) rad/s, what friction is evaluated at."""
        return self.dq

    @property
    def tau(self) -> np.ndarray:
        """(T, n) Nm, the mean of the command."""
        return self.late[:, 1]

    def filtered(self, x: np.ndarray) -> np.ndarray:
        """Return (T, n, ...): the means of x (F, n, ...) over the windows of each joint."""
        return _averaged(self.means, x)

    rows = filtered  # of what is evaluated at q, dq, ddq

    def felt(self, delay: float, lag: float) -> np.ndarray:
        """Return (T, n) Nm: the mean of the command as it is felt, held for a step, `delay` s later, behind a lag.

        That is u(t - delay - held - lagged), its mean over held, uniform in a step, and lagged, exponential.
        """
        late = (delay + HELD[:, None] * SIM_DT + lag * LAGGED) / SIM_DT + 1.0
        late = np.clip(late, 1.0, self.late.shape[1] - 3)
        at = late.astype(int)
        weights = np.zeros(self.late.shape[1])
        for k, weight in enumerate(_cubic(late - at), start=-1):
            np.add.at(weights, at + k, weight * SHARE / len(HELD))
        return np.einsum("tkn,k->tn", self.late, weights)


def _cubic(x: np.ndarray) -> list[np.ndarray]:
    """Return the weights of samples at -1, 0, 1 and 2 of what passes through them at x in [0, 1] (Lagrange)."""
    return [
        -x * (x - 1) * (x - 2) / 6,
        (x + 1) * (x - 1) * (x - 2) / 2,
        -(x + 1) * x * (x - 2) / 2,
        (x + 1) * x * (x - 1) / 6,
    ]


def _derivative(recording: Recording, order: int, most: int = 5) -> np.ndarray:
    """Return (T, n), a derivative of the angles, by polynomials of fourth order at most through `most` rows."""
    out = np.zeros_like(recording.q)
    for s in recording.stretches:
        rows = min(most, s.stop - s.start - (s.stop - s.start + 1) % 2)
        if rows > 2:
            out[s] = savgol_filter(recording.q[s], rows, min(rows - 1, 4), deriv=order, delta=SIM_DT, axis=0)
    return out


def _averaged(means: tuple[csr_array, ...], x: np.ndarray) -> np.ndarray:
    return np.stack([(m @ x[:, j].reshape(len(x), -1)).reshape(-1, *x.shape[2:]) for j, m in enumerate(means)], 1)


def _weights(half: int) -> np.ndarray:
    """Return the weights (2 half + 1,) of a window; they and two derivatives fade towards its ends."""
    weights = (1.0 - (np.arange(-half, half + 1) / (half + 1)) ** 2) ** 3
    return weights / weights.sum()


def _noise(half: int) -> float:
    """Return the standard deviation of mean acceleration over a window, of angles with white noise of 1 rad.

    By parts it is the noise times the window's second derivative, over the rows of SIM_DT that an instant stands for.
    """
    second = np.diff(np.pad(_weights(half), 2), 2) * RATE_HZ**2
    return float(np.linalg.norm(second) * np.sqrt(SIM_DT * RATE_HZ))


def _windows(q: np.ndarray, slides: np.ndarray, at: np.ndarray, slid: float) -> tuple[csr_array, np.ndarray]:
    """Return the weights (T, F) of one joint's windows about the instants `at` (T,), and half their widths (T,).

    slides (F,) is the direction it slides in, 0 where it may stand; 0 wide is a moment without a window.
    """
    first, last = np.zeros(len(q), dtype=int), np.full(len(q), -1)
    turns = np.flatnonzero(np.diff(slides, prepend=np.nan) != 0)
    for a, b in pairwise([*turns.tolist(), len(q)]):
        if slides[a] != 0.0:
            far = np.flatnonzero(np.abs(q[a:b] - q[a]) >= slid)
            first[a:b], last[a:b] = (a + far[0] if len(far) else b), b - 1
    guard, least, most = (round(seconds * RATE_HZ) for seconds in (GUARD, SHORTEST, LONGEST))
    half = np.minimum(np.minimum(at - first[at], last[at] - at) - guard, most)
    half = np.where(half >= least, half, 0)
    windows = {w: _weights(w) for w in range(least, most + 1)}
    some = np.flatnonzero(half)
    values = [windows[half[k]] for k in some]
    columns = [np.arange(at[k] - half[k], at[k] + half[k] + 1) for k in some]
    ends = np.concatenate([[0], np.cumsum(np.where(half > 0, 2 * half + 1, 0))])
    entries = np.concatenate([np.zeros(0), *values]), np.concatenate([np.zeros(0, dtype=int), *columns]), ends
    return csr_array(entries, shape=(len(at), len(q))), half
