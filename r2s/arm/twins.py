"""The hidden twins by their make: `arm=twin arm.make=...`."""

from typing import Any

from r2s.arm.elastic_twin import ElasticTwin
from r2s.arm.hidden_arm import HiddenArm
from r2s.arm.twin import Twin
from r2s.errors import UserError, check_number
from r2s.physics.robot import Robot

MAKES: dict[int, type[Twin] | type[ElasticTwin]] = {1: Twin, 2: ElasticTwin}


def twin(
    robot: Robot,
    *,
    make: int = 1,
    seed: int = 0,
    payload: Any = 0.0,
    stiffness: float | None = None,
    noise: int = 0,
    load: Any = None,
    friction: float = 1.0,
    late: float = 0.0,
) -> HiddenArm:
    """Return a hidden twin; the other arguments are those of `HiddenArm`.

    Args:
        make: 1: rigid or bending gears, LuGre friction, in DART. 2: what no model of ours has; see its file.

    Raises:
        UserError: there is no such make, or an argument is out of its range.
    """
    check_number("arm.make", make, "[1, inf)", whole=True)
    if make not in MAKES:
        raise UserError(f"arm.make: {make} is not allowed; there are {' and '.join(map(str, MAKES))}")
    return MAKES[make](robot, seed, payload, stiffness, noise, load, friction, late)
