"""Compute the implicit LuGre friction and the sensor values of the rigid twin in an engine step (compiled).

Friction f of a joint with velocity v and bristle deflection z in rad (Canudas de Wit et al., IEEE TAC 40(3), 1995):
    dz/dt = v - s0 |v| z / g(v),   f = s0 z + s1(v) dz/dt + s2 v,   s1(v) = s1 exp(-(v / vd)^2)
    g(v) = c (1 + (b - 1) exp(-(v / vs)^2)) + mu |load|,   c has a value per direction

s0 and s1 are stiffness and damping of the bristle, s2 is viscous friction per speed, g the friction level, c Coulomb
friction, b the ratio of breakaway to Coulomb friction, and vs the Stribeck speed. DQ_BRISTLE explains vd.
"""

import numpy as np

from r2s.arm.twins.draws import ENCODER, drag
from r2s.compiled import njit
from r2s.physics.contact import ROUNDS, add_contact, contact_torque, finish_contact, next_guess, start_guess
from r2s.physics.contact_layout import GUESS
from r2s.physics.linear_algebra import packed_element
from r2s.physics.robot import SIM_DT

# Rows of the joint parameters (ROWS, n)
C_NEG, C_POS, BREAK, MU, V_STRIBECK, S0, S1, S2, OFFSET = range(9)
DRAG_OWN, DRAG_NEXT, DRAG_WAVES, DRAG_PHASE, NOISE_Q, NOISE_DQ, NOISE_TAU, ARMATURE, COMPLIANCE = range(9, 18)
DELAY, LAG, DQ_FILTER, ROWS = range(18, 22)  # DELAY: cycles; LAG, DQ_FILTER: filter gains per cycle
# Rows of the joint states (STATES, n)
Z, MOTOR, DRIVE, V_GUESS, LEVEL, FRICTION, SLOPE, BIAS, DQ_MEASURED, Q_MEASURED, TAU_MEASURED, BENT = range(12)
Q, V, V_BEFORE, TOUCH, STATES = range(12, 17)  # TOUCH: Nm, joint torque of the contact with a surface

DQ_BRISTLE = 0.02  # rad/s, vd: bristle damping fades above this speed, else each reversal would cause a torque pulse
SWEEPS, CONVERGED = 50, 1e-9  # largest number of Gauss-Seidel sweeps; velocity change, rad/s, that ends the sweeps


@njit(cache=True)
def _stribeck(p, z, v, load, i):
    """Return the friction level g(v) (Nm) of joint i in the direction of the bristle deflection z."""
    coulomb = p[C_POS, i] if z >= 0 else p[C_NEG, i]
    fade = np.exp(-((v / p[V_STRIBECK, i]) ** 2))
    return coulomb * (1 + (p[BREAK, i] - 1) * fade) + p[MU, i] * abs(load)


@njit(cache=True)
def cable_drag(p, q, i):
    """Return the torque, Nm, of a cable on joint i at the joint angles q (n,) rad."""
    own, along, waves, phase = p[DRAG_OWN, i], p[DRAG_NEXT, i], p[DRAG_WAVES, i], p[DRAG_PHASE, i]
    return drag(own, along, waves, phase, q[i], q[(i + 1) % len(q)])


@njit(cache=True)
def rest(p, s, q, compensation, gravity):
    """Initialize an arm at rest at q (n,) rad; friction balances compensation + offset + cable drag - gravity."""
    s[:] = 0
    for i in range(len(q)):
        s[Q, i] = q[i]
        left = compensation[i] + p[OFFSET, i] + cable_drag(p, q, i)
        level = 0.95 * _stribeck(p, left - gravity[i], 0.0, compensation[i], i)
        s[FRICTION, i] = min(max(left - gravity[i], -level), level)
        s[Z, i] = s[FRICTION, i] / p[S0, i]
        s[DRIVE, i] = left
        s[LEVEL, i] = np.inf
        s[BIAS, i] = gravity[i]
        s[BENT, i] = p[COMPLIANCE, i] * (s[DRIVE, i] - s[FRICTION, i])


@njit(cache=True)
def drive(p, s, line, cycle, tau, compensation, mass, touch):
    """Apply a command; return passive torque (n,) Nm and implicit damping (n,) Nm s/rad for the engine's step.

    Gauss-Seidel iteration solves the coupled implicit equation mass (w - v) / h + bias + f(w) = drive for the next
    velocity w; v is the present velocity, h the time step, f the friction, and drive the sum of motor torque, gravity
    compensation, offset and cable drag. With k = h s0 / g, the bristle's backward Euler step z' = (z + h w) / (1 + k
    |w|) makes each joint's equation quadratic in w. Only one of the two roots has the direction of the torque at w =
    0, so each joint's solution is exact.

    Args:
        p: joint parameters. s: joint states. line: (slots, n) Nm, the last commands. cycle: index of this cycle.
        tau: (n,) Nm, command. compensation: (n,) Nm, gravity compensation. mass: (n, n) kg m^2, mass matrix.
        touch: contact, Jacobian (r2s/physics/contact.py), and whether the tip may touch the surface.
    """
    n, slots, h = len(tau), len(line), SIM_DT
    q, v, w = s[Q], s[V], s[V_GUESS]
    passive, damping = np.empty(n), np.empty(n)
    for i in range(n):
        line[cycle % slots, i] = tau[i]
    for i in range(n):
        whole = int(p[DELAY, i])
        part = p[DELAY, i] - whole
        newer, older = (cycle - whole) % slots, (cycle - whole - 1) % slots
        delayed = (1 - part) * line[newer, i] + part * line[older, i]
        s[MOTOR, i] += p[LAG, i] * (delayed - s[MOTOR, i])
        passive[i] = compensation[i] + p[OFFSET, i] + cable_drag(p, q, i)
        s[DRIVE, i] = s[MOTOR, i] + passive[i]
        s[LEVEL, i] = _stribeck(p, s[Z, i], v[i], compensation[i], i)
        limit = s[LEVEL, i] / p[S0, i]
        s[Z, i] = min(max(s[Z, i], -limit), limit)
        damping[i] = p[S1, i] * np.exp(-((v[i] / DQ_BRISTLE) ** 2)) / h  # s1 / h; replaced by the damping below
    if touch[2]:
        _solve_touch(p, s, damping, mass, touch[0], touch[1])
    else:
        s[TOUCH] = 0.0
        _solve(p, s, damping, mass)
    for i in range(n):
        stiff, z, k = p[S0, i] + damping[i], s[Z, i], h * p[S0, i] / s[LEVEL, i]
        grow = 1 + k * abs(w[i])
        sign = 1.0 if w[i] >= 0 else -1.0
        friction = stiff * (z + h * w[i]) / grow - damping[i] * z + p[S2, i] * w[i]
        slope = stiff * (h - z * k * sign) / (grow * grow) + p[S2, i]
        s[FRICTION, i], s[SLOPE, i] = friction, slope
        damping[i] = slope
        passive[i] -= friction - slope * w[i]
        passive[i] += s[TOUCH, i]
    return passive, damping


