"""Find the columns of t, q, dq, tau and trajectory in a file by default names, numbered names or joint names."""

import re
from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from r2s.errors import UserError, choices, instead_of, nearest
from r2s.recordings.csv_table import bare_name
from r2s.recordings.robot_logs import Table, choose_joints

Spec = str | list[str] | None
DEFAULT_COLUMNS = {  # field -> default column names; r2s uses the first name that the file has
    "t": ("t",),
    "q": ("q",),
    "dq": ("dq",),
    "tau": ("tau",),
    "trajectory": ("segment", "trajectory"),
}
TAU = {"measured": "tau_J", "commanded": "tau_J_d", "motor": "tau_motor"}  # kind of torque -> column name
NAMES = ("joint_names", "joints", "names", "name")  # names that an array of joint names may have in .npz or HDF5
CURRENT = ("current", "i")  # columns of motor current, which replace torque if the user sets a torque constant
OPTIONAL = ("dq", "trajectory")
WORDS = {  # field -> words for the field in a column name that also contains a joint name
    "q": ("q", "position", "positions", "pos", "angle"),
    "dq": ("dq", "qd", "velocity", "velocities", "vel", "speed"),
    "tau": ("tau", "effort", "efforts", "torque"),
}


def specs_of(columns: Mapping[str, Spec]) -> dict[str, Spec]:
    """Return {field: the user's column names without units}, with None for fields that the user did not name."""
    for key in columns:
        if key not in DEFAULT_COLUMNS:
            raise UserError(f"unknown key '{key}' in data.columns; {instead_of(key, DEFAULT_COLUMNS)}")
    return {x: _bare(columns.get(x)) for x in DEFAULT_COLUMNS}


def _bare(spec: Spec) -> Spec:
    """Remove units from the user's column names, because the table's column names contain no units."""
    if spec is None or isinstance(spec, str):
        return None if spec is None else bare_name(spec)[0]
    return [bare_name(str(name))[0] for name in spec]


def _is_current(name: str) -> bool:
    """Return whether a column name denotes a motor current, which must not be read as torque."""
    base = name.rsplit("/", 1)[-1].lower()
    return "current" in base or re.fullmatch(r"i(_?(\d+|\{[ij]\})|\[\d+\])?", base) is not None


def find_columns(
    table: Table,
    field: str,
    spec: Spec,
    torque: str = "",
    constant: np.ndarray | None = None,
    robot_joints: Sequence[str] | None = None,
) -> list[str]:
    """Return the names of a field's columns; [] for an optional field without columns in the file.

    Column names that contain joint names are returned in the order of `robot_joints`, the robot's joint names.
    """
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
        _check_order(list(spec), field, robot_joints or ())
        return list(spec)
    tried = candidates if spec is None else (spec,)
    for name in tried:
        if names := _match(table, field, name):
            return names
    if field in WORDS and (names := _by_joint(table, (*tried, *WORDS[field]), robot_joints or ())):
        return names
    if field in OPTIONAL and spec in (None, *candidates):
        return []
    raise _missing(table, field, spec or candidates[0], torque)


def _match(table: Table, field: str, name: str) -> list[str]:
    """Return the columns for a name such as "q": the column q itself, or the numbered columns q1, q2, ..."""
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


def _joint_of(column: str, robot_joints: Sequence[str]) -> tuple[int, str]:
    """Return the index of the joint named in a column name (-1: no joint), and the rest of the name in lower case."""
    lower = column.lower()
    cores = [re.sub(r"^joint_|_joint$", "", joint.lower()) for joint in robot_joints]
    for k in sorted(range(len(cores)), key=lambda k: -len(cores[k])):
        if len(cores[k]) > 2 and (found := re.search(rf"(?<![a-z0-9]){re.escape(cores[k])}(?![a-z0-9])", lower)):
            rest = lower[: found.start()] + " " + lower[found.end() :]
            return k, " ".join(re.sub(r"[\W_]+|\bjoints?\b", " ", rest.replace("_", " ")).split())
    return -1, lower


def _by_joint(table: Table, words: Sequence[str], robot_joints: Sequence[str]) -> list[str]:
    """Return one column per joint, with the joint and one of `words` in its name; [] if a joint has no column."""
    found: dict[str, dict[int, str]] = {}
    for column in table:
        joint, rest = _joint_of(column, robot_joints)
        if joint >= 0:
            found.setdefault(rest, {})[joint] = column
    for word in words:
        columns = found.get(" ".join(re.sub(r"[\W_]+", " ", word.lower()).split()), {})
        if robot_joints and len(columns) == len(robot_joints):
            return [columns[j] for j in range(len(robot_joints))]
    return []


