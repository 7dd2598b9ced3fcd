"""A Franka arm for libfranka's clients that is not there: our own FCI server, in a process of its own, on loopback.

    with Emulator(partial(Twin, robot, 3), version=5) as address:
        arm = Panda(robot, address, operator=lambda reason: True)

Behind it stands any `Arm` of ours. In lock-step, the default, the arm's clock advances only when the command came:
however slow either side is, the same commands give the same motion, bit for bit. In real time it runs at 1 kHz and
an answer that is not there within its millisecond counts as missed. By hand: `python -m r2s.arm.emulator --help`.

What it cannot show: a real network's jitter, brakes, and whether a motion is safe to stand beside.
"""

import argparse
import contextlib
import multiprocessing
import signal
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from r2s.arm import fci
from r2s.arm.emulator.control import KINDS, PATIENCE, Control, Fault
from r2s.arm.emulator.server import Server, check_loopback, listen
from r2s.arm.interface import Arm
from r2s.errors import UserError, choices
from r2s.physics.robot import OF_TASKS, load_robot

START_S = 180.0  # for the child to import, compile and build its arm


class Emulator:
    """A `Server` in a process of its own, which ends with the context, and with this process if that dies.

    Args:
        make_arm: builds the arm there, so it must be picklable: `partial(Twin, robot, 3)`.
        version: 5 is what libfranka 0.9 speaks (the Panda), 10 is 0.18 and later (the FR3).
        address: a loopback address; the first free one by default, as a client can only ask for port 1337.
        realtime: run at 1 kHz instead of in lock-step.
        faults: what goes wrong, and when.
        patience: cycles in a row without an answer until the arm stops itself.
    """

    def __init__(
        self,
        make_arm: Callable[[], Arm],
        *,
        version: int,
        address: str | None = None,
        realtime: bool = False,
        faults: Sequence[Fault] = (),
        patience: int = PATIENCE,
    ):
        if version not in fci.VERSIONS:
            raise UserError(f"the emulator speaks version {choices(map(str, fci.VERSIONS))}, not {version}")
        if address is not None:
            check_loopback(address)
        self._settings = dict(
            make_arm=make_arm, version=version, address=address, realtime=realtime, faults=faults, patience=patience
        )

    def __enter__(self) -> str:
        """Start the server; return its address."""
        context = multiprocessing.get_context("spawn")  # a fork would copy threads in any state
        mine, its = context.Pipe()
        self._process = context.Process(target=_child, args=(its, self._settings), daemon=True, name="FCI emulator")
        self._process.start()
        its.close()
        try:
            told = mine.recv() if mine.poll(START_S) else None
        except EOFError:
            told = None
        mine.close()
        if isinstance(told, str):
            return told
        self.__exit__()
        raise told if isinstance(told, UserError) else RuntimeError("the FCI emulator did not start")

    def __exit__(self, *_: object) -> None:
        """End the process."""
        self._process.terminate()
        self._process.join()


def _child(pipe, settings: dict) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the parent, which stops its arm first
    try:
        server = _server(**settings)
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
    *,
    version: int,
    address: str | None,
    realtime: bool,
    faults: Sequence[Fault] = (),
    patience: int = PATIENCE,
) -> Server:
    listener = listen(address)
    trial = make_arm()
    trial.move_to(trial.robot.q_home)
    trial.command(np.zeros(trial.robot.n))  # compiles now what would take longer than a client waits
    trial.stop()
    arm = make_arm()
    control = Control(arm, version, faults, patience)
    return Server(listener, control, fci.urdf(arm.robot), version, realtime=realtime)


def main(arguments: Sequence[str] | None = None) -> None:
    """Serve a twin until Ctrl-C."""
    parser = argparse.ArgumentParser(prog="python -m r2s.arm.emulator", description="An emulated Franka arm.")
    parser.add_argument("--version", type=int, default=5, choices=fci.VERSIONS, help="5: Panda (default), 10: FR3")
    parser.add_argument("--robot", type=Path, help="YAML with the arguments of load_robot: conf/robot/panda.yaml")
    parser.add_argument("--seed", type=int, default=0, help="of the twin behind it")
    parser.add_argument("--address", help="a loopback address; default: the first free one")
    parser.add_argument("--realtime", action="store_true", help="1 kHz instead of lock-step")
    parser.add_argument("--fault", nargs="+", action="append", default=[], metavar="X",
                        help=f"KIND CYCLE [MOTION [CYCLES]], repeatable; KIND: {choices(KINDS)}")  # fmt: skip
    given = parser.parse_args(arguments)
    from r2s.arm.twin import Twin

    try:
        robot = load_robot(**_yaml(given.robot))
        faults = [_fault(words) for words in given.fault]
        server = _server(
            partial(Twin, robot, given.seed),
            version=given.version,
            address=given.address,
            realtime=given.realtime,
            faults=faults,
        )
    except UserError as error:
        print(error, file=sys.stderr)
        sys.exit(2)
    print(f"FCI version {given.version} at {server.address}, port {fci.PORT}; Ctrl-C ends it", flush=True)
    with contextlib.suppress(KeyboardInterrupt):
        server.serve(note=lambda line: print(line, flush=True))


def _fault(words: Sequence[str]) -> Fault:
    try:
        numbers = [int(word) for word in words[1:]]
        return Fault(words[0], *numbers)
    except (TypeError, ValueError) as error:
        if isinstance(error, UserError):
            raise
        raise UserError(
            f"--fault {' '.join(words)}: it is KIND CYCLE [MOTION [CYCLES]], all whole numbers but KIND"
        ) from None


def _yaml(path: Path | None) -> dict:
    if path is None:
        return {}
    import yaml

    try:
        settings = yaml.safe_load(path.read_text())
    except OSError as error:
        raise UserError(f"--robot {path}: {error.strerror}") from None
    if "defaults" in settings:
        raise UserError(
            f"--robot {path}: it goes on from another file ('defaults'); one that says everything is allowed"
        )
    return {k: v for k, v in settings.items() if k not in ("_target_", *OF_TASKS)}
