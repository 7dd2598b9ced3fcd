"""Convert robot logs (ROS bags, MCAP, CSV of libfranka or rostopic) to tables of t, q, dq and tau for `readers`."""

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from r2s.errors import UserError, choices, nearest, optional_import

Table = dict[str, np.ndarray]  # column name -> (T,) or (T, n)
Layouts = dict[tuple[str, ...], list[int] | None]  # names in a message -> indices of the robot's joints; None: all

BAGS = (".bag", ".db3", ".mcap")
TYPES = ("JointState", "FrankaRobotState", "FrankaState")  # message types of sensor_msgs and franka_msgs
CYCLE = 1e-3  # s, control cycle of a Franka arm
MAX_LATENESS_NS = 10**9  # ns, largest delay of a network message; a larger step back is a clock restart


def is_bag(path: Path) -> bool:
    """Return whether `path` is a bag: a file with a bag's suffix, or a folder with metadata.yaml (ROS 2)."""
    return (path / "metadata.yaml").is_file() if path.is_dir() else path.suffix.lower() in BAGS


def libfranka_table(table: Table) -> Table:
    """Add t (T,) s and q, dq, tau_J, tau_J_d (T, 7) to a log of `franka::logToCSV`; return any other table unchanged.

    libfranka (src/log.cpp) logs `time` in whole ms, and measured torque as `state.tau_J`. A row has the state of
    cycle k + 1, but the command `cmd.tau_J_d` of cycle k; `shift_command` corrects this offset of one cycle.
    """
    if not {"time", "success_rate", "state.q[0]"} <= table.keys():
        return table
    time = table["time"]
    numeric = time.dtype.kind in "iuf"  # text is not converted: `readers` raises an error with the column's name
    t = time * CYCLE if numeric else time
    found = {"t": t}
    for field, name in (("q", "state.q"), ("dq", "state.dq"), ("tau_J", "state.tau_J"), ("tau_J_d", "cmd.tau_J_d")):
        columns = [table.get(f"{name}[{i}]") for i in range(7)]
        if all(column is not None for column in columns):
            found[field] = np.stack(columns, axis=1)  # type: ignore[arg-type]
    if "tau_J_d" in found and numeric and found["tau_J_d"].dtype.kind in "iuf":
        found["tau_J_d"] = shift_command(t, found["tau_J_d"])
    return found | table


def rostopic_table(table: Table) -> Table:
    """Add t, q, dq, tau and joint_names to a JointState log of `rostopic echo -p`; return any other table unchanged.

    `rostopic echo -p` writes stamps in ns, and joint names as columns `field.name0` ..., in the driver's order.
    """
    fields = {"q": "field.position", "dq": "field.velocity", "tau": "field.effort"}
    stamp = table.get("field.header.stamp")
    if stamp is None or stamp.dtype.kind not in "iuf" or "field.position0" not in table:
        return table
    found = {"t": (stamp - stamp[0]) * 1e-9}
    for field, name in fields.items():
        columns = [table[k] for k in sorted((k for k in table if re.fullmatch(name + r"\d+", k)), key=_last_number)]
        if columns and all(column.dtype.kind in "iuf" for column in columns):
            found[field] = np.stack(columns, axis=1)
    names = [table[k] for k in sorted((k for k in table if re.fullmatch(r"field\.name\d+", k)), key=_last_number)]
    if names and all((column == column[0]).all() for column in names):
        found["joint_names"] = np.array([str(column[0]) for column in names])
    return found | table


def _last_number(name: str) -> int:
    return int(re.findall(r"\d+", name)[-1])


def shift_command(t: np.ndarray, tau_J_d: np.ndarray) -> np.ndarray:
    """Shift the logged tau_J_d (T, n) Nm by one cycle, so that each state is paired with the next command.

    A Franka state at t (T,) s contains the command of the previous cycle, but a `Recording` (`r2s.arm.recorder`)
    pairs a state with the next command. If the log's time step is longer than a control cycle, the shifted commands
    are interpolated. The last command is not shifted, because the log contains no later command.
    """
    return np.stack([np.interp(t + CYCLE, t, column) for column in tau_J_d.T], axis=1)


