"""Robot logs as tables of t, q, dq and tau: ROS 1 and ROS 2 bags, MCAP, and the CSV that libfranka writes.

`readers.read` is the front door; what it finds here it treats like the columns of any other file.
"""

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from r2s.errors import UserError, choices, nearest

Table = dict[str, np.ndarray]  # column name -> (T,) or (T, n)
Layouts = dict[tuple[str, ...], list[int] | None]  # names in a message -> where the robot's are; None: as they come


BAGS = (".bag", ".db3", ".mcap")
TYPES = ("JointState", "FrankaRobotState", "FrankaState")  # of sensor_msgs and franka_msgs
CYCLE = 1e-3  # s, of a Franka arm
LATE_NS = 10**9  # the network delivers a message late by less than this; a clock that goes back further restarted


def is_bag(path: Path) -> bool:
    """Say whether `path` is a bag: by its suffix, or a folder with metadata.yaml (ROS 2)."""
    return (path / "metadata.yaml").is_file() if path.is_dir() else path.suffix.lower() in BAGS


def missing_extra(library: str, extra: str) -> UserError:
    """Return the error for a file whose reader is an optional part of r2s."""
    return UserError(f"reading it needs {library}, which is not installed: pip install 'r2s[{extra}]'")


def libfranka_table(table: Table) -> Table:
    """Add t, q, dq, tau_J and tau_J_d, as (T,) s and (T, 7), to a log of `franka::logToCSV`.

    Any other table comes back as it is. There (libfranka, src/log.cpp) `time` is in whole ms, `state.tau_J` is
    measured, and a row holds the state of cycle k + 1 beside the command `cmd.tau_J_d` of cycle k: see `sent`.
    """
    if not {"time", "success_rate", "state.q[0]"} <= table.keys():
        return table
    time = table["time"]
    numeric = time.dtype.kind in "iuf"  # else the column is shown as it is, and refused by name
    t = time * CYCLE if numeric else time
    found = {"t": t}
    for field, name in (("q", "state.q"), ("dq", "state.dq"), ("tau_J", "state.tau_J"), ("tau_J_d", "cmd.tau_J_d")):
        columns = [table.get(f"{name}[{i}]") for i in range(7)]
        if all(column is not None for column in columns):
            found[field] = np.stack(columns, axis=1)  # type: ignore[arg-type]
    if "tau_J_d" in found and numeric and found["tau_J_d"].dtype.kind in "iuf":
        found["tau_J_d"] = sent(t, found["tau_J_d"])
    return found | table


def sent(t: np.ndarray, tau_J_d: np.ndarray) -> np.ndarray:
    """Return the command (T, n) Nm sent in the cycle of each row.

    A Franka's state carries the command of the cycle before it, a recording the one that follows from its state
    (`r2s.arm.tracking`): it is tau_J_d one cycle later, interpolated where the log is slower than the arm.
    t: (T,) s. tau_J_d: (T, n) Nm, as logged. The last row keeps its own.
    """
    return np.stack([np.interp(t + CYCLE, t, column) for column in tau_J_d.T], axis=1)


class Sample(NamedTuple):
    """One message: header and bag time in ns, joint names (() where the type has none), values by field (n,)."""

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
    """Return t (T,) s, q, dq and tau (or tau_J and tau_J_d) (T, n) of one topic of a bag.

    t counts from the first message, in header stamps, or in the bag's own time where all stamps are zero. dq is
    left out where no message has it. Messages without one of the joints (a gripper on the same topic) are passed
    over; late ones are put back in order, repeated ones dropped.

    Args:
        path: .bag (ROS 1), .db3 or .mcap, or the folder of a ROS 2 bag.
        topic: of sensor_msgs/JointState, franka_msgs/FrankaState or FrankaRobotState; None: the only such topic.
        joints: names, in the robot's order; None: see `choose_joints`.
        model_joints: what the robot description calls its joints.
        n_joints: of the robot, if known.

    Raises:
        UserError: rosbags is not installed, the bag is damaged, or topic, joints or torque are not in it.

    """
    topic, samples = _read(path, topic)
    kept, pick = _pick_joints(topic, samples, joints, model_joints, n_joints)
    table = {field: _stack(topic, kept, field, pick) for field in kept[0].values}
    table = {field: x for field, x in table.items() if x.size and not np.isnan(x).all()}  # ROS 2: NaN is absent
    if "q" not in table or not {"tau", "tau_J", "tau_J_d"} & table.keys():
        lacking = "position" if "q" not in table else "effort"
        raise UserError(f"the messages on '{topic}' carry no {lacking}; a recording needs both, position and effort")
    stamp = np.array([s.stamp for s in kept])
    if not stamp.any():
        stamp = np.array([s.received for s in kept])
    stamp, table = _in_order(stamp, table)
    table["t"] = (stamp - stamp[0]) * 1e-9  # as differences of integers: an epoch in seconds keeps only 0.2 us
    if "tau_J_d" in table:
        table["tau_J_d"] = sent(table["t"], table["tau_J_d"])
    return table


