"""What is believed of an arm before it works, as arrays for a compiled cycle: links, friction, delay.

Friction is read from a table of each joint, whatever its family: what goes with the sign of the sliding, per
direction, and what goes with the velocity alone.
"""

from typing import NamedTuple

import numpy as np

from r2s.compiled import njit
from r2s.physics.actuation import steps_late
from r2s.physics.dynamics import Dynamics
from r2s.physics.friction import PRESLIDING
from r2s.physics.newton_euler import links_of
from r2s.physics.payload import hand
from r2s.physics.robot import Robot

POINTS = 401  # of a direction's table, denser towards rest
BEYOND = 1.5  # of dq_max, where the table ends
SLOW = 0.02  # rad/s, at which a breakaway that nobody has seen is taken for friction
FIRM = 0.1  # rad/s, of the level of friction
UP, DOWN, FLAT = range(3)  # rows of a table: with the sign of the sliding, positive and negative; with speed alone


class Believed(NamedTuple):
    """The arm of n joints without a payload; everything an array of floats.

    Attributes:
        links: (n, LINK). moments: (n, 4), what gravity compensation believes. hand: (12,). gravity: (3,).
        armature: (n,). offset, load: (n,). drag: (n, 2); as of `Dynamics`.
        turn: (n, 2) Nm, friction that goes with sin q and cos q. gives: (n,) rad/Nm, by which a gear bends; no
            identification looks for these (refinement.py).
        table: (n, 3, 2 POINTS - 1) Nm. fastest: (n,) rad/s at its end. presliding: (n,) rad.
        level: (n,) Nm, of sliding friction. edge: (n,) Nm, what holds a joint at rest at most.
        late: (2,) cycles, delay and lag.
    """

    links: np.ndarray
    moments: np.ndarray
    hand: np.ndarray
    gravity: np.ndarray
    armature: np.ndarray
    offset: np.ndarray
    load: np.ndarray
    drag: np.ndarray
    turn: np.ndarray
    gives: np.ndarray
    table: np.ndarray
    fastest: np.ndarray
    presliding: np.ndarray
    level: np.ndarray
    edge: np.ndarray
    late: np.ndarray


def believed(robot: Robot, d: Dynamics) -> Believed:
    """Return the arrays of an arm with these dynamics, of no batch shape."""
    place, axes = hand(robot)
    moments = np.column_stack([robot.mass, robot.mass[:, None] * robot.com])
    moments[-1] += d.told
    fastest = BEYOND * robot.dq_max
    side = np.linspace(-1, 1, 2 * POINTS - 1)
    speed = (np.sign(side) * side**2)[:, None] * fastest
    flat = d.family.torque(speed, d.phi, np.zeros_like(speed))
    up = d.family.torque(speed, d.phi, np.ones_like(speed)) - flat
    down = flat - d.family.torque(speed, d.phi, -np.ones_like(speed))
    names = d.family.names[: d.phi.shape[-1]]
    distance = d.phi[:, names.index("presliding")] if "presliding" in names else np.full(robot.n, PRESLIDING)
    slow = np.full(robot.n, SLOW)
    both = np.abs([d.friction(slow), d.friction(-slow)]).max(0)
    firm = np.full(robot.n, FIRM)
    late = [float(x) for x in steps_late(d.delay, d.lag)]
    return Believed(
        links=links_of(robot, d.mass, d.com, d.inertia),
        moments=moments,
        hand=np.concatenate([place, axes.ravel()]),
        gravity=np.array(robot.gravity, dtype=float),
        armature=np.array(d.armature, dtype=float),
        offset=np.array(d.offset, dtype=float),
        load=np.array(d.load, dtype=float),
        drag=np.array(d.drag, dtype=float),
        turn=np.zeros((robot.n, 2)),
        gives=np.zeros(robot.n),
        table=np.ascontiguousarray(np.stack([up, down, flat]).transpose(2, 0, 1)),
        fastest=fastest,
        presliding=np.array(distance, dtype=float),
        level=0.5 * np.abs(d.friction(firm) - d.friction(-firm)),
        edge=np.maximum(np.abs(d.breakaway).max(-1), both),
        late=np.array(late),
    )


@njit(cache=True, inline="always")
def friction(table, fastest, v, z):
    """Return Nm at v rad/s, with bristles bent by z in [-1, 1]; table (3, 2 POINTS - 1) of one joint."""
    u = min(abs(v) / fastest, 1.0) ** 0.5
    at = (u if v >= 0.0 else -u) * (POINTS - 1) + (POINTS - 1)
    k = min(int(at), 2 * POINTS - 3)
    share = at - k
    side = UP if z >= 0.0 else DOWN
    sign = table[side, k] + share * (table[side, k + 1] - table[side, k])
    return sign * z + table[FLAT, k] + share * (table[FLAT, k + 1] - table[FLAT, k])
