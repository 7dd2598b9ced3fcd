"""Write a `Recording` as a ROS 2 bag in MCAP format, together with a layout file for Foxglove."""

import json
import shutil
import tempfile
from collections.abc import Mapping
from itertools import chain as joined
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from r2s.errors import UserError, optional_import
from r2s.physics.description import Link, chain, write_urdf
from r2s.physics.dynamics import Dynamics
from r2s.physics.robot import Robot
from r2s.recordings.recording import Recording

START_NS = 10**9  # ns, stamp of the first row: readers interpret a stamp of 0 as missing
PAUSE_NS = 10**9  # ns, pause between trajectories: longer than any data.max_gap_s in use
TF_PERIOD = 0.02  # s, period of /tf: 50 Hz suffice for viewing
BASE = "base"  # the frame of the robot's base, as in r2s's URDF
TOPICS = {
    "/joint_states": "sensor_msgs/msg/JointState",
    "/external_wrench": "geometry_msgs/msg/WrenchStamped",
    "/reference": "trajectory_msgs/msg/JointTrajectory",
    "/tf": "tf2_msgs/msg/TFMessage",
    "/robot_description": "std_msgs/msg/String",
}
Message = tuple[int, str, Any]  # ns, topic, message


def stamps(recording: Recording) -> np.ndarray:
    """Return stamps (T,) ns of the rows on one common clock, with a pause between successive trajectories."""
    out, begin = np.empty(len(recording.t), dtype=np.int64), START_NS
    for s in recording.stretches:
        t = recording.t[s]
        out[s] = begin + np.rint((t - t[0]) * 1e9).astype(np.int64)
        begin = int(out[s][-1]) + PAUSE_NS
    return out


