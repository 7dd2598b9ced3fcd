"""The FR3 through pylibfranka, libfranka 0.18 and later: hardware, or the emulator in version 10.

pylibfranka has neither rate limiter nor low-pass in this loop: what is commanded is what the arm gets.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from r2s.arm import fci
from r2s.arm.franka import CAUTIOUS, Collision, Franka, connect, package, words
from r2s.arm.interface import ArmStopped
from r2s.physics.robot import Robot

STOPS_IN = 0.02  # rad, of a joint that is brought to rest from 0.2 rad/s, which is what is allowed there


def within_fr3(robot: Robot) -> Robot:
    """Return a robot that stays within an FR3's limits as well as its own, and slows down before them as an FR3 does.

    An FR3 allows no speed in the last hundredths of a radian: they are cut off, and what a stop takes before them.
    """
    still = fci.FR3_VELOCITY_OFFSET**2 / (2 * fci.FR3_DECELERATION) + STOPS_IN
    return replace(
        robot,
        q_min=np.maximum(robot.q_min, fci.FR3_Q_MIN + still),
        q_max=np.minimum(robot.q_max, fci.FR3_Q_MAX - still),
        dq_max=np.minimum(robot.dq_max, fci.FR3_DQ_MAX),
        slowing=(fci.FR3_DECELERATION, fci.FR3_VELOCITY_OFFSET),
    )


class FR3(Franka):
    """A Franka Research 3.

    Args:
        robot: the arm that the policy knows; what an FR3 allows less is cut off here (`within_fr3`).
        address: host name or IP of the arm, or of an emulator.
        operator: asked before the arm moves again after a stop, see `Franka`. collision: see there.
        realtime: demand a real-time kernel and priority, as hardware deserves; the emulator does not need them.

    Raises:
        UserError: pylibfranka is missing, or nothing that speaks its version answers at the address.
    """

    def __init__(
        self,
        robot: Robot,
        address: str,
        *,
        operator: Callable[[str], bool] | None = None,
        realtime: bool = False,
        collision: Collision = CAUTIOUS,
    ):
        super().__init__(within_fr3(robot), _FR3Client(address, realtime), operator, collision)


class _FR3Client:
    def __init__(self, address: str, realtime: bool):
        self._pylibfranka = package("pylibfranka", "fr3")
        config = self._pylibfranka.RealtimeConfig
        config = config.kEnforce if realtime else config.kIgnore
        self._robot = connect(lambda: self._pylibfranka.Robot(address, config), "fr3", address)
        self._control: Any = None
        self._last = [0.0] * 7

    def idle(self) -> Any:
        return self._ask(lambda: (self._robot.read_once(), self._robot.read_once())[1])  # the first may be old

    def start(self) -> Any:
        return self._ask(self._start)

    def exchange(self, tau: np.ndarray) -> Any:
        return self._ask(lambda: self._exchange(tau))

    def finish(self) -> None:
        if self._control is not None:
            self._ask(self._finish)
            self._control = None

    def recover(self) -> None:
        self._ask(self._robot.automatic_error_recovery)

    def watch_for(self, collision: Collision) -> None:
        torque, force = list(collision.torque), list(collision.force)
        self._ask(lambda: self._robot.set_collision_behavior(torque, torque, force, force))

    def close(self) -> None:
        self._control = self._robot = None

    def _start(self) -> Any:
        self._control, self._last = self._robot.start_torque_control(), [0.0] * 7
        while True:
            state, _ = self._control.readOnce()
            # until the arm counts commands it may not apply them, and the caller's first one shall not get lost
            if state.control_command_success_rate > 0:
                return state
            self._control.writeOnce(self._pylibfranka.Torques(self._last))

    def _exchange(self, tau: np.ndarray) -> Any:
        self._last = tau.tolist()
        self._control.writeOnce(self._pylibfranka.Torques(self._last))
        return self._control.readOnce()[0]

    def _finish(self) -> None:
        torques = self._pylibfranka.Torques(self._last)  # a step to zero could be a reflex
        torques.motion_finished = True
        self._control.writeOnce(torques)

    def _ask(self, question: Callable[[], Any]) -> Any:
        try:
            return question()
        except Exception as error:
            self._control = None
            raise ArmStopped(words(error)) from error
