"""Find which coupled joints stick, break away, stop or reverse within one step, and when.

A joint at rest sticks while its net torque lies between its edges, the breakaway torques in the negative and positive
direction. The net torque includes the coupling to other joints, but not the joint's own friction. If the net torque
exceeds an edge, the joint slides in the torque's direction. Torques are constant in a step, and accelerations are
constant between events, so the time of each event is exact (event-driven integration: Pfeiffer and Glocker, Multibody
Dynamics with Unilateral Contacts, 1996). Time stepping would apply the friction at a step's end to the whole step. At
a reversal, the impulse error would be up to the friction times the step h.

MuJoCo itself adds the forces of the joints' position limits.
"""

from typing import NamedTuple

import numpy as np

from r2s.compiled import njit
from r2s.physics.linear_algebra import factor, packed_element, solve, unpack

TINY = 1e-9  # rad/s, round-off of the velocity of a sticking joint
HELD, FREE = 0.0, 2.0  # `side` of a sticking joint and of a joint without stiction; -1, 1: direction of sliding


class JointForces(NamedTuple):
    """Velocities and torques of n joints at the beginning of a step.

    dq: (n,) rad/s, joint velocities. drive: (n,) Nm, sum of torques without friction. friction: (n,) Nm, friction at
    dq. rest: (2, n) Nm, kinetic friction at zero speed in negative and positive direction. edges: (2, n) Nm,
    breakaway torques in negative and positive direction. The magnitudes of `edges` are at least those of `rest`. For
    a joint without stiction, both edges are 0.
    """

    dq: np.ndarray
    drive: np.ndarray
    friction: np.ndarray
    rest: np.ndarray
    edges: np.ndarray


@njit(cache=True, error_model="numpy")
def any_reversal(mass, damping, h, dq, net, work):
    """Return whether any joint reverses if all joints slide under the torques `net` (n,) Nm, which include friction.

    `coming_velocity` explains all arguments except `net`.
    """
    n = len(dq)
    root, change = work[:n], work[n]
    unpack(mass, h, damping, root)
    factor(root, root)
    for i in range(n):
        change[i] = h * net[i]
    solve(root, change)
    reverses = False
    for i in range(n):
        reverses |= dq[i] * (dq[i] + change[i]) < 0.0
    return reverses


@njit(cache=True, error_model="numpy")
def coming_velocity(mass, damping, h, forces, dq_min, work, coming):
    """Write the velocities (n,) at the end of a step into `coming`; return whether stiction had an effect.

    Without stiction, `coming` is the solution of (mass + h damping) (coming - dq) = h (drive - friction).

    Args:
        mass: packed mass matrix, kg m^2. damping: (n,) Nm s/rad, implicit damping. h: s, duration of the step.
        forces: `JointForces` at the beginning of the step.
        dq_min: rad/s, speed below which a joint stops if its net torque lies between its breakaway torques.
        work: (n + 4, n), scratch array. coming: (n,) rad/s, array for the resulting velocities.
    """
    n = len(forces.dq)
    root, side, friction, acceleration, impulse = work[:n], work[n], work[n + 1], work[n + 2], work[n + 3]
    slow, at_rest = _initial_sides(forces, dq_min, side, friction, coming)
    if at_rest:
        return True
    took_part, left, events = False, h, 0
    while True:
        while True:  # the sticking joint with the net torque farthest beyond its edges breaks away
            for j in range(n):
                acceleration[j] = forces.drive[j] - friction[j]
            unpack(mass, h, damping, root)
            factor(root, root, side)
            solve(root, acceleration, side)
            j, direction = _farthest_beyond(mass, acceleration, forces, side)
            if j < 0 or events > 4 * n:  # after 4 n stops, no joint breaks away in this step
                break
            side[j] = direction if coming[j] == 0.0 else np.sign(coming[j])
            on = side[j] * forces.dq[j] > 0.0  # the joint's direction of motion does not change
            friction[j] = forces.friction[j] if on else forces.rest[int(side[j] > 0.0), j]
            took_part |= not on
        if slow:  # an impulse stops the slow sticking joints; the coupling transmits the impulse to other joints
            slow = False
            for j in range(n):
                impulse[j] = 0.0
                for k in range(n):
                    if side[k] == HELD:
                        impulse[j] += packed_element(mass, j, k) * coming[k]
            solve(root, impulse, side)
            for j in range(n):
                coming[j] = 0.0 if side[j] == HELD else coming[j] + impulse[j]
        for j in range(n):
            took_part |= side[j] == HELD
        span, first = _first_stop(coming, acceleration, side, left)
        for j in range(n):
            coming[j] += span * acceleration[j]
        if first < 0:
            return took_part
        if span > 0.0:
            coming[first] = 0.0
        slow, side[first], took_part = coming[first] != 0.0, HELD, True
        left -= span
        events += 1


@njit(cache=True, error_model="numpy")
def _initial_sides(forces, dq_min, side, friction, coming):
    """Write each joint's side, friction and velocity; return whether a HELD joint moves, and whether all rest."""
    dq, drive, edges, n = forces.dq, forces.drive, forces.edges, len(forces.dq)
    slow, held, inside = False, 0, True
    for j in range(n):
        coming[j], friction[j] = dq[j], forces.friction[j]
        if edges[0, j] == 0.0 and edges[1, j] == 0.0:
            side[j] = FREE
        elif abs(dq[j]) <= dq_min:
            side[j] = HELD
            slow |= dq[j] != 0.0
            held += 1
            inside &= edges[0, j] <= drive[j] <= edges[1, j]
        else:
            side[j] = np.sign(dq[j])
    return slow, held == n and inside and not slow


@njit(cache=True, error_model="numpy")
def _first_stop(coming, acceleration, side, left):
    """Return the time of the first stop or reversal within `left` s, and the joint's index (-1: no joint stops)."""
    span, first = left, -1
    for j in range(len(side)):
        if abs(side[j]) == 1.0:
            if side[j] * (coming[j] + span * acceleration[j]) < 0.0:
                until = -coming[j] / acceleration[j] if side[j] * coming[j] > 0.0 else 0.0
                if until < span:
                    span, first = until, j
            elif side[j] * coming[j] < 0.0 < span:  # the impulse reversed this joint
                span, first = 0.0, j
    return span, first


@njit(cache=True, error_model="numpy")
def _farthest_beyond(mass, acceleration, forces, side):
    """Return the sticking joint whose net torque is farthest beyond its edges (-1: none), and this torque's sign."""
    worst, at, direction = 0.0, -1, 1.0
    for j in range(len(side)):
        if side[j] == HELD:
            net, row = forces.drive[j], j * (j + 1) // 2
            for k in range(j):
                net -= mass[row + k] * acceleration[k]  # 0 for a sticking joint
            for k in range(j + 1, len(side)):
                row += k
                net -= mass[row + j] * acceleration[k]
            beyond = max(net - forces.edges[1, j], forces.edges[0, j] - net)
            if beyond > worst:
                worst, at, direction = beyond, j, np.sign(net)
    return at, direction
