"""Define the columns of the arrays `contact` and `guess` (contact.py, sliding.py), and fill `contact`."""

import numpy as np

from r2s.errors import UserError
from r2s.physics.payload import ee_pose
from r2s.physics.robot import Robot
from r2s.physics.surface import Surface

# Columns of `contact`: the surface (see `Surface`), the tool, and the results of a step
K, EXPONENT, DAMPING, MU, BRISTLE, POINT, NORMAL, TIP, RADIUS = 0, 1, 2, 3, 4, 5, 8, 11, 14
# HALF: half edges of a box; 0: plane. AXES: box axes as columns, row by row. NORMAL: of a box, at the tip
HALF, AXES, DEFLECTION, FORCE, DEPTH = 15, 18, 27, 30, 33
# Columns for a box that slides on a table (sliding.py). MASS: 0 for a fixed surface. WEIGHT: N. TABLE: friction
# coefficient. REACH: m, ratio of the moment to the force of table friction. UP: table normal. VELOCITY (3): m/s, of
# center. SPIN: rad/s, about UP. STRAIN (4): m, elastic deflection on the table; the fourth value is REACH times an
# angle about UP. ARM (3): m, vector from the center to the contact. LOAD: N, table friction while the box slides.
MASS, INERTIA, WEIGHT, TABLE, REACH, UP = range(DEPTH + 1, DEPTH + 7)
VELOCITY, SPIN, STRAIN, ARM, LOAD = UP + 3, UP + 6, UP + 7, UP + 11, UP + 14
COLUMNS = LOAD + 1
ROWS = 4  # rows of the Jacobian: normal motion; x, y and z of the tangential motion
# Columns of `guess`. RATE, SLIDE (3): penetration rate and tangential velocity before the step. NEXT, SPEED: guessed
# rate and speed after the step. BEGIN: m, depth d0. LINEAR, SLID (3): solved normal force and tangential velocity
RATE, SLIDE, BEGIN, NEXT, SPEED, NORMAL_FORCE, SLOPE = 0, 1, 4, 5, 6, 7, 8
SPRING, DAMPER, LINEAR, SLID = 9, 10, 11, 12
# With a box: tip velocity before the step (3), contact force at constant tip velocity (3) N, decrease of this force
# per change of tip velocity (9) N s/m, velocity and spin of the box after the step (4), guessed speed of the box
TIP_BEGIN, FORCE_BEGIN, RESISTANCE = SLID + 3, SLID + 6, SLID + 9
BOX_END, BOX_SPEED = RESISTANCE + 9, RESISTANCE + 13
GUESS = BOX_SPEED + 1


def contact_columns(robot: Robot, surface: Surface) -> np.ndarray:
    """Return the initial array `contact` (..., COLUMNS) for a surface and the robot's tool.

    Raises:
        UserError: the robot has no tool, or a value of the surface is out of its range.
    """
    if robot.tool is None:
        raise UserError(f"robot.tool: {robot.name} has no tool that could touch the surface; give robot.tool=FILE")
    surface.check()
    place, axes = ee_pose(robot)
    law = surface.coefficient, surface.exponent, surface.damping, surface.friction, surface.bristle
    box = np.zeros(3) if surface.half is None else surface.half, np.eye(3) if surface.axes is None else surface.axes
    lead = np.broadcast_shapes(
        *(np.shape(a) for a in law), surface.point.shape[:-1], surface.normal.shape[:-1], np.shape(box[0])[:-1],
        np.shape(box[1])[:-2], np.shape(0.0 if surface.mass is None else surface.mass), np.shape(surface.table),
    )  # fmt: skip
    out = np.zeros((*lead, COLUMNS))
    for k, value in enumerate(law):
        out[..., k] = value
    out[..., POINT : POINT + 3], out[..., NORMAL : NORMAL + 3] = surface.point, surface.normal
    out[..., TIP : TIP + 3], out[..., RADIUS] = place + axes @ robot.tool.tip, robot.tool.radius
    if surface.half is not None:
        out[..., HALF : HALF + 3] = surface.half
        axes = np.asarray(surface.axes)
        out[..., AXES : AXES + 9] = axes.reshape(*axes.shape[:-2], 9)
    if surface.mass is not None and surface.half is not None:
        out[..., MASS], out[..., TABLE], out[..., UP : UP + 3] = surface.mass, surface.table, surface.normal
        out[..., WEIGHT] = out[..., MASS] * np.linalg.norm(robot.gravity)
        out[..., INERTIA] = out[..., MASS] * (np.square(surface.half[..., :2]).sum(-1) / 3.0)
        out[..., REACH] = surface.reach
    out[..., DEPTH] = -np.inf
    return out


def box_pose(contact: np.ndarray) -> np.ndarray:
    """Return box poses (..., 6), each a center, m, and a first axis, from `contact` (..., COLUMNS)."""
    return np.concatenate([contact[..., POINT : POINT + 3], contact[..., AXES : AXES + 9 : 3]], axis=-1)
