"""Read a `Recording` from .csv, .npz, .parquet, HDF5 or a robot's own log: one column map for all of them."""

import os
import re
import zipfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from r2s.errors import UserError, choices, nearest
from r2s.files import DAMAGED
from r2s.recordings.recording import MIN_ROWS, Recording, declared_torque
from r2s.recordings.robot_logs import BAGS, Table, bag_table, is_bag, libfranka_table, missing_extra

HDF5 = (".h5", ".hdf5")
SUFFIXES = (".csv", ".npz", ".parquet", *HDF5, *BAGS)
DEFAULT_COLUMNS = {  # the first name that the file has
    "t": ("t",),
    "q": ("q",),
    "dq": ("dq",),
    "tau": ("tau",),
    "trajectory": ("segment", "trajectory"),
}
TAU = {"measured": "tau_J", "commanded": "tau_J_d", "motor": "tau_motor"}  # looked for before tau
CURRENT = ("current", "i")  # looked for with a torque constant
OPTIONAL = ("dq", "trajectory")
NO_BAG = dict.fromkeys(("topic", "joints", "model_joints", "n_joints"))
RESTART_S = 0.1  # s, from its first moment: where a clock goes back to that starts anew

Spec = str | list[str] | None


def read(
    path: str | os.PathLike,
    *,
    torque: str | None,
    columns: Mapping[str, Spec] | None = None,
    n_joints: int | None = None,
    max_gap_s: float | None = 0.05,
    period: float | None = None,
    name: str | None = None,
    topic: str | None = None,
    joints: Sequence[str] | None = None,
    model_joints: Sequence[str] | None = None,
    torque_constant: ArrayLike | None = None,
) -> Recording:
    """Read the recording in `path`, or raise a UserError: one line, the file and what is wrong with it.

    torque: 'measured' (contains gravity), 'commanded' (does not) or 'motor' (gravity, all friction and rotors are in
        it); None only where the file itself says it.
    columns: the name in the file for any of t (s), q (rad), dq (rad/s), tau (Nm, or A), trajectory. None is
        the default, t: t, q: q, dq: dq, tau: tau_J if measured, tau_J_d if commanded or tau_motor if motor, where
        absent tau, trajectory: segment, where absent trajectory. A name for q, dq or tau is a (T, n) array, or
        stands for q1 q2 ..., q_1 q_2 ... or q[1] q[2] ... (or from 0). `{j}` (from 1) or `{i}` (from 0) in a name
        spells that out; a list names the joints one by one. In HDF5 a name is a path: robot/q.
    n_joints: expected number of joints, if known.
    max_gap_s: longer gaps in time start a new trajectory; None leaves them. Units of time are never guessed.
    period: s, see `Recording`. name: of the recording; the default is the file's.
    topic, joints, model_joints: of a bag (.bag, .db3, .mcap or a ROS 2 bag's folder), see `bag_table`.
    torque_constant: Nm/A at the joint (gear included), (n,) or one for all, of a motor's currents: tau is then the
        column of the current, A (the default is current, where absent i).

    Without dq in the file it is the central difference of q on the logged time (zero phase), each trajectory
    by itself; without trajectory, gaps separate them, and (not in a bag) a clock that goes
    back to where it began. A file by `Recording.save` comes back as it was. The
    logs of `franka::logToCSV` and of Franka's ROS messages hold both torques: `torque` picks one.
    """
    constant = _constant(torque_constant, torque)
    path = Path(path).expanduser()
    bag = {"topic": topic, "joints": joints, "model_joints": model_joints, "n_joints": n_joints}
    table = load_table(path, bag)
    try:
        how = n_joints, max_gap_s, period, name or path.stem
        return from_table(table, torque, columns or {}, *how, restarting=not is_bag(path), constant=constant)
    except UserError as error:
        raise UserError(f"{path}: {error}") from None


