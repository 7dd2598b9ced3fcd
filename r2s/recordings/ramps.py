"""Read and save recorded torque ramps of the breakaway protocol, each with joint, direction and posture."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from r2s.errors import UserError, nearest
from r2s.recordings import readers
from r2s.recordings.columns import DEFAULT_COLUMNS, NAMES, Spec, by_names, find_columns, listed
from r2s.recordings.gaps import longest_step
from r2s.recordings.readers import Options, scalar
from r2s.recordings.recording import FIELDS, Recording, save_npz
from r2s.recordings.robot_logs import Table

OWN = {*FIELDS, "torque", "name", "joint", "sign", "pose"}  # arrays that `Ramps.save` writes
MIN_RISE = 1e-3  # Nm; a command that changes by less is treated as constant
BREAKAWAY = 2e-3  # rad; a joint that has moved this far has broken away or soon will


@dataclass(frozen=True, eq=False)
class Ramps:
    """Recorded torque ramps, one in each of the recording's K trajectories.

    Attributes:
        recording: motion with commanded torque; identification uses t, and the ramped joint's q and tau.
        joint: ramped joint, from 0. sign: direction, 1 or -1. pose: posture index, from 0. `joint`, `sign` and `pose`
            have K values; a single value applies to all ramps.

    Raises:
        UserError: the torque is not commanded, or `joint`, `sign` or `pose` has a wrong shape or value.
    """

    recording: Recording
    joint: np.ndarray
    sign: np.ndarray
    pose: np.ndarray = 0  # type: ignore[assignment]

    def __post_init__(self):
        r, count = self.recording, len(self.recording.stretches)
        if r.torque != "commanded":
            raise UserError(f"ramps: expected torque=commanded (a sensor does not show stiction), got {r.torque}")
        allowed = {"joint": range(r.n_joints), "sign": (-1, 1), "pose": range(1_000_000)}
        for field, values in allowed.items():
            given = np.asarray(getattr(self, field))
            numbers = np.full(count, given) if given.ndim == 0 else given
            if numbers.shape != (count,):
                raise UserError(f"ramps: expected {count} values of {field}, one per trajectory, got {given.shape}")
            for k, number in enumerate(numbers.tolist()):
                if number not in values:
                    names = "-1 or 1" if field == "sign" else f"0 to {values[-1]}"
                    raise UserError(f"ramps: expected {field} {names}, got {number} (ramp {k})")
            object.__setattr__(self, field, numbers.astype(np.int64))
            getattr(self, field).flags.writeable = False

    def save(self, path: str | os.PathLike) -> None:
        """Write the ramps to `path` (.npz); `readers.read` reads such a file as a recording."""
        numbers = {"joint": self.joint, "sign": self.sign, "pose": self.pose}
        save_npz(path, numbers | self.recording.arrays())


def read_ramps(
    path: str | os.PathLike,
    *,
    columns: Mapping[str, Spec] | None = None,
    n_joints: int | None = None,
    max_gap_s: float | None = None,
    joints: Sequence[str] | None = None,
    model_joints: Sequence[str] | None = None,
    limits: tuple[np.ndarray, np.ndarray] | None = None,
) -> Ramps:
    """Read ramps from a file that `Ramps.save` wrote, or from a log in any format of `readers.read`.

    A log needs the columns t (s), q (rad) and tau_J_d or tau (commanded torque, Nm); dq (rad/s) is optional. The log
    also needs `joint` (from 1, in the robot's order) and `sign` (1 or -1), with a value per row or per ramp. A new
    ramp begins where the value of `joint`, `sign`, `trajectory` or `segment` changes, where t restarts, and after a
    gap in t.

    Args:
        path: file of ramps.
        columns: {field: column name} of a log, see `readers.read`.
        n_joints: expected number of joints.
        max_gap_s: s, limit on the time step within a ramp; if None, the result of `longest_step` is the limit.
        joints: names of the joints in the log. model_joints, limits: names and position limits of the robot's joints.
            See `readers.read`.

    Raises:
        UserError: the file is missing or contains no ramps, or a joint or sign contradicts the command.
    """
    path = Path(path).expanduser()
    table = readers.load_table(path)
    try:
        if table.keys() >= OWN and table["torque"].ndim == 0:
            return _saved(table)
        table = by_names(table, joints if table.keys() & set(NAMES) else None, model_joints, n_joints)
        how = Options("commanded", dict(columns or {}), n_joints, max_gap_s, name=path.stem, repair=False)
        return _from_columns(table, replace(how, robot_joints=model_joints, limits=limits))
    except UserError as error:
        raise UserError(f"{path}: {error}") from None


def _saved(table: Table) -> Ramps:
    """Return the ramps in the table of a file that `Ramps.save` wrote."""
    t, q, dq, tau, trajectory = (table[k] for k in FIELDS)
    notes = readers.notes_of(table)
    motion = Recording(t, q, dq, tau, str(table["torque"]), trajectory, name=str(table["name"]), notes=notes)
    return Ramps(motion, table["joint"], table["sign"], table["pose"])


def _from_columns(table: Table, how: Options) -> Ramps:
    """Return the ramps in the columns of a log."""
    columns = how.columns
    for field in ("joint", "sign"):
        if field not in table:
            raise UserError(
                f"no column '{field}': ramps need 'joint' (from 1) and 'sign' (1 or -1), per row or per ramp; "
                f"columns: {listed(table)}{nearest(field, table)}"
            )
    t = scalar(table, find_columns(table, "t", columns.get("t")))
    found = find_columns(table, "trajectory", columns.get("trajectory"))
    marks = [scalar(table, found)] if found else []
    if (index := readers.restart_index(t)) is not None:
        marks.append(index)
    marks += [x for x in (table["joint"], table["sign"]) if x.shape == t.shape]
    cut = np.zeros(len(t), dtype=bool)
    for mark in marks:
        cut[1:] |= mark[1:] != mark[:-1]
    steps = np.diff(t)
    longest = longest_step(steps, how.max_gap_s)
    ramp = np.cumsum(cut)
    joint, sign = (_per_row(field, table[field], ramp) for field in ("joint", "sign"))
    cut[1:] |= steps > longest
    trajectory = np.cumsum(cut)
    rows = np.bincount(trajectory)[trajectory] > 1  # a single row has no motion
    dropped = ("joint", "sign", *DEFAULT_COLUMNS["trajectory"])
    noted = {k: v for k, v in table.items() if k == "reader_note"}
    table = {k: v[rows] if len(v) == len(t) else v for k, v in table.items() if v.ndim and k not in dropped} | noted
    table["trajectory"] = np.unique(trajectory[rows], return_inverse=True)[1]
    columns = dict(columns) | {"trajectory": "trajectory"}
    motion = readers.from_table(table, replace(how, columns=columns, max_gap_s=np.inf))
    first = [s.start for s in motion.stretches]
    joint, sign = joint[rows][first], sign[rows][first]
    for k, number in enumerate(joint):
        if number not in range(1, motion.n_joints + 1):
            raise UserError(f"expected joint 1 to {motion.n_joints}, got {number:g} (ramp {k + 1})")
    pose = [int(((joint[:k] == joint[k]) & (sign[:k] == sign[k])).sum()) for k in range(len(joint))]
    ramps = Ramps(motion, joint - 1, sign, np.array(pose))
    _check_commands(ramps)
    return ramps


def _per_row(field: str, values: np.ndarray, ramp: np.ndarray) -> np.ndarray:
    """Expand `values` (one per ramp or per row) to one value per row (T,); `ramp` (T,): ramp index of each row."""
    count = ramp[-1] + 1 if len(ramp) else 0
    if values.dtype.kind not in "iuf":
        raise UserError(f"column '{field}': expected numbers, got type {values.dtype}")
    if values.ndim != 1 or len(values) not in (len(ramp), count):
        raise UserError(f"{field}: expected {len(ramp)} values (rows) or {count} (ramps), got {values.shape}")
    return values if len(values) == len(ramp) else values[ramp]


def _check_commands(ramps: Ramps) -> None:
    """Raise UserError if the commands of a ramp contradict its joint or sign.

    Until breakaway, the ramped joint's command must change more along `sign` than against it. Constant commands of
    all joints are also allowed, because a joint may move before its ramp begins.
    """
    r = ramps.recording
    for k, (rows, j, sign) in enumerate(zip(r.stretches, ramps.joint, ramps.sign, strict=True)):
        moved = np.abs(r.q[rows, j] - r.q[rows.start, j]) > BREAKAWAY
        until = int(moved.argmax()) + 1 if moved.any() else len(moved)  # after breakaway the arm may brake
        change = r.tau[rows][:until] - r.tau[rows.start]
        up, down = (sign * change).max(0), (-sign * change).max(0)
        if up[j] > down[j] or np.maximum(up, down).max() < MIN_RISE:  # constant if the joint moved before the ramp
            continue
        other = int(np.maximum(up, down).argmax())
        got = "the opposite" if other == j else f"a change of joint {other + 1}"
        raise UserError(
            f"ramp {k + 1} (from row {rows.start}): expected a {'rising' if sign > 0 else 'falling'} command of "
            f"joint {j + 1}, got {got} (joints count from 1)"
        )
