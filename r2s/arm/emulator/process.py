"""An emulated Franka control box for libfranka's clients: our own FCI server in a process of its own, on loopback.

    with Emulator(partial(RigidTwin, robot, 3), version=5) as address:
        arm = Panda(robot, address, operator=lambda reason: True)

Any `Arm` of r2s can be behind it. In lock-step, the default, the arm's clock advances only with a command: the same
commands give the same motion, bit for bit, however slow either side is. In real time it runs at 1 kHz, and an answer
that arrives after its millisecond counts as missed. Manual start: `python -m r2s.arm.emulator --help`.

It emulates no network jitter, no brakes, and nothing that makes a motion safe beside a person.
"""

import argparse
import contextlib
import multiprocessing
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from r2s.arm.clients import fci
from r2s.arm.emulator.control import FAULT_KINDS, MAX_MISSED, Control, Fault
from r2s.arm.emulator.robot_model import urdf
from r2s.arm.emulator.server import Server, check_loopback, open_port
from r2s.arm.interface import Arm
from r2s.errors import UserError, choices
from r2s.physics.robot import OF_TASKS, load_robot

START_S = 180.0  # longest time for the process to import, compile and create its arm


class Emulator:
    """A `Server` in a process of its own, which ends with the context or with this process.

    Args:
        make_arm: creates the arm in that process, so it must be picklable: `partial(RigidTwin, robot, 3)`.
        version: of the FCI. 5: libfranka 0.9 (the Panda). 10: 0.18 and later (the FR3).
        address: a loopback address; default: the first free one, because clients always use port 1337.
        realtime: run at 1 kHz instead of in lock-step.
        faults: injected faults.
        max_missed: consecutive cycles without an answer that stop the arm. desk: settings of the box, see `Control`.
    """

    def __init__(
        self,
        make_arm: Callable[[], Arm],
        *,
        version: int,
        address: str | None = None,
        realtime: bool = False,
        faults: Sequence[Fault] = (),
        max_missed: int = MAX_MISSED,
        desk: Mapping[str, Any] | None = None,
    ):
        if version not in fci.VERSIONS:
            raise UserError(f"emulator: version {version}; allowed: {choices(map(str, fci.VERSIONS))}")
        if address is not None:
            check_loopback(address)
        self._settings = make_arm, version, address, realtime, faults, max_missed, desk

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
        """End the process."""
        self._process.terminate()
        self._process.join()


def _child(pipe, settings: tuple) -> None:
    os.setsid()  # as a control box, it receives no signal of the terminal
    try:
        server = _server(*settings)
    except UserError as error:
        pipe.send(error)
        return
    pipe.send(server.address)
    pipe.close()
    parent = multiprocessing.parent_process()
    assert parent is not None
    server.serve(parent.sentinel)  # type: ignore[arg-type]  # on POSIX a file descriptor


def _server(
    make_arm: Callable[[], Arm],
    version: int,
    address: str | None,
    realtime: bool,
    faults: Sequence[Fault],
    max_missed: int = MAX_MISSED,
    desk: Mapping[str, Any] | None = None,
) -> Server:
    socket = open_port(address)
    trial = make_arm()
    trial.move_to(trial.robot.q_home)
    trial.command(np.zeros(trial.robot.n))  # compiles; a client would time out during it
    trial.stop()
    arm = make_arm()
    control = Control(arm, version, faults, max_missed, desk)
    return Server(socket, control, urdf(arm.robot), version, realtime=realtime)


def main(arguments: Sequence[str] | None = None) -> None:
    """Serve a twin until Ctrl-C."""
    parser = argparse.ArgumentParser(prog="python -m r2s.arm.emulator", description="An emulated Franka arm.")
    parser.add_argument("--version", type=int, default=5, choices=fci.VERSIONS, help="5: Panda (default), 10: FR3")
    parser.add_argument("--robot", type=Path, help="YAML with the arguments of load_robot: conf/robot/panda.yaml")
    parser.add_argument("--seed", type=int, default=0, help="of the rigid twin")
    parser.add_argument("--surface", action="store_true", help="a table below the tip of the robot's tool")
    parser.add_argument("--address", help="a loopback address; default: the first free one")
    parser.add_argument("--realtime", action="store_true", help="1 kHz instead of lock-step")
    parser.add_argument("--fault", nargs="+", action="append", default=[], metavar="X",
                        help=f"KIND CYCLE [MOTION [CYCLES]], repeatable; KIND: {choices(FAULT_KINDS)}")  # fmt: skip
    options = parser.parse_args(arguments)
    from r2s.arm.twins.rigid_twin import RigidTwin

    try:
        robot = load_robot(**_read_robot(options.robot))
        faults = [_parse_fault(fault) for fault in options.fault]
        twin = partial(RigidTwin, robot, options.seed, surface=options.surface)
        server = _server(twin, options.version, options.address, options.realtime, faults)
    except UserError as error:
        print(error, file=sys.stderr)
        sys.exit(2)
    print(f"FCI version {options.version} at {server.address}, port {fci.PORT}; Ctrl-C ends it", flush=True)
    with contextlib.suppress(KeyboardInterrupt):
        server.serve(note=lambda line: print(line, flush=True))


def _parse_fault(fault: Sequence[str]) -> Fault:
    try:
        return Fault(fault[0], *map(int, fault[1:]))
    except (TypeError, ValueError) as error:
        if isinstance(error, UserError):
            raise
        raise UserError(
            f"--fault {' '.join(fault)}: expected KIND CYCLE [MOTION [CYCLES]] with whole numbers after KIND"
        ) from None


def _read_robot(path: Path | None) -> dict:
    if path is None:
        return {}
    import yaml

    try:
        settings = yaml.safe_load(path.read_text())
    except OSError as error:
        raise UserError(f"--robot {path}: {error.strerror}") from None
    if "defaults" in settings:
        raise UserError(f"--robot {path}: it extends another file ('defaults'); a complete file is required")
    return {k: v for k, v in settings.items() if k not in ("_target_", *OF_TASKS)}
