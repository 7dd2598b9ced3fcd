"""The Franka arms of conf/arm, ready to use: each is open inside a `with`, and closed after it.

    with panda(robot, address="172.16.0.2") as arm:
        arm.move_to(robot.q_home)

The emulated ones are the same clients against our emulator of the control box, with a hidden twin behind it.
"""

import sys
import termios
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, closing, contextmanager
from functools import partial
from typing import Any

from r2s.arm.emulator.process import Emulator
from r2s.arm.fr3 import FR3
from r2s.arm.franka import CAUTIOUS, Collision, Franka
from r2s.arm.panda import Panda
from r2s.arm.twin import Twin
from r2s.errors import UserError
from r2s.physics.robot import Robot

AGREED = "go on"  # what an operator types


@contextmanager
def panda(
    robot: Robot,
    *,
    address: str,
    realtime: bool = True,
    operator: str = "terminal",
    collision_torque: Sequence[float] = CAUTIOUS.torque,
    collision_force: Sequence[float] = CAUTIOUS.force,
) -> Iterator[Panda]:
    """Open a Franka Emika Panda; after a stop the operator is asked at the terminal. Arguments: see `Panda`."""
    collision, asked = Collision(collision_torque, collision_force), _operator(operator)
    with closing(Panda(robot, address, operator=asked, realtime=realtime, collision=collision)) as arm:
        yield arm


@contextmanager
def fr3(
    robot: Robot,
    *,
    address: str,
    realtime: bool = True,
    operator: str = "terminal",
    collision_torque: Sequence[float] = CAUTIOUS.torque,
    collision_force: Sequence[float] = CAUTIOUS.force,
) -> Iterator[FR3]:
    """Open a Franka Research 3; after a stop the operator is asked at the terminal. Arguments: see `FR3`."""
    collision, asked = Collision(collision_torque, collision_force), _operator(operator)
    with closing(FR3(robot, address, operator=asked, realtime=realtime, collision=collision)) as arm:
        yield arm


def panda_emulated(
    robot: Robot,
    *,
    seed: int = 0,
    realtime: bool = False,
    noise: int = 0,
    payload: Any = 0.0,
    load: Any = None,
    operator: str = "terminal",
    collision_torque: Sequence[float] = CAUTIOUS.torque,
    collision_force: Sequence[float] = CAUTIOUS.force,
) -> AbstractContextManager[Franka]:
    """Open a Panda that is emulated: libfranka's version 5, the twin `seed` behind it with the stream `noise`.

    What it carries, and what it was told of that: as of `HiddenArm`.
    """
    collision = Collision(collision_torque, collision_force)
    client = partial(Panda, operator=_operator(operator), collision=collision)
    return _emulated(client, 5, partial(Twin, robot, seed, payload=payload, noise=noise, load=load), realtime)


def fr3_emulated(
    robot: Robot,
    *,
    seed: int = 0,
    realtime: bool = False,
    noise: int = 0,
    payload: Any = 0.0,
    load: Any = None,
    operator: str = "terminal",
    collision_torque: Sequence[float] = CAUTIOUS.torque,
    collision_force: Sequence[float] = CAUTIOUS.force,
) -> AbstractContextManager[Franka]:
    """Open an FR3 that is emulated: libfranka's version 10, the twin `seed` behind it with the stream `noise`.

    What it carries, and what it was told of that: as of `HiddenArm`.
    """
    collision = Collision(collision_torque, collision_force)
    client = partial(FR3, operator=_operator(operator), collision=collision)
    return _emulated(client, 10, partial(Twin, robot, seed, payload=payload, noise=noise, load=load), realtime)


@contextmanager
def _emulated(client: Callable[..., Franka], version: int, twin: partial[Twin], realtime: bool) -> Iterator[Franka]:
    emulator = Emulator(twin, version=version, realtime=realtime)
    with emulator as address, closing(client(twin.args[0], address)) as arm:
        yield arm


def _operator(where: str) -> Callable[[str], bool]:
    if where != "terminal":
        raise UserError(
            f"operator: '{where}' is not allowed; terminal is, where somebody types that the arm may go on"
        )
    return operator_agrees


def operator_agrees(reason: str) -> bool:
    """Ask at the terminal whether an arm that was stopped may move again; nobody there, or any other answer: no."""
    if not sys.stdin.isatty():
        return False
    termios.tcflush(sys.stdin, termios.TCIFLUSH)  # what was typed before the question is no answer
    print(f"\nthe arm was stopped: {reason}", file=sys.stderr)
    try:
        said = input(f"look at it; type '{AGREED}' when it may move again, anything else ends the run: ")
    except EOFError:
        return False
    return said.strip() == AGREED
