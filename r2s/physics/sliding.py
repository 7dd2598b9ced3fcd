"""Simulate a box that a tool's tip pushes on a table, within the implicit contact step of contact.py.

The limit surface of table friction is an ellipsoid (Goyal, Ruina and Papadopoulos, Wear 143, 1991; Lynch, Maekawa and
Tanie, IROS 1992). The ratio r of friction moment to friction force is the mean distance between the base's points and
the base's center, because the model assumes uniform pressure on the base. A box with center velocity v and spin w has
the generalized velocity u = (v, r w). With friction coefficient mu and normal force N, a sliding box experiences the
table friction -mu N u / |u|. At rest, u / |u| is undefined. The model therefore replaces u / |u| by z / RIGID, where
z (4,) m is the elastic deflection between box and table. Backward Euler integrates dz/dt = u - |u| z / RIGID. While
the box slides, z / RIGID equals u / |u|. While the box rests, -mu N z / RIGID is an elastic force.

The box is not a body of the MuJoCo model, so simulations without a box stay unchanged. Training, twins and engines
share one compiled law, which solves joint friction and box motion together. The box neither tilts nor lifts off
(`check_size` in box.py). The tip does not touch the table; the tip's vertical force only changes the box's load.

In a step of h s, the tip's velocity relative to the box changes by d. The contact force on the tip is F = F0 - K d,
with a resistance K, N s/m, and the contact force F0 for d = 0. The tip's own velocity changes by d_tip. The box's
velocity at the contact changes by d_0 - h W F, where h W is the box's mobility, and d_0 is the change for F = 0.
Elimination of the box's velocity yields the contact force F = (1 + h K W)^-1 (F0 + K d_0 - K d_tip) for the joint
equations.
"""

import numpy as np

from r2s.compiled import njit
from r2s.physics.contact_layout import (
    ARM,
    AXES,
    BOX_END,
    BOX_SPEED,
    DAMPER,
    FORCE,
    FORCE_BEGIN,
    INERTIA,
    LOAD,
    MASS,
    NORMAL,
    POINT,
    REACH,
    RESISTANCE,
    SLOPE,
    SPIN,
    STRAIN,
    TABLE,
    TIP_BEGIN,
    UP,
    VELOCITY,
    WEIGHT,
)

RIGID = 1e-6  # m, largest elastic deflection of a box on its table
STILL = 1e-6  # m/s, speed below which a box without contact is at rest; friction stops a box of 4e-3 m/s in 1 ms
ROUNDS = 30  # largest number of guesses of the box's speed
CLOSE = 1e-4  # relative error of the guessed speed at which the iteration ends


@njit(cache=True, error_model="numpy")
def _cross(a, b, out):
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]


@njit(cache=True, error_model="numpy")
def load_box(contact, x, y, z):
    """Write the lever arm of a contact at (x, y, z) m, and the largest table friction for the last contact force."""
    a, b, c = contact[POINT], contact[POINT + 1], contact[POINT + 2]
    contact[ARM], contact[ARM + 1], contact[ARM + 2] = x - a, y - b, z - c
    down = 0.0
    for k in range(3):
        down += contact[FORCE + k] * contact[UP + k]
    contact[LOAD] = contact[TABLE] * max(contact[WEIGHT] + down, 0.0)


@njit(cache=True, error_model="numpy")
def contact_point_velocity(contact, motion, out):
    """Write the box's velocity (3,) m/s at the contact to `out`; `motion` (4,) is the center's velocity and spin."""
    _cross(contact[UP : UP + 3], contact[ARM : ARM + 3], out)
    for k in range(3):
        out[k] = motion[k] + motion[3] * out[k]


@njit(cache=True, error_model="numpy")
def _grip(contact, speed, h):
    """Return the coefficients k, N/m, and c, N s/m, of the table friction -(k z + c u) in a step of h s.

    z: m, elastic deflection before the step. u: m/s, generalized velocity after the step.
    """
    stiff = contact[LOAD] / RIGID / (1.0 + h * speed / RIGID)
    return stiff, h * stiff


