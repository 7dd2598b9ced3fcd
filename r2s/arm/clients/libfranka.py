"""Base class of the clients that use libfranka, and functions that open a connection and format error messages."""

import socket
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from r2s.arm.clients import fci
from r2s.arm.clients.collision_thresholds import CollisionThresholds
from r2s.arm.interface import ArmStopped
from r2s.arm.realtime import kept_scheduler
from r2s.errors import UserError, optional_import

DESK_PORT = 443  # https, Franka's web interface "Desk"
CONNECT_TIMEOUT_S = 3.0  # a control box at the other end of a cable answers within ms; libfranka waits about 60 s


class Client:
    """Base class of clients that use panda-python or pylibfranka; both libraries' RobotStates have equal attributes.

    If libfranka reports an error, the called method raises ArmStopped with libfranka's message.

    Attributes:
        name: value of the setting `arm=`, and name of the pip extra. package: name of the Python module.
        version: version of the arm's FCI.

    Args:
        address: host name or IP of the arm. realtime: whether to require a real-time kernel and priority.
    """

    name: str
    package: str
    version: int

    def __init__(self, address: str, realtime: bool):
        self._package = optional_import(self.package, f"arm={self.name}", self.name)
        config = self._package.RealtimeConfig
        config = config.kEnforce if realtime else config.kIgnore
        with kept_scheduler():
            self._robot = connect(lambda: self._package.Robot(address, config), self.name, address)

    def start(self) -> Any:
        """Start a torque motion; return the RobotState that the first command will answer."""
        raise NotImplementedError

    def exchange(self, tau: np.ndarray) -> Any:
        """Send tau (7,) Nm for this cycle, wait, and return the RobotState of the next cycle."""
        raise NotImplementedError

    def finish(self) -> None:
        """End the running motion."""
        raise NotImplementedError

    def idle(self) -> Any:
        """Return a new RobotState between motions; read twice, because the first state may be outdated."""
        return self._call(lambda: (self._robot.read_once(), self._robot.read_once())[1])

    def watch(self, seconds: float) -> tuple[np.ndarray, np.ndarray]:
        """Read a resting arm's states for `seconds`; return their times (k,) s by arm clock and computer clock."""
        times, begun = [], time.perf_counter()
        while time.perf_counter() < begun + seconds:
            times.append((self._call(self._robot.read_once).time.to_sec(), time.perf_counter()))
        arm, here = np.array(times).reshape(-1, 2).T
        return arm, here

    def recover(self) -> None:
        """Clear a reflex."""
        self._call(self._robot.automatic_error_recovery)

    def set_collision_thresholds(self, thresholds: CollisionThresholds) -> None:
        """Set the external torque and force at which the arm stops itself."""
        torque, force = list(thresholds.torque), list(thresholds.force)
        self._call(lambda: self._robot.set_collision_behavior(torque, torque, force, force))

    def close(self) -> None:
        """Close the connection."""
        self._robot = None

    def _call(self, function: Callable[[], Any]) -> Any:
        try:
            return function()
        except Exception as error:
            raise ArmStopped(one_line(error)) from error


def connect(make: Callable[[], Any], extra: str, address: str) -> Any:
    """Return the connected robot object that `make` creates.

    Raises:
        UserError: the connection failed; the message contains libfranka's reason.
    """
    if not is_reachable(address):
        raise UserError(f"arm={extra}: no connection to {address}: no answer; is the cable plugged in?")
    try:
        return make()
    except Exception as error:
        raise UserError(f"arm={extra}: no connection to {address}: {one_line(error)}") from None


def is_reachable(address: str) -> bool:
    """Return False if all connections to the address time out; a refused connection or another error yields True.

    The FCI port is tried last, because a connection to this port occupies the arm's only client slot.
    """
    for port in (DESK_PORT, fci.PORT):
        try:
            socket.create_connection((address, port), CONNECT_TIMEOUT_S).close()
        except TimeoutError:
            continue
        except OSError:
            pass  # refused, or an unknown host name, which libfranka reports
        return True
    return False


def one_line(error: BaseException) -> str:
    """Return libfranka's message as one line."""
    return " ".join(str(error).split()) or type(error).__name__
