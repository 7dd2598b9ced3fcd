"""Recorded ramps of the breakaway protocol: which joint, which way, where the arm stood."""

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from r2s.errors import UserError, nearest
from r2s.files import whole
from r2s.recordings.readers import (
    DEFAULT_COLUMNS,
    Spec,
    find_columns,
    from_table,
    listed,
    load_table,
    restarts,
    scalar,
)
from r2s.recordings.recording import Recording
from r2s.recordings.robot_logs import Table

OWN = {"t", "q", "dq", "tau", "trajectory", "torque", "name", "joint", "sign", "pose"}  # what `Ramps.save` writes
UNCHANGED = 1e-3  # Nm: a command that has changed by less has not begun to rise
STARTED = 2e-3  # rad: a joint so far from its first position has let go, or is about to


@dataclass(frozen=True, eq=False)
class Ramps:
    """K recorded ramps, one trajectory of the recording each; joint, sign and pose may be one number for all.

    Attributes:
        recording: of the command; of it t, and q and tau of the joint that is ramped.
        joint: (K,) which joint, from 0. sign: (K,) 1 or -1, which way. pose: (K,) where the arm stood, from 0.

    Raises:
        UserError: the torque is not the command, or numbers that do not fit the recording.
    """

    recording: Recording
    joint: np.ndarray
    sign: np.ndarray
    pose: np.ndarray = 0  # type: ignore[assignment]

    def __post_init__(self):
        r, count = self.recording, len(self.recording.stretches)
        if r.torque != "commanded":
            raise UserError(f"ramps: torque is '{r.torque}'; allowed: commanded (a sensor hides what friction holds)")
        allowed = {"joint": range(r.n_joints), "sign": (-1, 1), "pose": range(1_000_000)}
        for field, values in allowed.items():
            told = np.asarray(getattr(self, field))
            numbers = np.full(count, told) if told.ndim == 0 else told
            if numbers.shape != (count,):
                raise UserError(f"ramps: {field} has shape {told.shape}; the recording has {count} trajectories")
            for k, number in enumerate(numbers.tolist()):
                if number not in values:
                    names = "-1 or 1" if field == "sign" else f"0 to {values[-1]}"
                    raise UserError(f"ramps: {field} of ramp {k} is {number}, allowed {names}")
            object.__setattr__(self, field, numbers.astype(np.int64))
            getattr(self, field).flags.writeable = False

    def save(self, path: str | os.PathLike) -> None:
        """Write everything to `path` (.npz, plain arrays); `readers.read` reads it as a recording, too."""
        path = Path(path)
        if path.suffix != ".npz":
            raise UserError(f"ramps are saved as .npz; '{path.name}' ends in '{path.suffix}'")
        which = {"joint": self.joint, "sign": self.sign, "pose": self.pose}
        with whole(path) as part:
            np.savez_compressed(part, **which, **self.recording.arrays())  # type: ignore[arg-type]


def read_ramps(
    path: str | os.PathLike,
    *,
    columns: Mapping[str, Spec] | None = None,
    n_joints: int | None = None,
    max_gap_s: float = 0.05,
) -> Ramps:
    """Read the ramps in `path`: what `Ramps.save` wrote, or a user's own, in any format of `readers.read`.

    Such a file has the columns of a recording of the command (t s, q rad, dq rad/s or none, tau_J_d or tau Nm), and
    `joint` (from 1) and `sign` (1 or -1), a value for each row or for each ramp. A new ramp begins where one of them
    changes, where a column trajectory or segment does, where t goes back to where it began, and after a gap.

    Args:
        path: the file.
        columns: names in the file, as in `readers.read`.
        n_joints: expected number of joints, if known.
        max_gap_s: longer gaps in time separate ramps.

    Raises:
        UserError: no such file, one that holds no ramps, or a joint or sign that its own command contradicts.
    """
    path = Path(path).expanduser()
    table = load_table(path)
    try:
        if table.keys() >= OWN and table["torque"].ndim == 0:
            return _saved(table)
        return _from_columns(table, dict(columns or {}), n_joints, max_gap_s, path.stem)
    except UserError as error:
        raise UserError(f"{path}: {error}") from None


def _saved(table: Table) -> Ramps:
    """Return what `Ramps.save` wrote."""
    t, q, dq, tau, trajectory = (table[k] for k in ("t", "q", "dq", "tau", "trajectory"))
    motion = Recording(t, q, dq, tau, str(table["torque"]), trajectory, name=str(table["name"]))
    return Ramps(motion, table["joint"], table["sign"], table["pose"])


