"""Solve a 1 ms step of a tip's contact with a surface, by a method implicit in stiffness, damping and friction.

The normal force is the mean of Hunt and Crossley's force (surface.py) over the step. Between the depths d0 and d1,
the mean of the elastic force K d^e is the discrete gradient (V(d1) - V(d0)) / (d1 - d0) of the force's potential V
(Gonzalez, Journal of Nonlinear Science 6, 1996). A discrete gradient conserves the energy of a bounce at any
stiffness, even if contact begins or ends within the step. A semi-implicit step computes q1 = q + h dq1, so velocities
are half a step older than positions. Therefore, d0 = d - h rate / 2 and d1 = d0 + h (rate + rate1) / 2, with the
depth d and the penetration rates `rate` before and `rate1` after the step.

The stiffness of tangential bristles is proportional to the normal force F (Canudas de Wit et al., IEEE TAC 40(3),
1995). Backward Euler integrates the bristle deflection z: dz/dt = v - |v| z / z_s with the sliding velocity v and z_s
= `bristle`. The friction -mu F (z + MICRO_DAMPING exp(-(|v| / SLIP)^2) dz/dt) / z_s acts at the sphere's deepest
point. While the tip slides steadily, the magnitude of friction is mu F.

The unknowns of a contact step are the joint velocities at the step's end. `add_contact` linearizes normal force and
friction about a guess of the unknowns. `add_contact` then adds the linearized force's constant term to the driving
torque, and its linear term to the mass matrix. `coming_velocity` (stick_slip.py) solves stiction together with
contact, so contact can move a resting joint. `start_guess` writes the first guess. `contact_velocity` repeats
`add_contact`, `coming_velocity` and `next_guess` until the guess is accurate; one pass is usually enough.
`finish_contact` ends the step.
"""

import numpy as np

from r2s.compiled import njit
from r2s.physics.contact_layout import (
    AXES,
    BEGIN,
    BOX_END,
    BRISTLE,
    DAMPER,
    DAMPING,
    DEFLECTION,
    DEPTH,
    EXPONENT,
    FORCE,
    FORCE_BEGIN,
    GUESS,
    HALF,
    LINEAR,
    MASS,
    MU,
    NEXT,
    NORMAL,
    NORMAL_FORCE,
    POINT,
    RADIUS,
    RATE,
    RESISTANCE,
    SLID,
    SLIDE,
    SLOPE,
    SPEED,
    SPRING,
    TIP,
    TIP_BEGIN,
    VELOCITY,
    K,
)
from r2s.physics.friction import MICRO_DAMPING
from r2s.physics.sliding import contact_point_velocity, load_box, move_box, slide, start_box, yielded, yielding
from r2s.physics.stick_slip import JointForces, coming_velocity
from r2s.physics.surface import normal_force

RIGID = 1e-6  # m, smallest `bristle`, for a rigid surface: a fiftieth of the tip's motion per encoder step
SLIP = 0.02  # m/s, speed above which bristle damping fades out; without fading, each reversal causes a force pulse
MARGIN = 1e-3  # m, margin in the prediction of a touch: a tip would need 2000 m/s^2 to cross the margin in a step
FAR = 0.02  # m, a tip farther away would need 20 m/s to touch within a step
ROUNDS = 12  # largest number of guesses in a step
TOLERANCE = 1e-4  # allowed relative error of the normal force after the last guess
LATE = 1e-2  # allowed (error of the tangential force due to the guess) / (normal force)
BOX_LATE = 1e-3  # allowed relative error that the guessed speed of the box causes in table friction
NEGLIGIBLE = 1e-6  # N, force that is treated as 0
SHORT = 1e-6  # ratio |d1 - d0| / depth below which V(d1) - V(d0) is round-off; mean_force then uses the mean depth


@njit(cache=True, error_model="numpy")
def mean_force(contact, begin, rate, coming, h):
    """Return a step's mean normal force, N, and its derivative with respect to `coming`, N s/m.

    begin: m, penetration depth at the step's beginning. rate, coming: m/s, penetration rates at beginning and end.
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
    """Return the distance, m, from a box's surface to a point at x, y, z m from the box's center; negative: inside.

    Also write the surface normal at the point, and project the bristle deflection onto the tangent plane.
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
    """Write a tip's depth and Jacobian (ROWS, n); return whether the tip may touch the surface in this step.

    Call `near` only once per step: if the tip cannot touch the box, `near` also moves the box by one step.

    Args:
        contact: (COLUMNS,), see contact_layout.py; force and deflection become 0 if the tip cannot touch the surface.
        place: position (3,) m and rotation (9,), in the base frame, of the link with the tool.
        anchor, axis: (n, 3) m and (n, 3), position and direction of each joint axis. dq: (n,) rad/s, joint speeds.
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
        if contact[MASS] > 0.0:
            load_box(contact, x, y, z)
            rate += _box_rate(contact)
        if depth + h * max(rate, 0.0) + MARGIN > 0.0:
            return True
    for k in range(3):
        contact[DEFLECTION + k] = contact[FORCE + k] = 0.0
    if contact[MASS] > 0.0:
        load_box(contact, x, y, z)
        slide(contact, h)
    return False


@njit(cache=True, error_model="numpy")
def _box_rate(contact):
    """Return the contribution of the box's motion to the penetration rate, m/s."""
    point, rate = np.empty(3), 0.0
    contact_point_velocity(contact, contact[VELOCITY : VELOCITY + 4], point)
    for k in range(3):
        rate += contact[NORMAL + k] * point[k]
    return rate


