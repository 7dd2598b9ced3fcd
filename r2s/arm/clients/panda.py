"""Connect to a Panda (FER) through panda-python (libfranka 0.9): hardware, or the emulator in FCI version 5.

libfranka's control loop calls a callback once per millisecond, but r2s itself calls `Arm.command`. Therefore,
libfranka's loop runs in a separate thread. The callback passes each state to r2s and waits for a command. r2s
switches libfranka's rate limiter and low-pass off, so the arm receives unchanged commands.
"""

import threading
from collections.abc import Sequence
from queue import Empty, SimpleQueue
from typing import Any

import numpy as np

from r2s.arm.clients.collision_thresholds import CAUTIOUS, CollisionThresholds
from r2s.arm.clients.connection_check import PANDA, ArmType, Connection, check_joints
from r2s.arm.clients.consent import Operator, find_operator
from r2s.arm.clients.franka import Franka
from r2s.arm.clients.libfranka import Client, one_line
from r2s.arm.interface import ArmStopped
from r2s.physics.payload import payload_of
from r2s.physics.robot import Robot

NO_FILTER_HZ = 1000.0  # libfranka's kMaxCutoffFrequency: switches the low-pass off
OWNER_CHECK_S = 0.1  # s between two checks that the commanding thread is alive


class _PandaClient(Client):
    name, package = "panda", "panda_py.libfranka"

    def __init__(self, address: str, realtime: bool):
        self._motion: _Motion | None = None
        super().__init__(address, realtime)
        self.version = self._robot.server_version()

    def __del__(self):
        if self._motion is not None:  # ends the loop's thread, which waits for a command
            self._motion.answer(None)

    def start(self) -> Any:
        self._motion = _Motion(self._robot, self._package)
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

    def close(self) -> None:
        self._motion = self._robot = None


class _Motion:
    """libfranka's control loop in a thread: `next` returns a state, `answer` passes a command to the loop."""

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
            raise ArmStopped(one_line(state)) from state
        return state  # None only after `answer(None)`

    def answer(self, tau: np.ndarray | None) -> None:
        """Answer the last state from `next` with the command tau (7,) Nm; if tau is None, end the motion."""
        self._answers.put(tau if tau is None else tau.tolist())

    def join(self) -> None:
        """Wait until the motion has ended; call `answer(None)` first."""
        self._thread.join()
        while not self._states.empty():  # an interrupted reader may leave a state in the queue
            end = self._states.get()
            if isinstance(end, Exception):
                raise ArmStopped(one_line(end)) from end

    def _run(self) -> None:
        end: Exception | None = None
        try:
            self._robot.control(self._callback, limit_rate=False, cutoff_frequency=NO_FILTER_HZ)
        except Exception as error:
            end = error
        self._robot = None  # else a stored exception would keep the connection open
        self._states.put(end)

    def _callback(self, state: Any, _: Any) -> Any:
        # while control_command_success_rate is 0, the arm may ignore commands, so send zero torque
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
                return self._answers.get(timeout=OWNER_CHECK_S)
            except Empty:
                if not self._owner.is_alive():
                    raise RuntimeError("the thread that commanded the arm has ended") from None


class Panda(Franka):
    """A Franka Emika Panda.

    Attributes:
        arm_type: type of the arm. client_type: class of the client.
        within: function that clips a robot's limits to the arm's limits.

    Args:
        robot: limits and nominal model.
        address: host name or IP of the arm or of an emulator.
        operator: see `Franka`; 'terminal' asks a person at the terminal.
        realtime: whether to require a real-time kernel and priority; True for hardware, False for the emulator.
        collision_torque, collision_force: see `CollisionThresholds`. speed_share: see `Franka`.
        declared_payload: payload that the arm's gravity compensation assumes (Desk's end effector plus setLoad), see
            `payload_of`. r2s does not move an arm whose gravity compensation assumes another mass.
        moves: see `Connection`.

    Raises:
        UserError: the robot does not have 7 joints, panda-python is missing, no server of FCI version 5 answers at
            the address, or the connected arm does not match the model.
    """

    arm_type: ArmType = PANDA
    client_type: type[Client] = _PandaClient
    within = staticmethod(PANDA.within)

    def __init__(
        self,
        robot: Robot,
        address: str,
        *,
        operator: Operator | str | None = None,
        realtime: bool = False,
        collision_torque: Sequence[float] = CAUTIOUS.torque,
        collision_force: Sequence[float] = CAUTIOUS.force,
        declared_payload: Any = None,
        moves: bool = True,
        speed_share: float = 1.0,
    ):
        check_joints(robot)
        thresholds, operator = CollisionThresholds(collision_torque, collision_force), find_operator(operator)
        declared = payload_of(declared_payload, robot.payload_max, "arm.declared_payload")
        expected = Connection(self.arm_type, declared, moves)
        client = self.client_type(address, realtime)
        super().__init__(self.within(robot), client, operator, thresholds, expected, realtime, speed_share)
