"""Contact of a tool's tip with a surface within one step of 1 ms, implicit in stiffness, damping and friction.

Normal force: Hunt and Crossley (surface.py), as the mean over the path of the tip in the step: (V(d1) - V(d0)) /
(d1 - d0) with the potential V of K d^e. This discrete gradient (Gonzalez, J. Nonlinear Science 6, 1996) keeps the
energy of a bounce at any stiffness, and it contains touch and lift within a step. A semi-implicit step, q1 = q + h
dq1, has its velocities half a step before its positions; so the path begins at d0 = d - h rate / 2, and ends at d1 =
d0 + h (rate + rate1) / 2.

Tangential force: bristles in proportion to the load (Canudas de Wit et al., IEEE TAC 40(3), 1995), with deflection z
and z_s = `bristle`: dz/dt = v - |v| z / z_s, force -mu F (z + MICRO_DAMPING exp(-(|v| / SLIP)^2) dz/dt) / z_s at the
sphere's deepest point; backward Euler. In sliding this is mu F.

The unknown is the velocity at the end of the step. About a guess both forces are linear in it: a drive, and a matrix
that adds to the mass. The stick-slip law solves with them, so that a joint at rest sees the contact. `start_guess`,
`add_contact`, a solution and `next_guess` repeat until the guess is right, usually once; `finish_contact` ends the
step.
"""

import numpy as np

from r2s.compiled import njit
from r2s.errors import UserError
from r2s.physics.friction import MICRO_DAMPING
from r2s.physics.payload import ee_pose
from r2s.physics.robot import Robot
from r2s.physics.stick_slip import JointForces, coming_velocity
from r2s.physics.surface import Surface, normal_force

# Columns of a contact: surface (see `Surface`), tool, and what a step writes
K, EXPONENT, DAMPING, MU, BRISTLE, POINT, NORMAL, TIP, RADIUS = 0, 1, 2, 3, 4, 5, 8, 11, 14
# HALF: 0 for a plane. AXES: row by row. NORMAL: of a box, where the tip is
HALF, AXES, DEFLECTION, FORCE, DEPTH = 15, 18, 27, 30, 33
COLUMNS = DEPTH + 1
ROWS = 4  # of the Jacobian: normal, and the tangential part of x, y and z
# Columns of a guess. RATE: of the depth, and SLIDE (3): tangential velocity, at the beginning of the step. NEXT and
# SPEED: their guess for its end. BEGIN: m, where the path begins. LINEAR and SLID (3): force and velocity found.
RATE, SLIDE, BEGIN, NEXT, SPEED, NORMAL_FORCE, SLOPE = 0, 1, 4, 5, 6, 7, 8
SPRING, DAMPER, LINEAR, SLID = 9, 10, 11, 12
GUESS = SLID + 3

RIGID = 1e-6  # m, `bristle` of a surface without one: a fiftieth of an encoder's step at a tip
SLIP = 0.02  # m/s, damping of the bristles fades with speed, otherwise each reversal would cause a pulse of force
MARGIN = 1e-3  # m, a tip farther away does not touch within a step: a drive would have to give it 2000 m/s^2
FAR = 0.02  # m, a tip farther away would need 20 m/s
ROUNDS = 12  # most guesses
TOLERANCE = 1e-4  # of the force, error of the normal force at which they end
LATE = 1e-2  # of the force, by which the tangential force may then lag behind load and speed
NEGLIGIBLE = 1e-6  # N
SHORT = 1e-6  # of the depth, a shorter path has the force of its middle: the potential's difference is round-off