def from_table(
    table: Table,
    torque: str | None,
    columns: Mapping[str, Spec],
    n_joints: int | None = None,
    max_gap_s: float | None = None,
    period: float | None = None,
    name: str = "",
    restarting: bool = False,
    constant: np.ndarray | None = None,
) -> Recording:
    """Return the recording that a file's columns hold; arguments as in `read`, errors without the file's name.

    restarting: a clock that goes back to where it began starts a new trajectory. In a bag it does not: there
        messages of two starts may be mixed. constant: Nm/A, () or (n,), where tau is a current.
    """
    notes = {k: v.item() for k, v in table.items() if v.ndim == 0}  # what `Recording.save` says about the rows
    table = {k: v for k, v in table.items() if v.ndim > 0}
    torque = _agreed_torque(torque, notes.get("torque"))
    found = {field: find_columns(table, field, spec, torque, constant) for field, spec in _specs(columns).items()}
    arrays = {
        field: _vector(table, names, n_joints, field) if field in ("q", "dq", "tau") else scalar(table, names)
        for field, names in found.items()
        if names
    }
    if restarting and "trajectory" not in arrays and (anew := restarts(arrays["t"])) is not None:
        arrays["trajectory"] = anew
    if not np.any(arrays["tau"]):  # a position-controlled or simulated arm fills the field, with nothing
        raise UserError(f"tau ({listed(found['tau'])}) is 0 in every row: this log holds no {torque} torque")
    if constant is not None:
        arrays["tau"] = arrays["tau"] * _per_joint(constant, arrays["tau"])
    derive_dq = "dq" not in arrays
    if derive_dq:
        arrays["dq"] = np.zeros_like(arrays["q"])
    saved = set(table) == set(DEFAULT_COLUMNS) and {"torque", "name"} <= set(notes)
    if saved:
        period = notes.get("period") if period is None else period
    recording = Recording(**arrays, torque=torque, period=period, name=notes["name"] if saved else name)
    if max_gap_s is not None and not saved:
        recording = recording.split_at_gaps(max_gap_s)
    return replace(recording, dq=recording.derivative(recording.q)) if derive_dq else recording


def restarts(t: np.ndarray) -> np.ndarray | None:
    """Return the trajectories (T,) of a clock t (T,) s that starts anew for each: None where it does not.

    It goes back to where it began, and then counts on. What goes back otherwise is no restart but a disorder.
    """
    if t.ndim != 1 or not len(back := np.flatnonzero(np.diff(t) < 0) + 1):
        return None
    runs = np.diff([0, *back, len(t)])
    if runs.min() < MIN_ROWS or np.abs(t[back] - t[0]).max() > RESTART_S:
        return None
    return np.repeat(np.arange(len(runs)), runs)


def _agreed_torque(told: str | None, stored) -> str:
    """Return what the user and the file say about the torque; they must not contradict each other."""
    if not isinstance(stored, str):
        return declared_torque(told)
    if told not in (None, "", "???", declared_torque(stored)):
        raise UserError(f"the file declares torque={stored}, but data.torque={declared_torque(told)} was asked for")
    return stored


def _specs(columns: Mapping[str, Spec]) -> dict[str, Spec]:
    for key in columns:
        if key not in DEFAULT_COLUMNS:
            raise UserError(
                f"unknown key '{key}' in data.columns; allowed: {choices(DEFAULT_COLUMNS)}"
                f"{nearest(str(key), DEFAULT_COLUMNS)}"
            )
    return {field: columns.get(field) for field in DEFAULT_COLUMNS}


def _constant(value: ArrayLike | None, torque: str | None) -> np.ndarray | None:
    """Return torque constants as floats, () or (n,), or None where there are none."""
    if value is None:
        return None
    where = "data.torque_constant"
    if torque != "motor":
        raise UserError(f"{where} is for data.torque=motor, not {torque}; leave it null")
    try:
        constant = np.array(value, dtype=float)
    except (TypeError, ValueError):
        raise UserError(f"{where}: {value} is not a number of Nm/A, nor a list of one per joint") from None
    if constant.ndim > 1 or not np.all(np.isfinite(constant)) or np.any(constant == 0):
        raise UserError(f"{where}: {constant.tolist()} must be finite Nm/A, not 0: one per joint, or one for all")
    return constant


def _per_joint(constant: np.ndarray, tau: np.ndarray) -> np.ndarray:
    joints = tau.shape[-1] if tau.ndim > 1 else 1
    if constant.ndim and constant.shape != (joints,):
        raise UserError(f"data.torque_constant has {constant.size} values for {joints} joints")
    return constant


def _is_current(name: str) -> bool:
    """Whether a column's name says that it holds a current: it must not pass for a torque."""
    base = name.rsplit("/", 1)[-1].lower()
    return "current" in base or re.fullmatch(r"i(_?(\d+|\{[ij]\})|\[\d+\])?", base) is not None