@njit(cache=True, error_model="numpy")
def _free_change(contact, speed, h, out):
    """Write a box's velocity change (4,) in a step without tip force; return `along` and `about`.

    along: s/kg, change of velocity per force. about: s/(kg m^2), change of spin per moment.
    """
    spring, damper = _grip(contact, speed, h)
    reach, strain = contact[REACH], contact[STRAIN : STRAIN + 4]
    along = h / (contact[MASS] + h * damper)
    about = h / (contact[INERTIA] + h * damper * reach * reach)
    for k in range(3):
        out[k] = -along * (damper * contact[VELOCITY + k] + spring * strain[k])
    out[3] = -about * reach * (damper * reach * contact[SPIN] + spring * strain[3])
    return along, about


@njit(cache=True, error_model="numpy")
def _pushed(contact, force, change, along, about, out):
    """Write the box's velocity and spin (4,) after a step with `force` (3,) N on the tip and -force on the box."""
    up, lever = contact[UP : UP + 3], np.empty(3)
    _cross(up, contact[ARM : ARM + 3], lever)
    upwards, moment = 0.0, 0.0
    for k in range(3):
        upwards += force[k] * up[k]
        moment += force[k] * lever[k]
    for k in range(3):
        out[k] = contact[VELOCITY + k] + change[k] - along * (force[k] - upwards * up[k])
    out[3] = contact[SPIN] + change[3] - about * moment


@njit(cache=True, error_model="numpy")
def _speed(contact, motion):
    turning = contact[REACH] * motion[3]
    return np.sqrt(motion[0] ** 2 + motion[1] ** 2 + motion[2] ** 2 + turning * turning)


@njit(cache=True, error_model="numpy")
def _next_speed(contact, old, found, h):
    """Return the next guess of the box's speed, m/s, if the guess `old` results in the speed `found`, m/s."""
    if old <= 0.0:
        return found
    slowing = h * contact[LOAD] / contact[MASS]  # straight motion: found = frictionless speed * old / (old + slowing)
    return min(max(found + slowing * (found - old) / old, 0.25 * found), 4.0 * found)


@njit(cache=True, error_model="numpy")
def start_box(contact, guess):
    """Write the box's present speed as the first guess of its speed after the step."""
    guess[BOX_SPEED] = _speed(contact, contact[VELOCITY : VELOCITY + 4])


@njit(cache=True, error_model="numpy")
def yielding(contact, force, h, guess):
    """Write FORCE_BEGIN (3,) N and RESISTANCE (3, 3) N s/m of the contact with a movable box into `guess`.

    force: (3,) N, force on the tip if the tip's velocity relative to the box does not change.
    """
    change, lever, point = np.empty(4), np.empty(3), np.empty(3)
    along, about = _free_change(contact, guess[BOX_SPEED], h, change)
    up, n, slope, damper = contact[UP : UP + 3], contact[NORMAL : NORMAL + 3], guess[SLOPE], guess[DAMPER]
    _cross(up, contact[ARM : ARM + 3], lever)
    contact_point_velocity(contact, change, point)
    a, ahead = np.empty((3, 3)), 0.0
    for i in range(3):
        ahead += n[i] * point[i]
    begin, resistance = guess[FORCE_BEGIN : FORCE_BEGIN + 3], guess[RESISTANCE : RESISTANCE + 9].reshape(3, 3)
    for i in range(3):
        begin[i] = force[i] + damper * point[i] + (slope - damper) * n[i] * ahead
        for j in range(3):
            resistance[i, j] = (slope - damper) * n[i] * n[j] + (damper if i == j else 0.0)
    for i in range(3):  # 1 + K W
        for j in range(3):
            a[i, j] = 1.0 if i == j else 0.0
            for k in range(3):
                mobility = about * lever[k] * lever[j] - along * up[k] * up[j] + (along if k == j else 0.0)
                a[i, j] += resistance[i, k] * mobility
    _divide(a, begin, resistance)


