"""Connect to an FR3 through pylibfranka (libfranka 0.18 and later): hardware, or the emulator in FCI version 10.

pylibfranka's readOnce and writeOnce have no rate limiter and no low-pass: the arm receives unchanged commands.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from r2s.arm.clients import connection_check, fr3_limits
from r2s.arm.clients.libfranka import Client
from r2s.arm.clients.panda import Panda
from r2s.physics.robot import Robot

# rad, braking distance from 0.2 rad/s. At the position limits of `within_fr3`, an FR3 allows 0.16 to 0.48 rad/s.
STOP_DISTANCE = 0.02


def within_fr3(robot: Robot) -> Robot:
    """Return the robot with its limits clipped to those of an FR3, and with an FR3's velocity limit.

    The velocity limit depends on the position. Near a position limit, an FR3 allows no speed. The new position limits
    exclude this region and a further STOP_DISTANCE.
    """
    margin = fr3_limits.VELOCITY_OFFSET**2 / (2 * fr3_limits.DECELERATION) + STOP_DISTANCE
    return replace(
        robot,
        q_min=np.maximum(robot.q_min, fr3_limits.Q_MIN + margin),
        q_max=np.minimum(robot.q_max, fr3_limits.Q_MAX - margin),
        dq_max=np.minimum(robot.dq_max, fr3_limits.DQ_MAX),
        velocity_envelope=(fr3_limits.DECELERATION, fr3_limits.VELOCITY_OFFSET),
    )


def as_driven(robot: Robot) -> Robot:
    """Return `within_fr3(robot)` if the robot's limits are within those of an FR3, else the unchanged robot."""
    limits = fr3_limits
    if robot.n != len(limits.Q_MIN) or robot.velocity_envelope is not None:
        return robot
    inside = (robot.q_min >= limits.Q_MIN) & (robot.q_max <= limits.Q_MAX) & (robot.dq_max <= limits.DQ_MAX)
    return within_fr3(robot) if inside.all() else robot


class _FR3Client(Client):
    name, package = "fr3", "pylibfranka"
    version = 10  # libfranka connects to no other version, and pylibfranka does not report the version

    def __init__(self, address: str, realtime: bool):
        super().__init__(address, realtime)
        self._control: Any = None
        self._last = [0.0] * 7

    def start(self) -> Any:
        return self._call(self._start)

    def exchange(self, tau: np.ndarray) -> Any:
        return self._call(lambda: self._exchange(tau))

    def finish(self) -> None:
        if self._control is not None:
            self._call(self._finish)
            self._control = None

    def close(self) -> None:
        self._control = self._robot = None

    def _start(self) -> Any:
        self._control, self._last = self._robot.start_torque_control(), [0.0] * 7
        while True:
            state, _ = self._control.readOnce()
            # while control_command_success_rate is 0, the arm may ignore commands, so send zero torque
            if state.control_command_success_rate > 0:
                return state
            self._control.writeOnce(self._package.Torques(self._last))

    def _exchange(self, tau: np.ndarray) -> Any:
        self._last = tau.tolist()
        self._control.writeOnce(self._package.Torques(self._last))
        return self._control.readOnce()[0]

    def _finish(self) -> None:
        torques = self._package.Torques(self._last)  # the last torque, because a step to zero could trigger a reflex
        torques.motion_finished = True
        self._control.writeOnce(torques)

    def _call(self, function: Callable[[], Any]) -> Any:
        try:
            return super()._call(function)
        except Exception:
            self._control = None
            raise


class FR3(Panda):
    """A Franka Research 3, with the arguments of `Panda` and the limits of `within_fr3`.

    Raises:
        UserError: the robot does not have 7 joints, pylibfranka is missing, no server of FCI version 10 answers at
            the address, or the connected arm does not match the model.
    """

    arm_type, client_type, within = connection_check.FR3, _FR3Client, staticmethod(within_fr3)
