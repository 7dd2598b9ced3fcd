"""Simulate an arm that shares no code with r2s: rigid links, exact stick-slip, delay and lag, at 0.1 ms.

    M(q) ddq + c(q, dq) + g(q) = tau_drive + g_nominal(q) + offset - tau_f,    tau_drive = lag(delay(command))

Masses and centres are nominal, so gravity and its compensation cancel, except for the weight of a payload, which
gravity compensation does not know. A joint at rest holds while its net torque (all but friction) lies in its band.
The net torque includes the accelerations of the other joints, so one joint can pull another one loose. A joint
comes to rest if its velocity crosses 0, or is at most `v_stick`, with the net torque inside the band (not within 5
ms of its release). Both events are located in time to 1e-12 s. LuGre has no such rule: bristles hold the joint.

Rigid bodies are spatial vectors about the base's origin (Featherstone 2008, ch. 5 and 6); the arm is Franka's table
of (modified) Denavit-Hartenberg parameters. Integration is the classical fourth-order Runge-Kutta method.
"""

from collections import namedtuple

import numpy as np
from numba import njit

N = 7
CYCLE = 1e-3  # s, one command each
HISTORY = 16  # stored commands: the longest delay is one less, in ms
SETTLE = 5e-3  # s after its release during which a joint cannot come to rest
MAX_EVENTS = 1000  # in 1 ms: more indicates an error
SMOOTH, COULOMB, LUGRE = range(3)  # friction laws: eq. (5); Coulomb, Stribeck and viscous per direction; bristles
ALPHA = np.array([0.0, -1.0, 1.0, 1.0, -1.0, 1.0, 1.0])  # in right angles
A = np.array([0.0, 0.0, 0.0, 0.0825, -0.0825, 0.0, 0.088])  # m
D = np.array([0.333, 0.0, 0.316, 0.0, 0.384, 0.0, 0.0])  # m

# mass (N,), com (N, 3), tensor (N, 3, 3) about com; kind, law (N, 9): phi1..3, or fc, fv, fs of + and -, vs, sigma0
# and sigma1; offset, low, high (N,) Nm; v_stick rad/s, delay and lag s, step: the longest step, s; carried (N, 4) kg
# and m: mass and centre of a payload in the last link's row, whose inertia the links contain
Arm = namedtuple("Arm", "mass com tensor kind law offset low high v_stick delay lag step carried")
# q, dq, bristle (N,) rad, rad/s, rad; stuck (N,) 1 or 0; way (N,) direction of motion; since (N,) s after release;
# drive (N,) Nm after the lag; line (HISTORY, N) Nm, commands, the newest last
State = namedtuple("State", "q dq bristle stuck way since drive line")


