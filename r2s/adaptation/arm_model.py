"""Convert an identified arm to arrays for compiled functions: links, friction and latency.

Each joint has a table, which can represent any friction law. It has a column per speed and the rows FORWARD, BACKWARD
and SPEED_ONLY. At the presliding deflection z in [-1, 1], friction is z * FORWARD + SPEED_ONLY if z >= 0, else z *
BACKWARD + SPEED_ONLY.
"""

from typing import NamedTuple

import numpy as np

from r2s.adaptation.tuning import BREAKAWAY_SPEED, LEVEL_SPEED, TABLE_END
from r2s.compiled import njit
from r2s.physics.actuation import steps_late
from r2s.physics.dynamics import Dynamics
from r2s.physics.friction import PRESLIDING
from r2s.physics.newton_euler import links_of
from r2s.physics.payload import ee_pose
from r2s.physics.robot import Robot

POINTS = 401  # number of speeds per direction of a table; the speeds are denser near 0
FORWARD, BACKWARD, SPEED_ONLY = range(3)  # rows of a table


class ArmModel(NamedTuple):
    """Model of an arm with n joints and without a payload, in arrays of floats.

    `angle_friction` and `compliance` are 0 until `apply_correction` (model_correction.py) adds fitted values.
    """

    links: np.ndarray  # (n, LINK)
    compensated: np.ndarray  # (n, 4) kg and kg m, mass and first moment that gravity compensation uses
    declared: np.ndarray  # (4,) kg and kg m, the declared payload, which `compensated` includes
    payload_frame: np.ndarray  # (12,), position and axes of the payload frame in the last link's frame
    gravity: np.ndarray  # (3,) m/s^2
    armature: np.ndarray  # (n,) kg m^2
    offset: np.ndarray  # (n,) Nm; `Dynamics` explains offset, load and drag
    load: np.ndarray  # (n,)
    drag: np.ndarray  # (n, 2)
    angle_friction: np.ndarray  # (n, 2) Nm, friction proportional to sin q, to cos q
    compliance: np.ndarray  # (n,) rad/Nm, compliance of the gears
    table: np.ndarray  # (n, 3, 2 POINTS - 1) Nm, friction; rows: FORWARD, BACKWARD, SPEED_ONLY
    max_speed: np.ndarray  # (n,) rad/s, speed at the ends of the table
    presliding: np.ndarray  # (n,) rad
    level: np.ndarray  # (n,) Nm, sliding friction
    breakaway: np.ndarray  # (n,) Nm, largest torque that stiction balances
    latency: np.ndarray  # (2,) cycles, delay and lag
    payload_max: np.ndarray  # (2,) kg, m, largest mass of a payload and largest distance of its center, see `Robot`


def make_arm_model(robot: Robot, d: Dynamics) -> ArmModel:
    """Return the `ArmModel` of an arm; the arrays of its dynamics `d` must have no batch dimension."""
    position, axes = ee_pose(robot)
    compensated = np.column_stack([robot.mass, robot.mass[:, None] * robot.com])
    compensated[-1] += d.declared_payload
    max_speed = TABLE_END * robot.dq_max
    grid = np.linspace(-1, 1, 2 * POINTS - 1)
    speed = (np.sign(grid) * grid**2)[:, None] * max_speed
    speed_only = d.family.torque(speed, d.phi, np.zeros_like(speed))
    forward = d.family.torque(speed, d.phi, np.ones_like(speed)) - speed_only
    backward = speed_only - d.family.torque(speed, d.phi, -np.ones_like(speed))
    names = d.family.names[: d.phi.shape[-1]]
    presliding = d.phi[:, names.index("presliding")] if "presliding" in names else np.full(robot.n, PRESLIDING)
    slow = np.full(robot.n, BREAKAWAY_SPEED)
    slow_friction = np.abs([d.friction(slow), d.friction(-slow)]).max(0)
    sliding = np.full(robot.n, LEVEL_SPEED)
    latency = [float(x) for x in steps_late(d.delay, d.lag)]
    return ArmModel(
        links=links_of(robot, d.mass, d.com, d.inertia),
        compensated=compensated,
        declared=np.array(d.declared_payload, dtype=float),
        payload_frame=np.concatenate([position, axes.ravel()]),
        gravity=np.array(robot.gravity, dtype=float),
        armature=np.array(d.armature, dtype=float),
        offset=np.array(d.offset, dtype=float),
        load=np.array(d.load, dtype=float),
        drag=np.array(d.drag, dtype=float),
        angle_friction=np.zeros((robot.n, 2)),
        compliance=np.zeros(robot.n),
        table=np.ascontiguousarray(np.stack([forward, backward, speed_only]).transpose(2, 0, 1)),
        max_speed=max_speed,
        presliding=np.array(presliding, dtype=float),
        level=0.5 * np.abs(d.friction(sliding) - d.friction(-sliding)),
        breakaway=np.maximum(np.abs(d.breakaway).max(-1), slow_friction),
        latency=np.array(latency),
        payload_max=np.array(robot.payload_max, dtype=float),
    )


@njit(cache=True, inline="always")
def friction_torque(table, max_speed, v, z):
    """Return a joint's friction in Nm at speed v rad/s and presliding deflection z; table: (3, 2 POINTS - 1) Nm."""
    u = min(abs(v) / max_speed, 1.0) ** 0.5
    at = (u if v >= 0.0 else -u) * (POINTS - 1) + (POINTS - 1)
    k = min(int(at), 2 * POINTS - 3)
    share = at - k
    side = FORWARD if z >= 0.0 else BACKWARD
    sign = table[side, k] + share * (table[side, k + 1] - table[side, k])
    return sign * z + table[SPEED_ONLY, k] + share * (table[SPEED_ONLY, k + 1] - table[SPEED_ONLY, k])
