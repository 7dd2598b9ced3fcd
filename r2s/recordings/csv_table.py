"""Read CSV files with the separators, comments, units and decimal commas of spreadsheets, NumPy, ROS and vendors."""

import csv
import re
from pathlib import Path

import numpy as np
import pandas as pd

from r2s.errors import UserError

HEAD = 1 << 16  # bytes at the start of the file that must contain the header
MARKS = "#%"  # characters that begin a comment line, or the header (NumPy, rostopic echo -p)
UNITS = {
    "rad": 1.0, "deg": np.pi / 180, "degree": np.pi / 180, "degrees": np.pi / 180, "°": np.pi / 180, "mrad": 1e-3,
    "rad/s": 1.0, "deg/s": np.pi / 180, "°/s": np.pi / 180, "mrad/s": 1e-3, "rpm": np.pi / 30,
    "nm": 1.0, "n*m": 1.0, "n.m": 1.0, "n·m": 1.0, "n m": 1.0, "mnm": 1e-3, "knm": 1e3, "a": 1.0, "ma": 1e-3,
    "s": 1.0, "sec": 1.0, "seconds": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9,
}  # fmt: skip
EXAMPLE = "t,q1,q2,...,dq1,dq2,...,tau1,tau2,..."


def read_csv(path: Path) -> dict[str, np.ndarray]:
    """Return the columns of a CSV file by name, (T,) each.

    The header is the line above the first numeric line and may begin with `#` or `%`; earlier lines are skipped.

    Raises:
        UserError: the file has no header, or header and rows have different numbers of cells.
    """
    head = path.read_bytes()[:HEAD]
    encoding = _encoding(head)
    lines = [line.strip("\r ") for line in head.decode(encoding, errors="replace").split("\n")]
    lines = lines[:-1] if len(head) == HEAD else lines
    filled = [k for k, line in enumerate(lines) if line.strip()]
    if not filled:
        raise UserError("cannot be read as csv: No columns to parse from file")
    plain = [k for k in filled if lines[k].lstrip()[0] not in MARKS]
    first: int | None = next((k for k in plain if _is_numeric(lines[k])), None)
    if first is None:  # no line is numeric, because a column is text: the header is the first line
        title = plain[0] if plain and plain[0] == filled[0] else filled[0]
        first = next((k for k in filled if k > title), title + 1)
    above = [k for k in filled if k < first]
    if not above:
        raise UserError(f"the first line holds numbers, no names; put a header before it, such as {EXAMPLE}")
    top, row = lines[above[-1]].lstrip(MARKS + " "), lines[first] if first < len(lines) else ""
    separator = _separator(row or top)
    width = len(_split(row, separator)) if row.strip() else len(_split(top, separator))
    names = next((x for x in (_split(top, s) for s in (separator, _separator(top))) if len(x) == width), [])
    names = names or _split(top, separator)
    if width == len(names) + 1 and row.rstrip().endswith(separator or "\0"):
        names.append("")  # a separator at the end of each row
    if len(names) != width:
        raise UserError(f"the header has {len(names)} names and the first row {width} values: '{top[:60]}'")
    frame = pd.read_csv(
        path, sep=separator or r"\s+", header=None, names=range(width), skiprows=first, index_col=False,
        comment="#", skipinitialspace=True, low_memory=False, encoding=encoding,
        decimal="," if separator != "," and re.search(r"\d,\d", row) else ".",
    )  # fmt: skip
    table: dict[str, np.ndarray] = {}
    for k, name in enumerate(x.strip() for x in names):
        if name:  # a repeated name gets a number
            table[name if name not in table else f"{name}.{k}"] = _numbers(frame[k]).to_numpy()
    return table


def _numbers(column: pd.Series) -> pd.Series:
    """Convert a column to numbers if its only text is a truncated last cell, such as "-" or "1.2e"."""
    text = column.dtype.kind not in "iufb" and len(column) > 1
    if not text or not re.fullmatch(r"[+-]?[\d.]*(e[+-]?)?", str(column.iloc[-1])):
        return column
    numbers = pd.to_numeric(column, errors="coerce")
    return numbers if numbers[:-1].notna().all() else column


def without_units(table: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the table in SI units; remove the units from names such as `q1 [deg]` or `t (ms)`."""
    out = {}
    for name, column in table.items():
        bare, factor = bare_name(name)
        convert = factor != 1.0 and column.dtype.kind in "iuf"
        out[bare if bare == name or bare not in table else name] = column * factor if convert else column
    return out


def bare_name(name: str) -> tuple[str, float]:
    """Split a column name such as `q1 [deg]` into the name without unit, and the factor from the unit to SI units."""
    found = re.fullmatch(r"(.*?)\s*[\[(]([^\])]*)[\])]", name)
    unit = found[2].strip().lower() if found else ""
    if not found or unit not in UNITS or (unit in ("a", "ma") and not found[1].lower().startswith(("i", "current"))):
        return name, 1.0  # keep the unit of `tau1 [A]`: this column is a current
    return found[1], UNITS[unit]


def _encoding(head: bytes) -> str:
    if head[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return "utf-16"
    try:
        head[: head.rfind(b"\n") + 1].decode("utf-8-sig")
    except UnicodeDecodeError:
        return "latin-1"  # for example, a German spreadsheet with a degree sign
    return "utf-8-sig"


def _separator(line: str) -> str:
    """Return a line's separator: the first of semicolon, tab and comma that the line contains, or "" for spaces."""
    return next((mark for mark in ";\t," if mark in line), "")  # in lines with semicolons or tabs, commas are decimal


def _split(line: str, separator: str) -> list[str]:
    return next(csv.reader([line], delimiter=separator, skipinitialspace=True)) if separator else line.split()


def _is_numeric(line: str) -> bool:
    """Return whether all fields of a line are numbers or empty, and at least two are numbers."""
    fields = [x.strip() for x in _split(line, _separator(line))]
    numbers = 0
    for x in fields:
        try:
            float(x.replace(",", "."))
            numbers += 1
        except ValueError:
            if x:
                return False
    return numbers >= 2
