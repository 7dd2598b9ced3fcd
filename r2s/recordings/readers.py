"""Read a `Recording` by column names from .csv, .npz, .parquet, HDF5, a LeRobotDataset or a robot's log."""

import os
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from r2s.errors import UserError, choices, instead_of, nearest_file, optional_import
from r2s.files import DAMAGED
from r2s.recordings.columns import DEFAULT_COLUMNS, Spec, by_names, find_columns, listed, specs_of
from r2s.recordings.csv_table import read_csv, without_units
from r2s.recordings.lerobot import dataset_files, is_dataset, lerobot_table
from r2s.recordings.recording import MIN_ROWS, SIGNALS, Recording, declared_torque
from r2s.recordings.repairs import held, repair_rows, unwrap
from r2s.recordings.robot_logs import BAGS, Table, bag_table, is_bag, libfranka_table, rostopic_table

HDF5 = (".h5", ".hdf5")
SUFFIXES = (".csv", ".npz", ".parquet", *HDF5, *BAGS)
NO_BAG = dict.fromkeys(("topic", "joints", "model_joints", "n_joints"))
RESTART_S = 0.1  # s; a clock that jumps back to less than this time from its first value has restarted


@dataclass(frozen=True)
class Options:
    """Arguments of `read` that define how a file's columns are interpreted."""

    torque: str | None
    columns: Mapping[str, Spec]
    n_joints: int | None = None
    max_gap_s: float | None = np.inf
    period: float | None = None
    name: str = ""
    torque_constant: np.ndarray | None = None
    restarts: bool = False  # whether a clock restart begins a new trajectory
    robot_joints: Sequence[str] | None = None
    limits: tuple[np.ndarray, np.ndarray] | None = None
    repair: bool = True  # whether the reader may sort or omit rows


def read(
    path: str | os.PathLike,
    *,
    torque: str | None,
    columns: Mapping[str, Spec] | None = None,
    n_joints: int | None = None,
    max_gap_s: float | None = None,
    period: float | None = None,
    name: str | None = None,
    topic: str | None = None,
    joints: Sequence[str] | None = None,
    model_joints: Sequence[str] | None = None,
    torque_constant: ArrayLike | None = None,
    limits: tuple[np.ndarray, np.ndarray] | None = None,
) -> Recording:
    """Read the recording in `path` with the torque of kind `torque`; logs of a Franka arm contain several kinds.

    Args:
        path: .csv, .npz, .parquet, .h5, a bag (.bag, .db3, .mcap or the folder of a ROS 2 bag), or the folder of a
            LeRobotDataset.
        torque: kind of torque, "measured", "commanded" or "motor" (see `Recording`); if None, the file must declare
            the kind.
        columns: {field: column name} for t (s), q (rad), dq (rad/s), tau (Nm, or A) and trajectory. The default names
            are in DEFAULT_COLUMNS; for tau, the name in TAU has priority. For q, dq and tau, a name stands for one
            array (T, n), or for columns numbered from 1 or 0: q1 q2 ..., q_1 q_2 ... or q[1] q[2] ... In a name,
            `{j}` (from 1) or `{i}` (from 0) stands for the joint number. A list of names has one column name per
            joint. In HDF5 a column name is the path of a dataset, such as robot/q.
        n_joints: expected number of joints.
        max_gap_s: s, longest time step within a trajectory; None: the result of `longest_step`; inf: gaps do not
            separate trajectories.
        period: s, period of the motion, see `Recording`.
        name: name of the recording; if None, the file name without its suffix.
        topic: ROS topic to read from a bag, see `bag_table`.
        joints, model_joints: the robot's joint names in the file, and in the robot description. `by_names` and
            `choose_joints` select and sort the file's joints by these names.
        torque_constant: Nm/A, (n,) or one value: joint torque, after the gear, per motor current; if given, the
            column of tau contains motor current.
        limits: (lowest, highest) q of the robot, (n,) rad each; angles outside are shifted inside by full
            revolutions, if possible.

    Without a column dq, dq is the central difference of q over the logged time. Gaps and clock restarts separate
    trajectories; clock restarts do not do so in bags and in files with a column `trajectory`. The reader repairs log
    faults that have only one remedy (r2s/recordings/repairs.py); the recording's notes list the repairs. A file that
    `Recording.save` wrote is restored unchanged.

    Raises:
        UserError: the file or a column is missing or damaged, or the values do not form a valid recording.
    """
    constant = _constant(torque_constant, torque)
    path = Path(path).expanduser()
    table = load_table(path, {"topic": topic, "joints": joints, "model_joints": model_joints, "n_joints": n_joints})
    restarts = not is_bag(path)  # in a bag, messages from before and after a restart may alternate
    how = Options(torque, columns or {}, n_joints, max_gap_s, period, name or path.stem, constant, restarts)
    how = replace(how, robot_joints=model_joints, limits=limits)
    try:
        if not is_bag(path):
            table = by_names(table, joints, model_joints, n_joints)
        return from_table(table, how)
    except UserError as error:
        raise UserError(f"{path}: {error}") from None