def write_mcap(
    path: Path,
    robot: Robot,
    recording: Recording,
    dynamics: Dynamics,
    reference: Mapping[str, np.ndarray] | None = None,
) -> list[str]:
    """Write a bag `path` (.mcap) and a Foxglove layout; return one line of text for each omitted topic.

    The topics are /joint_states (effort is tau), /external_wrench (if the recording has O_F_ext_hat_K), /reference
    (if given), /tf (link poses at 50 Hz or less) and /robot_description (the URDF, latched).

    Args:
        robot, dynamics: arm and parameters for the URDF. recording: motion of this arm.
        reference: planned motion {"t": (T,) s, "q", "dq", "ddq": (T, n)}, which starts at the same time as the
            recording.

    Raises:
        UserError: rosbags is not installed, or robot and recording differ in their number of joints.
    """
    optional_import("rosbags", str(path), "recordings")
    from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    if recording.n_joints != robot.n:
        raise UserError(f"expected {robot.n} joints, as robot={robot.name} has, got {recording.n_joints}")
    store, endless = get_typestore(Stores.ROS2_HUMBLE), QosTime(0, 0)
    latched = Qos(
        QosHistory.KEEP_LAST, 1, QosReliability.RELIABLE, QosDurability.TRANSIENT_LOCAL, endless, endless,
        QosLiveliness.SYSTEM_DEFAULT, endless, False,
    )  # fmt: skip
    links, left_out = chain(robot, dynamics, friction=False)[0], []
    make = _Messages(store.types)
    ns = stamps(recording)
    with tempfile.TemporaryDirectory(dir=path.parent) as folder:
        parts = [make.joint_states(recording, ns, [link.joint for link in links]), make.frames(recording, ns, links)]
        try:
            write_urdf(Path(folder) / "arm.urdf", robot, dynamics)
            parts.append(make.description((Path(folder) / "arm.urdf").read_text()))
        except UserError as error:
            left_out.append(f"/robot_description is left out: {error}")
        if "O_F_ext_hat_K" in recording.signals:
            parts.append(make.wrenches(recording.signals["O_F_ext_hat_K"], ns))
        if reference is not None:
            parts.append(make.reference(reference, [link.joint for link in links]))
        messages = sorted(joined(*parts), key=lambda message: message[0])
        with Writer(Path(folder) / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as bag:
            topics = {}
            for topic in sorted({topic for _, topic, _ in messages}):
                qos = [latched] if topic == "/robot_description" else []
                topics[topic] = bag.add_connection(topic, TOPICS[topic], typestore=store, offered_qos_profiles=qos)
            for at, topic, content in messages:
                bag.write(topics[topic], at, store.serialize_cdr(content, TOPICS[topic]))
        shutil.move(next((Path(folder) / "bag").glob("*.mcap")), path)
    path.with_suffix(".foxglove.json").write_text(json.dumps(layout(robot.n, set(topics)), indent=1))
    return left_out


class _Messages:
    """Build stamped ROS 2 messages from `types`, the message classes of a rosbags typestore."""

    def __init__(self, types: Mapping[str, Any]):
        self._types = types

    def _header(self, ns: int, frame: str = BASE) -> Any:
        time = self._types["builtin_interfaces/msg/Time"](sec=int(ns // 10**9), nanosec=int(ns % 10**9))
        return self._types["std_msgs/msg/Header"](stamp=time, frame_id=frame)

    def _xyz(self, x: np.ndarray, kind: str = "Vector3") -> Any:
        return self._types[f"geometry_msgs/msg/{kind}"](**dict(zip("xyzw", map(float, x), strict=False)))

    def joint_states(self, recording: Recording, ns: np.ndarray, names: list[str]) -> list[Message]:
        make = self._types["sensor_msgs/msg/JointState"]
        rows = zip(ns.tolist(), recording.q, recording.dq, recording.tau, strict=True)
        return [
            (at, "/joint_states", make(self._header(at), name=names, position=q, velocity=dq, effort=tau))
            for at, q, dq, tau in rows
        ]

    def wrenches(self, wrench: np.ndarray, ns: np.ndarray) -> list[Message]:
        """Return messages of `O_F_ext_hat_K` (T, 6): force (N) and moment (Nm) that the arm exerts, in base axes."""
        of, stamped = (self._types[f"geometry_msgs/msg/{kind}"] for kind in ("Wrench", "WrenchStamped"))
        return [
            (at, "/external_wrench", stamped(self._header(at), of(force=self._xyz(x[:3]), torque=self._xyz(x[3:]))))
            for at, x in zip(ns.tolist(), wrench, strict=True)
        ]

    def frames(self, recording: Recording, ns: np.ndarray, links: list[Link]) -> list[Message]:
        """Return /tf messages: the pose of each link in the frame of its parent link, as in the URDF."""
        transform, stamped, message = (
            self._types[x]
            for x in ("geometry_msgs/msg/Transform", "geometry_msgs/msg/TransformStamped", TOPICS["/tf"])
        )
        slots = ns // round(TF_PERIOD * 1e9)
        rows = np.flatnonzero(np.diff(slots, prepend=-1) != 0)
        parents = [BASE, *(link.name for link in links[:-1])]
        rotations = [
            (Rotation.from_matrix(x.origin[:3, :3]) * Rotation.from_rotvec(q[:, None] * x.axis)).as_quat()
            for x, q in zip(links, recording.q[rows].T, strict=True)
        ]
        out = []
        for k, at in enumerate(ns[rows].tolist()):
            poses = [
                stamped(
                    self._header(at, parent),
                    child_frame_id=link.name,
                    transform=transform(self._xyz(link.origin[:3, 3]), self._xyz(rotation[k], "Quaternion")),
                )
                for parent, link, rotation in zip(parents, links, rotations, strict=True)
            ]
            out.append((at, "/tf", message(transforms=poses)))
        return out

    def reference(self, motion: Mapping[str, np.ndarray], names: list[str]) -> list[Message]:
        trajectory, point = (self._types[f"trajectory_msgs/msg/JointTrajectory{x}"] for x in ("", "Point"))
        duration, points = self._types["builtin_interfaces/msg/Duration"], []
        for t, q, dq, ddq in zip(*(motion[x] for x in ("t", "q", "dq", "ddq")), strict=True):
            sec, nanosec = divmod(round(float(t) * 1e9), 10**9)
            points.append(point(q, dq, ddq, np.empty(0), time_from_start=duration(sec=sec, nanosec=nanosec)))
        return [(START_NS, "/reference", trajectory(self._header(START_NS), joint_names=names, points=points))]

    def description(self, text: str) -> list[Message]:
        return [(START_NS, "/robot_description", self._types["std_msgs/msg/String"](data=text))]


def layout(n: int, topics: set[str]) -> dict[str, Any]:
    """Return a Foxglove layout: a 3D view, and plots of position, velocity, effort and, if recorded, wrench."""
    paths = {
        f"Plot!{field}": [f"/joint_states.{field}[{j}]" for j in range(n)]
        for field in ("position", "velocity", "effort")
    }
    if "/external_wrench" in topics:
        paths["Plot!wrench"] = [f"/external_wrench.wrench.{x}.{axis}" for x in ("force", "torque") for axis in "xyz"]
    panels: dict[str, Any] = {
        name: {
            "title": name.removeprefix("Plot!"),
            "paths": [{"value": x, "enabled": True, "timestampMethod": "headerStamp"} for x in values],
            "showLegend": True,
            "xAxisVal": "timestamp",
        }
        for name, values in paths.items()
    }
    column: Any = None
    for name in reversed(paths):
        column = name if column is None else {"direction": "column", "first": name, "second": column}
    shown = {topic: {"visible": True} for topic in ("/robot_description",) if topic in topics}
    panels["3D!arm"] = {"followTf": BASE, "scene": {"transforms": {"showLabel": True}}, "topics": shown}
    return {
        "configById": panels,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": {"direction": "row", "first": "3D!arm", "second": column, "splitPercentage": 40},
    }
