"""Open a Franka client that is connected to the emulated control box of a hidden twin."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, closing, contextmanager
from functools import partial
from typing import Any

from r2s.arm.clients.collision_thresholds import CAUTIOUS, CollisionThresholds
from r2s.arm.clients.consent import Operator, find_operator
from r2s.arm.clients.fr3 import FR3
from r2s.arm.clients.franka import Franka
from r2s.arm.clients.panda import Panda
from r2s.arm.emulator.process import Emulator
from r2s.arm.twins.rigid_twin import RigidTwin
from r2s.errors import UserError, check_number, choices
from r2s.physics.robot import Robot

CLIENTS: dict[str, type[Panda]] = {"panda": Panda, "fr3": FR3}


def emulated_arm(
    robot: Robot,
    *,
    client: str,
    seed: int = 0,
    realtime: bool = False,
    noise: int = 0,
    payload: Any = 0.0,
    declared_payload: Any = None,
    surface: Any = False,
    operator: Operator | str | None = "terminal",
    collision_torque: Sequence[float] = CAUTIOUS.torque,
    collision_force: Sequence[float] = CAUTIOUS.force,
    moves: bool = True,
    speed_share: float = 1.0,
) -> AbstractContextManager[Franka]:
    """Open an emulated Panda or FR3 with the arguments from conf/arm/*_emulated.yaml.

    Args:
        robot: nominal model. client: 'panda' or 'fr3'. seed: random seed of the rigid twin that replaces the arm.
        realtime: whether the emulator runs at 1 kHz; if False, the emulator waits for each command (lock-step).
        noise, payload, declared_payload, surface: see `TwinBase`.
        operator, collision_torque, collision_force, speed_share, moves: see `Panda`.
    """
    if client not in CLIENTS:
        raise UserError(f"arm.client: {client!r}; allowed: {choices(CLIENTS)}")
    make = CLIENTS[client]
    CollisionThresholds(collision_torque, collision_force)  # checked before the emulator starts
    check_number("speed_share", speed_share, "(0, 1]")
    settings: dict[str, Any] = {"collision_torque": collision_torque, "collision_force": collision_force}
    settings |= {"declared_payload": declared_payload, "moves": moves, "speed_share": speed_share}
    arm = partial(make, robot, operator=find_operator(operator), **settings)
    own: dict[str, Any] = {"payload": payload, "declared_payload": declared_payload, "surface": surface}
    twin = partial(RigidTwin, robot, seed, noise=noise, **own)
    return _opened(arm, Emulator(twin, version=make.arm_type.version, realtime=realtime), realtime)


@contextmanager
def _opened(make_arm: Callable[[str], Franka], emulator: Emulator, realtime: bool) -> Iterator[Franka]:
    with emulator as address, closing(make_arm(address)) as arm:
        arm.realtime = realtime  # set here, because the argument `realtime` would require a real-time kernel
        yield arm