def choose_joints(
    seen: Sequence[str], joints: Sequence[str] | None, model_joints: Sequence[str] | None, n: int | None
) -> list[str]:
    """Return which of the joint names `seen` in a log are the robot's, in the robot's order.

    The order of a message is not the robot's: ROS 2 brings up drivers that sort by name, or do not sort at all.
    So, in this order: `joints` as told; `model_joints`, where each is found (also behind a prefix: panda_joint1);
    n names that differ in one number, by that number; the first n in the order in which they appear, unless
    `model_joints` speaks against them.
    """
    listed = choices(seen)
    if joints is not None:
        for name in joints:
            if name not in seen:
                raise UserError(f"no joint '{name}'; joints: {listed}{nearest(str(name), seen)} (set data.joints)")
        distinct = len(set(joints))
        if not distinct or distinct < len(joints) or (n is not None and distinct != n):
            robot = "at least one" if n is None else f"{n}, as the robot has"
            raise UserError(
                f"data.joints names {distinct} different joints ({choices(joints)}); it must name {robot}"
            )
        return list(joints)
    if n is not None and len(seen) < n:
        raise UserError(f"{len(seen)} joints ({listed}), the robot has {n}")
    n = len(seen) if n is None else n
    same = [
        [s for s in seen if s == m] or [s for s in seen if s.endswith(("_" + m, "/" + m))] for m in model_joints or ()
    ]
    if same and all(len(names) == 1 for names in same) and len({names[0] for names in same}) == n:
        return [names[0] for names in same]
    families: dict[str, list[str]] = {}
    for name in seen:
        families.setdefault(re.sub(r"\d+(?=\D*$)", "#", name), []).append(name)
    arms = [names for family, names in families.items() if "#" in family and len(names) == n]
    if len(arms) > 1:
        raise UserError(f"several arms of {n} joints: {listed}; say which: data.joints=[...]")
    if arms:
        return sorted(arms[0], key=lambda name: int(re.findall(r"\d+", name)[-1]))
    if model_joints and n > 1:
        raise UserError(
            f"the joints {listed} are not called what the robot calls its own ({choices(model_joints)}); "
            "say which they are, in that order: data.joints=[...]"
        )
    return list(seen[:n])


def _read(path: Path, topic: str | None) -> tuple[str, list[Sample]]:
    """Return the topic and all its messages."""
    try:
        import rosbags.rosbag1
        import rosbags.rosbag2
    except ImportError:
        raise missing_extra("rosbags", "bags") from None
    try:
        # only what is read may fail: other topics of the bag can hold types that nobody understands
        ros1 = path.is_file() and path.suffix.lower() == ".bag"
        with (rosbags.rosbag1 if ros1 else rosbags.rosbag2).Reader(path) as reader:
            topic, connections = _pick_topic(reader.connections, topic)
            samples = list(_samples(reader, connections, ros1))
    except UserError:
        raise
    except Exception as error:  # a damaged file lets the library stumble anywhere
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        mend = "if it was cut off, rosbag reindex, ros2 bag reindex or mcap recover may mend it"
        raise UserError(f"cannot be read as a bag: {reason} ({mend})") from None
    if not samples:
        raise UserError(f"no message on '{topic}'")
    return topic, samples


def _pick_topic(connections: Sequence[Any], topic: str | None) -> tuple[str, list[Any]]:
    """Return the topic and its connections."""
    types = {c.topic: c.msgtype.replace("/msg/", "/") for c in connections}
    readable = [t for t, kind in types.items() if kind.rsplit("/")[-1] in TYPES]
    listed = choices(f"{t} ({kind})" for t, kind in types.items()) or "none"
    if topic is None:
        if not readable:
            raise UserError(f"no topic of type {choices(TYPES)}; topics: {listed}")
        if len(readable) > 1:
            listed = choices(f"{t} ({types[t]})" for t in readable)
            raise UserError(f"several topics hold joint states: {listed}; say which: data.topic=...")
        topic = readable[0]
    elif topic not in types:
        raise UserError(f"no topic '{topic}'; topics: {listed}{nearest(topic, types)} (set data.topic)")
    elif topic not in readable:
        raise UserError(f"topic '{topic}' is {types[topic]}; allowed: {choices(TYPES)}; topics: {listed}")
    return topic, [c for c in connections if (c.topic, c.msgtype.replace("/msg/", "/")) == (topic, types[topic])]