class Sample(NamedTuple):
    """A message: header stamp and bag time in ns, joint names (() if its type has no names), {field: values (n,)}."""

    stamp: int
    received: int
    names: tuple[str, ...]
    values: dict[str, np.ndarray]


def bag_table(
    path: Path,
    *,
    topic: str | None = None,
    joints: Sequence[str] | None = None,
    model_joints: Sequence[str] | None = None,
    n_joints: int | None = None,
) -> Table:
    """Return t (T,) s and q, dq, tau (or tau_J and tau_J_d) (T, n) from one topic of a bag.

    t starts at 0 and comes from the header stamps, or from bag time if all stamps are 0. Messages without all joints
    of the robot, such as messages of a gripper, are ignored. Messages are sorted by time, and repeated messages are
    dropped. The entry `reader_note` states how many messages were omitted: those with stamp 0, and those before the
    first complete message.

    Args:
        path: .bag (ROS 1), .db3 or .mcap file, or the folder of a ROS 2 bag.
        topic: topic of type JointState, FrankaState or FrankaRobotState; if None, the only topic of these types.
        joints, model_joints, n_joints: see `choose_joints`.

    Raises:
        UserError: rosbags is not installed, the bag is damaged, or topic, joints or torque are missing.
    """
    topic, samples = _read(path, topic)
    kept, pick = _pick_joints(topic, samples, joints, model_joints, n_joints)
    table = {field: _stack(topic, kept, field, pick) for field in kept[0].values}
    table = {field: x for field, x in table.items() if x.size and not np.isnan(x).all()}  # ROS 2: NaN means absent
    if "q" not in table or not {"tau", "tau_J", "tau_J_d"} & table.keys():
        missing = "position" if "q" not in table else "effort"
        raise UserError(f"expected position and effort in the messages on '{topic}', got no {missing}")
    stamp = np.array([s.stamp for s in kept])
    if not stamp.any():
        stamp = np.array([s.received for s in kept])
    use, notes = stamp != 0, []  # drivers may send messages before they know the time
    if not use.all():
        notes.append(f"{int((~use).sum())} messages with stamp 0 are left out")
    valued = ~np.any([np.isnan(x).any(axis=1) for x in table.values()], axis=0)
    if valued.any() and (early := int(np.argmax(valued & use))) > (begin := int(np.argmax(use))):
        notes.append(f"the first {early - begin} messages lack values and are left out")
        use[:early] = False
    stamp, table = _in_order(stamp[use], {field: x[use] for field, x in table.items()})
    if notes:
        table["reader_note"] = np.array("; ".join(notes))
    table["t"] = (stamp - stamp[0]) * 1e-9  # integer difference: a float of seconds since 1970 resolves only 0.2 us
    if "tau_J_d" in table:
        table["tau_J_d"] = shift_command(table["t"], table["tau_J_d"])
    return table


def choose_joints(
    logged: Sequence[str], joints: Sequence[str] | None, model_joints: Sequence[str] | None, n: int | None
) -> list[str]:
    """Return the robot's joints among the names in a log, in the robot's order.

    Logs may order joints differently: some ROS 2 drivers sort joints by name. The function uses the first applicable
    rule. Rule 1: `joints`. Rule 2: `model_joints`, if each name occurs once, perhaps with a prefix as in
    panda_joint1. Rule 3: n names that differ only in a number, sorted by this number. Rule 4: the first n names, if n
    is 1 or `model_joints` is empty.

    Args:
        logged: joint names in the log.
        joints: joint names set by the user, in the robot's order.
        model_joints: joint names in the robot description.
        n: number of joints of the robot.
    """
    names = choices(logged)
    if joints is not None:
        for name in joints:
            if name not in logged:
                raise UserError(f"no joint '{name}'; joints: {names}{nearest(name, logged)} (set data.joints)")
        distinct = len(set(joints))
        if not distinct or distinct < len(joints) or (n is not None and distinct != n):
            expected = n or max(len(joints), 1)
            raise UserError(f"data.joints: expected {expected} different names, got {choices(joints) or 'none'}")
        return list(joints)
    if n is not None and len(logged) < n:
        raise UserError(f"expected {n} joints, got {len(logged)} ({names})")
    n = len(logged) if n is None else n
    found = [
        [x for x in logged if x == m] or [x for x in logged if x.endswith(("_" + m, "/" + m))]
        for m in model_joints or ()
    ]
    if found and all(len(same) == 1 for same in found) and len({same[0] for same in found}) == n:
        return [same[0] for same in found]
    numbered: dict[str, list[str]] = {}
    for name in logged:
        numbered.setdefault(re.sub(r"\d+(?=\D*$)", "#", name), []).append(name)
    arms = [same for pattern, same in numbered.items() if "#" in pattern and len(same) == n]
    if len(arms) > 1:
        raise UserError(f"several arms of {n} joints: {names}; choose with data.joints=[...]")
    if arms:
        return sorted(arms[0], key=lambda name: int(re.findall(r"\d+", name)[-1]))
    if model_joints and n > 1:
        raise UserError(
            f"expected the joints {choices(model_joints)}, got {names}; name them in order: data.joints=[...]"
        )
    return list(logged[:n])