def contact_columns(robot: Robot, surface: Surface) -> np.ndarray:
    """Return (..., COLUMNS) of a surface and the robot's tool, before the first step.

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
        np.shape(box[1])[:-2],
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
    out[..., DEPTH] = -np.inf
    return out


@njit(cache=True, error_model="numpy")
def mean_force(contact, begin, rate, coming, h):
    """Return the mean normal force, N, over a step from depth `begin` m, and its slope, N s/m, in `coming`.

    rate, coming: m/s, of the depth at the beginning and at the end of the step.
    """
    middle = 0.5 * (rate + coming)
    span = h * middle
    end, power = begin + span, contact[EXPONENT]
    a, b = max(begin, 0.0), max(end, 0.0)
    resists = 1.0 + contact[DAMPING] * middle
    if (a == 0.0 and b == 0.0) or resists <= 0.0:
        return 0.0, 0.0
    if abs(span) > SHORT * max(a, b):
        if power == 1.0:
            force, last = 0.5 * (b * b - a * a) / span, b
        else:
            last = b**power
            force = (last * b - a ** (power + 1.0)) / ((power + 1.0) * span)
        slope = (last - force) / span
    else:
        depth = 0.5 * (a + b)
        force = depth**power
        slope = 0.5 * power * force / depth
    force *= contact[K]
    slope *= contact[K]
    return force * resists, 0.5 * (h * slope * resists + contact[DAMPING] * force)


@njit(cache=True, error_model="numpy")
def _from_box(contact, x, y, z):
    """Return the distance, m, of a point from the surface of a box, from whose centre it is at x, y, z m.

    Writes the normal there, and turns the bristles into the tangential plane.
    """
    axes, half, normal = contact[AXES : AXES + 9], contact[HALF : HALF + 3], contact[NORMAL : NORMAL + 3]
    square, face, least, side = 0.0, 0, -np.inf, 1.0
    normal[:] = 0.0
    for k in range(3):
        p = axes[k] * x + axes[3 + k] * y + axes[6 + k] * z
        beyond = abs(p) - half[k]
        if beyond > least:
            face, least, side = k, beyond, np.sign(p)
        if beyond > 0.0:
            square += beyond * beyond
            for i in range(3):
                normal[i] += np.sign(p) * beyond * axes[3 * i + k]
    distance = np.sqrt(square) if square > 0.0 else least
    for i in range(3):
        normal[i] = normal[i] / distance if square > 0.0 else side * axes[3 * i + face]
    z_n = 0.0
    for i in range(3):
        z_n += contact[DEFLECTION + i] * normal[i]
    for i in range(3):
        contact[DEFLECTION + i] -= z_n * normal[i]
    return distance


@njit(cache=True, error_model="numpy")
def near(contact, place, anchor, axis, dq, h, jacobian):
    """Write depth and Jacobian (ROWS, n) of a tip; return whether it may touch within the step.

    Args:
        contact: (COLUMNS,); of a tip that cannot touch, force and deflection become 0.
        place: position (3,) m and rotation (9,) of the link that carries the tool, in the base frame.
        anchor, axis: (n, 3) of the joints. dq: (n,) rad/s.
    """
    position, R = place
    rate = 0.0
    a, b, c = contact[TIP], contact[TIP + 1], contact[TIP + 2]
    x = position[0] + R[0] * a + R[1] * b + R[2] * c - contact[POINT]
    y = position[1] + R[3] * a + R[4] * b + R[5] * c - contact[POINT + 1]
    z = position[2] + R[6] * a + R[7] * b + R[8] * c - contact[POINT + 2]
    if contact[HALF] > 0.0:
        distance = _from_box(contact, x, y, z)
    else:
        distance = contact[NORMAL] * x + contact[NORMAL + 1] * y + contact[NORMAL + 2] * z
    nx, ny, nz, depth = contact[NORMAL], contact[NORMAL + 1], contact[NORMAL + 2], contact[RADIUS] - distance
    contact[DEPTH] = depth
    if depth > -FAR:
        x += contact[POINT] - contact[RADIUS] * nx  # the sphere's deepest point
        y += contact[POINT + 1] - contact[RADIUS] * ny
        z += contact[POINT + 2] - contact[RADIUS] * nz
        for j in range(len(dq)):
            u, v, w = x - anchor[j, 0], y - anchor[j, 1], z - anchor[j, 2]
            a, b, c = (
                axis[j, 1] * w - axis[j, 2] * v,
                axis[j, 2] * u - axis[j, 0] * w,
                axis[j, 0] * v - axis[j, 1] * u,
            )
            along = nx * a + ny * b + nz * c
            jacobian[0, j] = along
            jacobian[1, j], jacobian[2, j], jacobian[3, j] = a - nx * along, b - ny * along, c - nz * along
            rate -= along * dq[j]
        if depth + h * max(rate, 0.0) + MARGIN > 0.0:
            return True
    for k in range(3):
        contact[DEFLECTION + k] = contact[FORCE + k] = 0.0
    return False


@njit(cache=True, error_model="numpy")
def _bristles(contact, force, speed, h):
    """Return spring and damper, N/m and N s/m, of the tangential force under a normal force N at a speed m/s.

    The force is -(spring z + damper v), with deflection z at the beginning and velocity v at the end of a step.
    """
    reach = max(contact[BRISTLE], RIGID)
    late = MICRO_DAMPING * np.exp(-((speed / SLIP) ** 2)) / h
    damper = (1.0 + late) / (1.0 + h * speed / reach)
    stiff = contact[MU] * force / reach
    return stiff * (damper - late), stiff * h * damper


@njit(cache=True, error_model="numpy")
def _velocity(jacobian, dq, slide):
    """Return the rate of the depth, m/s, and write the tangential velocity (3,) m/s."""
    rate = 0.0
    slide[:] = 0.0
    for j in range(len(dq)):
        rate -= jacobian[0, j] * dq[j]
        for k in range(3):
            slide[k] += jacobian[1 + k, j] * dq[j]
    return rate, np.sqrt(slide[0] ** 2 + slide[1] ** 2 + slide[2] ** 2)


@njit(cache=True, error_model="numpy")
def start_guess(contact, jacobian, dq, h, guess):
    """Write the guess (GUESS,) that a tip goes on at dq (n,) rad/s."""
    rate, speed = _velocity(jacobian, dq, guess[SLIDE : SLIDE + 3])
    guess[RATE], guess[NEXT], guess[SPEED], guess[BEGIN] = rate, rate, speed, contact[DEPTH] - 0.5 * h * rate
    guess[NORMAL_FORCE], guess[SLOPE] = mean_force(contact, guess[BEGIN], rate, rate, h)


@njit(cache=True, error_model="numpy")
def add_contact(contact, jacobian, h, guess, mass, drive):
    """Add the contact, linear about the guess, to a packed mass matrix, kg m^2, and a drive (n,) Nm."""
    spring, damper = _bristles(contact, guess[NORMAL_FORCE], guess[SPEED], h)
    guess[SPRING], guess[DAMPER], slope = spring, damper, guess[SLOPE]
    force = guess[NORMAL_FORCE] + slope * (guess[RATE] - guess[NEXT])
    x = spring * contact[DEFLECTION] + damper * guess[SLIDE]
    y = spring * contact[DEFLECTION + 1] + damper * guess[SLIDE + 1]
    z = spring * contact[DEFLECTION + 2] + damper * guess[SLIDE + 2]
    slope, damper, row = h * slope, h * damper, 0
    for i in range(len(drive)):
        n, a, b, c = jacobian[0, i], jacobian[1, i], jacobian[2, i], jacobian[3, i]
        drive[i] += n * force - a * x - b * y - c * z
        n, a, b, c = slope * n, damper * a, damper * b, damper * c
        for k in range(i + 1):
            mass[row + k] += n * jacobian[0, k] + a * jacobian[1, k] + b * jacobian[2, k] + c * jacobian[3, k]
        row += i + 1


@njit(cache=True, error_model="numpy")
def next_guess(contact, jacobian, h, coming, guess):
    """Set the guess to the velocities found, coming (n,) rad/s; return whether the old guess was right."""
    force, fast = guess[NORMAL_FORCE], guess[SPEED]
    rate, speed = _velocity(jacobian, coming, guess[SLID : SLID + 3])
    guess[LINEAR] = force + guess[SLOPE] * (rate - guess[NEXT])
    guess[NEXT], guess[SPEED] = rate, speed
    new, guess[SLOPE] = mean_force(contact, guess[BEGIN], guess[RATE], rate, h)
    guess[NORMAL_FORCE] = new
    wrong = h * abs(speed - fast) / (max(contact[BRISTLE], RIGID) + h * max(speed, fast))
    late = contact[MU] * (abs(new - force) + new * wrong)
    return abs(new - guess[LINEAR]) <= TOLERANCE * new + NEGLIGIBLE and late <= LATE * new + NEGLIGIBLE


@njit(cache=True, error_model="numpy")
def finish_contact(contact, h, guess):
    """Write force and deflection after a step."""
    spring, damper, force = guess[SPRING], guess[DAMPER], guess[LINEAR]
    _deflect(contact, guess[SLID : SLID + 3], guess[SPEED], h, (force, spring, damper))


@njit(cache=True, error_model="numpy")
def _deflect(contact, slide, speed, h, terms):
    """Write the force of a normal force N, a spring and a damper, and the deflection after h s at a velocity (3,)."""
    force, spring, damper = terms
    reach, length = max(contact[BRISTLE], RIGID), 0.0
    z = contact[DEFLECTION : DEFLECTION + 3]
    for k in range(3):
        contact[FORCE + k] = force * contact[NORMAL + k] - spring * z[k] - damper * slide[k]
        z[k] = (z[k] + h * slide[k]) / (1.0 + h * speed / reach) if force > NEGLIGIBLE else 0.0
        length += z[k] * z[k]
    if length > reach * reach:
        z *= reach / np.sqrt(length)


@njit(cache=True, error_model="numpy")
def explicit_contact(contact, jacobian, dq, h):
    """Write force and deflection of a step that is much shorter than the contact's oscillation."""
    slide = np.empty(3)
    rate, speed = _velocity(jacobian, dq, slide)
    force = normal_force(contact[K], contact[EXPONENT], contact[DAMPING], contact[DEPTH], rate)
    spring, damper = _bristles(contact, force, speed, h)
    _deflect(contact, slide, speed, h, (force, spring, damper))


