"""Simulate a 1 ms cycle of the elastic twin (compiled): elastic gears, and friction that decreases with heat.

A joint has the motor angle theta and velocity w, scaled to the joint's side of the gear, and the link angle q and
velocity v:
    rotor dw/dt = motor torque + offset - s - L (w - v) - f,   M(q) dv/dt + c(q, v) + g(q) = s + drag(q) - d v + J'F
    s = K (theta - q) + D (w - v)
    f = sign(w) warm ripple (c (1 + (b - 1) / (1 + |w / vs|^a)) + mu |s| + r |w|^e),  c has a value per direction

s: gear torque; K, D: stiffness and damping of the gear; L: damping by the drive's torque loop; d: damping of the
joint; F: contact force of a surface; J: Jacobian of the contact (r2s/physics/contact.py). c: Coulomb friction; b:
ratio of breakaway torque to Coulomb friction; vs, a: speed and exponent of the Stribeck curve; mu: load friction;
coefficient r and exponent e of viscous friction.

A resting motor stays at rest while the net torque on it is below the breakaway torque f(w = 0). Heat lowers friction
by the factor warm = 1 - fall (1 - exp(-heat / 0.6)). The factor ripple is 1 plus three sines of theta, whose periods
are one joint revolution, one motor revolution and half a motor revolution (the two lobes of a strain wave gear).

A step follows position Verlet: positions advance by half a step, velocities by a whole step with the forces at
mid-step, then positions by the other half of the step. A first pass predicts the velocities at mid-step; a second
pass computes the velocity-dependent forces at the predicted velocities. A motor whose velocity reaches zero within a
step stays at rest or reverses, as in r2s/physics/stick_slip.py. Motors act on each other only through their gears, so
the step solves for each motor's velocity separately.
"""

import numpy as np

from r2s.arm.twins.draws import ENCODER, drag
from r2s.compiled import njit
from r2s.physics.contact import contact_torque, explicit_contact, near
from r2s.physics.kinematics import link_frames
from r2s.physics.linear_algebra import factor, solve
from r2s.physics.newton_euler import WORK, equations
from r2s.physics.robot import SIM_DT

# Rows of the joint parameters (ROWS, n)
C_NEG, C_POS, BREAK, MU, V_STRIBECK, SHAPE, VISCOUS, POWER, RATIO = range(9)
RIPPLE, PHASE = 9, 12  # three rows each: per joint revolution, motor revolution and half motor revolution
FALL, POWER_0, COOLING = range(15, 18)  # POWER_0: friction power (W) at which heat settles at 1
HELP, HELP_VISCOUS, HELP_WIDTH = range(18, 21)  # the arm's own friction compensation: Nm, Nm s/rad, rad/s
ROTOR, STIFF, GEAR, LOOP, DAMPING, DELAY, LAG = range(21, 28)
OFFSET, DRAG_OWN, DRAG_NEXT, DRAG_WAVES, DRAG_PHASE, NOISE_Q, NOISE_DQ, NOISE_TAU, ROWS = range(28, 37)
# Rows of the joint states (STATES, n); *_AT: at the time of measurement; ADDED: Nm, added to a command by the arm
LINK_Q, LINK_V, THETA, W, MOTOR, HEAT, Q_MEASURED, DQ_MEASURED, TAU_MEASURED, THETA_AT, W_AT, S_AT, ADDED, STATES = (
    range(14)
)
# Rows of the forces within a step (FORCES, n), and of the velocities at mid-step
F_DRIVE, F_FACTOR, F_SPRING, F_LINK_V, F_W, F_POWER, F_TOUCH, FORCES = range(8)
HALF_WARM = 0.6  # heat scale of the friction decrease; steady motion at a quarter of the speed limit has heat 1


@njit(cache=True)
def warmth(p, heat, i):
    """Return the factor by which heat changes friction: 1 for a cold joint, down to 1 - FALL for a warm joint."""
    return 1.0 - p[FALL, i] * (1.0 - np.exp(-heat / HALF_WARM))


@njit(cache=True)
def ripple(p, theta, i):
    """Return the factor by which the motor angle theta, rad, changes the friction of joint i."""
    joint = p[RIPPLE, i] * np.sin(theta + p[PHASE, i])
    motor = p[RIPPLE + 1, i] * np.sin(p[RATIO, i] * theta + p[PHASE + 1, i])
    return 1.0 + joint + motor + p[RIPPLE + 2, i] * np.sin(2 * p[RATIO, i] * theta + p[PHASE + 2, i])


