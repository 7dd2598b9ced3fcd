"""Define `Recording`: joint motion and torque of an arm over the time of its log."""

import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from scipy.signal import butter, sosfiltfilt

from r2s.errors import UserError, choices, instead_of
from r2s.files import atomic_write
from r2s.recordings.gaps import longest_step
from r2s.recordings.periodicity import find_period, overlap, tracks_of

TORQUES = ("measured", "commanded", "motor")
MIN_ROWS = 10
SPLIT_GUARD_S = 0.1  # s; `split` drops training rows this close to a validation row, which are almost equal to it
FIELDS = ("t", "q", "dq", "tau", "trajectory")
SIGNALS = (  # further values that an arm may measure or estimate, with libfranka's names; see `ArmState`
    "tau_ext_hat_filtered", "O_F_ext_hat_K", "joint_contact", "cartesian_contact", "joint_collision",
    "cartesian_collision", "control_command_success_rate", "O_T_EE", "m_ee", "m_load",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Recording:
    """Motion and torque of n joints in T rows; the constructor checks the arrays and makes them read-only.

    Methods return new recordings. No difference, filter or window includes rows of two trajectories.

    Attributes:
        t: (T,) s, logged time; increases within each trajectory, evenly or not; may restart in a new trajectory.
        q, dq, tau: (T, n) joint angles in rad, velocities in rad/s and torques in Nm.
        torque: kind of `tau`: "measured" (by a link-side sensor, with gravity), "commanded" (without gravity) or
            "motor" (motor torque times gear ratio, with gravity, all friction and rotor inertia).
        signals: {name from `SIGNALS`: (T,) or (T, k)}, further values that the arm reported; None: no signals.
        trajectory: (T,) trajectory index of each row; a trajectory is a part of the log without pauses; None: all
            indices are 0.
        period: s, period of the motion on the clock `t` (see `split`); None if no period is known.
        notes: remarks of the file reader, such as one line per repair.
        command_period: s, time for which the arm applies each command; None: until the next row.
    """

    t: np.ndarray
    q: np.ndarray
    dq: np.ndarray
    tau: np.ndarray
    torque: str
    trajectory: np.ndarray = None  # type: ignore[assignment]
    period: float | None = None
    name: str = ""
    signals: Mapping[str, np.ndarray] = None  # type: ignore[assignment]
    notes: tuple[str, ...] = ()
    command_period: float | None = None

    def __post_init__(self):
        for field in FIELDS[:4]:
            object.__setattr__(self, field, _floats(field, getattr(self, field)))
        trajectory = np.zeros(len(self.t)) if self.trajectory is None else self.trajectory
        object.__setattr__(self, "trajectory", _floats("trajectory", trajectory))
        object.__setattr__(self, "torque", declared_torque(self.torque))
        if self.period is not None:
            object.__setattr__(self, "period", _positive("period", self.period, "s"))
        if self.command_period is not None:
            _positive("command_period", self.command_period, "s")
        self._check_shapes()
        for field in FIELDS:
            _check_finite(field, getattr(self, field))
        self._check_trajectories()
        object.__setattr__(self, "signals", {k: self._signal(k, v) for k, v in (self.signals or {}).items()})
        for x in (*(getattr(self, field) for field in FIELDS), *self.signals.values()):
            x.flags.writeable = False

    def _signal(self, name: str, value: np.ndarray) -> np.ndarray:
        x = _floats(name, value)
        if name not in SIGNALS or len(x) != len(self.t):
            raise UserError(
                f"signals: expected {len(self.t)} rows of {choices(SIGNALS)}; got '{name}', {len(x)} rows"
            )
        _check_finite(name, x)
        return x

    def _check_shapes(self):
        t, q = self.t, self.q
        if t.ndim != 1 or q.ndim != 2 or q.shape[1] == 0:
            raise UserError(f"expected t of shape (T,) and q of shape (T, n), got {t.shape} and {q.shape}")
        width = {"q": q.shape[1:], "dq": q.shape[1:], "tau": q.shape[1:], "trajectory": ()}
        for field, shape in width.items():
            seen = getattr(self, field).shape
            if seen != (len(t), *shape):
                raise UserError(f"expected {field} of shape {(len(t), *shape)}, got {seen}")
        if len(t) < MIN_ROWS:
            raise UserError(f"expected at least {MIN_ROWS} rows, got {len(t)}")

    def _check_trajectories(self):
        index = self.trajectory.astype(np.int32, copy=False)
        if not np.array_equal(index, self.trajectory):
            row = int(np.flatnonzero(index != self.trajectory)[0])
            raise UserError(f"expected whole numbers in trajectory, got {self.trajectory[row]:g} at row {row}")
        object.__setattr__(self, "trajectory", index)
        seen = set()
        for stretch in self.stretches:
            label = int(index[stretch.start])
            if label in seen:
                raise UserError(f"trajectory {label} occurs again at row {stretch.start}; each stretch needs its own")
            seen.add(label)
            back = np.flatnonzero(np.diff(self.t[stretch]) <= 0)
            if len(back):
                row = stretch.start + int(back[0]) + 1
                equal = self.t[row] == self.t[row - 1]
                hint = "log more digits of the time" if equal else "a restarted clock needs a new trajectory"
                raise UserError(
                    f"time does not increase at row {row}: t is {self.t[row - 1]!s}, then {self.t[row]!s} s "
                    f"({len(back)} such rows in trajectory {label}; {hint})"
                )

    @property
    def n_joints(self) -> int:
        """Number of joints n."""
        return self.q.shape[1]

    @property
    def stretches(self) -> list[slice]:
        """One slice of rows for each trajectory, in the order of the log."""
        edges = [0, *(np.flatnonzero(np.diff(self.trajectory)) + 1).tolist(), len(self.t)]
        return [slice(start, stop) for start, stop in pairwise(edges)]

    @property
    def duration(self) -> float:
        """Recorded time in s, summed over trajectories."""
        return float(sum(self.t[s][-1] - self.t[s][0] for s in self.stretches))

    @property
    def rate_hz(self) -> float:
        """Rate of the log in Hz: the inverse of the median time step within trajectories."""
        steps = self._steps()
        if not len(steps):
            raise UserError("every trajectory is a single row: the recording has no rate")
        return float(1 / np.median(steps))

    def _steps(self) -> np.ndarray:
        return np.diff(self.t)[np.diff(self.trajectory) == 0]

    def select(self, mask: np.ndarray) -> "Recording":
        """Select the rows where `mask` (T,) is True; each sequence of adjacent rows becomes a trajectory."""
        mask = np.asarray(mask)
        if mask.dtype != bool or mask.shape != self.t.shape:
            raise UserError(f"expected a mask of shape {self.t.shape} bool, got {mask.shape} {mask.dtype}")
        rows = np.flatnonzero(mask)
        cut = (np.diff(rows) != 1) | (np.diff(self.trajectory[rows]) != 0)
        return self.rows(rows, np.concatenate([[0], np.cumsum(cut)])[: len(rows)])

    def split_at_gaps(self, max_gap_s: float | None = None) -> "Recording":
        """Begin a new trajectory after each pause (see `longest_step`), and drop trajectories of a single row."""
        if max_gap_s is not None:
            _positive("max_gap_s", max_gap_s, "s")
        steps = self._steps()
        longest = longest_step(steps, max_gap_s)
        if not np.any(steps > longest):
            return self
        cut = (np.diff(self.t) > longest) | (np.diff(self.trajectory) != 0)
        trajectory = np.concatenate([[0], np.cumsum(cut)])
        return self.rows(np.arange(len(self.t)), trajectory, drop_lone=True)

    def resample(self, dt: float) -> "Recording":
        """Interpolate each trajectory linearly onto a uniform grid of `dt` s from its first logged time.

        A command acts until the next command, so commanded torque is averaged over each step of `dt`. There is no
        anti-aliasing filter: to lower the rate, resample at the logged rate, call `smooth`, then resample again. A
        resampled row has the last logged `signals`, because flags and poses cannot be interpolated. Trajectories
        shorter than `dt` are dropped.
        """
        _positive("dt", dt, "s")
        columns: dict[str, list[np.ndarray]] = {field: [] for field in FIELDS}
        rows = []
        for s in self.stretches:
            t = self.t[s]
            grid = t[0] + dt * np.arange(int((t[-1] - t[0]) / dt + 1e-6) + 1)
            if len(grid) < 2:
                continue
            columns["t"].append(grid)
            rows.append(s.start + np.searchsorted(t, grid + 1e-9 * dt, side="right") - 1)
            columns["trajectory"].append(np.full(len(grid), self.trajectory[s.start]))
            for field in ("q", "dq", "tau"):
                x = getattr(self, field)[s]
                columns[field].append(np.stack([np.interp(grid, t, column) for column in x.T], axis=1))
            if self.torque == "commanded":
                columns["tau"][-1] = self._held(s, grid, dt)
        if not columns["t"]:
            raise UserError(f"no trajectory is as long as dt={dt:g} s; the recording lasts {self.duration:g} s")
        signals = {name: x[np.concatenate(rows)] for name, x in self.signals.items()}
        return replace(self, signals=signals, **{f: np.concatenate(parts) for f, parts in columns.items()})  # type: ignore[arg-type]

    def _held(self, s: slice, grid: np.ndarray, dt: float) -> np.ndarray:
        """Return the mean command (G, n) Nm in each of the G intervals from `grid` to `grid + dt`; s: slice of rows.

        A command acts until the next command. Commands that were sent between two logged rows are interpolated.
        """
        t, tau, period = self.t[s], self.tau[s], self.command_period or 1.0 / self.rate_hz
        if len(grid) == len(t) and np.abs(grid - t).max() < 1e-6 * dt and period > 0.9 * dt:
            return tau
        parts = np.maximum(np.rint(np.diff(t) / period), 1).astype(int)
        row = np.append(np.repeat(np.arange(len(parts)) - (np.cumsum(parts) - parts) / parts, parts), 0.0)
        row[:-1] += np.arange(len(row) - 1) / np.repeat(parts, parts)
        row[-1] = len(t) - 1
        sent = np.interp(row, np.arange(len(t)), t)
        edges, ends = np.append(grid, grid[-1] + dt), np.append(sent, max(sent[-1] + period, grid[-1] + dt))
        out = np.empty((len(grid), tau.shape[1]))
        for j, column in enumerate(tau.T):
            held = np.interp(row, np.arange(len(t)), column)
            out[:, j] = np.diff(np.interp(edges, ends, np.append(0.0, np.cumsum(held * np.diff(ends))))) / dt
        return out

    def smooth(self, cutoff_hz: float) -> "Recording":
        """Low-pass q, dq and tau without delay, by a Butterworth filter of order 4, run forwards and backwards.

        The two passes together have a gain of -6 dB at the cutoff. Time steps must be uniform (see `resample`).
        """
        _positive("cutoff_hz", cutoff_hz, "Hz")
        steps, rate = self._steps(), self.rate_hz
        if not np.allclose(steps, 1 / rate, rtol=1e-3, atol=0):
            raise UserError(f"expected a uniform time step, got {steps.min():g} to {steps.max():g} s: resample first")
        if cutoff_hz >= rate / 2:
            raise UserError(f"cutoff_hz={cutoff_hz:g} must be below half the rate, {rate / 2:g} Hz")
        sos = butter(4, cutoff_hz, fs=rate, output="sos")
        filtered = {field: np.empty_like(self.q) for field in ("q", "dq", "tau")}
        for s in self.stretches:
            pad = min(s.stop - s.start - 1, int(3 * rate / cutoff_hz))  # longer than the filter's transient
            for field, out in filtered.items():
                out[s] = sosfiltfilt(sos, getattr(self, field)[s], axis=0, padlen=pad)
        return replace(self, **filtered)  # type: ignore[arg-type]

    def derivative(self, x: np.ndarray) -> np.ndarray:
        """Return the time derivative of `x` (T, n) by central differences over the logged time, without delay."""
        out = np.empty_like(x)
        for s in self.stretches:
            if s.stop - s.start < 2:
                raise UserError(f"trajectory {self.trajectory[s.start]} has 1 row ({s.start}) and no derivative")
            out[s] = np.gradient(x[s], self.t[s], axis=0)
        return out

    def acceleration(self) -> np.ndarray:
        """Return the acceleration (T, n) rad/s^2, the `derivative` of dq; `resample` and `smooth` raw data first."""
        return self.derivative(self.dq)

    def find_period(self) -> float | None:
        """Return the period (s) of the motion, or None if the motion does not repeat itself.

        A repetition lasts at least 0.5 s. Each joint's RMS difference from the repeated motion is below a tolerance,
        about 0.03 rad, and a joint moves by about ten tolerances or more. `in_phase` also aligns repetitions after
        a clock restart.
        """
        return self._period_and_clock()[0]

    def in_phase(self) -> "Recording":
        """Return the recording with its period, and with t shifted so that all repetitions have the same phase.

        If the motion does not repeat, the recording is returned unchanged.
        """
        period, t = self._period_and_clock()
        return self if period is None else replace(self, t=t, period=period)

    def _period_and_clock(self) -> tuple[float | None, np.ndarray]:
        best, clock = None, self.t
        runs, each = (tracks_of(self.t, self.q, self.stretches, each) for each in (False, True))
        for tracks in (runs, each) if len(each) > len(runs) else (runs,):
            period, shift = find_period(tracks)
            if period is None:
                continue
            # trajectories that were started by hand may not be in phase with a period found on the log's clock
            if best is None or np.abs((shift + 0.5 * best) % best - 0.5 * best).max() > SPLIT_GUARD_S / 2:
                best, clock = period, self.t.copy()
                for track, late in zip(tracks, shift, strict=True):
                    for s in track.stretches:
                        clock[s] += late
        return best, clock

    def overlap(self, training: "Recording") -> float:
        """Return the share (0 to 1) of this recording's motion that occurs in `training` (see `periodicity.overlap`).

        Pieces with too little motion are ignored. The share does not depend on when a motion occurs.
        """
        return overlap(*(tracks_of(r.t, r.q, r.stretches) for r in (training, self)))

    def split(self, validation_fraction: float, period: float | None = None) -> "tuple[Recording, Recording]":
        """Return (train, validation) without common motion; validation has about `validation_fraction` of the rows.

        1. If the motion has a period (argument or attribute), validation is the end of each period: the rows whose
           phase (`t` modulo period) is largest. A chronological split would put repeated motion on both sides.
        2. Otherwise, validation is the last trajectories that have about the share f = `validation_fraction` of the
           rows, if their exact share is between 0.5 f and max(2 f, 0.5).
        3. Otherwise, validation is the end of the recording.

        Except in case 2, training has no rows within 0.1 s of a validation row. Single-row trajectories are dropped.
        """
        if not 0 < validation_fraction < 1:
            raise UserError(f"validation_fraction: expected a number in (0, 1), got {validation_fraction}")
        period = self.period if period is None else _positive("period", period, "s")
        if period is not None:
            phase = self.t % period
            start, stop = np.quantile(phase, 1 - validation_fraction), phase.max()
            validation = phase >= start
            before = (start - phase) % period  # phase is circular
            after = (phase - stop) % period
            train = ~validation & (before > SPLIT_GUARD_S) & (after > SPLIT_GUARD_S)
        elif len(self.stretches) > 1:
            count, share = len(self.t), validation_fraction
            first = min((s.start for s in self.stretches[1:]), key=lambda row: abs(row - (1 - share) * count))
            if not 0.5 * share <= 1 - first / count <= max(2 * share, 0.5):  # for example, one early pause
                first = min(round((1 - share) * count), count - 1)
            close = (self.trajectory == self.trajectory[first]) & (self.t > self.t[first] - SPLIT_GUARD_S)
            validation = np.arange(count) >= first
            train = ~validation & ~close
        else:
            start = self.t[-1] - validation_fraction * self.duration
            validation = self.t >= start
            train = self.t < start - SPLIT_GUARD_S
        for side, rows in (("training", train), ("validation", validation)):
            if rows.sum() < MIN_ROWS:
                raise UserError(
                    f"expected at least {MIN_ROWS} rows for {side}, got {rows.sum()} of {len(self.t)} "
                    f"(validation_fraction={validation_fraction:g})"
                )
        return self.select(train)._without_lone_rows(), self.select(validation)._without_lone_rows()

    def save(self, path: str | os.PathLike) -> None:
        """Write the recording to `path` (.npz), from which `readers.read` restores the recording."""
        save_npz(path, self.arrays())

    def arrays(self) -> dict[str, np.ndarray]:
        """Return {name: array} for all arrays that `save` writes."""
        own = {k: getattr(self, k) for k in (*FIELDS, "torque", "name", "period", "command_period")}
        own["reader_note"] = "\n".join(self.notes) or None
        return {**{k: np.asarray(x) for k, x in own.items() if x is not None}, **self.signals}

    def rows(self, rows: np.ndarray, trajectory: np.ndarray, drop_lone: bool = False) -> "Recording":
        """Return the rows with indices `rows` (K,) as a recording with the trajectory indices `trajectory` (K,).

        drop_lone: whether to drop trajectories of a single row. If `rows` are consecutive, the new arrays are views.
        """
        if drop_lone:
            together = np.bincount(trajectory)[trajectory] > 1
            rows, trajectory = rows[together], np.unique(trajectory[together], return_inverse=True)[1]
        some = rows if len(rows) == 0 or np.any(np.diff(rows) != 1) else slice(rows[0], rows[-1] + 1)
        arrays = {field: getattr(self, field)[some] for field in FIELDS[:4]}
        signals = {name: x[some] for name, x in self.signals.items()}
        return replace(self, trajectory=trajectory, signals=signals, **arrays)

    def _without_lone_rows(self) -> "Recording":
        dense = np.unique(self.trajectory, return_inverse=True)[1]
        return self.rows(np.arange(len(self.t)), dense, drop_lone=True)


def save_npz(path: str | os.PathLike, arrays: Mapping[str, np.ndarray]) -> None:
    """Write arrays to `path`, which must end in .npz."""
    path = Path(path)
    if path.suffix != ".npz":
        raise UserError(f"expected a file name ending in .npz, got '{path.name}'")
    with atomic_write(path) as part:
        np.savez_compressed(part, **arrays)  # type: ignore[arg-type]


def declared_torque(torque: str | None) -> str:
    """Return `torque` if it is one of `TORQUES`; otherwise raise a UserError that explains the kinds of torque."""
    if torque in TORQUES:
        return str(torque)
    meaning = (
        "set data.torque=measured (link-side sensor, contains gravity: tau_J of a Franka), "
        "data.torque=commanded (the command, without gravity: tau_J_d) or data.torque=motor (motor side, contains "
        "gravity and all friction; from currents with data.torque_constant)"
    )
    if torque in (None, "", "???"):
        raise UserError(f"torque is not declared; {meaning}")
    raise UserError(f"unknown torque '{torque}'; {instead_of(torque, TORQUES)}; {meaning}")


def _floats(field: str, value) -> np.ndarray:
    own = np.int32 if field == "trajectory" else np.float64
    if isinstance(value, np.ndarray) and value.dtype == own and not value.flags.writeable:
        return np.ascontiguousarray(value)  # a read-only array comes from a recording or reader and needs no copy
    try:
        return np.array(value, dtype=np.float64, order="C")
    except (TypeError, ValueError):
        raise UserError(f"expected {field} to be a rectangular array of numbers") from None


def _positive(field: str, value: float, unit: str) -> float:
    if not (np.isfinite(value) and value > 0):
        raise UserError(f"{field}: expected a positive number of {unit}, got {value}")
    return float(value)


def _check_finite(field: str, x: np.ndarray) -> None:
    bad = np.argwhere(~np.isfinite(x))
    if len(bad):
        where = f"row {bad[0][0]}" + (f" of joint {bad[0][1] + 1}" if x.ndim == 2 else "")
        count = "1 such value" if len(bad) == 1 else f"{len(bad)} such values"
        raise UserError(f"{field}: expected finite values, got {x[tuple(bad[0])]} at {where} ({count})")
