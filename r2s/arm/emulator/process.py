"""Emulate, in a separate process, a Franka control box to which libfranka's clients connect on loopback.

    with Emulator(partial(RigidTwin, robot, 3), version=5) as address:
        arm = Panda(robot, address, operator=lambda reason: True)

The emulated control box can control any `Arm` of 7 joints. In lock-step, the default, the arm's clock advances only
with a command. Equal commands then cause bit-identical motions, even on a slow computer. In real time, the arm's
clock runs at 1 kHz, and the client misses a cycle if its answer arrives after that cycle.

The emulator simulates neither network jitter nor brakes. A test on the emulator does not prove that a motion is safe
beside a person.
"""

import multiprocessing
import os
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from r2s.arm.clients import fci
from r2s.arm.emulator.control import MAX_MISSED, Control, Fault
from r2s.arm.emulator.robot_model import urdf
from r2s.arm.emulator.server import Server, open_port
from r2s.arm.interface import Arm
from r2s.errors import UserError, choices

START_S = 180.0  # longest time for the server's process to import, compile and create its arm


class Emulator:
    """Runs a `Server` in a child process, which ends when the context or the parent process ends.

    Args:
        make_arm: picklable function that creates the arm in the child process, like `partial(RigidTwin, robot, 3)`.
        version: FCI version, 5 for libfranka 0.9 (Panda), 10 for libfranka 0.18 and later (FR3).
        realtime: whether the emulator runs at 1 kHz; if False, the emulator waits for each command (lock-step).
        faults: faults that the emulator injects.
        max_missed: consecutive unanswered cycles after which the arm stops. desk: settings of the box, see `Control`.
    """

    def __init__(
        self,
        make_arm: Callable[[], Arm],
        *,
        version: int,
        realtime: bool = False,
        faults: Sequence[Fault] = (),
        max_missed: int = MAX_MISSED,
        desk: Mapping[str, Any] | None = None,
    ):
        if version not in fci.VERSIONS:
            raise UserError(f"emulator: version {version}; allowed: {choices(map(str, fci.VERSIONS))}")
        self._settings = make_arm, version, realtime, faults, max_missed, desk

    def __enter__(self) -> str:
        """Start the server; return its address."""
        context = multiprocessing.get_context("spawn")  # fork would copy locks that other threads hold
        local, remote = context.Pipe()
        self._process = context.Process(target=_child, args=(remote, self._settings), daemon=True, name="emulator")
        self._process.start()
        remote.close()
        try:
            started = local.recv() if local.poll(START_S) else None
        except EOFError:
            started = None
        local.close()
        if isinstance(started, str):
            return started
        self.__exit__()
        raise started if isinstance(started, UserError) else RuntimeError("the FCI emulator did not start")

    def __exit__(self, *_: object) -> None:
        """End the server's process."""
        self._process.terminate()
        self._process.join()


def _child(pipe, settings: tuple) -> None:
    make_arm, version, realtime, faults, max_missed, desk = settings
    os.setsid()  # like a control box, this process gets no signals from the terminal
    try:
        socket = open_port()
        arm = make_arm()
        arm.move_to(arm.robot.q_home)
        arm.command(np.zeros(arm.robot.n))  # compile now, because a client would time out during compilation
        arm.stop()
        arm = make_arm()
        control = Control(arm, version, faults, max_missed, desk)
        server = Server(socket, control, urdf(arm.robot), version, realtime=realtime)
    except UserError as error:
        pipe.send(error)
        return
    pipe.send(server.address)
    pipe.close()
    parent = multiprocessing.parent_process()
    assert parent is not None
    server.serve(parent.sentinel)  # type: ignore[arg-type]  # on POSIX a file descriptor