def find_columns(
    table: Table, field: str, spec: Spec, torque: str = "", constant: np.ndarray | None = None
) -> list[str]:
    """Return the columns of a field; [] where an optional one is absent."""
    candidates = DEFAULT_COLUMNS[field]
    if field == "tau":
        candidates = (TAU[torque], *candidates) if constant is None else CURRENT
        named = [name for name in ([spec] if isinstance(spec, str) else spec or []) if _is_current(name)]
        if spec is None and not any(_match(table, field, name) for name in candidates):
            named = [name for name in CURRENT if _match(table, field, name)]
        if named and torque == "motor" and constant is None:
            raise UserError(
                f"column '{named[0]}' is a current: set data.torque_constant=[Nm/A of each joint, gear included]"
            )
    if spec is not None and not isinstance(spec, str):
        missing = [name for name in spec if name not in table]
        if missing or not spec:
            raise _missing(table, field, missing[0] if missing else "")
        return list(spec)
    for name in candidates if spec is None else (spec,):
        names = _match(table, field, name)
        if names:
            return names
    if field in OPTIONAL and spec in (None, *candidates):
        return []
    raise _missing(table, field, spec or candidates[0], torque)


def _match(table: Table, field: str, name: str) -> list[str]:
    """Return the columns that one name stands for."""
    if field in ("t", "trajectory"):
        return [name] if name in table else []
    if name in table and table[name].ndim > 1:
        return [name]
    if "{j}" in name or "{i}" in name:
        return _numbered(table, re.sub(r"\{[ij]\}", "{}", name), 1 if "{j}" in name else 0)
    for pattern in (name + "{}", name + "_{}", name + "[{}]"):
        names = _numbered(table, pattern, None)
        if names:
            return names
    return [name] if name in table else []


def _numbered(table: Table, pattern: str, first: int | None) -> list[str]:
    """Return the columns that `pattern` numbers without a hole, from `first` (None: 0 if there, else 1)."""
    before, _, after = pattern.partition("{}")
    hits = (re.fullmatch(re.escape(before) + r"(0|[1-9]\d*)" + re.escape(after), name) for name in table)
    numbers = sorted(int(hit[1]) for hit in hits if hit)
    if first is None:
        first = 0 if 0 in numbers else 1
    numbers = [number for number in numbers if number >= first]
    for expected, number in enumerate(numbers, start=first):
        if number != expected:
            raise UserError(
                f"column '{before}{expected}{after}' is missing, though '{before}{number}{after}' is there"
            )
    return [f"{before}{number}{after}" for number in numbers]


def _missing(table: Table, field: str, name: str, torque: str = "") -> UserError:
    """Say which column is missing; never suggest the other kind of torque as a mere typo."""
    inside = {key: key.rsplit("/", 1)[-1] for key in table}  # HDF5: what a group holds
    nested = [key for key, last in inside.items() if last == name]
    hint = f"; did you mean '{nested[0]}'?" if nested else nearest(name, table)
    for other, column in TAU.items():
        known = column in inside.values() or _match(table, field, column)
        if field == "tau" and torque and other != torque and known and not nested:
            hint = f"; {column} is {other} torque"
    in_nm = [column for column in (TAU["motor"], "tau") if _match(table, field, column)]
    if torque == "motor" and name in CURRENT and in_nm:
        hint = f"; {in_nm[0]} is torque already if it is in Nm: then leave data.torque_constant null"
    of = f" ({torque} torque)" if torque and field == "tau" else ""
    return UserError(f"no column '{name}' for {field}{of}; columns: {listed(table)}{hint} (set data.columns.{field})")


def listed(names: Iterable[str], limit: int = 40) -> str:
    """Return names for an error message, not more than `limit` of them."""
    names = list(names)
    return choices(names[:limit]) + (f", ... ({len(names)} in all)" if len(names) > limit else "")