@njit(cache=True)
def rigid_body(q, dq, mass, com, tensor, gravity, M, bias):
    """Fill M (N, N) kg m^2 and bias (N,) Nm, the torque at ddq = 0, for q, dq (N,) and gravity m/s^2 downwards."""
    axis, arm, J, h, f = np.empty((N, 3)), np.empty((N, 3)), np.empty((N, 3, 3)), np.empty((N, 3)), np.empty((N, 6))
    R, P = np.eye(3), np.zeros(3)
    w, v, aw, av = np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3)
    av[2] = gravity
    turned, about = np.empty((3, 3)), np.empty((3, 3))
    for k in range(N):
        sa = ALPHA[k]
        ca = 1.0 if sa == 0.0 else 0.0
        x, y, z = A[k], -sa * D[k], ca * D[k]
        c, s = np.cos(q[k]), np.sin(q[k])
        for i in range(3):
            P[i] += R[i, 0] * x + R[i, 1] * y + R[i, 2] * z
            e = ca * R[i, 1] + sa * R[i, 2]
            turned[i, 0] = c * R[i, 0] + s * e
            turned[i, 1] = c * e - s * R[i, 0]
            turned[i, 2] = ca * R[i, 2] - sa * R[i, 1]
        R[:] = turned
        z0, z1, z2 = R[0, 2], R[1, 2], R[2, 2]
        s0, s1, s2 = P[1] * z2 - P[2] * z1, P[2] * z0 - P[0] * z2, P[0] * z1 - P[1] * z0
        axis[k, 0], axis[k, 1], axis[k, 2] = z0, z1, z2
        arm[k, 0], arm[k, 1], arm[k, 2] = s0, s1, s2
        d = dq[k]
        aw[0] += (w[1] * z2 - w[2] * z1) * d
        aw[1] += (w[2] * z0 - w[0] * z2) * d
        aw[2] += (w[0] * z1 - w[1] * z0) * d
        av[0] += (v[1] * z2 - v[2] * z1 + w[1] * s2 - w[2] * s1) * d
        av[1] += (v[2] * z0 - v[0] * z2 + w[2] * s0 - w[0] * s2) * d
        av[2] += (v[0] * z1 - v[1] * z0 + w[0] * s1 - w[1] * s0) * d
        w[0] += z0 * d
        w[1] += z1 * d
        w[2] += z2 * d
        v[0] += s0 * d
        v[1] += s1 * d
        v[2] += s2 * d
        m, square = mass[k], 0.0
        for i in range(3):
            h[k, i] = P[i] + R[i, 0] * com[k, 0] + R[i, 1] * com[k, 1] + R[i, 2] * com[k, 2]
            square += h[k, i] * h[k, i]
            for j in range(3):
                about[i, j] = R[i, 0] * tensor[k, 0, j] + R[i, 1] * tensor[k, 1, j] + R[i, 2] * tensor[k, 2, j]
        for i in range(3):
            for j in range(3):
                J[k, i, j] = about[i, 0] * R[j, 0] + about[i, 1] * R[j, 1] + about[i, 2] * R[j, 2]
                J[k, i, j] -= m * h[k, i] * h[k, j]
            J[k, i, i] += m * square
        for i in range(3):
            h[k, i] *= m
        h0, h1, h2 = h[k, 0], h[k, 1], h[k, 2]
        L0 = J[k, 0, 0] * w[0] + J[k, 0, 1] * w[1] + J[k, 0, 2] * w[2] + h1 * v[2] - h2 * v[1]
        L1 = J[k, 1, 0] * w[0] + J[k, 1, 1] * w[1] + J[k, 1, 2] * w[2] + h2 * v[0] - h0 * v[2]
        L2 = J[k, 2, 0] * w[0] + J[k, 2, 1] * w[1] + J[k, 2, 2] * w[2] + h0 * v[1] - h1 * v[0]
        p0 = m * v[0] + w[1] * h2 - w[2] * h1
        p1 = m * v[1] + w[2] * h0 - w[0] * h2
        p2 = m * v[2] + w[0] * h1 - w[1] * h0
        f[k, 0] = J[k, 0, 0] * aw[0] + J[k, 0, 1] * aw[1] + J[k, 0, 2] * aw[2] + h1 * av[2] - h2 * av[1]
        f[k, 1] = J[k, 1, 0] * aw[0] + J[k, 1, 1] * aw[1] + J[k, 1, 2] * aw[2] + h2 * av[0] - h0 * av[2]
        f[k, 2] = J[k, 2, 0] * aw[0] + J[k, 2, 1] * aw[1] + J[k, 2, 2] * aw[2] + h0 * av[1] - h1 * av[0]
        f[k, 0] += w[1] * L2 - w[2] * L1 + v[1] * p2 - v[2] * p1
        f[k, 1] += w[2] * L0 - w[0] * L2 + v[2] * p0 - v[0] * p2
        f[k, 2] += w[0] * L1 - w[1] * L0 + v[0] * p1 - v[1] * p0
        f[k, 3] = m * av[0] + aw[1] * h2 - aw[2] * h1 + w[1] * p2 - w[2] * p1
        f[k, 4] = m * av[1] + aw[2] * h0 - aw[0] * h2 + w[2] * p0 - w[0] * p2
        f[k, 5] = m * av[2] + aw[0] * h1 - aw[1] * h0 + w[0] * p1 - w[1] * p0
    m = 0.0
    for k in range(N - 1, -1, -1):
        m += mass[k]
        if k < N - 1:  # composite body of all links beyond the joint
            h[k] += h[k + 1]
            J[k] += J[k + 1]
            f[k] += f[k + 1]
        z0, z1, z2 = axis[k, 0], axis[k, 1], axis[k, 2]
        s0, s1, s2 = arm[k, 0], arm[k, 1], arm[k, 2]
        h0, h1, h2 = h[k, 0], h[k, 1], h[k, 2]
        bias[k] = z0 * f[k, 0] + z1 * f[k, 1] + z2 * f[k, 2] + s0 * f[k, 3] + s1 * f[k, 4] + s2 * f[k, 5]
        L0 = J[k, 0, 0] * z0 + J[k, 0, 1] * z1 + J[k, 0, 2] * z2 + h1 * s2 - h2 * s1
        L1 = J[k, 1, 0] * z0 + J[k, 1, 1] * z1 + J[k, 1, 2] * z2 + h2 * s0 - h0 * s2
        L2 = J[k, 2, 0] * z0 + J[k, 2, 1] * z1 + J[k, 2, 2] * z2 + h0 * s1 - h1 * s0
        p0, p1, p2 = m * s0 + z1 * h2 - z2 * h1, m * s1 + z2 * h0 - z0 * h2, m * s2 + z0 * h1 - z1 * h0
        for i in range(k + 1):
            M[i, k] = axis[i, 0] * L0 + axis[i, 1] * L1 + axis[i, 2] * L2 + arm[i, 0] * p0 + arm[i, 1] * p1
            M[i, k] += arm[i, 2] * p2
            M[k, i] = M[i, k]