@njit(cache=True)
def _solve(p, s, damping, mass):
    for _ in range(SWEEPS):
        if _sweep(p, s, damping, mass) < CONVERGED:
            break


@njit(cache=True)
def _solve_touch(p, s, damping, mass, contact, jacobian):
    """Solve the step with a contact force, and store the joint torque due to the contact force in the row TOUCH."""
    n, h = len(damping), SIM_DT
    added, soft, guess = np.empty(n * (n + 1) // 2), np.empty((n, n)), np.empty(GUESS)
    start_guess(contact, jacobian, s[V], h, guess)
    for _ in range(ROUNDS):
        added[:], s[TOUCH] = 0.0, 0.0
        add_contact(contact, jacobian, h, guess, added, s[TOUCH])
        for i in range(n):
            for j in range(n):
                soft[i, j] = mass[i, j] + packed_element(added, i, j)
        _solve(p, s, damping, soft)
        if next_guess(contact, jacobian, h, s[V_GUESS], guess):
            break
    finish_contact(contact, h, guess)
    contact_torque(contact, jacobian, s[TOUCH])


@njit(cache=True)
def _sweep(p, s, damping, mass):
    """Solve each joint's equation once for the joint's next velocity; return the largest velocity change, rad/s."""
    n, h, v, w, change = len(damping), SIM_DT, s[V], s[V_GUESS], 0.0
    for i in range(n):
        free = s[DRIVE, i] + s[TOUCH, i] - s[BIAS, i] + mass[i, i] / h * v[i]
        for j in range(n):
            if j != i:
                free -= mass[i, j] / h * (w[j] - v[j])
        stiff, z, k = p[S0, i] + damping[i], s[Z, i], h * p[S0, i] / s[LEVEL, i]
        a = mass[i, i] / h + p[S2, i]
        left = free + damping[i] * z - stiff * z  # the torque at w = 0 determines the direction
        sign = 1.0 if left >= 0 else -1.0
        b = a + stiff * h - sign * (free + damping[i] * z) * k
        root = np.sqrt(b * b + 4 * a * k * abs(left))
        speed = 2 * abs(left) / (b + root) if b > 0 else (root - b) / (2 * a * k)
        change = max(change, abs(sign * speed - w[i]))
        w[i] = sign * speed
    return change


@njit(cache=True)
def sense(p, s, mass, noise):
    """Update bristles, friction, bias torque and sensor values after the engine has taken its step.

    Args:
        p: joint parameters.
        s: joint states; Q, V: angle and velocity after the step; V_BEFORE: velocity before the step.
        mass: (n, n) kg m^2, mass matrix. noise: (3, n), standard normal, for the sensors of q, dq and tau_J.
    """
    n, h, v, before = s.shape[1], SIM_DT, s[V], s[V_BEFORE]
    for i in range(n):
        s[FRICTION, i] += s[SLOPE, i] * (v[i] - s[V_GUESS, i])
        s[Z, i] = (s[Z, i] + h * v[i]) / (1 + h * p[S0, i] / s[LEVEL, i] * abs(v[i]))
        link = s[DRIVE, i] - s[FRICTION, i]
        inertial = 0.0
        for j in range(n):
            inertial += mass[i, j] * (v[j] - before[j]) / h
        s[BIAS, i] = link + s[TOUCH, i] - inertial
        rotor = p[ARMATURE, i] * (v[i] - before[i]) / h  # accelerates the rotor; acts neither on gear nor on sensor
        bent = p[COMPLIANCE, i] * (link - rotor)
        motor_q, motor_v = s[Q, i] + bent, v[i] + (bent - s[BENT, i]) / h
        s[BENT, i] = bent
        s[Q_MEASURED, i] = ENCODER * np.round((motor_q + p[NOISE_Q, i] * noise[0, i]) / ENCODER)
        s[DQ_MEASURED, i] += p[DQ_FILTER, i] * (motor_v + p[NOISE_DQ, i] * noise[1, i] - s[DQ_MEASURED, i])
        s[TAU_MEASURED, i] = link - rotor + p[NOISE_TAU, i] * noise[2, i]
    for i in range(n):
        s[V_GUESS, i] = v[i]