@njit(cache=True)
def level(p, w, load, side, i):
    """Return a cold joint's friction (Nm) without ripple at w rad/s in direction `side`; w = 0: breakaway torque."""
    coulomb = p[C_POS, i] if side > 0 else p[C_NEG, i]
    speed = abs(w)
    rise = (p[BREAK, i] - 1.0) / (1.0 + (speed / p[V_STRIBECK, i]) ** p[SHAPE, i])
    return coulomb * (1.0 + rise) + p[MU, i] * abs(load) + p[VISCOUS, i] * speed ** p[POWER, i]


@njit(cache=True)
def _next_velocity(p, w, middle, push, load, factor, h, i):
    """Return a motor's velocity (rad/s) after h s under friction and `push` (Nm), the sum of all other torques.

    Args:
        p: parameters. i: joint index. w: present velocity, rad/s. middle: predicted mid-step velocity, rad/s;
            friction is computed at `middle` if the motor moves in this direction. load: gear torque, Nm.
        factor: factor on the friction.
    """
    side = np.sign(w)
    if w != 0.0:
        f = factor * level(p, middle if middle * side > 0 else w, load, side, i)
        after = w + h / p[ROTOR, i] * (push - side * f)
        if after * side >= 0.0:
            return after
        h *= 1.0 - w / (w - after)  # the remaining time of the step, after the motor has stopped
    side = np.sign(push)
    edge = factor * level(p, 0.0, load, side, i)
    if abs(push) <= edge:
        return 0.0
    f = factor * level(p, middle, load, side, i) if middle * side > 0 else edge
    return h / p[ROTOR, i] * (push - side * f)


@njit(cache=True)
def _active(line, cycle, t, delay):
    """Return the row in `line` of the newest command in effect at time t (cycles), or -1 if none is in effect."""
    slots, arrival = len(line), line.shape[1] - 1
    for k in range(cycle, max(cycle - slots, -1), -1):
        if line[k % slots, arrival] + delay <= t:
            return k % slots
    return -1


@njit(cache=True)
def _commanded(line, cycle, begin, end, delay, i):
    """Return the mean delayed command (Nm) of joint i between the times `begin` and `end` (cycles)."""
    older, newer = _active(line, cycle, begin, delay), _active(line, cycle, end, delay)
    after = line[newer, i] if newer >= 0 else 0.0
    if older == newer:
        return after
    before = line[older, i] if older >= 0 else 0.0
    return after + (before - after) * (line[newer, line.shape[1] - 1] + delay - begin) / (end - begin)


@njit(cache=True)
def compensate(p, s, gravity):
    """Write to row ADDED the torque that the arm adds to a command: `gravity` (n,) Nm and friction compensation."""
    for i in range(s.shape[1]):
        dq = s[DQ_MEASURED, i]
        s[ADDED, i] = gravity[i] + p[HELP, i] * np.tanh(dq / p[HELP_WIDTH, i]) + p[HELP_VISCOUS, i] * dq


@njit(cache=True)
def advance(p, s, arm, line, cycle, steps, age):
    """Simulate one cycle in `steps` steps; the sensors measure `age` cycles before the end of the cycle.

    Args:
        p: joint parameters (ROWS, n). s: joint states (STATES, n), updated in place.
        arm: (links, gravity, touch) of the true arm; touch: the attributes `contact`, `jacobian`, `frames`, `axes`
            and `there` of `Touch`.
        line: (slots, n + 1), the last commands (Nm) and their arrival times (cycles). cycle: index of this cycle.
    """
    links, gravity, touch = arm
    n, h = s.shape[1], SIM_DT / steps
    mass, root, bias, work = np.empty((n, n)), np.empty((n, n)), np.empty(n), np.empty((n, WORK))
    f, before = np.empty((FORCES, n)), np.empty((3, n))
    f[F_POWER], f[F_TOUCH] = 0.0, 0.0
    for step in range(steps):
        for i in range(n):
            before[0, i], before[1, i] = s[THETA, i], s[W, i]
            before[2, i] = _gear_torque(p, s, i)
        _move(s, 0.5 * h)
        _external_forces(p, s, f, line, cycle, cycle + step / steps, cycle + (step + 1) / steps, h)
        if touch[4]:
            _touch(s, links, touch, h, f[F_TOUCH])
        for correction in range(2):
            equations(links, gravity, s[LINK_Q], f[F_LINK_V], mass, bias, work)
            if correction == 0:
                factor(mass, root)
            _accelerate(p, s, f, bias, root, h, correction == 1)
        _move(s, 0.5 * h)
        share = steps * (1.0 - age) - step  # share of this step before the time of measurement
        if 0.0 <= share <= 1.0:
            for i in range(n):
                s[THETA_AT, i] = (1.0 - share) * before[0, i] + share * s[THETA, i]
                s[W_AT, i] = (1.0 - share) * before[1, i] + share * s[W, i]
                s[S_AT, i] = (1.0 - share) * before[2, i] + share * _gear_torque(p, s, i)
    for i in range(n):
        s[HEAT, i] += SIM_DT / p[COOLING, i] * (f[F_POWER, i] / steps / p[POWER_0, i] - s[HEAT, i])


