"""The wire format of the Franka Control Interface (FCI), as far as torque control needs it.

A client opens TCP port 1337, says its version and a UDP port; the robot then sends a RobotState per millisecond by
UDP and, in a motion, takes a RobotCommand for each. Two generations are spoken here: version 5 (libfranka 0.9, the
Panda, FER) and version 10 (libfranka 0.18 and later, the FR3). All structs are packed and little-endian. Facts: the
public headers of libfranka-common (service_types.h, rbk_types.h), checked against both client packages.
"""

from dataclasses import replace
from xml.etree import ElementTree as ET

import mujoco
import numpy as np

from r2s.physics import description
from r2s.physics.dynamics import Dynamics
from r2s.physics.robot import Robot

PORT = 1337  # libfranka cannot ask for another one: several robots are several addresses
VERSIONS = (5, 10)
HEADER = np.dtype([("command", "<u4"), ("id", "<u4"), ("size", "<u4")])  # size includes the header
CONNECT = np.dtype([("version", "<u2"), ("udp_port", "<u2")])
MOVE = np.dtype([("controller_mode", "<u4"), ("motion_generator_mode", "<u4")])  # deviations follow, unused
COLLISION = np.dtype(  # thresholds of accelerating arms first, which are the same for our clients
    [
        ("torque_acceleration", "<f8", (2, 7)),
        ("lower_torque", "<f8", 7),
        ("upper_torque", "<f8", 7),
        ("force", "<f8", (4, 6)),
    ]
)


_SHARED = ("Connect", "Move", "StopMove")
_SETTERS = (
    "SetCollisionBehavior", "SetJointImpedance", "SetCartesianImpedance", "SetGuidingMode", "SetEEToK", "SetNEToEE",
    "SetLoad",
)  # fmt: skip
REQUESTS = {  # the number of a request is its place
    5: (*_SHARED, "GetCartesianLimit", *_SETTERS, "SetFilters", "AutomaticErrorRecovery", "LoadModelLibrary"),
    10: (*_SHARED, *_SETTERS, "AutomaticErrorRecovery", "GetRobotModel"),
}
MOVE_STATUS = {
    5: {
        "Success": 0, "MotionStarted": 1, "Preempted": 2, "NotPossible": 3, "InvalidArgument": 5,
        "ReflexAborted": 6, "EmergencyAborted": 7,
    },
    10: {
        "Success": 0, "MotionStarted": 1, "Preempted": 2, "NotPossible": 5, "InvalidArgument": 7,
        "ReflexAborted": 8, "EmergencyAborted": 9,
    },
}  # fmt: skip
DONE, NOT_POSSIBLE, EMERGENCY = 0, 1, 5  # status of the other requests; a wrong version is 1, too


# torque control in a Move request, and in the state while it runs; 0.9 has no "none" among motion generators
EXTERNAL_CONTROLLER = 2
GENERATOR_ASKED = {5: 1, 10: 4}
GENERATOR_RUNNING = {5: 2, 10: 5}
OTHER_CONTROLLER, NO_GENERATOR = 3, 0


IDLE, MOVE_MODE, GUIDING, REFLEX, USER_STOPPED = 1, 2, 3, 4, 5  # robot_mode


# places in `errors` and `reflex_reason`, of 41
N_ERRORS = 41
JOINT_POSITION_LIMITS, JOINT_VELOCITY, JOINT_REFLEX = 0, 3, 6
COMMUNICATION_CONSTRAINTS, TORQUE_DISCONTINUITY, TORQUE_RANGE = 25, 32, 34


# an FR3's own limits, which are not a Panda's: rad, rad/s, and, because it allows less speed the closer a joint is to
# its position limit, rad/s and rad/s^2; Franka's documentation
FR3_Q_MIN = np.array([-2.9007, -1.8361, -2.9007, -3.0770, -2.8763, 0.4398, -3.0508])
FR3_Q_MAX = np.array([2.9007, 1.8361, 2.9007, -0.1169, 2.8763, 4.6216, 3.0508])
FR3_DQ_MAX = np.array([2.62, 2.62, 2.62, 2.62, 5.26, 4.18, 5.26])
FR3_VELOCITY_OFFSET = np.array([0.6599, 0.2517, 0.2, 0.3533, 0.5757, 0.4878, 0.4628])
FR3_DECELERATION = np.array([6, 2.585, 3.5, 4, 17, 5.5, 17])


