"""The wire format of the Franka Control Interface (FCI), limited to what torque control needs.

A client connects to TCP port 1337 and sends its FCI version and its UDP port. The robot then sends one RobotState
per millisecond by UDP and, in a motion, expects a RobotCommand for each state. This module contains FCI version 5
(libfranka 0.9, Panda or FER) and version 10 (libfranka 0.18 or later, FR3). All structs are packed and little-endian.

Source: the public headers of libfranka-common (service_types.h, rbk_types.h), checked with panda-python, pylibfranka.
"""

import numpy as np

PORT = 1337  # libfranka uses only this port, so each robot needs its own address
VERSIONS = (5, 10)
HEADER = np.dtype([("command", "<u4"), ("id", "<u4"), ("size", "<u4")])  # size includes the header
CONNECT = np.dtype([("version", "<u2"), ("udp_port", "<u2")])
MOVE = np.dtype([("controller_mode", "<u4"), ("motion_generator_mode", "<u4")])  # the emulator ignores further fields
COLLISION = np.dtype(  # our clients set equal thresholds for motion with and without acceleration
    [
        ("torque_acceleration", "<f8", (2, 7)),
        ("lower_torque", "<f8", 7),
        ("upper_torque", "<f8", 7),
        ("force_acceleration", "<f8", (2, 6)),
        ("lower_force", "<f8", 6),
        ("upper_force", "<f8", 6),
    ]
)
LOAD = np.dtype([("m_load", "<f8"), ("F_x_Cload", "<f8", 3), ("I_load", "<f8", 9)])
SETTINGS = {  # requests that change the RobotState, and types of their data; the emulator ignores other settings
    "SetCollisionBehavior": COLLISION,
    "SetLoad": LOAD,
    "SetEEToK": np.dtype([("EE_T_K", "<f8", 16)]),
    "SetNEToEE": np.dtype([("NE_T_EE", "<f8", 16)]),
}


_SHARED = ("Connect", "Move", "StopMove")
_SETTERS = (
    "SetCollisionBehavior", "SetJointImpedance", "SetCartesianImpedance", "SetGuidingMode", "SetEEToK", "SetNEToEE",
    "SetLoad",
)  # fmt: skip
REQUESTS = {  # a request's number is its index
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
DONE, NOT_POSSIBLE, EMERGENCY = 0, 1, 5  # status of requests other than Move; NOT_POSSIBLE: also a wrong version


# codes of torque control in a Move request and in a motion's RobotState
# FCI version 5 has no motion generator "none", so libfranka 0.9 requests the generator of joint velocities
EXTERNAL_CONTROLLER = 2
GENERATOR_REQUESTED = {5: 1, 10: 4}
GENERATOR_RUNNING = {5: 2, 10: 5}
OTHER_CONTROLLER, NO_GENERATOR = 3, 0


IDLE, MOVE_MODE, GUIDING, REFLEX, USER_STOPPED = 1, 2, 3, 4, 5  # robot_mode


# indices in the 41 flags of `errors` and of `reflex_reason`
N_ERRORS = 41
JOINT_POSITION_LIMITS, JOINT_VELOCITY, JOINT_REFLEX, CARTESIAN_REFLEX = 0, 3, 6, 7
COMMUNICATION_CONSTRAINTS, TORQUE_DISCONTINUITY, TORQUE_RANGE = 25, 32, 34


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
        [("message_id", "<u8")]  # also the robot's time in ms
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