def _vector(table: Table, names: list[str], n_joints: int | None, field: str) -> np.ndarray:
    """Return the columns as (T, n)."""
    parts = [_numbers(table, name) for name in names]
    if len(parts) > 1 and {part.shape for part in parts} != {parts[0].shape[:1]}:
        shapes = choices(f"{name} {part.shape}" for name, part in zip(names, parts, strict=True))
        raise UserError(f"the columns of {field} must each be (T,) and equally long; they are {shapes}")
    value = parts[0] if parts[0].ndim > 1 else np.stack(parts, axis=1)
    if n_joints is not None and value.ndim == 2 and value.shape[1] != n_joints:
        raise UserError(
            f"{field} has {value.shape[1]} joints ({listed(names)}), the robot has {n_joints}; "
            f"a list in data.columns.{field} picks columns"
        )
    return value


def scalar(table: Table, names: list[str]) -> np.ndarray:
    """Return the one column as (T,)."""
    if len(names) != 1:
        raise UserError(f"t and trajectory are one column each, not {len(names)}: {listed(names)}")
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
            raise UserError(f"column '{name}' is not numeric: '{text}' at row {row}") from None
    raise UserError(f"column '{name}' is not numeric: its type is {column.dtype}")


def files_of(path: str | os.PathLike) -> list[Path]:
    """Return the files of a recording: itself, or all files of a ROS 2 bag's folder."""
    path = Path(path).expanduser()
    return sorted(p for p in path.iterdir() if p.is_file()) if path.is_dir() else [path]


def load_table(path: Path, bag: Mapping[str, Any] = NO_BAG) -> Table:
    """Return all columns of the file, or raise a UserError that names it; `bag` goes to `bag_table`."""
    if not path.exists():
        if not path.parent.is_dir():
            raise UserError(f"no file {path}: there is no folder {path.parent}")
        raise UserError(f"no file {path}{nearest(path.name, (p.name for p in path.parent.iterdir()))}")
    if path.is_dir() and not is_bag(path):
        raise UserError(f"{path} is a folder; a recording is one file ({choices(SUFFIXES)}) or a ROS 2 bag's folder")
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES and not is_bag(path):
        raise UserError(
            f"{path}: unknown suffix '{path.suffix}'; allowed: {choices(SUFFIXES)}{nearest(suffix, SUFFIXES)}"
        )
    try:
        if is_bag(path):
            return bag_table(path, **bag)
        for key in ("topic", "joints"):
            if bag[key] is not None:
                raise UserError(f"data.{key}={bag[key]} is for bags ({choices(BAGS)}); leave it null for {suffix}")
        return libfranka_table(_columns(path, suffix))
    except UserError as error:
        raise UserError(f"{path}: {error}") from None
    except DAMAGED as error:
        reason = " ".join(str(error).split())[:200]
        raise UserError(f"{path} cannot be read as {suffix[1:]}: {reason}") from None


def _columns(path: Path, suffix: str) -> Table:
    if suffix in HDF5:
        return _load_hdf5(path)
    if suffix == ".npz":
        return _load_npz(path)
    frame = pd.read_csv(path, skipinitialspace=True, low_memory=False) if suffix == ".csv" else pd.read_parquet(path)
    return {str(name).strip(): _column(frame[name]) for name in frame.columns}


def _load_npz(path: Path) -> Table:
    table: Table = {}
    if not zipfile.is_zipfile(path):
        raise UserError("not an .npz archive (damaged, or not written by numpy.savez)")
    with np.load(path, allow_pickle=False) as archive:
        for name in archive.files:
            try:
                table[name] = archive[name]
            except ValueError as error:
                if "allow_pickle" not in str(error):
                    raise
                raise UserError(f"'{name}' is pickled, which is never loaded; save plain arrays") from None
    return table


def _load_hdf5(path: Path) -> Table:
    """Return every dataset by its path in the file; not the images, which no column can be."""
    try:
        import h5py
    except ImportError:
        raise missing_extra("h5py", "hdf5") from None
    table: Table = {}

    def keep(name, item):
        if isinstance(item, h5py.Dataset) and item.shape is not None and item.ndim <= 2:
            table[name] = np.asarray(item.asstr()[()] if h5py.check_string_dtype(item.dtype) else item[()])

    with h5py.File(path, "r") as file:
        file.visititems(keep)
    return table


def _column(series: pd.Series) -> np.ndarray:
    """Return a column as (T,), or as (T, n) where each cell is a list (parquet)."""
    column = series.to_numpy()
    if column.dtype == object and len(column) and isinstance(column[0], list | np.ndarray):
        return np.array(column.tolist())
    return column