@njit(cache=True, error_model="numpy")
def contact_torque(contact, jacobian, out):
    """Write the joint torques (n,) Nm of the contact force."""
    x, y, z = contact[FORCE], contact[FORCE + 1], contact[FORCE + 2]
    normal = contact[NORMAL] * x + contact[NORMAL + 1] * y + contact[NORMAL + 2] * z
    for j in range(len(out)):
        out[j] = jacobian[0, j] * normal + jacobian[1, j] * x + jacobian[2, j] * y + jacobian[3, j] * z


@njit(cache=True, error_model="numpy")
def contact_velocity(touch, mass, damping, h, forces, dq_min, work, coming):
    """Write the velocities (n,) at the end of a step in contact into `coming`, force and deflection into the contact.

    Args:
        touch: contact (COLUMNS,) and Jacobian of `near`. work: (2 n + 6, n) at least, any content.
        mass, damping, h, forces, dq_min, coming: as for `coming_velocity`.
    """
    contact, jacobian = touch
    n, size, guess = len(coming), len(mass), np.empty(GUESS)
    own, desk = work[: n + 4], work[n + 4 :].reshape(-1)
    soft, drive = desk[:size], desk[size : size + n]
    loads = JointForces(forces.dq, drive, forces.friction, forces.rest, forces.edges)
    start_guess(contact, jacobian, forces.dq, h, guess)
    for _ in range(ROUNDS):
        soft[:] = mass
        drive[:] = forces.drive
        add_contact(contact, jacobian, h, guess, soft, drive)
        coming_velocity(soft, damping, h, loads, dq_min, own, coming)
        if next_guess(contact, jacobian, h, coming, guess):
            break
    finish_contact(contact, h, guess)
