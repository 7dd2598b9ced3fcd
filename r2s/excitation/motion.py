"""A reference motion on the arm's clock, and its file."""

import os
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from r2s.errors import UserError, choices, nearest
from r2s.excitation.safety import (
    TABLE_M,
    TOOL_M,
    check_motion,
)
from r2s.files import whole
from r2s.physics.robot import Robot


@dataclass(frozen=True)
class Excitation:
    """A reference motion on a uniform clock, at rest at both ends.

    Attributes:
        t: (T,) s from 0. q, dq, ddq: (T, n) rad, rad/s, rad/s^2.

    """

    t: np.ndarray
    q: np.ndarray
    dq: np.ndarray
    ddq: np.ndarray

    def save(self, path: str | os.PathLike) -> None:
        """Write `path` (.csv): t, q1.., dq1.., ddq1.., SI units, one row per ms; any controller can replay it."""
        path = Path(path)
        if path.suffix != ".csv":
            raise UserError(f"an excitation is saved as .csv; '{path.name}' ends in '{path.suffix}'")
        table = np.column_stack([self.t, self.q, self.dq, self.ddq])
        header = ",".join(_columns(self.q.shape[1]))
        with whole(path) as part:
            np.savetxt(part, table, fmt="%.12g", delimiter=",", header=header, comments="")


def load(path: str | os.PathLike, robot: Robot, *, table: float = TABLE_M, z_min: float = TOOL_M) -> Excitation:
    """Return the excitation of a file that `Excitation.save` wrote, or one like it, checked for this robot.

    Raises:
        UserError: no such file, not such a file, or a motion that `motion_checks.check_motion` forbids.

    """
    path = Path(path)
    if not path.is_file():
        others = [p.name for p in path.parent.glob("*.csv")] if path.parent.is_dir() else []
        raise UserError(f"data.excitation: no such file: {path}{nearest(path.name, others)}")
    try:
        with open(path, encoding="utf-8") as file:
            header = [name.strip() for name in file.readline().split(",")]
            with warnings.catch_warnings(action="ignore"):  # of no rows
                rows = np.loadtxt(file, delimiter=",", ndmin=2)
    except ValueError as error:  # also what is no text
        raise UserError(f"data.excitation: {path} is not a table of numbers: {str(error).splitlines()[0]}") from None
    wanted = _columns(robot.n)
    for name in wanted:
        if name not in header:
            strange = [h for h in header if h not in wanted]
            raise UserError(
                f"data.excitation: {path} has no column '{name}'; for {robot.name} it must have t, q1..q{robot.n}, "
                f"dq1..dq{robot.n}, ddq1..ddq{robot.n}; it has {choices(header[:30])}{nearest(name, strange)}"
            )
    if f"q{robot.n + 1}" in header:
        raise UserError(f"data.excitation: {path} moves joint {robot.n + 1}; {robot.name} has {robot.n} joints")
    if not rows.size:
        raise UserError(f"data.excitation: {path} has 0 rows")
    if rows.shape[1] != len(header):
        raise UserError(f"data.excitation: {path} has {len(header)} names but {rows.shape[1]} columns")
    columns = rows[:, [header.index(name) for name in wanted]]
    e = Excitation(columns[:, 0], *np.split(columns[:, 1:], 3, axis=1))
    try:
        check_motion(robot, e, table=table, z_min=z_min)
    except UserError as error:
        raise UserError(f"{path}: {error}") from None
    return e


def _columns(n: int) -> list[str]:
    return ["t", *(f"{x}{j + 1}" for x in ("q", "dq", "ddq") for j in range(n))]