def _check_order(names: list[str], field: str, robot_joints: Sequence[str]) -> None:
    """Raise UserError if the user's columns name all the robot's joints, but not in the robot's order."""
    joints = [_joint_of(name, robot_joints)[0] for name in names]
    every = list(range(len(robot_joints)))
    if every and joints != every and sorted(joints) == every:
        right = choices(f"'{names[joints.index(j)]}'" for j in every)
        raise UserError(
            f"data.columns.{field} has the robot's joints in another order: by their names it is [{right}], got "
            f"{choices(names)}"
        )


def by_names(table: Table, user: Sequence[str] | None, robot_joints: Sequence[str] | None, n: int | None) -> Table:
    """Select and order the columns of (T, m) arrays by the robot's joint names; return the changed table.

    Args:
        table: {column name: array}. The first text array with a name in NAMES contains the file's joint names (m,).
        user: the user's joint names, data.joints. robot_joints, n: names and number of the robot's joints.

    Raises:
        UserError: `user` names joints but the file contains no joint names, or the file lacks a joint.
    """
    key = next((k for k in NAMES if k in table and table[k].ndim == 1 and table[k].dtype.kind in "USO"), None)
    if key is None:
        if user is not None:
            raise UserError(
                f"data.joints: expected null, as the file names no joints (it has no {choices(NAMES)}), got "
                f"{choices(user)}"
            )
        return table
    logged = [x.decode() if isinstance(x, bytes) else str(x) for x in table[key]]
    joints = choose_joints(logged, user, robot_joints, n)
    if joints == logged or len(set(logged)) < len(logged):
        return table
    order = [logged.index(joint) for joint in joints]
    return {k: x[:, order] if x.ndim == 2 and x.shape[1] == len(logged) else x for k, x in table.items()}


def _numbered(table: Table, pattern: str, first: int | None) -> list[str]:
    """Return the columns q1, q2, ... for pattern "q{}" and first=1; first=None: begin at q0 if present, else q1."""
    before, _, after = pattern.partition("{}")
    hits = (re.fullmatch(re.escape(before) + r"(0|[1-9]\d*)" + re.escape(after), name) for name in table)
    numbers = sorted(int(hit[1]) for hit in hits if hit)
    if first is None:
        first = 0 if 0 in numbers else 1
    numbers = [number for number in numbers if number >= first]
    for expected, number in enumerate(numbers, start=first):
        if number != expected:
            raise UserError(f"expected column '{before}{expected}{after}' before '{before}{number}{after}'")
    return [f"{before}{number}{after}" for number in numbers]


def _missing(table: Table, field: str, name: str, torque: str = "") -> UserError:
    """Return the error for a missing column; a hint names a similar column or another kind of torque in the file."""
    if field == "tau" and _match(table, "q", "ddq"):
        return UserError(
            "no torque, but ddq: this is a planned motion; let the arm follow it, and give the arm's own log"
        )
    inside = {key: key.rsplit("/", 1)[-1] for key in table}  # in HDF5: the last part of the path
    nested = [key for key, last in inside.items() if last == name]
    hint = f"; did you mean '{nested[0]}'?" if nested else nearest(name, table)
    for other, column in TAU.items():
        known = column in inside.values() or _match(table, field, column)
        if field == "tau" and torque and other != torque and known and not nested:
            hint = f"; {column} is {other} torque"
    in_nm = [column for column in (TAU["motor"], "tau") if _match(table, field, column)]
    if torque == "motor" and name in CURRENT and in_nm:
        hint = f"; if {in_nm[0]} is in Nm, leave data.torque_constant null"
    of = f" ({torque} torque)" if torque and field == "tau" else ""
    return UserError(f"no column '{name}' for {field}{of}; columns: {listed(table)}{hint} (set data.columns.{field})")


def listed(names: Iterable[str], limit: int = 40) -> str:
    """Return names as text for an error message, at most `limit` of them."""
    names = list(names)
    return choices(names[:limit]) + (f", ... ({len(names)} in all)" if len(names) > limit else "")
