"""Logs with the faults of public reports: each gives the right result, or one line that names it.

Each row names the report, on GitHub, that describes the fault; the data here are made.
"""

# ruff: noqa: F811 (the arguments are fixtures of made_logs.py)

from dataclasses import replace

import numpy as np
import pytest
from conftest import conf
from made_logs import (  # noqa: F401 (ur is a fixture)
    ALPHABET,
    JOINTS,
    UR,
    columns,
    decimal_comma,
    held,
    moved,
    rostopic,
    rows,
    savetxt,
    swapped,
    text,
    ur,
    with_row,
)
from test_public_reports_urdf import URDF

from r2s.errors import UserError
from r2s.identification.checks import check_recording
from r2s.physics.robot import load_robot
from r2s.recordings.readers import read


@pytest.fixture(scope="module")
def recording(ur):
    return moved(ur)


SENSIBLE = 1e-6  # of values that were written with 9 digits
# name: (report, file of a recording, its arguments, what is expected: None is the right result, a text the error)
LOGS = {
    "semicolons": ("pandas-dev/pandas#41304", lambda r: text(columns(r), sep=";"), {}, None),
    "tabs, and units in names": (
        "msoon/PyMonsoon#37",
        lambda r: text({"Time(ms)": 1e3 * r.t, **{k: v for k, v in columns(r).items() if k != "t"}}, sep="\t"),
        {"columns": {"t": "Time"}},
        None,
    ),
    "decimal commas": ("gkjohnson/urdf-loaders#276", decimal_comma, {}, None),
    "a separator at the end of rows": (
        "pandas-dev/pandas#14124",
        lambda r: "\n".join(x + "," * (k > 0) for k, x in enumerate(text(columns(r)).splitlines())),
        {},
        None,
    ),
    "a column more than names": (
        "pandas-dev/pandas#15203",
        lambda r: "\n".join(x + ",7" * (k > 0) for k, x in enumerate(text(columns(r)).splitlines())),
        {},
        "the header has 19 names and the first row 20 values",
    ),
    "no header": (
        "MichaelGrupp/evo#725 (ros2 topic echo --csv)",
        lambda r: text(columns(r), header=False),
        {},
        "the first line holds numbers, no names; put a header before it, such as t,q1",
    ),
    "a header behind a hash": (
        "openmm/openmm#2403",
        lambda r: savetxt(r, delimiter=" ", header=" ".join(columns(r))),
        {},
        None,
    ),
    "a header with commas over rows with spaces": (
        "astropy/astropy#8674 (numpy.savetxt)",
        lambda r: savetxt(r, delimiter=" ", header=",".join(columns(r))),
        {},
        None,
    ),
    "lines about the robot before the header": (
        "influxdata/telegraf#9898",
        lambda r: "# robot: UR10e\nserial 2023\n\n" + text(columns(r)),
        {},
        None,
    ),
    "degrees": (
        "Kinovarobotics/ros2_kortex#32",
        lambda r: text(
            {
                "t [s]": r.t,
                **{f"q{j + 1} [deg]": np.degrees(r.q[:, j]) for j in range(6)},
                **{f"dq{j + 1} (deg/s)": np.degrees(r.dq[:, j]) for j in range(6)},
                **{f"tau{j + 1} [Nm]": r.tau[:, j] for j in range(6)},
            }
        ),
        {},
        None,
    ),
    "a name that says ms over seconds": (
        "swift-nav/piksi_tools#629",
        lambda r: text({"t (ms)": r.t, **{k: v for k, v in columns(r).items() if k != "t"}}),
        {},
        "expected at least 1 s in which a joint moves",
    ),
    "amperes under the name of a torque": (
        "msoon/PyMonsoon#37",
        lambda r: text({k + " [A]" * k.startswith("tau"): v for k, v in columns(r).items()}),
        {},
        "no column 'tau_J' for tau (measured torque); columns: t, q1",
    ),
    "names of joints in alphabetical order": (
        "UniversalRobots/Universal_Robots_ROS_Driver#619",
        lambda r: text(columns(r, UR, ALPHABET, "{joint}_{field}")),
        {},
        None,
    ),
    "a list in alphabetical order": (
        "UniversalRobots/Universal_Robots_ROS_Driver#173",
        lambda r: text(columns(r, UR, ALPHABET, "{joint}_{field}")),
        {"columns": {"q": [f"{UR[j]}_q" for j in ALPHABET]}},
        "data.columns.q has the robot's joints in another order: by their names it is ['shoulder_pan_q', 'shoulder_l",
    ),
    "alphabetical order under numbers": (
        "ros-industrial-attic/ur_modern_driver#113",
        lambda r: text(columns(replace(r, **{k: getattr(r, k)[:, ALPHABET] for k in ("q", "dq", "tau")}))),
        {},
        "only with the joints in another order: columns 3 2 1 4 5 6 (the log has them in alphabetical order)",
    ),
    "rostopic echo -p": ("jsk-ros-pkg/jsk_common#739", lambda r: rostopic(r, ALPHABET), {}, None),
    "two rows swapped": (
        "ros-drivers/phidgets_drivers#17",
        lambda r: text(rows(columns(r), swapped(len(r.t), 40))),
        {},
        None,
    ),
    "rows twice": (
        "stereolabs/zed-ros-wrapper#577",
        lambda r: text(rows(columns(r), np.sort(np.r_[np.arange(len(r.t)), 100, 100, 700]))),
        {},
        None,
    ),
    "ten rows of one time": (
        "ori-drs/pronto#54",
        lambda r: text(columns(replace(r, t=r.t)) | {"t": np.round(r.t, 1)}),
        {},
        "time does not increase at row 1: t is 0.0, then 0.0 s (",
    ),
    "time with one decimal": (
        "jetperch/pyjoulescope_ui#159",
        lambda r: text(columns(r) | {"t": np.floor(10 * r.t) / 10}),
        {},
        "log more digits of the time",
    ),
    "zero stamps first": (
        "stereolabs/zed-ros-wrapper#969",
        lambda r: text(columns(r) | {"t": np.where(np.arange(len(r.t)) < 5, 0.0, 1.7e9 + r.t)}, float_format="%.17g"),
        {},
        None,
    ),
    "a clock that is set back by seconds": (
        "ros/ros_comm#2336",
        lambda r: text(columns(r) | {"t": r.t - 3.0 * (r.t > 4)}),
        {},
        "time does not increase at row 1001",
    ),
    "simulated clock at 1.2": (
        "ADVRHumanoids/XBotControl#49 (no time in the log)",
        lambda r: text(columns(r) | {"t": 1.2 * r.t}),
        {},
        "in all moving joints: is t wrong (208.3 Hz by t, 250 Hz by dq)",
    ),
    "15 Hz for 21 Hz": (
        "vanadiumlabs/arbotix_ros#34",
        lambda r: text(columns(r) | {"t": r.t * 15 / 21.15}),
        {},
        "q changes 1.41 times as much as dq integrates to",
    ),
    "2 Hz for 10 Hz": (
        "ros-industrial/ros_canopen#259",
        lambda r: text(columns(r) | {"t": r.t / 5}),
        {},
        "is 0.2 times the slope of its q",
    ),
    "values held": ("sbgisen/vesc#69", lambda r: text(held(r, 8)), {}, 31.25),
    "an angle from 0 to one turn": (
        "Reach-Robotics/reach_robotics_sdk#6",
        lambda r: text(columns(replace(r, q=np.mod(r.q, 2 * np.pi)))),
        {},
        "turned",
    ),
    "an angle within half a turn": (
        "Kinovarobotics/kinova-ros#334",
        lambda r: text(columns(replace(r, q=np.mod(r.q + 1.5708, 2 * np.pi) - 1.5708))),
        {},
        "turned",
    ),
    "-pi where reading failed": (
        "Interbotix/interbotix_ros_core#46",
        lambda r: text(with_row(r, 500, q=-np.pi)),
        {},
        "failed",
    ),
    "one joint out of range in a row": (
        "agilexrobotics/piper_sdk#70",
        lambda r: text(with_row(r, 500, q=[*r.q[500, :1], 55.0, *r.q[500, 2:]])),
        {},
        "failed",
    ),
    "zeros in between": (
        "automaticaddison/yahboom_rosmaster#4",
        lambda r: text(with_row(r, slice(400, 404), q=0.0, dq=0.0, tau=0.0)),
        {},
        "failed",
    ),
    "an effort of NaN": (
        "moveit/moveit2_tutorials#767",
        lambda r: text(columns(replace(r, tau=0 * r.tau)) | {f"tau{j}": np.nan for j in range(1, 7)}),
        {},
        "tau: expected finite values, got nan at row 0 of joint 1",
    ),
    "an effort of zero": (
        "ros-controls/gz_ros2_control#169",
        lambda r: text(columns(replace(r, tau=0 * r.tau))),
        {},
        "is 0 in every row: this log holds no measured torque",
    ),
    "a velocity that follows the position": (
        "ros-controls/ros2_controllers#1230",
        lambda r: text(columns(replace(r, dq=np.where(np.arange(6) == 2, r.q - r.q.mean(0), r.dq)))),
        {},
        "does not follow the slope of its q",
    ),
    "a velocity of the other sign": (
        "robotology/mesh-support#1019",
        lambda r: text(columns(replace(r, dq=r.dq * [1, 1, -1, 1, 1, 1]))),
        {},
        "dq of joint 3 is of the other sign than the slope of its q",
    ),
    "a velocity of zero": (
        "o3de/o3de-extras#374",
        lambda r: text(columns(replace(r, dq=0 * r.dq))),
        {},
        "is 0 rad/s in every row, though q moves; leave dq out of the file",
    ),
    "an interrupted last row": (
        "Mechanical-Advantage/AdvantageScope#373",
        lambda r: text(columns(r))[:-60],
        {},
        "shorter",
    ),
    "a torque without gravity": (
        "Kinovarobotics/kinova-ros#366",
        lambda r: text(columns(replace(r, tau=moved(load_robot(**conf("robot/ur10e")), "commanded").tau))),
        {},
        "hardly contains gravity",
    ),
    "currents as efforts": (
        "UniversalRobots/Universal_Robots_ROS_Driver#286",
        lambda r: text(columns(replace(r, tau=r.tau / [13.2, 13.2, 9.9, 9.9, 9.9, 9.9]))),
        {},
        "times what ur10e needs: is it a current in A? Then set data.torque=motor and data.torque_constant=[Nm/A of",
    ),
    "currents of joints 1 and 3 in each other's column": (
        "ros-industrial/universal_robot#656",
        lambda r: text(columns(replace(r, tau=r.tau[:, ALPHABET]))),
        {},
        "columns 3, 1 of tau fit joints 1, 3",
    ),
    "two columns of one name": (
        "frankarobotics/libfranka#87",
        lambda r: text(columns(r)).replace("tau6\n", "tau6,q1\n", 1).replace("\n", ",9\n").replace(",9\n", "\n", 1),
        {},
        None,
    ),
}


