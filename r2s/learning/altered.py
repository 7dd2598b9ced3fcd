"""Arms that are not as they were identified: payloads, friction that has warmed, commands that come later."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from r2s.adaptation.telling import truth
from r2s.errors import UserError, check_number
from r2s.learning.randomization import Draw, carried, check_payload
from r2s.physics.dynamics import Dynamics
from r2s.physics.robot import Robot

LEVEL = ("coulomb", "viscous", "phi1")  # parameters of friction families that a warmth multiplies
# standard deviations of what is told: kg, kg m, shares; about what an estimate has after a second or two of motion
ERROR_KG, ERROR_KG_M, ERROR_SHARE = 0.03, 0.005, 0.05
KNOWN_S = 1.0  # after as much at most an estimate has come


@dataclass(frozen=True)
class Altered:
    """Arms as `draw` has them, changed: what a policy learns on that is told of it; a `Draw` that tells.

    friction of each joint ~ drawn x U(friction), delay ~ drawn + U(0, late), payload as of `carried`.
    told from U(0, KNOWN_S) s on: truth + N(0, ERROR); zeros before, as an estimate takes its time.

    Attributes:
        robot: the arm. center: what is believed of it, to which what is told is relative. draw: arms about it.
        payload: least and most kg. friction: least and most of what was drawn. late: s, most.

    Raises:
        UserError: no such payload, friction or delay.
    """

    robot: Robot
    center: Dynamics
    draw: Draw
    payload: Sequence[float] = (0.0, 1.5)
    friction: Sequence[float] = (0.7, 1.2)
    late: float = 0.005

    def __post_init__(self):
        check_changes(self.payload, self.friction, self.late)

    def __call__(self, rng: np.random.Generator, m: int) -> Dynamics:
        """Return m drawn dynamics."""
        return carried(
            self.robot, altered(self.robot, self.draw, self.friction, self.late, rng, m), self.payload, rng, m
        )

    def said(self, rng: np.random.Generator, dynamics: Dynamics) -> tuple[np.ndarray, np.ndarray]:
        """Return what is told (m, 4 + n), and from when on (m,) s."""
        right = truth(self.robot, self.center, dynamics)
        error = np.concatenate([[ERROR_KG], np.full(3, ERROR_KG_M), np.full(self.robot.n, ERROR_SHARE)])
        return right + error * rng.normal(size=right.shape), rng.uniform(0.0, KNOWN_S, len(right))


def altered(
    robot: Robot, draw: Draw, friction: Sequence[float], late: float, rng: np.random.Generator, m: int
) -> Dynamics:
    """Return m arms as `draw` has them with other friction and delay; arguments as of `Altered`."""
    base, (least, most) = draw(rng, m), friction
    names = base.family.names[: base.phi.shape[-1]]
    scale = np.where([n in LEVEL for n in names], rng.uniform(least, most, (m, robot.n, 1)), 1.0)
    return replace(base, phi=base.phi * scale, delay=base.delay + rng.uniform(0, late, m))


def check_changes(payload: Sequence[float], friction: Sequence[float], late: float) -> None:
    """Raise UserError unless these are payloads, shares of friction and a delay that there may be."""
    check_payload(payload)
    if not isinstance(friction, list | tuple) or len(friction) != 2:
        raise UserError(f"training.friction: {friction!r} is not allowed; [least, most] of what was identified is")
    for value in friction:
        check_number("training.friction", value, "(0, 5]")
    if friction[0] > friction[1]:
        raise UserError(f"training.friction: {friction[0]:g} is above {friction[1]:g}; the least goes first")
    check_number("training.late", late, "[0, 0.01]")
