"""The Franka arms of conf/arm, ready to use: each is open inside a `with`, and closed after it.

    with panda(robot, address="172.16.0.2") as arm:
        arm.move_to(robot.q_home)

The emulated ones are the same clients against our emulator of the control box, with a hidden twin behind it.
"""

import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, closing, contextmanager
from functools import partial

from r2s.arm.emulator.process import Emulator
from r2s.arm.fr3 import FR3
from r2s.arm.franka import Franka
from r2s.arm.panda import Panda
from r2s.arm.twin import Twin
from r2s.physics.robot import Robot


@contextmanager
def panda(robot: Robot, *, address: str, realtime: bool = True) -> Iterator[Panda]:
    """Open a Franka Emika Panda; the operator is asked before a reflex is cleared. Arguments: see `Panda`."""
    with closing(Panda(robot, address, clear=operator_agrees, realtime=realtime)) as arm:
        yield arm


@contextmanager
def fr3(robot: Robot, *, address: str, realtime: bool = True) -> Iterator[FR3]:
    """Open a Franka Research 3; the operator is asked before a reflex is cleared. Arguments: see `FR3`."""
    with closing(FR3(robot, address, clear=operator_agrees, realtime=realtime)) as arm:
        yield arm


def panda_emulated(
    robot: Robot, *, seed: int = 0, realtime: bool = False, noise: int = 0
) -> AbstractContextManager[Franka]:
    """Open a Panda that is emulated: libfranka's version 5, the twin `seed` behind it with the stream `noise`."""
    return _emulated(Panda, 5, partial(Twin, robot, seed, noise=noise), realtime)


def fr3_emulated(
    robot: Robot, *, seed: int = 0, realtime: bool = False, noise: int = 0
) -> AbstractContextManager[Franka]:
    """Open an FR3 that is emulated: libfranka's version 10, the twin `seed` behind it with the stream `noise`."""
    return _emulated(FR3, 10, partial(Twin, robot, seed, noise=noise), realtime)


@contextmanager
def _emulated(client: Callable[..., Franka], version: int, twin: partial[Twin], realtime: bool) -> Iterator[Franka]:
    emulator = Emulator(twin, version=version, realtime=realtime)
    with emulator as address, closing(client(twin.args[0], address, clear=lambda reason: True)) as arm:
        yield arm


def operator_agrees(reason: str) -> bool:
    """Ask whether a stop of the arm may be cleared; nobody at the terminal: no."""
    if not sys.stdin.isatty():
        return False
    return input(f"\nthe arm has stopped itself: {reason}\nis it safe to go on? [y/N] ").strip().lower() == "y"