@njit(cache=True)
def friction(kind, p, v, way, bristle):
    """Return friction, Nm, and bristle rate, rad/s, of a joint that slides at v rad/s to the side `way` (1 or -1)."""
    if kind == SMOOTH:
        return p[0] / (1.0 + np.exp(-p[1] * (v + p[2]))) - p[0] / (1.0 + np.exp(-p[1] * p[2])), 0.0
    side = 0 if (v > 0.0 if kind == LUGRE else way > 0) else 1
    level = p[side] + (p[4 + side] - p[side]) * np.exp(-((v / p[6]) ** 2))
    if kind == COULOMB:
        return way * level + p[2 + side] * v, 0.0
    bends = v - p[7] * abs(v) * bristle / level
    return p[7] * bristle + p[8] * bends + p[2 + side] * v, bends


@njit(cache=True)
def accelerate(arm, q, dq, bristle, stuck, way, drive, M, bias, ddq, bends, net):
    """Fill ddq, bristle rates, and net (N,) Nm: the torque that static friction balances in a stuck joint."""
    if arm.carried[N - 1, 0] > 0.0:
        rigid_body(q, np.zeros(N), arm.carried[:, 0], arm.carried[:, 1:], np.zeros((N, 3, 3)), 9.81, M, net)
        weight = net.copy()
    else:
        weight = np.zeros(N)
    rigid_body(q, dq, arm.mass, arm.com, arm.tensor, 0.0, M, bias)
    bias += weight
    free, at = np.empty(N, np.int64), 0
    for j in range(N):
        net[j] = drive[j] + arm.offset[j] - bias[j]
        ddq[j] = bends[j] = 0.0
        if not stuck[j]:
            tau, bends[j] = friction(arm.kind, arm.law[j], dq[j], way[j], bristle[j])
            ddq[j] = net[j] - tau
            free[at] = j
            at += 1
    L = np.empty((N, N))
    for a in range(at):  # Cholesky factor with forward substitution
        i = free[a]
        for b in range(a + 1):
            s = M[i, free[b]]
            for c in range(b):
                s -= L[a, c] * L[b, c]
            if b < a:
                L[a, b] = s / L[b, b]
                ddq[i] -= L[a, b] * ddq[free[b]]
            else:
                L[a, a] = np.sqrt(s)
        ddq[i] /= L[a, a]
    for a in range(at - 1, -1, -1):
        i = free[a]
        for b in range(a + 1, at):
            ddq[i] -= L[b, a] * ddq[free[b]]
        ddq[i] /= L[a, a]
    for j in range(N):
        for a in range(at):
            if free[a] != j:
                net[j] -= M[j, free[a]] * ddq[free[a]]


@njit(cache=True)
def advance(arm, q, dq, bristle, stuck, way, drive, command, h, out):
    """Fill out (3, N) with q, dq and bristle after h s of a constant command."""
    M, bias, net, late = np.empty((N, N)), np.empty(N), np.empty(N), np.empty(N)
    k, at = np.empty((3, N)), np.empty((3, N))
    out[0], out[1], out[2] = q, dq, bristle
    for stage in range(4):
        part = 0.0 if stage == 0 else (h if stage == 3 else 0.5 * h)
        for j in range(N):
            at[0, j], at[1, j], at[2, j] = q[j], dq[j], bristle[j]
            if stage > 0:
                at[0, j] += part * k[0, j]
                at[1, j] += part * k[1, j]
                at[2, j] += part * k[2, j]
        lagged(drive, command, arm.lag, part, late)
        accelerate(arm, at[0], at[1], at[2], stuck, way, late, M, bias, k[1], k[2], net)
        weight = h / 6.0 if stage in (0, 3) else h / 3.0
        for j in range(N):
            k[0, j] = 0.0 if stuck[j] else at[1, j]
            out[0, j] += weight * k[0, j]
            out[1, j] += weight * k[1, j]
            out[2, j] += weight * k[2, j]


@njit(cache=True)
def lagged(drive, command, lag, h, out):
    """Fill out (N,) Nm with the drive torque h s later."""
    left = np.exp(-h / lag) if lag > 0.0 else 0.0
    for j in range(N):
        out[j] = command[j] + (drive[j] - command[j]) * left


@njit(cache=True)
def outside(arm, j, net):
    """Return how far the net torque is above (positive) or below (negative) the band of joint j, Nm."""
    return net[j] - arm.high[j] if net[j] > arm.high[j] else min(net[j] - arm.low[j], 0.0)


@njit(cache=True)
def net_torque(arm, s, drive, net):
    """Fill net (N,) Nm of a state."""
    M, bias, ddq, bends = np.empty((N, N)), np.empty(N), np.empty(N), np.empty(N)
    accelerate(arm, s.q, s.dq, s.bristle, s.stuck, s.way, drive, M, bias, ddq, bends, net)