@njit(cache=True, error_model="numpy")
def _bristles(contact, force, speed, h):
    """Return friction's spring constant, N/m, and damping, N s/m, at a normal force, N, and a sliding speed, m/s.

    The friction force is -(spring z + damper v), with the deflection z before and the velocity v after the step.
    """
    reach = max(contact[BRISTLE], RIGID)
    late = MICRO_DAMPING * np.exp(-((speed / SLIP) ** 2)) / h
    damper = (1.0 + late) / (1.0 + h * speed / reach)
    stiff = contact[MU] * force / reach
    return stiff * (damper - late), stiff * h * damper


@njit(cache=True, error_model="numpy")
def _velocity(jacobian, dq, slide):
    """Return a tip's penetration rate and sliding speed, m/s; write the tangential velocity to `slide` (3,) m/s."""
    rate = 0.0
    slide[:] = 0.0
    for j in range(len(dq)):
        rate -= jacobian[0, j] * dq[j]
        for k in range(3):
            slide[k] += jacobian[1 + k, j] * dq[j]
    return rate, np.sqrt(slide[0] ** 2 + slide[1] ** 2 + slide[2] ** 2)


@njit(cache=True, error_model="numpy")
def _relative(contact, rate, slide, point):
    """Return penetration rate and sliding speed, m/s, relative to a box with velocity `point` m/s; update `slide`."""
    n, along, speed = contact[NORMAL : NORMAL + 3], 0.0, 0.0
    for k in range(3):
        along += n[k] * point[k]
    for k in range(3):
        slide[k] -= point[k] - along * n[k]
        speed += slide[k] * slide[k]
    return rate + along, np.sqrt(speed)


@njit(cache=True, error_model="numpy")
def start_guess(contact, jacobian, dq, h, guess):
    """Write the first guess (GUESS,), which assumes that the joint velocities dq (n,) rad/s stay constant."""
    rate, speed = _velocity(jacobian, dq, guess[SLIDE : SLIDE + 3])
    if contact[MASS] > 0.0:
        point = np.empty(3)
        for k in range(3):
            guess[TIP_BEGIN + k] = guess[SLIDE + k] - rate * contact[NORMAL + k]
        contact_point_velocity(contact, contact[VELOCITY : VELOCITY + 4], point)
        rate, speed = _relative(contact, rate, guess[SLIDE : SLIDE + 3], point)
        start_box(contact, guess)
    guess[RATE], guess[NEXT], guess[SPEED], guess[BEGIN] = rate, rate, speed, contact[DEPTH] - 0.5 * h * rate
    guess[NORMAL_FORCE], guess[SLOPE] = mean_force(contact, guess[BEGIN], rate, rate, h)


@njit(cache=True, error_model="numpy")
def add_contact(contact, jacobian, h, guess, mass, drive):
    """Add the linearized contact force to a packed mass matrix, kg m^2, and to a driving torque (n,) Nm."""
    spring, damper = _bristles(contact, guess[NORMAL_FORCE], guess[SPEED], h)
    guess[SPRING], guess[DAMPER], slope = spring, damper, guess[SLOPE]
    force = guess[NORMAL_FORCE] + slope * (guess[RATE] - guess[NEXT])
    x = spring * contact[DEFLECTION] + damper * guess[SLIDE]
    y = spring * contact[DEFLECTION + 1] + damper * guess[SLIDE + 1]
    z = spring * contact[DEFLECTION + 2] + damper * guess[SLIDE + 2]
    if contact[MASS] > 0.0:
        _add_box_contact(contact, jacobian, h, guess, (force, x, y, z), mass, drive)
        return
    slope, damper, row = h * slope, h * damper, 0
    for i in range(len(drive)):
        n, a, b, c = jacobian[0, i], jacobian[1, i], jacobian[2, i], jacobian[3, i]
        drive[i] += n * force - a * x - b * y - c * z
        n, a, b, c = slope * n, damper * a, damper * b, damper * c
        for k in range(i + 1):
            mass[row + k] += n * jacobian[0, k] + a * jacobian[1, k] + b * jacobian[2, k] + c * jacobian[3, k]
        row += i + 1


