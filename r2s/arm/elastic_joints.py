"""Joints with elastic gears and dry friction that warms up, compiled: one 1 ms cycle of the second make of twin.

Per joint, theta and w = dtheta/dt of the motor (at the joint's side of the gear), q and v of the link:
    rotor dw/dt = motor torque + offset - s - L (w - v) - f,   M(q) dv/dt + c(q, v) + g(q) = s + drag(q) - d v
    s = K (theta - q) + D (w - v)
    f = sign(w) warm ripple (c (1 + (b - 1) / (1 + |w / vs|^a)) + mu |s| + r |w|^e),  c one value per direction
L (w - v) is how the drive's own torque loop damps the gear. A motor at rest is held while the net torque on it lies
within f at w = 0, and is at rest exactly; what it carries then is whatever the others do to it.
warm = 1 - fall (1 - exp(-heat / 0.6)); ripple is 1 and a sine each of theta per turn of the joint, of the motor, and
of half of that (the two lobes of a strain wave gear).

Steps are those of Verlet: half a step of positions, a whole one of velocities with the forces there, half a step of
positions; forces that depend on velocity are taken at the middle of the step, by one correction. Within a step a
motor that comes to rest does so when it does, and rests or turns from there (as in r2s/physics/stick_slip.py; motors
feel each other only through their gears, so each is solved by itself).
"""

import numpy as np

from r2s.arm.hidden_arm import ENCODER, drag
from r2s.compiled import njit
from r2s.physics.newton_euler import equations

# Rows of the parameters (rows, n) ...
C_NEG, C_POS, BREAK, MU, V_STRIBECK, SHAPE, VISCOUS, POWER, RATIO = range(9)
RIPPLE, PHASE = 9, 12  # three each: of the joint's turn, the motor's and its half
FALL, POWER_0, COOLING, HELP, HELP_VISCOUS, HELP_WIDTH = range(15, 21)
ROTOR, STIFF, GEAR, LOOP, DAMPING, DELAY, LAG = range(21, 28)
OFFSET, DRAG_OWN, DRAG_NEXT, DRAG_WAVES, DRAG_PHASE, NOISE_Q, NOISE_DQ, NOISE_TAU, ROWS = range(28, 37)
# ... and of the state (rows, n)
LINK_Q, LINK_V, THETA, W, MOTOR, HEAT, Q_SEEN, DQ_SEEN, TAU_SEEN, THETA_AT, W_AT, S_AT, STATES = range(13)
HALF_WARM = 0.6  # of the heat of a quarter of the speed limit, over which friction falls


@njit(cache=True)
def warmth(p, heat, i):
    """Return the factor of all friction, from 1 when cold to 1 - FALL."""
    return 1.0 - p[FALL, i] * (1.0 - np.exp(-heat / HALF_WARM))


@njit(cache=True)
def ripple(p, theta, i):
    """Return the factor of all friction that goes with the position."""
    joint = p[RIPPLE, i] * np.sin(theta + p[PHASE, i])
    motor = p[RIPPLE + 1, i] * np.sin(p[RATIO, i] * theta + p[PHASE + 1, i])
    return 1.0 + joint + motor + p[RIPPLE + 2, i] * np.sin(2 * p[RATIO, i] * theta + p[PHASE + 2, i])


@njit(cache=True)
def level(p, w, load, side, i):
    """Return the friction that opposes motion to `side` at w rad/s, cold and without ripple, Nm; at 0: the edge."""
    coulomb = p[C_POS, i] if side > 0 else p[C_NEG, i]
    speed = abs(w)
    rise = (p[BREAK, i] - 1.0) / (1.0 + (speed / p[V_STRIBECK, i]) ** p[SHAPE, i])
    return coulomb * (1.0 + rise) + p[MU, i] * abs(load) + p[VISCOUS, i] * speed ** p[POWER, i]


@njit(cache=True)
def _coming(p, w, middle, push, load, factor, h, i):
    """Return the motor's velocity after h seconds under a net torque `push` without friction.

    `middle` is the velocity at which friction is taken while the motor keeps its direction.
    """
    side = np.sign(w)
    if w != 0.0:
        f = factor * level(p, middle if middle * side > 0 else w, load, side, i)
        after = w + h / p[ROTOR, i] * (push - side * f)
        if after * side >= 0.0:
            return after
        h *= 1.0 - w / (w - after)  # it has come to rest, and this is left
    side = np.sign(push)
    edge = factor * level(p, 0.0, load, side, i)
    if abs(push) <= edge:
        return 0.0
    f = factor * level(p, middle, load, side, i) if middle * side > 0 else edge
    return h / p[ROTOR, i] * (push - side * f)


@njit(cache=True)
def _active(line, sent, cycle, t, delay):
    """Return the row of the line that a joint obeys at t cycles, -1 for none yet: the last whose delay is over."""
    slots = len(line)
    for k in range(cycle, max(cycle - slots, -1), -1):
        if sent[k % slots] + delay <= t:
            return k % slots
    return -1


@njit(cache=True)
def _commanded(line, sent, cycle, begin, end, delay, i):
    """Return the mean command, Nm, that a joint obeys between two times, cycles."""
    older, newer = _active(line, sent, cycle, begin, delay), _active(line, sent, cycle, end, delay)
    after = line[newer, i] if newer >= 0 else 0.0
    if older == newer:
        return after
    before = line[older, i] if older >= 0 else 0.0
    return after + (before - after) * (sent[newer] + delay - begin) / (end - begin)