@pytest.mark.long
@pytest.mark.parametrize("name", LOGS)
def test_a_log_of_a_public_report(tmp_path, ur, recording, name):
    _, make, arguments, expected = LOGS[name]
    path = tmp_path / "log.csv"
    path.write_text(make(recording))
    how = {"torque": "measured", "n_joints": 6, "model_joints": JOINTS, **arguments}
    if isinstance(expected, str) and expected not in ("turned", "shorter", "failed"):
        with pytest.raises(UserError) as caught:
            check_recording(ur, read(path, **how))
        assert expected in str(caught.value)
        assert "\n" not in str(caught.value)
        return
    got = read(path, **how, limits=(ur.q_min, ur.q_max))
    if isinstance(expected, float):
        assert got.rate_hz == pytest.approx(expected)
        assert "each value is repeated: the log has 250 rows/s, its values 31.25 per s" in got.notes[0]
        return
    at = {"shorter": slice(0, len(got.t)), "failed": np.isin(np.round(recording.t, 6), np.round(got.t, 6))}
    q, dq, tau = (getattr(recording, k)[at.get(str(expected), slice(-len(got.t), None))] for k in ("q", "dq", "tau"))
    assert len(recording.t) - len(got.t) <= 5
    shift = got.q - q
    if expected == "turned":
        shift -= 2 * np.pi * np.round(shift[0] / (2 * np.pi))
    assert np.abs(shift).max() < SENSIBLE
    np.testing.assert_allclose(got.dq, dq, atol=1e-6)
    np.testing.assert_allclose(got.tau, tau, atol=1e-4)
    check_recording(ur, got)