@njit(cache=True)
def _gear_torque(p, s, i):
    return p[STIFF, i] * (s[THETA, i] - s[LINK_Q, i]) + p[GEAR, i] * (s[W, i] - s[LINK_V, i])


@njit(cache=True)
def _move(s, h):
    for i in range(s.shape[1]):
        s[LINK_Q, i] += h * s[LINK_V, i]
        s[THETA, i] += h * s[W, i]


@njit(cache=True)
def _touch(s, links, touch, h, out):
    """Write to `out` the joint torque (n,) Nm of the contact force at the middle of a step of h s."""
    contact, jacobian, frames, axes, _ = touch
    link_frames(links, s[LINK_Q], frames, axes)
    place = frames[-1, :3], frames[-1, 3:]
    out[:] = 0.0
    if near(contact, place, frames[:, :3], axes, s[LINK_V], h, jacobian):
        explicit_contact(contact, jacobian, s[LINK_V], h)
        contact_torque(contact, jacobian, out)


@njit(cache=True)
def _external_forces(p, s, f, line, cycle, begin, end, h):
    """Write a step's torques, friction factors and velocities to `f`; the step is from `begin` to `end`, cycles."""
    for i in range(s.shape[1]):
        target = s[ADDED, i] + _commanded(line, cycle, begin, end, p[DELAY, i], i)
        change = (target - s[MOTOR, i]) * -np.expm1(-h / p[LAG, i])
        f[F_DRIVE, i] = s[MOTOR, i] + 0.5 * change + p[OFFSET, i]
        s[MOTOR, i] += change
        f[F_FACTOR, i] = warmth(p, s[HEAT, i], i) * ripple(p, s[THETA, i], i)
        f[F_SPRING, i] = p[STIFF, i] * (s[THETA, i] - s[LINK_Q, i])
        f[F_LINK_V, i], f[F_W, i] = s[LINK_V, i], s[W, i]


@njit(cache=True)
def _accelerate(p, s, f, bias, root, h, last):
    """Predict the velocities at mid-step; if `last`, use this prediction to compute the velocities after the step."""
    n, q = s.shape[1], s[LINK_Q]
    for i in range(n):
        gear = f[F_SPRING, i] + p[GEAR, i] * (f[F_W, i] - f[F_LINK_V, i])
        pull = drag(p[DRAG_OWN, i], p[DRAG_NEXT, i], p[DRAG_WAVES, i], p[DRAG_PHASE, i], q[i], q[(i + 1) % n])
        bias[i] = gear + pull - p[DAMPING, i] * f[F_LINK_V, i] - bias[i] + f[F_TOUCH, i]
        push = f[F_DRIVE, i] - gear - p[LOOP, i] * (f[F_W, i] - f[F_LINK_V, i])
        after = _next_velocity(p, s[W, i], f[F_W, i], push, gear, f[F_FACTOR, i], h, i)
        if last:
            f[F_POWER, i] += (push - p[ROTOR, i] * (after - s[W, i]) / h) * 0.5 * (s[W, i] + after)
            s[W, i] = after
        else:
            f[F_W, i] = 0.5 * (s[W, i] + after)
    solve(root, bias)
    for i in range(n):
        if last:
            s[LINK_V, i] += h * bias[i]
        else:
            f[F_LINK_V, i] = s[LINK_V, i] + 0.5 * h * bias[i]


@njit(cache=True)
def sense(p, s, noise, dq_filter):
    """Compute the sensor values from the rows *_AT of the state `s` and from standard normal `noise` (3, n)."""
    for i in range(s.shape[1]):
        s[Q_MEASURED, i] = ENCODER * np.round((s[THETA_AT, i] + p[NOISE_Q, i] * noise[0, i]) / ENCODER)
        s[DQ_MEASURED, i] += dq_filter * (s[W_AT, i] + p[NOISE_DQ, i] * noise[1, i] - s[DQ_MEASURED, i])
        s[TAU_MEASURED, i] = s[S_AT, i] + p[NOISE_TAU, i] * noise[2, i]