def _samples(reader: Any, connections: Sequence[Any], ros1: bool) -> Iterator[Sample]:
    """Read the messages of one topic."""
    from rosbags.interfaces import MessageDefinitionFormat
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    kind, definition = connections[0].msgtype, connections[0].msgdef
    if definition.format == MessageDefinitionFormat.MSG:
        store = get_typestore(Stores.EMPTY)
        store.register(get_types_from_msg(definition.data, kind))
    else:  # ROS 2 before Iron keeps no definitions in .db3
        store = get_typestore(Stores.LATEST)
    if kind not in store.fielddefs:
        raise UserError(
            f"it holds no definition of {kind}, as ROS 2 before Iron leaves them out; convert it to MCAP where "
            "that package is installed (ros2 bag convert), or read a JointState topic"
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
    """Return names and values of either of Franka's messages (franka_ros, franka_ros2)."""
    if hasattr(message, "measured_joint_state"):
        names, values = _joint_state(message.measured_joint_state)
        desired = message.desired_joint_state
        if list(desired.name) not in ([], list(names)):
            raise UserError(f"measured joints are {choices(names)}, desired ones {choices(desired.name)}")
        return names, {"q": values["q"], "dq": values["dq"], "tau_J": values["tau"], "tau_J_d": desired.effort}
    lower = {name.lower(): value for name, value in vars(message).items()}  # ROS 2 allows lower case only: tau_j
    missing = [f for f in ("q", "dq", "tau_J", "tau_J_d") if f.lower() not in lower]
    if missing:
        raise UserError(f"FrankaState without {choices(missing)}; fields: {choices(lower)}")
    return (), {f: lower[f.lower()] for f in ("q", "dq", "tau_J", "tau_J_d")}


def _pick_joints(topic: str, samples: list[Sample], joints, model_joints, n_joints) -> tuple[list[Sample], Layouts]:
    """Return the messages that hold all joints, and where."""
    layouts = dict.fromkeys(s.names for s in samples)
    seen = list(dict.fromkeys(name for names in layouts for name in names))
    if not seen:
        if joints is not None:
            raise UserError(f"the messages on '{topic}' name no joints: leave data.joints=null")
        return samples, {(): None}
    try:
        wanted = choose_joints(seen, joints, model_joints, n_joints)
    except UserError as error:
        raise UserError(f"'{topic}': {error}") from None
    pick: Layouts = {names: [names.index(name) for name in wanted] for names in layouts if set(wanted) <= set(names)}
    if not pick:
        held = " | ".join(choices(names) for names in layouts)
        raise UserError(f"no message on '{topic}' holds all of {choices(wanted)}; they hold {held} (set data.joints)")
    return [s for s in samples if s.names in pick], pick


def _stack(topic: str, samples: list[Sample], field: str, pick: Layouts) -> np.ndarray:
    """Return a field as (T, n); empty where no message has it."""
    if not any(s.values[field].size for s in samples):
        return np.empty(0)
    rows = []
    for k, s in enumerate(samples):
        x, at = s.values[field], pick[s.names]
        expected = len(s.names) if s.names else len(samples[0].values["q"])
        if len(x) != expected:
            raise UserError(f"message {k} on '{topic}' holds {len(x)} values of {field} for {expected} joints")
        rows.append(x if at is None else x[at])
    return np.stack(rows)


def _in_order(stamp: np.ndarray, table: Table) -> tuple[np.ndarray, Table]:
    """Put late messages where they belong and drop repeated ones; a clock that restarted is left to be refused."""
    if len(stamp) < 2 or np.diff(stamp).min() < -LATE_NS:
        return stamp, table
    order = np.argsort(stamp, kind="stable")
    stamp, table = stamp[order], {field: x[order] for field, x in table.items()}
    new = np.diff(stamp, prepend=stamp[0] - 1) > 0
    for x in table.values():
        new[1:] |= (x[1:] != x[:-1]).any(axis=1)
    return stamp[new], {field: x[new] for field, x in table.items()}
