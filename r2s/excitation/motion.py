"""A reference motion at 1 kHz and its file format."""

import os
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from r2s.errors import UserError, choices, nearest, nearest_file
from r2s.excitation.motion_checks import TABLE_M, TOOL_M, check_motion
from r2s.files import atomic_write
from r2s.physics.robot import Robot


@dataclass(frozen=True)
class Excitation:
    """A reference motion at 1 kHz that begins and ends at rest: t (T,) s; q, dq, ddq (T, n) rad, rad/s, rad/s^2."""

    t: np.ndarray
    q: np.ndarray
    dq: np.ndarray
    ddq: np.ndarray

    def save(self, path: str | os.PathLike) -> None:
        """Write `path` (.csv): t, q1.., dq1.., ddq1.. in SI units, one row per ms."""
        path = Path(path)
        if path.suffix != ".csv":
            raise UserError(f"expected a file name ending in .csv, got '{path.name}'")
        table = np.column_stack([self.t, self.q, self.dq, self.ddq])
        header = ",".join(_columns(self.q.shape[1]))
        with atomic_write(path) as part:
            np.savetxt(part, table, fmt="%.12g", delimiter=",", header=header, comments="")


def load(path: str | os.PathLike, robot: Robot, *, table: float = TABLE_M, z_min: float = TOOL_M) -> Excitation:
    """Read an excitation in the format of `Excitation.save`, and check the motion for this robot.

    Raises:
        UserError: the file is missing or has another format, or the motion fails `motion_checks.check_motion`.
    """
    path = Path(path)
    if not path.is_file():
        raise UserError(f"data.excitation: no such file: {path}{nearest_file(path, '*.csv')}")
    try:
        with open(path, encoding="utf-8") as file:
            header = [name.strip() for name in file.readline().split(",")]
            with warnings.catch_warnings(action="ignore"):  # NumPy warns about a file without rows
                rows = np.loadtxt(file, delimiter=",", ndmin=2)
    except ValueError as error:  # UnicodeDecodeError is a ValueError too
        raise UserError(f"data.excitation: {path} is not a table of numbers: {str(error).splitlines()[0]}") from None
    expected, n = _columns(robot.n), robot.n
    for name in expected:
        if name not in header:
            others = [h for h in header if h not in expected]
            raise UserError(
                f"data.excitation: expected the columns t, q1..q{n}, dq1..dq{n}, ddq1..ddq{n}, got no '{name}' in "
                f"{path}; it has {choices(header[:30])}{nearest(name, others)}"
            )
    if f"q{n + 1}" in header:
        raise UserError(f"data.excitation: expected {n} joints, as {robot.name} has, got joint {n + 1} in {path}")
    if not rows.size:
        raise UserError(f"data.excitation: {path} has 0 rows")
    if rows.shape[1] != len(header):
        raise UserError(f"data.excitation: expected {len(header)} columns, got {rows.shape[1]} in {path}")
    columns = rows[:, [header.index(name) for name in expected]]
    e = Excitation(columns[:, 0], *np.split(columns[:, 1:], 3, axis=1))
    try:
        check_motion(robot, e, table=table, z_min=z_min)
    except UserError as error:
        raise UserError(f"{path}: {error}") from None
    return e


def _columns(n: int) -> list[str]:
    return ["t", *(f"{x}{j + 1}" for x in ("q", "dq", "ddq") for j in range(n))]
