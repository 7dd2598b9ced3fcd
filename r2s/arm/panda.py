"""The Panda (FER) through panda-python, libfranka 0.9: hardware, or the emulator in version 5.

libfranka calls back once a millisecond; an `Arm` is called. So its loop runs in a thread, and its callback hands the
state over and waits for the command. Rate limiter and low-pass of libfranka are off: what is commanded is what the
arm gets, or nothing (r2s/arm/interface.py).
"""

import threading
from collections.abc import Callable
from queue import Empty, SimpleQueue
from typing import Any

import numpy as np

from r2s.arm.franka import CAUTIOUS, Collision, Franka, connect, package, words
from r2s.arm.interface import ArmStopped
from r2s.physics.robot import Robot

NO_FILTER_HZ = 1000.0  # libfranka's kMaxCutoffFrequency: the low-pass is off
WATCH_S = 0.1  # between looks whether the thread that commands is still alive


class Panda(Franka):
    """A Franka Emika Panda.

    Args:
        robot: its limits and nominal model.
        address: host name or IP of the arm, or of an emulator.
        operator: asked before the arm moves again after a stop, see `Franka`. collision: see there.
        realtime: demand a real-time kernel and priority, as hardware deserves; the emulator does not need them.

    Raises:
        UserError: panda-python is missing, or nothing that speaks version 5 answers at the address.
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
        super().__init__(robot, _PandaClient(address, realtime), operator, collision)


class _PandaClient:
    def __init__(self, address: str, realtime: bool):
        self._motion: _Motion | None = None
        self._libfranka = package("panda_py.libfranka", "panda")
        config = self._libfranka.RealtimeConfig
        config = config.kEnforce if realtime else config.kIgnore
        self._robot = connect(lambda: self._libfranka.Robot(address, config), "panda", address)

    def __del__(self):
        if self._motion is not None:  # nobody will answer its loop any more
            self._motion.answer(None)

    def idle(self) -> Any:
        return _ask(lambda: (self._robot.read_once(), self._robot.read_once())[1])  # the first may be an old one

    def start(self) -> Any:
        self._motion = _Motion(self._robot, self._libfranka)
        return self._motion.next()

    def exchange(self, tau: np.ndarray) -> Any:
        assert self._motion is not None
        self._motion.answer(tau)
        return self._motion.next()

    def finish(self) -> None:
        motion, self._motion = self._motion, None
        if motion is not None:
            motion.answer(None)
            motion.join()

    def recover(self) -> None:
        _ask(self._robot.automatic_error_recovery)

    def watch_for(self, collision: Collision) -> None:
        torque, force = list(collision.torque), list(collision.force)
        _ask(lambda: self._robot.set_collision_behavior(torque, torque, force, force))

    def close(self) -> None:
        self._motion = self._robot = None


class _Motion:
    """libfranka's control loop, turned inside out."""

    def __init__(self, robot: Any, libfranka: Any):
        self._robot, self._libfranka = robot, libfranka
        self._states: SimpleQueue = SimpleQueue()
        self._answers: SimpleQueue = SimpleQueue()
        self._owner = threading.current_thread()
        self._started, self._last = False, [0.0] * 7
        self._thread = threading.Thread(target=self._run, name="libfranka control loop")
        self._thread.start()

    def next(self) -> Any:
        """Return the RobotState of the next cycle."""
        state = self._states.get()
        if isinstance(state, Exception):
            self._thread.join()
            raise ArmStopped(words(state)) from state
        return state  # never None, which only an answer of None brings about

    def answer(self, tau: np.ndarray | None) -> None:
        """Answer the state that `next` returned last; None ends the motion."""
        self._answers.put(tau if tau is None else tau.tolist())

    def join(self) -> None:
        """Wait for the end of a motion that was asked to end."""
        self._thread.join()
        while not self._states.empty():  # a state may be left over if its reader was interrupted
            end = self._states.get()
            if isinstance(end, Exception):
                raise ArmStopped(words(end)) from end

    def _run(self) -> None:
        try:
            self._robot.control(self._callback, limit_rate=False, cutoff_frequency=NO_FILTER_HZ)
        except Exception as error:
            self._robot = None  # an exception that somebody keeps shall not keep the connection
            self._states.put(error)
        else:
            self._robot = None
            self._states.put(None)

    def _callback(self, state: Any, _: Any) -> Any:
        # until the arm counts commands it may not apply them, and the caller's first one shall not get lost
        self._started = self._started or state.control_command_success_rate > 0
        if not self._started:
            return self._libfranka.Torques(self._last)
        self._states.put(state)
        tau = self._wait()
        if tau is None:
            return self._libfranka.motion_finished(self._libfranka.Torques(self._last))
        self._last = tau
        return self._libfranka.Torques(tau)

    def _wait(self) -> list[float] | None:
        while True:
            try:
                return self._answers.get(timeout=WATCH_S)
            except Empty:
                if not self._owner.is_alive():
                    raise RuntimeError("the thread that commanded the arm has ended") from None


def _ask(question: Callable[[], Any]) -> Any:
    try:
        return question()
    except Exception as error:
        raise ArmStopped(words(error)) from error