@njit(cache=True, error_model="numpy")
def _divide(a, vector, matrix):
    """Replace `vector` (3,) with a^-1 vector and `matrix` (3, 3) with a^-1 matrix, by Cramer's rule."""
    inverse = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            k, m, p, q = (j + 1) % 3, (j + 2) % 3, (i + 1) % 3, (i + 2) % 3
            inverse[i, j] = a[k, p] * a[m, q] - a[k, q] * a[m, p]
    size = a[0, 0] * inverse[0, 0] + a[0, 1] * inverse[1, 0] + a[0, 2] * inverse[2, 0]
    old, kept = vector.copy(), matrix.copy()
    for i in range(3):
        vector[i] = 0.0
        for j in range(3):
            vector[i] += inverse[i, j] * old[j] / size
            matrix[i, j] = 0.0
            for k in range(3):
                matrix[i, j] += inverse[i, k] * kept[k, j] / size


@njit(cache=True, error_model="numpy")
def yielded(contact, tip, h, guess, point):
    """Write the box's velocity at the contact to `point`; return the relative error of the assumed table friction.

    The guessed speed of the box causes this error. `point` and `tip`, (3,) m/s, are velocities after the step.
    """
    force, change = np.empty(3), np.empty(4)
    for i in range(3):
        force[i] = guess[FORCE_BEGIN + i]
        for j in range(3):
            force[i] -= guess[RESISTANCE + 3 * i + j] * (tip[j] - guess[TIP_BEGIN + j])
    old, motion = guess[BOX_SPEED], guess[BOX_END : BOX_END + 4]
    along, about = _free_change(contact, old, h, change)
    _pushed(contact, force, change, along, about, motion)
    contact_point_velocity(contact, motion, point)
    found = _speed(contact, motion)
    guess[BOX_SPEED] = _next_speed(contact, old, found, h)
    return h * abs(found - old) / (RIGID + h * max(found, old))


@njit(cache=True, error_model="numpy")
def move_box(contact, motion, h):
    """Move the box for h s with velocity and spin `motion` (4,); store `motion` and the elastic deflection."""
    share, length = 1.0 / (1.0 + h * _speed(contact, motion) / RIGID), 0.0
    for k in range(4):
        rate = motion[k] if k < 3 else contact[REACH] * motion[3]
        contact[STRAIN + k] = share * (contact[STRAIN + k] + h * rate)
        contact[VELOCITY + k] = motion[k]
        length += contact[STRAIN + k] ** 2
    if length > RIGID * RIGID:
        for k in range(4):
            contact[STRAIN + k] *= RIGID / np.sqrt(length)
    for k in range(3):
        contact[POINT + k] += h * motion[k]
    angle = h * motion[3]
    if angle != 0.0:
        up, column, side = contact[UP : UP + 3], np.empty(3), np.empty(3)
        cos, sin = np.cos(angle), np.sin(angle)
        for j in range(2):  # the third axis is UP
            for i in range(3):
                column[i] = contact[AXES + 3 * i + j]
            _cross(up, column, side)
            for i in range(3):
                contact[AXES + 3 * i + j] = cos * column[i] + sin * side[i]


@njit(cache=True, error_model="numpy")
def slide(contact, h):
    """Move the box for a step of h s under the contact force in `contact`."""
    force, motion, change = contact[FORCE : FORCE + 3], np.empty(4), np.empty(4)
    touched = force[0] != 0.0 or force[1] != 0.0 or force[2] != 0.0
    speed = _speed(contact, contact[VELOCITY : VELOCITY + 4])
    if not touched and speed < STILL:
        contact[VELOCITY : VELOCITY + 4] = 0.0
        contact[STRAIN : STRAIN + 4] = 0.0
        return
    for _ in range(ROUNDS):
        along, about = _free_change(contact, speed, h, change)
        _pushed(contact, force, change, along, about, motion)
        found = _speed(contact, motion)
        if abs(found - speed) <= CLOSE * found + 1e-9:
            break
        speed = _next_speed(contact, speed, found, h)
    move_box(contact, motion, h)