def notes_of(table: Table) -> tuple[str, ...]:
    """Return the notes that `Recording.save` or a reader wrote to a table."""
    return tuple(str(table["reader_note"]).split("\n")) if "reader_note" in table else ()


def from_table(table: Table, how: Options) -> Recording:
    """Build a recording from the columns of a file; error messages do not contain the file name."""
    notes = {k: v.item() for k, v in table.items() if v.ndim == 0}  # scalars that `Recording.save` or a reader wrote
    earlier, table = notes_of(table), {k: v for k, v in table.items() if v.ndim > 0}
    torque = _agreed_torque(how.torque, notes.get("torque"))
    constant = how.torque_constant
    specs, names_of = specs_of(how.columns), how.robot_joints
    found = {x: find_columns(table, x, spec, torque, constant, names_of) for x, spec in specs.items()}
    arrays = {
        x: _vector(table, names, how.n_joints, x) if x in ("q", "dq", "tau") else scalar(table, names)
        for x, names in found.items()
        if names
    }
    saved = set(table) - set(SIGNALS) == set(DEFAULT_COLUMNS) and {"torque", "name"} <= set(notes)
    repair = how.repair and not saved
    arrays, repairs = repair_rows(arrays) if repair else (arrays, [])
    repairs = [*earlier, *repairs]
    if how.restarts and "trajectory" not in arrays and (index := restart_index(arrays["t"])) is not None:
        arrays["trajectory"] = index
    if not saved:
        arrays, more = unwrap(arrays, how.limits)
        repairs += more
    if not np.any(arrays["tau"]):  # position-controlled and simulated arms fill the field with zeros
        raise UserError(f"tau ({listed(found['tau'])}) is 0 in every row: this log holds no {torque} torque")
    if constant is not None:
        joints = arrays["tau"].shape[-1] if arrays["tau"].ndim > 1 else 1
        if constant.ndim and constant.shape != (joints,):
            raise UserError(f"data.torque_constant: expected {joints} values, one per joint, got {constant.size}")
        arrays["tau"] = arrays["tau"] * constant
    derive_dq = "dq" not in arrays
    if derive_dq:
        arrays["dq"] = np.zeros_like(arrays["q"])
    signals = {k: v for k, v in table.items() if k in SIGNALS} if saved else {}
    period = notes.get("period") if saved and how.period is None else how.period
    name = notes["name"] if saved else how.name
    held = notes.get("command_period") if saved else None
    arrays = {k: x.view() for k, x in arrays.items()}
    for x in arrays.values():
        x.flags.writeable = False  # so that `Recording` makes no copy
    recording = Recording(**arrays, torque=torque, period=period, name=name, signals=signals)  # type: ignore[arg-type]
    recording = replace(recording, notes=tuple(repairs), command_period=held)
    if how.max_gap_s != np.inf and not saved:
        recording = recording.split_at_gaps(how.max_gap_s)
    if repair:
        recording = _without_holds(recording)
    return replace(recording, dq=recording.derivative(recording.q)) if derive_dq else recording