_STATE = (
    ("O_T_EE", 16), ("O_T_EE_d", 16), ("F_T_EE", 16), ("EE_T_K", 16), ("F_T_NE", 16), ("NE_T_EE", 16),
    ("m_ee", 1), ("I_ee", 9), ("F_x_Cee", 3), ("m_load", 1), ("I_load", 9), ("F_x_Cload", 3),
    ("elbow", 2), ("elbow_d", 2), ("tau_J", 7), ("tau_J_d", 7), ("dtau_J", 7), ("q", 7), ("q_d", 7),
    ("dq", 7), ("dq_d", 7), ("ddq_d", 7), ("joint_contact", 7), ("cartesian_contact", 6),
    ("joint_collision", 7), ("cartesian_collision", 6), ("tau_ext_hat_filtered", 7), ("O_F_ext_hat_K", 6),
    ("K_F_ext_hat_K", 6), ("O_dP_EE_d", 6), ("O_ddP_O", 3), ("elbow_c", 2), ("delbow_c", 2), ("ddelbow_c", 2),
    ("O_T_EE_c", 16), ("O_dP_EE_c", 6), ("O_ddP_EE_c", 6), ("theta", 7), ("dtheta", 7),
)  # fmt: skip
_ACCELEROMETERS = (("accelerometer_top", 18), ("accelerometer_bottom", 18))


def _state_type(number: str, values: tuple[tuple[str, int], ...]) -> np.dtype:
    flags = [(name, "u1", (N_ERRORS,)) for name in ("errors", "reflex_reason")]
    return np.dtype(
        [("message_id", "<u8")]  # is the robot's time in ms, too
        + [(name, number, (n,)) for name, n in values]
        + [("motion_generator_mode", "u1"), ("controller_mode", "u1"), *flags, ("robot_mode", "u1")]
        + [("control_command_success_rate", number)]
    )


STATE = {5: _state_type("<f8", _STATE), 10: _state_type("<f4", _STATE + _ACCELEROMETERS)}


_MOTION = (
    ("message_id", "<u8"), ("q_c", "<f8", (7,)), ("dq_c", "<f8", (7,)), ("O_T_EE_c", "<f8", (16,)),
    ("O_dP_EE_c", "<f8", (6,)), ("elbow_c", "<f8", (2,)), ("valid_elbow", "?"), ("motion_generation_finished", "?"),
    ("tau_J_d", "<f8", (7,)),
)  # fmt: skip
COMMAND = {5: np.dtype(list(_MOTION)), 10: np.dtype([*_MOTION, ("torque_command_finished", "?")])}
FINISHED = {5: "motion_generation_finished", 10: "torque_command_finished"}


def fr3_velocity_bounds(q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the least and the largest dq (7,) rad/s that an FR3 takes at q (7,) rad."""

    def bound(room: np.ndarray) -> np.ndarray:
        free = np.sqrt(2 * FR3_DECELERATION * np.maximum(room, 0)) - FR3_VELOCITY_OFFSET
        return np.minimum(FR3_DQ_MAX, np.maximum(0, free))

    return -bound(q - FR3_Q_MIN), bound(FR3_Q_MAX - q)


def outside_fr3(q: np.ndarray, dq: np.ndarray) -> tuple[int, str] | None:
    """Return the error and the words for a joint at q, dq (7,) rad, rad/s that is beyond an FR3's limits, or None."""
    out = np.maximum(FR3_Q_MIN - q, q - FR3_Q_MAX)
    i = int(out.argmax())
    if out[i] > 0:
        allowed = f"{FR3_Q_MIN[i]:g} to {FR3_Q_MAX[i]:g}"
        return JOINT_POSITION_LIMITS, f"joint {i + 1}: position {q[i]:.4f} rad, an FR3 allows {allowed}"
    low, high = fr3_velocity_bounds(q)
    over = np.maximum(low - dq, dq - high)
    i = int(over.argmax())
    if over[i] <= 0:
        return None
    allowed = f"{low[i]:.3f} to {high[i]:.3f}"
    return JOINT_VELOCITY, f"joint {i + 1}: velocity {dq[i]:.3f} rad/s, at {q[i]:.4f} rad an FR3 allows {allowed}"


def urdf(robot: Robot) -> str:
    """Return the arm as URDF, without shapes and with an FR3's joint limits: what GetRobotModel answers."""
    slowing = FR3_DECELERATION, FR3_VELOCITY_OFFSET
    fr3 = replace(robot, q_min=FR3_Q_MIN, q_max=FR3_Q_MAX, dq_max=FR3_DQ_MAX, slowing=slowing)
    links, _ = description.chain(robot, Dynamics.of(robot, np.zeros((robot.n, 3))), friction=False)
    return ET.tostring(description.urdf(fr3, links), encoding="unicode")


class Forward:
    """The pose of the arm's hand, as RobotState holds it."""

    def __init__(self, robot: Robot):
        self._model = robot.model(gravity=False)
        self._data = mujoco.MjData(self._model)
        self._site = self._model.site(robot.ee_site).id

    def __call__(self, q: np.ndarray) -> np.ndarray:
        """Return the homogeneous transform (16,), column by column, at q (n,) rad."""
        self._data.qpos[:] = q
        mujoco.mj_kinematics(self._model, self._data)
        pose = np.eye(4)
        pose[:3, :3] = self._data.site_xmat[self._site].reshape(3, 3)
        pose[:3, 3] = self._data.site_xpos[self._site]
        return pose.T.ravel()