def _read(path: Path, topic: str | None) -> tuple[str, list[Sample]]:
    """Read `topic`, or the only readable topic if `topic` is None; return the topic's name and messages."""
    rosbag1, rosbag2 = (optional_import(f"rosbags.rosbag{k}", "reading this file", "recordings") for k in (1, 2))
    try:
        # only this topic is decoded: other topics may have unknown message types
        ros1 = path.is_file() and path.suffix.lower() == ".bag"
        with (rosbag1 if ros1 else rosbag2).Reader(path) as reader:
            topic, connections = _pick_topic(reader.connections, topic)
            samples = list(_samples(reader, connections, ros1))
    except UserError:
        raise
    except Exception as error:  # rosbags raises many kinds of error for a damaged file
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        repair = "rosbag reindex, ros2 bag reindex or mcap recover may repair a truncated one"
        raise UserError(f"cannot be read as a bag: {reason} ({repair})") from None
    if not samples:
        raise UserError(f"no message on '{topic}'")
    return topic, samples


def _pick_topic(connections: Sequence[Any], topic: str | None) -> tuple[str, list[Any]]:
    """Return the topic to read, with its connections; if `topic` is None, choose the only readable topic."""
    types = {c.topic: c.msgtype.replace("/msg/", "/") for c in connections}
    readable = [t for t, kind in types.items() if kind.rsplit("/")[-1] in TYPES]
    listed = choices(f"{t} ({kind})" for t, kind in types.items()) or "none"
    if topic is None:
        if not readable:
            raise UserError(f"no topic of type {choices(TYPES)}; topics: {listed}")
        if len(readable) > 1:
            listed = choices(f"{t} ({types[t]})" for t in readable)
            raise UserError(f"several topics hold joint states: {listed}; choose with data.topic=...")
        topic = readable[0]
    elif topic not in types:
        raise UserError(f"no topic '{topic}'; topics: {listed}{nearest(topic, types)} (set data.topic)")
    elif topic not in readable:
        raise UserError(f"topic '{topic}': expected {choices(TYPES)}, got {types[topic]}; topics: {listed}")
    return topic, [c for c in connections if (c.topic, c.msgtype.replace("/msg/", "/")) == (topic, types[topic])]


def _samples(reader: Any, connections: Sequence[Any], ros1: bool) -> Iterator[Sample]:
    """Yield the messages of a topic."""
    from rosbags.interfaces import MessageDefinitionFormat
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    kind, definition = connections[0].msgtype, connections[0].msgdef
    if definition.format == MessageDefinitionFormat.MSG:
        store = get_typestore(Stores.EMPTY)
        store.register(get_types_from_msg(definition.data, kind))
    else:  # ROS 2 before Iron stores no definitions in .db3
        store = get_typestore(Stores.LATEST)
    if kind not in store.fielddefs:
        raise UserError(
            f"no definition of {kind} (ROS 2 before Iron does not store them); convert the bag to MCAP on a machine "
            "with that package (ros2 bag convert), or read a JointState topic"
        )
    decode = store.deserialize_ros1 if ros1 else store.deserialize_cdr
    for _, received, raw in reader.messages(connections=connections):
        message: Any = decode(raw, kind)
        names, values = _joint_state(message) if kind.endswith("/JointState") else _franka_state(message)
        time = message.header.stamp
        yield Sample(
            time.sec * 10**9 + time.nanosec,
            received,
            tuple(names),
            {field: np.array(x, dtype=float) for field, x in values.items()},
        )


