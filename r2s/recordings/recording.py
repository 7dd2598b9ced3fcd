"""One recording of an arm: what its joints did, under which torque, on the clock of the log."""

import os
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from scipy.signal import butter, sosfiltfilt

from r2s.errors import UserError, choices, nearest
from r2s.files import whole
from r2s.recordings.repeats import TOLERANCE, comes_again, share_known, tracks_of

TORQUES = ("measured", "commanded", "motor")
MIN_ROWS = 10
SPLIT_GUARD_S = 0.1  # rows this close to the held-out ones are nearly the same rows: neither side gets them


@dataclass(frozen=True, eq=False)
class Recording:
    """Joint motion and torque of n joints in T rows; checked on construction, its arrays are read-only.

    Every operation returns a new recording. Nothing (difference, filter, window) bridges two trajectories.
    """

    t: np.ndarray
    """(T,) s, as logged: increasing within a trajectory, steps may differ, may restart in the next one."""
    q: np.ndarray
    """(T, n) rad."""
    dq: np.ndarray
    """(T, n) rad/s."""
    tau: np.ndarray
    """(T, n) Nm; `torque` says which."""
    torque: str
    """'measured': link-side sensor, contains gravity. 'commanded': the command, without gravity. 'motor': of the
    motors, as their joints would feel it through an ideal gear; contains gravity, all friction and rotor inertia."""
    trajectory: np.ndarray = None  # type: ignore[assignment]
    """(T,) index of the continuous stretch a row belongs to; None means that all rows are one stretch."""
    period: float | None = None
    """s; the excitation repeats itself in `t` after this long (`split` needs to know); None: it does not."""
    name: str = ""

    def __post_init__(self):
        for field in ("t", "q", "dq", "tau"):
            object.__setattr__(self, field, _floats(field, getattr(self, field)))
        trajectory = np.zeros(len(self.t)) if self.trajectory is None else self.trajectory
        object.__setattr__(self, "trajectory", _floats("trajectory", trajectory))
        object.__setattr__(self, "torque", declared_torque(self.torque))
        if self.period is not None:
            object.__setattr__(self, "period", _positive("period", self.period, "s"))
        self._check_shapes()
        for field in ("t", "q", "dq", "tau", "trajectory"):
            _check_finite(field, getattr(self, field))
        self._check_trajectories()
        for field in ("t", "q", "dq", "tau", "trajectory"):
            getattr(self, field).flags.writeable = False

    def _check_shapes(self):
        t, q = self.t, self.q
        if t.ndim != 1 or q.ndim != 2 or q.shape[1] == 0:
            raise UserError(f"t must be (T,) and q (T, n); they are {t.shape} and {q.shape}")
        for field, expected in (("q", (len(t), q.shape[1])), ("dq", q.shape), ("tau", q.shape)):
            seen = getattr(self, field).shape
            if seen != expected:
                other = "t" if field == "q" else "q"
                raise UserError(f"{field} is {seen} but {other} is {getattr(self, other).shape}")
        if self.trajectory.shape != t.shape:
            raise UserError(f"trajectory is {self.trajectory.shape} but t is {t.shape}")
        if len(t) < MIN_ROWS:
            raise UserError(f"a recording of {len(t)} rows is too short; at least {MIN_ROWS} are needed")

    def _check_trajectories(self):
        index = self.trajectory.astype(np.int64)
        if not np.array_equal(index, self.trajectory):
            row = int(np.flatnonzero(index != self.trajectory)[0])
            raise UserError(f"trajectory must hold whole numbers; it is {self.trajectory[row]:g} at row {row}")
        object.__setattr__(self, "trajectory", index)
        seen = set()
        for stretch in self.stretches:
            label = int(index[stretch.start])
            if label in seen:
                raise UserError(
                    f"trajectory {label} starts again at row {stretch.start} after another one; "
                    "give every continuous stretch an index of its own"
                )
            seen.add(label)
            back = np.flatnonzero(np.diff(self.t[stretch]) <= 0)
            if len(back):
                row = stretch.start + int(back[0]) + 1
                raise UserError(
                    f"time does not increase at row {row}: t is {self.t[row - 1]!s}, then {self.t[row]!s} s "
                    f"({len(back)} such rows in trajectory {label}; a restarted clock needs a new one)"
                )

    @property
    def n_joints(self) -> int:
        """Number of joints n."""
        return self.q.shape[1]

    @property
    def stretches(self) -> list[slice]:
        """The rows of each trajectory, in the order of the log."""
        edges = [0, *(np.flatnonzero(np.diff(self.trajectory)) + 1).tolist(), len(self.t)]
        return [slice(start, stop) for start, stop in pairwise(edges)]

    @property
    def duration(self) -> float:
        """Seconds recorded, summed over trajectories: time between them does not count."""
        return float(sum(self.t[s][-1] - self.t[s][0] for s in self.stretches))

    @property
    def rate_hz(self) -> float:
        """One over the median logged step within a trajectory."""
        steps = self._steps()
        if not len(steps):
            raise UserError("every trajectory is a single row: there is no rate")
        return float(1 / np.median(steps))

    def _steps(self) -> np.ndarray:
        return np.diff(self.t)[np.diff(self.trajectory) == 0]

    def select(self, mask: np.ndarray) -> "Recording":
        """Keep the rows where `mask` (T,) is true; each unbroken run of them becomes its own trajectory."""
        mask = np.asarray(mask)
        if mask.dtype != bool or mask.shape != self.t.shape:
            raise UserError(f"a mask must be {self.t.shape} bool; it is {mask.shape} {mask.dtype}")
        rows = np.flatnonzero(mask)
        cut = (np.diff(rows) != 1) | (np.diff(self.trajectory[rows]) != 0)
        return self._rows(rows, np.concatenate([[0], np.cumsum(cut)])[: len(rows)])

    def split_at_gaps(self, max_gap_s: float) -> "Recording":
        """Start a new trajectory wherever the log paused longer than `max_gap_s`.

        A row with a gap on both sides is dropped: there is no motion in a single row.
        """
        _positive("max_gap_s", max_gap_s, "s")
        steps = self._steps()
        if len(steps) and np.median(steps) > max_gap_s:
            raise UserError(
                f"most steps in time are longer than max_gap_s={max_gap_s:g} (median {np.median(steps):g}): "
                "t must be in seconds (units are not guessed); if it is, raise max_gap_s"
            )
        if not np.any(steps > max_gap_s):
            return self
        cut = (np.diff(self.t) > max_gap_s) | (np.diff(self.trajectory) != 0)
        trajectory = np.concatenate([[0], np.cumsum(cut)])
        return self._rows(np.arange(len(self.t)), trajectory, drop_lone=True)

    def resample(self, dt: float) -> "Recording":
        """Interpolate each trajectory linearly onto a uniform grid of `dt` s from its own first logged time.

        `t` stays the clock of the log. This does not filter: to go well below the logged rate, resample at
        that rate, `smooth`, then resample again. A trajectory shorter than `dt` is dropped.
        """
        _positive("dt", dt, "s")
        columns: dict[str, list[np.ndarray]] = {f: [] for f in ("t", "q", "dq", "tau", "trajectory")}
        for s in self.stretches:
            t = self.t[s]
            grid = t[0] + dt * np.arange(int((t[-1] - t[0]) / dt + 1e-6) + 1)
            if len(grid) < 2:
                continue
            columns["t"].append(grid)
            columns["trajectory"].append(np.full(len(grid), self.trajectory[s.start]))
            for field in ("q", "dq", "tau"):
                x = getattr(self, field)[s]
                columns[field].append(np.stack([np.interp(grid, t, column) for column in x.T], axis=1))
        if not columns["t"]:
            raise UserError(f"no trajectory is as long as dt={dt:g} s; the recording lasts {self.duration:g} s")
        return replace(self, **{field: np.concatenate(parts) for field, parts in columns.items()})  # type: ignore[arg-type]

    def smooth(self, cutoff_hz: float) -> "Recording":
        """Low-pass q, dq and tau, each trajectory by itself: Butterworth of order 4, both ways (zero phase).

        Needs a uniform grid (`resample` first). Both ways double the attenuation: -6 dB at the cutoff.
        """
        _positive("cutoff_hz", cutoff_hz, "Hz")
        steps, rate = self._steps(), self.rate_hz
        if not np.allclose(steps, 1 / rate, rtol=1e-3, atol=0):
            raise UserError(
                f"smooth needs a uniform grid in time, not {steps.min():g}-{steps.max():g} s: resample first"
            )
        if cutoff_hz >= rate / 2:
            raise UserError(f"cutoff_hz={cutoff_hz:g} must be below half the rate, {rate / 2:g} Hz")
        sos = butter(4, cutoff_hz, fs=rate, output="sos")
        filtered = {field: np.empty_like(self.q) for field in ("q", "dq", "tau")}
        for s in self.stretches:
            pad = min(s.stop - s.start - 1, int(3 * rate / cutoff_hz))  # the transient fades within it
            for field, out in filtered.items():
                out[s] = sosfiltfilt(sos, getattr(self, field)[s], axis=0, padlen=pad)
        return replace(self, **filtered)  # type: ignore[arg-type]

    def derivative(self, x: np.ndarray) -> np.ndarray:
        """Differentiate `x` (T, n) by logged time, each trajectory by itself; central, so without delay."""
        out = np.empty_like(x)
        for s in self.stretches:
            if s.stop - s.start < 2:
                raise UserError(
                    f"trajectory {self.trajectory[s.start]} is the single row {s.start}: it has no derivative"
                )
            out[s] = np.gradient(x[s], self.t[s], axis=0)
        return out

    def acceleration(self) -> np.ndarray:
        """(T, n) rad/s^2: `derivative` of dq. Noisy on raw data; `resample` and `smooth` come first."""
        return self.derivative(self.dq)

    def repeats_after(self, tolerance: float = TOLERANCE) -> float | None:
        """Return the period, s, after which the motion repeats itself, or None.

        It repeats when, at some lag, at least 0.5 s of the recording comes again within `tolerance` rad RMS per
        joint while the arm moves through ten times that. What was recorded twice must not be split in two. Where
        the clock restarts, the repetitions may be trajectories: `in_phase` sets their clocks.
        """
        return self._in_phase(tolerance)[0]

    def in_phase(self, tolerance: float = TOLERANCE) -> "Recording":
        """Return the recording with its `period`, if it repeats itself (`repeats_after`), else as it is.

        The clocks of trajectories that restarted it, or were started by hand, are set so that the same motion has
        the same phase in all of them.
        """
        period, t = self._in_phase(tolerance)
        return self if period is None else replace(self, t=t, period=period)

    def _in_phase(self, tolerance: float) -> tuple[float | None, np.ndarray]:
        """Return the period, s, and the clock (T,) s that it is of."""
        best, clock = None, self.t
        runs, each = (tracks_of(self.t, self.q, self.stretches, each) for each in (False, True))
        for tracks in (runs, each) if len(each) > len(runs) else (runs,):
            period, shift = comes_again(tracks, tolerance)
            if period is None:
                continue
            # a period of the log's clock may fit only some of the trajectories: those that a hand started
            if best is None or np.abs((shift + 0.5 * best) % best - 0.5 * best).max() > SPLIT_GUARD_S / 2:
                best, clock = period, self.t.copy()
                for track, late in zip(tracks, shift, strict=True):
                    for s in track.stretches:
                        clock[s] += late
        return best, clock

    def known_from(self, training: "Recording") -> float:
        """Return which share of this motion comes in `training` too, within 0.01 rad RMS of each joint: 0 to 1.

        Motion that hardly moves says nothing, nor does when it came.
        """
        return share_known(*(tracks_of(r.t, r.q, r.stretches) for r in (training, self)))

    def split(self, validation_fraction: float, period: float | None = None) -> "tuple[Recording, Recording]":
        """Return (train, validation), about `validation_fraction` of the rows in the second, without a leak.

        What is held out depends on what would repeat itself in both halves:

        1. with a period (the argument, else the recording's): one block of phase, `t` modulo the period, the
           last of the phases recorded, in every repetition. A repeated excitation does the same again
           one period later: gaz2019 has a period of 13.33 s and its segment 1 partly repeats segment 0, so a
           chronological split of it leaks.
        2. with several trajectories: the last ones, whole, at least one on each side.
        3. otherwise the end of the recording.

        In 1 and 3 training also loses the rows within 0.1 s of the held-out block. A row left alone between
        two cuts is dropped.
        """
        if not 0 < validation_fraction < 1:
            raise UserError(f"validation_fraction={validation_fraction} must lie between 0 and 1")
        period = self.period if period is None else _positive("period", period, "s")
        if period is not None:
            phase = self.t % period
            start, stop = np.quantile(phase, 1 - validation_fraction), phase.max()
            validation = phase >= start
            before = (start - phase) % period  # on a circle: after the last phase comes phase 0
            after = (phase - stop) % period
            train = ~validation & (before > SPLIT_GUARD_S) & (after > SPLIT_GUARD_S)
        elif len(self.stretches) > 1:
            first_rows = np.array([s.start for s in self.stretches[1:]])
            first = first_rows[np.abs(first_rows - (1 - validation_fraction) * len(self.t)).argmin()]
            validation = np.arange(len(self.t)) >= first
            train = ~validation
        else:
            start = self.t[-1] - validation_fraction * self.duration
            validation = self.t >= start
            train = self.t < start - SPLIT_GUARD_S
        for side, rows in (("training", train), ("validation", validation)):
            if rows.sum() < MIN_ROWS:
                raise UserError(
                    f"validation_fraction={validation_fraction:g} of {len(self.t)} rows leaves {rows.sum()} "
                    f"for {side}; at least {MIN_ROWS} are needed"
                )
        return self.select(train)._without_lone_rows(), self.select(validation)._without_lone_rows()

    def save(self, path: str | os.PathLike) -> None:
        """Write everything to `path` (.npz, plain arrays); `readers.read` gives the same recording back."""
        path = Path(path)
        if path.suffix != ".npz":
            raise UserError(f"a recording is saved as .npz; '{path.name}' ends in '{path.suffix}'")
        with whole(path) as part:
            np.savez_compressed(part, **self.arrays())  # type: ignore[arg-type]

    def arrays(self) -> dict[str, np.ndarray]:
        """Return what `save` writes, by name."""
        fields = ("t", "q", "dq", "tau", "trajectory", "torque", "name")
        period = {} if self.period is None else {"period": np.asarray(self.period)}
        return {field: np.asarray(getattr(self, field)) for field in fields} | period

    def _rows(self, rows: np.ndarray, trajectory: np.ndarray, drop_lone: bool = False) -> "Recording":
        if drop_lone:
            together = np.bincount(trajectory)[trajectory] > 1
            rows, trajectory = rows[together], np.unique(trajectory[together], return_inverse=True)[1]
        arrays = {field: getattr(self, field)[rows] for field in ("t", "q", "dq", "tau")}
        return replace(self, trajectory=trajectory, **arrays)

    def _without_lone_rows(self) -> "Recording":
        dense = np.unique(self.trajectory, return_inverse=True)[1]
        return self._rows(np.arange(len(self.t)), dense, drop_lone=True)