def _from_columns(table: Table, columns: dict[str, Spec], n_joints: int | None, gap: float, name: str) -> Ramps:
    """Return the ramps of a user's columns."""
    for field in ("joint", "sign"):
        if field not in table:
            raise UserError(
                f"no column '{field}': ramps need 'joint' (from 1) and 'sign' (1 or -1), for each row or each ramp; "
                f"columns: {listed(table)}{nearest(field, table)}"
            )
    t, *told = (scalar(table, find_columns(table, "t", columns.get("t"))), table["joint"], table["sign"])
    cut = np.zeros(len(t), dtype=bool)
    marks = [
        scalar(table, found) for found in [find_columns(table, "trajectory", columns.get("trajectory"))] if found
    ]
    marks += [anew for anew in [restarts(t)] if anew is not None]
    marks += [x for x in told if x.shape == t.shape]
    for mark in marks:
        cut[1:] |= mark[1:] != mark[:-1]
    steps = np.diff(t)
    if len(steps) and np.median(steps) > gap:
        raise UserError(f"t must be in seconds; its median step is {np.median(steps):g}, a gap is {gap:g}")
    each = np.cumsum(cut)
    joint, sign = (_of_rows(field, x, each) for field, x in zip(("joint", "sign"), told, strict=True))
    cut[1:] |= steps > gap
    trajectory = np.cumsum(cut)
    rows = np.bincount(trajectory)[trajectory] > 1  # there is no motion in a single row
    table = {k: v[rows] if len(v) == len(t) else v for k, v in table.items() if v.ndim and k not in ("joint", "sign")}
    table = {k: v for k, v in table.items() if k not in DEFAULT_COLUMNS["trajectory"]}
    table["trajectory"] = np.unique(trajectory[rows], return_inverse=True)[1]
    motion = from_table(table, "commanded", columns | {"trajectory": "trajectory"}, n_joints, name=name)
    first = [s.start for s in motion.stretches]
    joint, sign = joint[rows][first], sign[rows][first]
    for k, number in enumerate(joint):
        if number not in range(1, motion.n_joints + 1):
            raise UserError(f"joint of ramp {k + 1} is {number:g}, allowed 1 to {motion.n_joints}")
    pose = [int(((joint[:k] == joint[k]) & (sign[:k] == sign[k])).sum()) for k in range(len(joint))]
    ramps = Ramps(motion, joint - 1, sign, np.array(pose))
    _check_commands(ramps)
    return ramps


def _of_rows(field: str, told: np.ndarray, each: np.ndarray) -> np.ndarray:
    """Return (T,): what is told for each row, or for each of the ramps `each` (T,) counts."""
    count = each[-1] + 1 if len(each) else 0
    if told.dtype.kind not in "iuf":
        raise UserError(f"column '{field}' is not numeric: its type is {told.dtype}")
    if told.ndim != 1 or len(told) not in (len(each), count):
        raise UserError(
            f"{field} is {told.shape}; it must have a value for each of {len(each)} rows or {count} ramps"
        )
    return told if len(told) == len(each) else told[each]


def _check_commands(ramps: Ramps) -> None:
    """Raise UserError where another command rises than that of the joint, or in the other direction."""
    r = ramps.recording
    for k, (rows, j, sign) in enumerate(zip(r.stretches, ramps.joint, ramps.sign, strict=True)):
        away = np.abs(r.q[rows, j] - r.q[rows.start, j]) > STARTED
        until = int(away.argmax()) + 1 if away.any() else len(away)  # then it may be braked
        change = r.tau[rows][:until] - r.tau[rows.start]
        up, down = (sign * change).max(0), (-sign * change).max(0)
        if up[j] > down[j] or np.maximum(up, down).max() < UNCHANGED:  # or the joint went before its command rose
            continue
        other = int(np.maximum(up, down).argmax())
        way = "other way" if other == j else f"command that changes is that of joint {other + 1}"
        raise UserError(
            f"ramp {k + 1} (from row {rows.start}) is of joint {j + 1}, sign {sign}, but its command does not "
            f"{'rise' if sign > 0 else 'fall'}: {'it goes the ' if other == j else 'the '}{way} (joints count from 1)"
        )