def _without_holds(recording: Recording) -> Recording:
    """Drop rows that repeat the values of the previous row, if the log repeats most values (see `held`)."""
    rows = held(recording.t, recording.q, recording.dq, recording.stretches)
    if rows is None:
        return recording
    kept = recording.rows(np.flatnonzero(rows), recording.trajectory[rows], drop_lone=True)
    note = f"each value is repeated: the log has {recording.rate_hz:.4g} rows/s, its values {kept.rate_hz:.4g} per s"
    return replace(kept, notes=(*recording.notes, f"{note}; the repetitions are left out"))


def restart_index(t: np.ndarray) -> np.ndarray | None:
    """Return the trajectory index (T,) of each row, or None if the clock t (T,) s does not restart.

    At a restart, the clock jumps back to about its first value; `Recording` rejects any other backward jump.
    """
    if t.ndim != 1 or not len(back := np.flatnonzero(np.diff(t) < 0) + 1):
        return None
    runs = np.diff([0, *back, len(t)])
    if runs.min() < MIN_ROWS or np.abs(t[back] - t[0]).max() > RESTART_S:
        return None
    return np.repeat(np.arange(len(runs)), runs)


def _agreed_torque(declared: str | None, stored) -> str:
    """Return the declared kind of torque; raise UserError if the user and the file declare different kinds."""
    if not isinstance(stored, str):
        return declared_torque(declared)
    if declared not in (None, "", "???", declared_torque(stored)):
        declared = declared_torque(declared)
        raise UserError(f"expected torque={stored}, as the file declares, got data.torque={declared}")
    return stored


def _constant(value: ArrayLike | None, torque: str | None) -> np.ndarray | None:
    """Return the torque constants in Nm/A as an array () or (n,), or None if `value` is None."""
    if value is None:
        return None
    where = "data.torque_constant"
    if torque != "motor":
        raise UserError(f"{where}: expected null unless data.torque=motor, got {value} with data.torque={torque}")
    try:
        constant = np.array(value, dtype=float)
    except (TypeError, ValueError):
        raise UserError(f"{where}: expected a number of Nm/A or one per joint, got {value}") from None
    if constant.ndim > 1 or not np.all(np.isfinite(constant)) or np.any(constant == 0):
        raise UserError(f"{where}: expected finite Nm/A other than 0, one or one per joint, got {constant.tolist()}")
    return constant


def _vector(table: Table, names: list[str], n_joints: int | None, field: str) -> np.ndarray:
    """Return the columns of a field as one array (T, n)."""
    parts = [_numbers(table, name) for name in names]
    if len(parts) > 1 and {part.shape for part in parts} != {parts[0].shape[:1]}:
        shapes = choices(f"{name} {part.shape}" for name, part in zip(names, parts, strict=True))
        raise UserError(f"expected columns of {field} of shape (T,) and equal length, got {shapes}")
    value = parts[0] if parts[0].ndim > 1 else np.stack(parts, axis=1)
    if n_joints is not None and value.ndim == 2 and value.shape[1] != n_joints:
        raise UserError(
            f"{field}: expected {n_joints} joints, got {value.shape[1]} ({listed(names)}); "
            f"a list in data.columns.{field} selects columns"
        )
    return value


def scalar(table: Table, names: list[str]) -> np.ndarray:
    """Return the values (T,) of the single column in `names`."""
    if len(names) != 1:
        raise UserError(f"expected one column for t and for trajectory, got {len(names)}: {listed(names)}")
    value = _numbers(table, names[0])
    return value[:, 0] if value.ndim == 2 and value.shape[1] == 1 else value