@njit(cache=True)
def helped(p, s, gravity, out):
    """Write what the arm's own control adds to a command, (n,) Nm: gravity (n,), and against a part of friction."""
    for i in range(len(out)):
        seen = s[DQ_SEEN, i]
        out[i] = gravity[i] + p[HELP, i] * np.tanh(seen / p[HELP_WIDTH, i]) + p[HELP_VISCOUS, i] * seen


@njit(cache=True)
def advance(p, s, links, gravity, help, line, sent, cycle, steps, age, dt, work):
    """Take the arm through one cycle of dt s in `steps` steps; keep its motion at `age` cycles before the end.

    Args:
        p, s: parameters, and the state that is changed. links, gravity: of the true arm. help: `helped`.
        line, sent: (slots, n) Nm, the last commands, and (slots,) cycles, when each was there to be obeyed.
        cycle: its number. work: `equations`'.
    """
    n = s.shape[1]
    h = dt / steps
    mass, root = np.empty((n, n)), np.empty((n, n))
    bias, ahead_v, ahead_w, drive, factor, spring = (
        np.empty(n), np.empty(n), np.empty(n), np.empty(n), np.empty(n), np.empty(n),
    )  # fmt: skip
    q, v, theta, w, motor, before = s[LINK_Q], s[LINK_V], s[THETA], s[W], s[MOTOR], np.empty((3, n))
    power = np.zeros(n)
    for step in range(steps):
        begin, end = cycle + step / steps, cycle + (step + 1) / steps
        for i in range(n):
            before[0, i], before[1, i] = theta[i], w[i]
            before[2, i] = p[STIFF, i] * (theta[i] - q[i]) + p[GEAR, i] * (w[i] - v[i])
            q[i] += 0.5 * h * v[i]
            theta[i] += 0.5 * h * w[i]
        for i in range(n):
            target = help[i] + _commanded(line, sent, cycle, begin, end, p[DELAY, i], i)
            change = (target - motor[i]) * -np.expm1(-h / p[LAG, i])
            drive[i] = motor[i] + 0.5 * change + p[OFFSET, i]
            motor[i] += change
            factor[i] = warmth(p, s[HEAT, i], i) * ripple(p, theta[i], i)
            spring[i] = p[STIFF, i] * (theta[i] - q[i])
            ahead_v[i], ahead_w[i] = v[i], w[i]  # at the middle of the step
        for correction in range(2):
            equations(links, gravity, q, ahead_v, mass, bias, work)
            if correction == 0:
                _factor(mass, root)
            for i in range(n):
                gear = spring[i] + p[GEAR, i] * (ahead_w[i] - ahead_v[i])
                pull = drag(p[DRAG_OWN, i], p[DRAG_NEXT, i], p[DRAG_WAVES, i], p[DRAG_PHASE, i], q[i], q[(i + 1) % n])
                bias[i] = gear + pull - p[DAMPING, i] * ahead_v[i] - bias[i]
                push = drive[i] - gear - p[LOOP, i] * (ahead_w[i] - ahead_v[i])
                after = _coming(p, w[i], ahead_w[i], push, gear, factor[i], h, i)
                if correction == 1:
                    power[i] += (push - p[ROTOR, i] * (after - w[i]) / h) * 0.5 * (w[i] + after)
                    w[i] = after
                else:
                    ahead_w[i] = 0.5 * (w[i] + after)
            _solve(root, bias)
            for i in range(n):
                if correction == 1:
                    v[i] += h * bias[i]
                else:
                    ahead_v[i] = v[i] + 0.5 * h * bias[i]
        for i in range(n):
            q[i] += 0.5 * h * v[i]
            theta[i] += 0.5 * h * w[i]
        share = steps * (1.0 - age) - step  # of this step, where the sensors look
        if 0.0 <= share <= 1.0:
            for i in range(n):
                now = p[STIFF, i] * (theta[i] - q[i]) + p[GEAR, i] * (w[i] - v[i])
                s[THETA_AT, i] = (1.0 - share) * before[0, i] + share * theta[i]
                s[W_AT, i] = (1.0 - share) * before[1, i] + share * w[i]
                s[S_AT, i] = (1.0 - share) * before[2, i] + share * now
    for i in range(n):
        s[HEAT, i] += dt / p[COOLING, i] * (power[i] / steps / p[POWER_0, i] - s[HEAT, i])


@njit(cache=True)
def sense(p, s, noise, dq_filter):
    """Let the sensors see the motion that was kept; noise (3, n) is standard normal."""
    for i in range(s.shape[1]):
        s[Q_SEEN, i] = ENCODER * np.round((s[THETA_AT, i] + p[NOISE_Q, i] * noise[0, i]) / ENCODER)
        s[DQ_SEEN, i] += dq_filter * (s[W_AT, i] + p[NOISE_DQ, i] * noise[1, i] - s[DQ_SEEN, i])
        s[TAU_SEEN, i] = s[S_AT, i] + p[NOISE_TAU, i] * noise[2, i]


@njit(cache=True, error_model="numpy")
def _factor(mass, root):
    """Write Cholesky's root of the mass matrix, its diagonal inverted."""
    for i in range(len(mass)):
        for k in range(i + 1):
            d = mass[i, k]
            for c in range(k):
                d -= root[i, c] * root[k, c]
            root[i, k] = d * root[k, k] if k < i else 1.0 / np.sqrt(d)


@njit(cache=True, error_model="numpy")
def _solve(root, x):
    """Replace x (n,) by the solution."""
    n = len(x)
    for i in range(n):
        for c in range(i):
            x[i] -= root[i, c] * x[c]
        x[i] *= root[i, i]
    for i in range(n - 1, -1, -1):
        for c in range(i + 1, n):
            x[i] -= root[c, i] * x[c]
        x[i] *= root[i, i]