@njit(cache=True)
def release(arm, s):
    """Release the joints whose net torque exceeds their band, the worst first."""
    net = np.empty(N)
    for _ in range(N):
        net_torque(arm, s, s.drive, net)
        worst, by = -1, 0.0
        for j in range(N):
            beyond = outside(arm, j, net) if s.stuck[j] else 0.0
            if abs(beyond) > abs(by):
                worst, by = j, beyond
        if worst < 0:
            return
        s.stuck[worst] = 0
        s.since[worst] = 0.0
        s.way[worst] = 1.0 if by > 0 else -1.0


@njit(cache=True)
def would_hold(arm, s, j):
    """Return whether joint j would hold if it came to rest now."""
    before, moving, net = s.dq[j], s.stuck[j], np.empty(N)
    s.dq[j], s.stuck[j] = 0.0, 1
    net_torque(arm, s, s.drive, net)
    s.dq[j], s.stuck[j] = before, moving
    return outside(arm, j, net) == 0.0


@njit(cache=True)
def slow(arm, s, j, later):
    """Return whether a sliding joint is slow enough, and `later` s from now released long enough, to come to rest."""
    return abs(s.dq[j]) <= arm.v_stick and s.since[j] + later > SETTLE


@njit(cache=True)
def event(arm, s, out, command, h, drive, net):
    """Return whether a joint sticks or slips within h s; fill drive (N,) and net (N,) with the values after h s."""
    lagged(s.drive, command, arm.lag, h, drive)
    advance(arm, s.q, s.dq, s.bristle, s.stuck, s.way, s.drive, command, h, out)
    if arm.kind == LUGRE:
        return False
    then, held = State(out[0], out[1], out[2], s.stuck, s.way, s.since, drive, s.line), False
    for j in range(N):
        if s.stuck[j]:
            held = True
        elif out[1, j] * s.way[j] < 0.0 or (slow(arm, then, j, h) and would_hold(arm, then, j)):
            return True
    if held:
        net_torque(arm, then, drive, net)
        for j in range(N):
            if s.stuck[j] and outside(arm, j, net) != 0.0:
                return True
    return False


@njit(cache=True)
def piece(arm, s, command, seconds):
    """Advance by `seconds` under a constant command (N,) Nm, from event to event."""
    out, drive, net = np.empty((3, N)), np.empty(N), np.empty(N)
    left, events, fresh = seconds, 0, True
    while left > 1e-13:
        if fresh and arm.kind != LUGRE:
            release(arm, s)
        h = left / np.ceil(left / arm.step - 1e-9)
        fresh = event(arm, s, out, command, h, drive, net)
        if fresh:
            events += 1
            if events > MAX_EVENTS:
                raise RuntimeError("a joint sticks and slips without end")
            low, high = 0.0, h
            while high - low > 1e-12:
                middle = 0.5 * (low + high)
                if event(arm, s, out, command, middle, drive, net):
                    high = middle
                else:
                    low = middle
            h = high
            event(arm, s, out, command, h, drive, net)
        s.q[:], s.dq[:], s.bristle[:] = out[0], out[1], out[2]
        s.drive[:] = drive
        left -= h
        for j in range(N):
            s.since[j] += h
            if s.stuck[j] or arm.kind == LUGRE:
                continue
            over = s.dq[j] * s.way[j] < 0.0
            if over:
                s.dq[j] = 0.0
            if over or slow(arm, s, j, 0.0):
                if would_hold(arm, s, j):
                    s.dq[j], s.stuck[j] = 0.0, 1
                elif over:
                    s.way[j] = -s.way[j]
                    s.since[j] = 0.0


@njit(cache=True)
def cycle(arm, s, command):
    """Advance by 1 ms; command (N,) Nm is sent at its start and acts after `delay`."""
    for k in range(HISTORY - 1):
        s.line[k] = s.line[k + 1]
    s.line[HISTORY - 1] = command
    whole = int(arm.delay / CYCLE)
    late = arm.delay - whole * CYCLE
    if late > 0.0:
        piece(arm, s, s.line[HISTORY - 2 - whole], late)
    piece(arm, s, s.line[HISTORY - 1 - whole], CYCLE - late)


def at_rest(arm, q):
    """Return the state of an arm at rest at q (N,) rad without a command."""
    bristle = arm.offset / arm.law[:, 7] if arm.kind == LUGRE else np.zeros(N)
    stuck = np.full(N, 0 if arm.kind == LUGRE else 1)
    q = np.array(q, dtype=float)
    return State(q, np.zeros(N), bristle, stuck, np.ones(N), np.ones(N), np.zeros(N), np.zeros((HISTORY, N)))