def _joint_state(message: Any) -> tuple[Sequence[str], dict[str, Any]]:
    return message.name, {"q": message.position, "dq": message.velocity, "tau": message.effort}


def _franka_state(message: Any) -> tuple[Sequence[str], dict[str, Any]]:
    """Return the joint names and {field: values} of a Franka state message (franka_ros or franka_ros2)."""
    if hasattr(message, "measured_joint_state"):
        names, values = _joint_state(message.measured_joint_state)
        desired = message.desired_joint_state
        if list(desired.name) not in ([], list(names)):
            raise UserError(f"expected desired joints {choices(names)}, as measured, got {choices(desired.name)}")
        return names, {"q": values["q"], "dq": values["dq"], "tau_J": values["tau"], "tau_J_d": desired.effort}
    lower = {name.lower(): value for name, value in vars(message).items()}  # ROS 2 field names are lower case: tau_j
    missing = [f for f in ("q", "dq", "tau_J", "tau_J_d") if f.lower() not in lower]
    if missing:
        raise UserError(f"FrankaState without {choices(missing)}; fields: {choices(lower)}")
    return (), {f: lower[f.lower()] for f in ("q", "dq", "tau_J", "tau_J_d")}


def _pick_joints(topic: str, samples: list[Sample], joints, model_joints, n_joints) -> tuple[list[Sample], Layouts]:
    """Return the messages with all joints of the robot, and {names in a message: indices of the robot's joints}."""
    layouts = dict.fromkeys(s.names for s in samples)
    logged = list(dict.fromkeys(name for names in layouts for name in names))
    if not logged:
        if joints is not None:
            raise UserError(f"data.joints: expected null, as the messages on '{topic}' name no joints, got {joints}")
        return samples, {(): None}
    try:
        robot = choose_joints(logged, joints, model_joints, n_joints)
    except UserError as error:
        raise UserError(f"'{topic}': {error}") from None
    pick: Layouts = {names: [names.index(name) for name in robot] for names in layouts if set(robot) <= set(names)}
    if not pick:
        got = " | ".join(choices(names) for names in layouts)
        raise UserError(f"expected {choices(robot)} in one message on '{topic}', got {got} (set data.joints)")
    return [s for s in samples if s.names in pick], pick


def _stack(topic: str, samples: list[Sample], field: str, pick: Layouts) -> np.ndarray:
    """Return the values (T, n) of a field, or an empty array if no message has values of this field."""
    if not any(s.values[field].size for s in samples):
        return np.empty(0)
    rows = []
    for k, s in enumerate(samples):
        x, at = s.values[field], pick[s.names]
        expected = len(s.names) if s.names else len(samples[0].values["q"])
        if not len(x):
            x = np.full(expected, np.nan)
        if len(x) != expected:
            raise UserError(f"message {k} on '{topic}': expected {expected} values of {field}, got {len(x)}")
        rows.append(x if at is None else x[at])
    return np.stack(rows)


def _in_order(stamp: np.ndarray, table: Table) -> tuple[np.ndarray, Table]:
    """Sort messages by stamp and drop repeated messages; if the clock restarts, return the messages unchanged."""
    if len(stamp) < 2 or np.diff(stamp).min() < -MAX_LATENESS_NS:
        return stamp, table
    order = np.argsort(stamp, kind="stable")
    stamp, table = stamp[order], {field: x[order] for field, x in table.items()}
    new = np.diff(stamp, prepend=stamp[0] - 1) > 0
    for x in table.values():
        new[1:] |= (x[1:] != x[:-1]).any(axis=1)
    return stamp[new], {field: x[new] for field, x in table.items()}