@njit(cache=True, error_model="numpy")
def _add_box_contact(contact, jacobian, h, guess, held, mass, drive):
    """Add the linearized contact force of a movable box, as `add_contact` does.

    held: N, normal force and negated tangential force (3) for a constant box velocity.
    """
    n, at = contact[NORMAL : NORMAL + 3], np.empty(3)
    for k in range(3):
        at[k] = held[0] * n[k] - held[1 + k]
    yielding(contact, at, h, guess)
    force, resistance, row = guess[FORCE_BEGIN : FORCE_BEGIN + 3], guess[RESISTANCE : RESISTANCE + 9], 0
    for i in range(len(drive)):
        for k in range(3):
            at[k] = jacobian[1 + k, i] + n[k] * jacobian[0, i]
        drive[i] += at[0] * force[0] + at[1] * force[1] + at[2] * force[2]
        a = h * (resistance[0] * at[0] + resistance[1] * at[1] + resistance[2] * at[2])
        b = h * (resistance[3] * at[0] + resistance[4] * at[1] + resistance[5] * at[2])
        c = h * (resistance[6] * at[0] + resistance[7] * at[1] + resistance[8] * at[2])
        along = n[0] * a + n[1] * b + n[2] * c
        for k in range(i + 1):
            mass[row + k] += along * jacobian[0, k] + a * jacobian[1, k] + b * jacobian[2, k] + c * jacobian[3, k]
        row += i + 1


@njit(cache=True, error_model="numpy")
def next_guess(contact, jacobian, h, coming, guess):
    """Return whether the guess was accurate; update the guess from the joint velocities `coming` (n,) rad/s."""
    force, fast = guess[NORMAL_FORCE], guess[SPEED]
    rate, speed = _velocity(jacobian, coming, guess[SLID : SLID + 3])
    box_late = 0.0
    if contact[MASS] > 0.0:
        tip, point = np.empty(3), np.empty(3)
        for k in range(3):
            tip[k] = guess[SLID + k] - rate * contact[NORMAL + k]
        box_late = yielded(contact, tip, h, guess, point)
        rate, speed = _relative(contact, rate, guess[SLID : SLID + 3], point)
    guess[LINEAR] = force + guess[SLOPE] * (rate - guess[NEXT])
    guess[NEXT], guess[SPEED] = rate, speed
    new, guess[SLOPE] = mean_force(contact, guess[BEGIN], guess[RATE], rate, h)
    guess[NORMAL_FORCE] = new
    wrong = h * abs(speed - fast) / (max(contact[BRISTLE], RIGID) + h * max(speed, fast))
    late = contact[MU] * (abs(new - force) + new * wrong)
    return (
        abs(new - guess[LINEAR]) <= TOLERANCE * new + NEGLIGIBLE
        and late <= LATE * new + NEGLIGIBLE
        and box_late <= BOX_LATE
    )


@njit(cache=True, error_model="numpy")
def finish_contact(contact, h, guess):
    """Write the contact force and the bristle deflection after a solved step, and move the box."""
    spring, damper, force = guess[SPRING], guess[DAMPER], guess[LINEAR]
    _deflect(contact, guess[SLID : SLID + 3], guess[SPEED], h, (force, spring, damper))
    if contact[MASS] > 0.0:
        move_box(contact, guess[BOX_END : BOX_END + 4], h)


@njit(cache=True, error_model="numpy")
def _deflect(contact, slide, speed, h, terms):
    """Write the contact force, and the bristle deflection after h s at the sliding velocity `slide` (3,) m/s.

    speed: m/s, magnitude of `slide`, exact or estimated. terms: normal force N, spring constant N/m and
        damping N s/m.
    """
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
    """Compute an explicit contact step of h s, which must be much shorter than the contact's oscillation period."""
    tangent = np.empty(3)
    rate, speed = _velocity(jacobian, dq, tangent)
    if contact[MASS] > 0.0:
        point = np.empty(3)
        contact_point_velocity(contact, contact[VELOCITY : VELOCITY + 4], point)
        rate, speed = _relative(contact, rate, tangent, point)
    force = normal_force(contact[K], contact[EXPONENT], contact[DAMPING], contact[DEPTH], rate)
    spring, damper = _bristles(contact, force, speed, h)
    _deflect(contact, tangent, speed, h, (force, spring, damper))
    if contact[MASS] > 0.0:
        slide(contact, h)


@njit(cache=True, error_model="numpy")
def contact_torque(contact, jacobian, out):
    """Write the joint torques (n,) Nm due to the contact force."""
    x, y, z = contact[FORCE], contact[FORCE + 1], contact[FORCE + 2]
    normal = contact[NORMAL] * x + contact[NORMAL + 1] * y + contact[NORMAL + 2] * z
    for j in range(len(out)):
        out[j] = jacobian[0, j] * normal + jacobian[1, j] * x + jacobian[2, j] * y + jacobian[3, j] * z


@njit(cache=True, error_model="numpy")
def contact_velocity(touch, mass, damping, h, forces, dq_min, work, coming):
    """Solve a step in contact; write the final joint velocities (n,) rad/s to `coming`, and the force to `contact`.

    Args:
        touch: arrays `contact` (COLUMNS,) and `jacobian` (ROWS, n) of `near`. work: (2 n + 6, n), scratch array.
        mass, damping, h, forces, dq_min, coming: see `coming_velocity`.
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