def test_a_repair_is_noted(tmp_path, recording):
    """Each repair adds a line, which the command line prints."""
    table = rows(columns(recording), np.sort(np.r_[np.arange(len(recording.t)), 100, 700]))
    table = rows(table, swapped(len(table["t"]), 40))
    table["q1"] = np.mod(table["q1"], 2 * np.pi)
    path = tmp_path / "log.csv"
    path.write_text(text(table))
    order, repeats, turns = read(path, torque="measured").notes
    assert order == "2 rows out of order are sorted by time"
    assert repeats == "2 repeated rows are left out"
    assert "q of joint 1 jumps by a turn" in turns


def test_a_names_array_gives_the_order(tmp_path, ur, recording):
    """In .npz the joints' names stand beside (T, n) arrays; data.joints then chooses."""
    r, path = recording, tmp_path / "log.npz"
    arrays = {k: getattr(r, k)[:, ALPHABET] for k in ("q", "dq", "tau")}
    np.savez(path, t=r.t, joint_names=[JOINTS[j] for j in ALPHABET], **arrays)
    for how in ({"model_joints": JOINTS}, {"joints": JOINTS}):
        np.testing.assert_array_equal(read(path, torque="measured", n_joints=6, **how).q, r.q)
    np.savez(path, t=r.t, **arrays)
    with pytest.raises(UserError, match=r"data\.joints: expected null, as the file names no joints"):
        read(path, torque="measured", joints=JOINTS)


def test_there_are_forty_reports():
    """Each row has a source, and no fault stands twice."""
    assert len(LOGS) + len(URDF) >= 40
    assert all("#" in row[0] for row in (*LOGS.values(), *URDF.values()))
