"""Readers of robot logs: bags, HDF5 and libfranka's CSV restore the written data or raise one-line errors."""

import sqlite3
import sys

import h5py
import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from r2s.errors import UserError
from r2s.recordings.readers import files_of, read
from r2s.recordings.robot_logs import choose_joints

PANDA = [f"panda_joint{j}" for j in range(1, 8)]
EPOCH = 1_700_000_000_123_456_789  # ns
OMEGA = 2 * np.pi * 0.4  # rad/s
STATE = "std_msgs/Header header\n" + "".join(f"float64[7] {f}\n" for f in ("q", "q_d", "dq", "{0}", "{1}"))
ROBOT_STATE = (
    "std_msgs/Header header\nsensor_msgs/JointState measured_joint_state\nsensor_msgs/JointState desired_joint_state"
)


def motion(rows=300, n=7, step=1e-3, jitter=0.3, seed=0):
    """Return t (T,) ns from 0, and q, dq, tau_J, tau_J_d (T, n): every joint and every row differ."""
    steps = step * np.random.default_rng(seed).uniform(1 - jitter, 1 + jitter, rows - 1) if jitter else step
    ns = np.concatenate([[0], np.cumsum(np.round(1e9 * np.broadcast_to(steps, rows - 1)).astype(np.int64))])
    angle = OMEGA * ns[:, None] * 1e-9 + np.arange(n)
    q, dq = np.sin(angle), OMEGA * np.cos(angle)
    return ns, q, dq, 10 * q + dq, 3 * dq


def message(call, *args, **kwargs):
    with pytest.raises(UserError) as caught:
        call(*args, **kwargs)
    text = str(caught.value)
    assert "\n" not in text
    return text