def declared_torque(torque: str | None) -> str:
    """Return `torque` if it is one of `TORQUES`; to who left it open a UserError explains them."""
    if torque in TORQUES:
        return str(torque)
    meaning = (
        "say data.torque=measured (link-side sensor, contains gravity: tau_J of a Franka), "
        "data.torque=commanded (the command, without gravity: tau_J_d) or data.torque=motor (of the motors, contains "
        "gravity and all friction; from currents with data.torque_constant); the numbers alone do not tell"
    )
    if torque in (None, "", "???"):
        raise UserError(f"torque is not declared; {meaning}")
    raise UserError(
        f"unknown torque '{torque}'; allowed: {choices(TORQUES)}{nearest(str(torque), TORQUES)}; {meaning}"
    )


def _floats(field: str, value) -> np.ndarray:
    try:
        return np.array(value, dtype=np.float64, order="C")
    except (TypeError, ValueError):
        raise UserError(f"{field} is not a rectangular array of numbers") from None


def _positive(field: str, value: float, unit: str) -> float:
    if not (np.isfinite(value) and value > 0):
        raise UserError(f"{field}={value} must be a positive number of {unit}")
    return float(value)


def _check_finite(field: str, x: np.ndarray) -> None:
    bad = np.argwhere(~np.isfinite(x))
    if len(bad):
        where = f"row {bad[0][0]}" + (f" of joint {bad[0][1] + 1}" if x.ndim == 2 else "")
        count = "1 such value" if len(bad) == 1 else f"{len(bad)} such values"
        raise UserError(f"{field} is {x[tuple(bad[0])]} at {where} ({count} in {field}); all must be finite")