def _numbers(table: Table, name: str) -> np.ndarray:
    column = table[name]
    if column.dtype.kind in "iuf":
        return column
    for row, value in enumerate(column):
        try:
            float(value)
        except (TypeError, ValueError):
            text = " ".join(str(value).split())[:40]
            raise UserError(f"column '{name}': expected numbers, got '{text}' at row {row}") from None
    raise UserError(f"column '{name}': expected numbers, got type {column.dtype}")


def files_of(path: str | os.PathLike) -> list[Path]:
    """Return the files of a recording: `path` itself, or the files in the folder of a ROS 2 bag or LeRobotDataset."""
    path = Path(path).expanduser()
    if is_dataset(path):
        return dataset_files(path)
    return sorted(p for p in path.iterdir() if p.is_file()) if path.is_dir() else [path]


def load_table(path: Path, bag: Mapping[str, Any] = NO_BAG) -> Table:
    """Return all columns of a file; errors contain its `path`. bag: arguments of `bag_table`."""
    if not path.exists():
        if not path.parent.is_dir():
            raise UserError(f"no file {path}: no folder {path.parent}")
        raise UserError(f"no file {path}{nearest_file(path)}")
    if path.is_dir() and not is_bag(path) and not is_dataset(path):
        raise UserError(
            f"{path}: expected a file ({choices(SUFFIXES)}), a ROS 2 bag or a LeRobotDataset, got another folder"
        )
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES and not path.is_dir():
        raise UserError(f"{path}: unknown suffix '{path.suffix}'; {instead_of(suffix, SUFFIXES)}")
    try:
        if is_bag(path):
            return bag_table(path, **bag)
        for key in ("topic", "joints") if suffix in (".csv", ".parquet") else ("topic",):
            if bag[key] is not None:
                kind = "a LeRobotDataset" if path.is_dir() else suffix
                raise UserError(f"data.{key}: expected null for {kind}, got {bag[key]}: it is for {choices(BAGS)}")
        if is_dataset(path):
            return lerobot_table(path)
        return rostopic_table(libfranka_table(without_units(_columns(path, suffix))))
    except UserError as error:
        raise UserError(f"{path}: {error}") from None
    except DAMAGED as error:
        reason = " ".join(str(error).split())[:200]
        kind = "a LeRobotDataset" if path.is_dir() else suffix[1:]
        raise UserError(f"{path} cannot be read as {kind}: {reason}") from None


def _columns(path: Path, suffix: str) -> Table:
    if suffix in HDF5:
        return _load_hdf5(path)
    if suffix == ".npz":
        return _load_npz(path)
    if suffix == ".csv":
        return read_csv(path)
    frame = pd.read_parquet(path)
    return {str(name).strip(): _column(frame[name]) for name in frame.columns}


def _load_npz(path: Path) -> Table:
    table: Table = {}
    if not zipfile.is_zipfile(path):
        raise UserError("expected an .npz archive of numpy.savez, got another or a damaged file")
    with np.load(path, allow_pickle=False) as archive:
        for name in archive.files:
            try:
                table[name] = archive[name]
            except ValueError as error:
                if "allow_pickle" not in str(error):
                    raise
                raise UserError(f"'{name}' is pickled, and r2s loads no pickles; save plain arrays") from None
    return table


def _load_hdf5(path: Path) -> Table:
    """Return {path: dataset} for all datasets in an HDF5 file that have at most two dimensions."""
    h5py = optional_import("h5py", "reading this file", "recordings")
    table: Table = {}

    def keep(name, item):
        if isinstance(item, h5py.Dataset) and item.shape is not None and item.ndim <= 2:
            table[name] = np.asarray(item.asstr()[()] if h5py.check_string_dtype(item.dtype) else item[()])

    with h5py.File(path, "r") as file:
        file.visititems(keep)
    return table


def _column(series: pd.Series) -> np.ndarray:
    """Return a column as (T,), or as (T, n) if each cell is a list (parquet)."""
    column = series.to_numpy()
    if column.dtype == object and len(column) and isinstance(column[0], list | np.ndarray):
        return np.array(column.tolist())
    return column