class Bag:
    """Write one bag of the given kind: 'bag' (ROS 1), 'db3' or 'mcap' (ROS 2)."""

    def __init__(self, folder, kind):
        self.ros1 = kind == "bag"
        self.path = folder / ("log.bag" if self.ros1 else "log")
        self.store = get_typestore(Stores.ROS1_NOETIC if self.ros1 else Stores.ROS2_HUMBLE)
        plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
        self.writer = Writer1(self.path) if self.ros1 else Writer2(self.path, version=9, storage_plugin=plugin)
        self.writer.open()
        self.topics = {}

    def define(self, kind, text):
        """Add a message type."""
        self.store.register(get_types_from_msg(text, kind))

    def header(self, ns):
        """Return a std_msgs/Header with that stamp."""
        seq = {"seq": 0} if self.ros1 else {}
        stamp = self.store.types["builtin_interfaces/msg/Time"](sec=int(ns // 10**9), nanosec=int(ns % 10**9))
        return self.store.types["std_msgs/msg/Header"](**seq, stamp=stamp, frame_id="")

    def joint_state(self, ns, names, q, dq, tau):
        """Return a sensor_msgs/JointState."""
        make = self.store.types["sensor_msgs/msg/JointState"]
        return make(header=self.header(ns), name=list(names), position=q, velocity=dq, effort=tau)

    def write(self, topic, kind, ns, content):
        """Add a message, received at ns."""
        if topic not in self.topics:
            self.topics[topic] = self.writer.add_connection(topic, kind, typestore=self.store)
        encode = self.store.serialize_ros1 if self.ros1 else self.store.serialize_cdr
        self.writer.write(self.topics[topic], int(ns), encode(content, kind))

    def close(self):
        """Finish the bag and return where it is."""
        self.writer.close()
        return self.path


NOTHING = np.empty(0)
JOINT_STATE = "sensor_msgs/msg/JointState"


def joint_states(folder, kind="mcap", names=PANDA, data=None, change=None, others=(), stamped=True):
    """Write /joint_states with `names` in a new order in every message; `change` edits (k, q, dq, tau)."""
    ns, q, dq, tau, _ = data or motion(n=len(names))
    bag, order = Bag(folder, kind), np.random.default_rng(1)
    for k in range(len(ns)):
        at = order.permutation(len(names)) if others != "fixed" else np.arange(len(names))
        values = [x[k][at] for x in (q, dq, tau)]
        values = change(k, *values) if change else values
        stamp = EPOCH + ns[k] if stamped else 0
        content = bag.joint_state(stamp, [names[j] for j in at], *values)
        received = EPOCH + (1_000_000 * k if stamped else ns[k])  # by the recorder, on a clock of its own
        bag.write("/joint_states", JOINT_STATE, received, content)
        if others == "gripper":
            half = [np.full(2, 0.04)] * 3
            bag.write("/joint_states", JOINT_STATE, received, bag.joint_state(EPOCH, ["f1", "f2"], *half))
        elif others == "text":
            text = bag.store.types["std_msgs/msg/String"](data="hello")
            bag.write("/chatter", "std_msgs/msg/String", received, text)
        elif others == "second":
            bag.write("/arm2/joint_states", JOINT_STATE, received, content)
    return bag.close()


def assert_motion(recording, data, torque="measured"):
    ns, q, dq, tau, _ = data
    np.testing.assert_allclose(recording.t, ns * 1e-9, rtol=0, atol=1e-12)
    for field, x in (("q", q), ("dq", dq), ("tau", tau)):
        np.testing.assert_array_equal(getattr(recording, field), x, err_msg=field)
    assert recording.torque == torque
    assert recording.name == "log"


@pytest.mark.long
@pytest.mark.parametrize("kind", ["bag", "db3", "mcap"])
@pytest.mark.parametrize("others", ["", "gripper", "text"])
def test_joint_states_come_back_in_joint_order(tmp_path, kind, others):
    """Joint order differs from message to message; a gripper shares the topic; other topics do not matter."""
    path = joint_states(tmp_path, kind, others=others)
    assert_motion(read(path, torque="measured", n_joints=7), motion())
    assert_motion(read(path, torque="commanded", n_joints=7), motion(), "commanded")
    reverse = read(path, torque="measured", joints=PANDA[::-1], topic="/joint_states")
    np.testing.assert_array_equal(reverse.q, motion()[1][:, ::-1])
    if kind != "bag":  # also the file in the folder, by itself
        (file,) = path.glob(f"*.{kind}")
        np.testing.assert_array_equal(read(file, torque="measured", n_joints=7).q, motion()[1])
        assert files_of(path) == sorted([file, path / "metadata.yaml"])
    else:
        assert files_of(path) == [path]


def test_without_stamps_the_time_of_the_bag_counts(tmp_path):
    assert_motion(read(joint_states(tmp_path, stamped=False), torque="measured"), motion())


@pytest.mark.parametrize("absent", [NOTHING, np.full(7, np.nan)])
def test_absent_velocity_is_derived_and_absent_effort_refused(tmp_path, absent):
    """Empty (ROS 1) and NaN (ROS 2 broadcasters) values are missing values."""
    path = joint_states(tmp_path, change=lambda k, q, dq, tau: (q, absent, tau))
    recording = read(path, torque="measured")
    assert np.abs(recording.dq - motion()[2]).max() < 0.01 * OMEGA
    (tmp_path / "b").mkdir()
    path = joint_states(tmp_path / "b", change=lambda k, q, dq, tau: (q, dq, absent))
    text = message(read, path, torque="measured")
    assert text == (f"{path}: expected position and effort in the messages on '/joint_states', got no effort")


def test_late_messages_are_put_in_order_and_repeated_ones_dropped(tmp_path):
    data = motion()
    rows = np.arange(300)
    rows[100:102] = [101, 100]
    rows = np.insert(rows, 200, rows[200])
    mixed = [x[rows] for x in data]
    assert_motion(read(joint_states(tmp_path, data=mixed, others="fixed"), torque="measured"), data)


def test_messages_before_the_first_stamp_are_left_out(tmp_path):
    """A driver may send some with stamp 0 before it knows the time."""
    data = motion()
    early = [np.concatenate([x[:5], x]) for x in data]
    early[0][:5] = -EPOCH
    assert_motion(read(joint_states(tmp_path, data=early, others="fixed"), torque="measured"), data)


@pytest.mark.parametrize("absent", [NOTHING, np.full(7, np.nan)])
def test_messages_before_the_first_values_are_left_out(tmp_path, absent):
    """Broadcasters of ROS 2 send before the arm's interfaces have values."""
    data, early = motion(), 5
    wait = [np.concatenate([x[:early], x]) for x in data]
    wait[0] = np.concatenate([data[0][:early] - data[0][early], data[0]])
    path = joint_states(
        tmp_path, data=wait, change=lambda k, q, dq, tau: (q, dq, absent if k < early else tau), others="fixed"
    )
    out = read(path, torque="measured")
    assert_motion(out, data)
    assert out.notes == ("the first 5 messages lack values and are left out",)


def test_fingers_beside_the_arm_may_have_no_values(tmp_path):
    """Names in any order, NaN for joints that are not the arm's, stamps of 0 at the start, a message that is late."""
    names, data = ["panda_finger_joint1", *PANDA, "panda_finger_joint2"], motion(n=9)
    for x in data[1:]:
        x[:, [0, 8]] = np.nan
    mixed = [np.concatenate([x[:3], x]) for x in data]
    mixed[0][:3] = -EPOCH
    for x in mixed:
        x[[100, 101]] = x[[101, 100]]
    out = read(joint_states(tmp_path, names=names, data=mixed), torque="measured", model_joints=PANDA, n_joints=7)
    assert_motion(out, [data[0], *(x[:, 1:8] for x in data[1:])])
    assert out.notes == ("3 messages with stamp 0 are left out",)


def test_a_restarted_clock_is_refused(tmp_path):
    """Rows of two starts must not be shuffled into one another."""
    data = motion(step=0.02)
    data[0][150:] -= data[0][150]
    assert "time does not increase at row 150" in message(read, joint_states(tmp_path, data=data), torque="measured")


def test_slow_irregular_logs_are_resampled_and_smoothed_in_phase(tmp_path):
    """100 Hz JointState with 30 % jitter: on the 1 ms grid, and filtered there, it stays on the true motion."""
    recording = read(joint_states(tmp_path, data=motion(rows=600, step=0.01)), torque="measured")
    assert recording.rate_hz == pytest.approx(100, rel=0.05)
    fine = recording.resample(1e-3)
    truth = np.sin(OMEGA * fine.t[:, None] + np.arange(7))
    assert fine.rate_hz == pytest.approx(1000)
    assert np.abs(fine.q - truth).max() < OMEGA**2 * 0.013**2 / 8 * 1.01  # what a chord misses of a sine
    middle = slice(500, -500)
    smooth = fine.smooth(10.0)
    assert np.abs(smooth.q - truth)[middle].max() < 2e-4  # a delay of 1 ms would miss by OMEGA * 1e-3 = 2.5e-3


FRANKA = [("bag", "tau_J", "tau_J_d"), ("mcap", "tau_j", "tau_j_d"), ("db3", "tau_j", "tau_j_d")]


def franka_state(folder, kind, tau_J, tau_J_d):
    bag = Bag(folder, kind)
    bag.define("franka_msgs/msg/FrankaState", STATE.format(tau_J, tau_J_d))
    ns, q, dq, measured, commanded = motion(jitter=0)
    for k in range(len(ns)):
        torques = {tau_J: measured[k], tau_J_d: commanded[k]}
        make = bag.store.types["franka_msgs/msg/FrankaState"]
        content = make(header=bag.header(EPOCH + ns[k]), q=q[k], q_d=0 * q[k], dq=dq[k], **torques)
        bag.write("/franka_states", "franka_msgs/msg/FrankaState", EPOCH + ns[k], content)
    return bag.close()


@pytest.mark.parametrize(("kind", "tau_J", "tau_J_d"), FRANKA)
def test_franka_states_hold_both_torques(tmp_path, kind, tau_J, tau_J_d):
    """tau_J is measured; tau_J_d is the command of the cycle before, so row k commands what row k + 1 logs."""
    path = franka_state(tmp_path, kind, tau_J, tau_J_d)
    data = motion(jitter=0)
    assert_motion(read(path, torque="measured", n_joints=7), data)
    commanded = read(path, torque="commanded", n_joints=7, model_joints=[f"joint{j}" for j in range(1, 8)])
    np.testing.assert_allclose(commanded.tau[:-1], data[4][1:], rtol=0, atol=1e-9)
    assert "data.joints: expected null, as the messages on" in message(read, path, torque="measured", joints=PANDA)
    assert "q: expected 6 joints, got 7 (q)" in message(read, path, torque="measured", n_joints=6)


def test_franka_robot_state_holds_both_torques(tmp_path):
    bag, kind = Bag(tmp_path, "mcap"), "franka_msgs/msg/FrankaRobotState"
    bag.define(kind, ROBOT_STATE)
    data = motion(jitter=0)
    ns, q, dq, tau_J, tau_J_d = data
    names = [f"fr3_joint{j}" for j in range(1, 8)]
    for k in range(len(ns)):
        stamp = EPOCH + ns[k]
        measured = bag.joint_state(0, names, q[k], dq[k], tau_J[k])
        desired = bag.joint_state(0, names, 0 * q[k], 0 * dq[k], tau_J_d[k])
        make = bag.store.types[kind]
        content = make(header=bag.header(stamp), measured_joint_state=measured, desired_joint_state=desired)
        bag.write("/state", kind, stamp, content)
    path = bag.close()
    assert_motion(read(path, torque="measured", n_joints=7), data)
    np.testing.assert_allclose(read(path, torque="commanded").tau[:-1], tau_J_d[1:], rtol=0, atol=1e-9)


def forget_definitions(path):
    (file,) = path.glob("*.db3")
    with sqlite3.connect(file) as connection:
        connection.execute("DELETE FROM message_definitions")
    connection.close()


def test_old_ros2_bags_have_no_definitions(tmp_path):
    """Bags before ROS 2 Iron: JointState is readable without a definition, Franka's messages are not."""
    path = joint_states(tmp_path, "db3")
    forget_definitions(path)
    assert_motion(read(path, torque="measured"), motion())
    (tmp_path / "franka").mkdir()
    path = franka_state(tmp_path / "franka", "db3", "tau_j", "tau_j_d")
    forget_definitions(path)
    text = message(read, path, torque="measured")
    assert "no definition of franka_msgs/msg/FrankaState" in text
    assert "ros2 bag convert" in text


@pytest.mark.parametrize(
    ("written", "arguments", "expected"),
    [
        (
            {"others": "text"},
            {"topic": "/joint_state"},
            "no topic '/joint_state'; topics: /joint_states (sensor_msgs/JointState), /chatter (std_msgs/String); "
            "did you mean '/joint_states'? (set data.topic)",
        ),
        (
            {"others": "text"},
            {"topic": "/chatter"},
            "topic '/chatter': expected JointState, FrankaRobotState, FrankaState, got std_msgs/String",
        ),
        ({"others": "second"}, {}, "several topics hold joint states: /joint_states (sensor_msgs/JointState), /arm2"),
        ({}, {"joints": [*PANDA[:6], "panda_jont7"]}, "'/joint_states': no joint 'panda_jont7'; joints: panda_jo"),
        ({}, {"joints": [*PANDA[:6], "panda_jont7"]}, "; did you mean 'panda_joint7'? (set data.joints)"),
        (
            {},
            {"joints": PANDA[:6], "n_joints": 7},
            "data.joints: expected 7 different names, got panda_joint1, panda_joi",
        ),
        ({}, {"joints": PANDA[:6], "n_joints": 7}, "data.joints: expected 7 different names"),
        ({}, {"joints": [*PANDA[:6], PANDA[0]]}, "data.joints: expected 7 different names"),
        ({}, {"joints": []}, "data.joints: expected 1 different names, got none"),
        ({"names": PANDA[:3]}, {"n_joints": 7}, "expected 7 joints, got 3 (panda_joint"),
        ({"others": "gripper"}, {"joints": ["panda_joint1", "f1"]}, "expected panda_joint1, f1 in one message on"),
        ({}, {"torque": None}, "torque is not declared"),
        ({}, {"columns": {"tau": "tau_J"}}, "no column 'tau_J' for tau"),
        ({}, {"max_gap_s": 1e-4}, "most steps in time are longer than max_gap_s"),
        (
            {"change": lambda k, q, dq, tau: (q, dq, tau[: 6 if k == 8 else 7])},
            {},
            "message 8 on '/joint_states': expected 7 values of tau, got 6",
        ),
        (
            {"change": lambda k, q, dq, tau: (q, dq, 0 * tau)},
            {},
            "tau (tau) is 0 in every row: this log holds no measured torque",
        ),
    ],
)
def test_a_bad_bag_is_named_in_one_line(tmp_path, written, arguments, expected):
    path = joint_states(tmp_path, data=motion(rows=20, n=len(written.get("names", PANDA))), **written)
    text = message(read, path, **{"torque": "measured", **arguments})
    assert text.startswith(f"{path}: ")
    assert expected in text


def test_a_bag_without_joint_states(tmp_path):
    bag = Bag(tmp_path, "bag")
    bag.write("/chatter", "std_msgs/msg/String", EPOCH, bag.store.types["std_msgs/msg/String"](data="hello"))
    path = bag.close()
    assert message(read, path, torque="measured") == (
        f"{path}: no topic of type JointState, FrankaRobotState, FrankaState; topics: /chatter (std_msgs/String)"
    )


@pytest.mark.parametrize("kind", ["bag", "db3", "mcap"])
@pytest.mark.parametrize("share", [0.0, 0.01, 0.5, 0.99])
def test_a_truncated_bag_is_refused(tmp_path, kind, share):
    """Any truncation gives one line of error and no partial data."""
    path = joint_states(tmp_path, kind)
    file = path if kind == "bag" else next(path.glob(f"*.{kind}"))
    whole = file.read_bytes()
    file.write_bytes(whole[: int(share * len(whole))])
    text = message(read, path, torque="measured")
    assert text.startswith(f"{path}: cannot be read as a bag: ")


def test_what_only_looks_like_a_bag(tmp_path):
    for name in ("noise.bag", "noise.db3", "noise.mcap"):
        (tmp_path / name).write_bytes(b"\x00\x01" * 99)
        assert "cannot be read as a bag: " in message(read, tmp_path / name, torque="measured")
    (tmp_path / "folder.bag").mkdir()
    assert "expected a file (.csv" in message(read, tmp_path / "folder.bag", torque="measured")


def test_the_order_of_joints():
    """Names from the user, the model or a number take precedence over the order of a message."""
    shuffled = ["panda_joint2", "panda_finger_joint1", "panda_joint1", "panda_joint3"]
    known = ["panda_joint1", "panda_joint2", "panda_joint3"]
    assert choose_joints(shuffled, None, None, 3) == known
    assert choose_joints([f"j{j}" for j in (10, 9, 1)], None, None, 3) == ["j1", "j9", "j10"]
    assert choose_joints(["ur_elbow", "ur_lift", "ur_pan"], None, ["pan", "lift", "elbow"], 3) == [
        "ur_pan",
        "ur_lift",
        "ur_elbow",
    ]
    assert choose_joints(["elbow", "pan", "grip"], None, None, 2) == ["elbow", "pan"]
    assert choose_joints(["elbow", "pan", "grip"], ["pan", "elbow"], ["a", "b"], 2) == ["pan", "elbow"]
    assert "name them in order" in message(choose_joints, ["elbow", "pan"], None, ["a", "b"], 2)
    two = [f"{side}_joint{j}" for side in ("left", "right") for j in (1, 2)]
    assert "several arms of 2 joints" in message(choose_joints, two, None, ["joint1", "joint2"], 2)


def without(monkeypatch, *heads):
    """Make the libraries look as if they were not installed."""
    for name in list(sys.modules):
        if name.split(".")[0] in heads:
            monkeypatch.setitem(sys.modules, name, None)


def test_a_missing_extra_is_named(tmp_path, monkeypatch):
    bag, file = joint_states(tmp_path), tmp_path / "log.h5"
    with h5py.File(file, "w") as h5:
        h5["t"] = np.arange(20.0)
    without(monkeypatch, "rosbags", "h5py")
    assert message(read, bag, torque="measured") == (
        f"{bag}: reading this file needs rosbags, which is not installed: pip install 'r2s[recordings]'"
    )
    assert message(read, file, torque="measured") == (
        f"{file}: reading this file needs h5py, which is not installed: pip install 'r2s[recordings]'"
    )
