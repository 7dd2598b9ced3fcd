"""Stick and slip of coupled joints within one step: who is held, lets go, stops or turns, and when.

A joint at rest is held while the net torque on it, which is all but its own friction, the coupling to the others
included, lies within its edges. Beyond them it slides against the friction of its direction. Torques are constant for
a step; so are accelerations from event to event, and each event is found where it happens (event-driven integration:
Pfeiffer and Glocker, Multibody Dynamics with Unilateral Contacts, 1996). Time stepping takes the friction of a step's
end for all of it, and is wrong by up to h times that friction at every turn.

Hard stops are MuJoCo's own: where a joint lies at one, they come on top of what is found here.
"""

import numpy as np

from r2s.compiled import njit

TINY = 1e-9  # rad/s, what round-off leaves of a joint that is held: it is at rest
HELD, FREE = 0.0, 2.0  # in place of a direction: at rest, and without edges to be held by


@njit(cache=True, error_model="numpy")
def turns(mass, damping, h, dq, drive, work):
    """Return whether any joint comes through rest by sliding on; arguments as below, but friction is in `drive`."""
    n, change = len(dq), work[len(dq)]
    for i in range(n):  # Cholesky's root of mass + h damping, its diagonal inverted, and at once the first solution
        row = i * (i + 1) // 2
        d, s = mass[row + i] + h * damping[i], h * drive[i]
        for k in range(i):
            r = mass[row + k]
            for c in range(k):
                r -= work[i, c] * work[k, c]
            r *= work[k, k]
            work[i, k] = r
            d -= r * r
            s -= r * change[k]
        d = 1.0 / np.sqrt(d)
        work[i, i], change[i] = d, s * d
    for i in range(n - 1, -1, -1):
        s = change[i]
        for c in range(i + 1, n):
            s -= work[c, i] * change[c]
        change[i] = s * work[i, i]
        if dq[i] * (dq[i] + change[i]) < 0.0:
            return True
    return False


@njit(cache=True, error_model="numpy")
def coming_velocity(mass, damping, h, dq, drive, friction, rest, edges, dq_min, work, coming):
    """Write the velocities (n,) at the end of a step into `coming`; return whether stiction had a part in them.

    Where it had none they are those of sliding on: (mass + h damping) (coming - dq) = h (drive - friction).

    Args:
        mass: (n (n + 1) / 2,) kg m^2, the lower triangle, row by row. damping: (n,) Nm s/rad, implicit. h: s.
        dq, drive, friction: (n,) rad/s, Nm, Nm: velocity, all torques but friction, friction at dq.
        rest: (2, n) Nm, friction when sliding just begins, in the negative and in the positive direction.
        edges: (2, n) Nm, what holds a joint at rest, at least `rest`; 0, 0 where nothing does.
        dq_min: rad/s, below which a joint whose net torque is within its edges comes to rest.
        work: (n + 4, n), anything. coming: (n,) rad/s.
    """
    n = len(dq)
    root, side, now, acceleration, rhs = work[:n], work[n], work[n + 1], work[n + 2], work[n + 3]
    slow, held, within = False, 0, True
    for j in range(n):
        coming[j], now[j] = dq[j], friction[j]
        if edges[0, j] == 0.0 and edges[1, j] == 0.0:
            side[j] = FREE
        elif abs(dq[j]) <= dq_min:
            side[j] = HELD
            slow |= dq[j] != 0.0
            held += 1
            within &= edges[0, j] <= drive[j] <= edges[1, j]
        else:
            side[j] = np.sign(dq[j])
    if held == n and within and not slow:  # nothing moves
        return True
    took_part, left, events = False, h, 0
    while True:
        while True:  # of all at rest, the joint farthest beyond its edges lets go
            for j in range(n):
                rhs[j] = drive[j] - now[j]
            _factor(mass, damping, h, side, root)
            _solve(root, side, rhs, acceleration)
            j, way = _farthest_beyond(mass, acceleration, drive, edges, side)
            if j < 0 or events > 4 * n:  # who stopped that often in a millisecond stays for the rest of it
                break
            side[j] = way if coming[j] == 0.0 else np.sign(coming[j])
            on = side[j] * dq[j] > 0.0  # it slides as it did
            now[j] = friction[j] if on else rest[int(side[j] > 0.0), j]
            took_part |= not on
        if slow:  # an impulse stops those that are held and not at rest, and the others feel it
            slow = False
            for j in range(n):
                rhs[j] = 0.0
                for k in range(n):
                    if side[k] == HELD:
                        rhs[j] += element(mass, j, k) * coming[k]
            _solve(root, side, rhs, rhs)
            for j in range(n):
                coming[j] = 0.0 if side[j] == HELD else coming[j] + rhs[j]
        span, first = left, -1
        for j in range(n):
            took_part |= side[j] == HELD
            if abs(side[j]) == 1.0:
                if side[j] * (coming[j] + span * acceleration[j]) < 0.0:
                    until = -coming[j] / acceleration[j] if side[j] * coming[j] > 0.0 else 0.0
                    if until < span:
                        span, first = until, j
                elif side[j] * coming[j] < 0.0 < span:  # by an impulse
                    span, first = 0.0, j
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
def element(mass, i, k):
    """Return one element of the matrix whose lower triangle is `mass`."""
    return mass[i * (i + 1) // 2 + k] if i >= k else mass[k * (k + 1) // 2 + i]


@njit(cache=True, error_model="numpy")
def _factor(mass, damping, h, side, root):
    """Write Cholesky's root of mass + h damping of those that slide, its diagonal inverted."""
    for i in range(len(side)):
        if side[i] != HELD:
            row = i * (i + 1) // 2
            d = mass[row + i] + h * damping[i]
            for k in range(i):
                s = 0.0
                if side[k] != HELD:
                    s = mass[row + k]
                    for c in range(k):
                        s -= root[i, c] * root[k, c]
                    s *= root[k, k]
                    d -= s * s
                root[i, k] = s
            root[i, i] = 1.0 / np.sqrt(d)


@njit(cache=True, error_model="numpy")
def _solve(root, side, rhs, x):
    """Write the solution to x, which may be `rhs`; 0 for those held."""
    n = len(rhs)
    for i in range(n):
        s = 0.0
        if side[i] != HELD:
            s = rhs[i]
            for c in range(i):
                s -= root[i, c] * x[c]
            s *= root[i, i]
        x[i] = s
    for i in range(n - 1, -1, -1):
        if side[i] != HELD:
            s = x[i]
            for c in range(i + 1, n):
                if side[c] != HELD:
                    s -= root[c, i] * x[c]
            x[i] = s * root[i, i]


@njit(cache=True, error_model="numpy")
def _farthest_beyond(mass, acceleration, drive, edges, side):
    """Return which held joint's net torque is the farthest beyond its edges, -1 for none, and which way it points."""
    worst, at, way = 0.0, -1, 1.0
    for j in range(len(side)):
        if side[j] == HELD:
            net, row = drive[j], j * (j + 1) // 2
            for k in range(j):
                net -= mass[row + k] * acceleration[k]  # 0 where held
            for k in range(j + 1, len(side)):
                row += k
                net -= mass[row + j] * acceleration[k]
            beyond = max(net - edges[1, j], edges[0, j] - net)
            if beyond > worst:
                worst, at, way = beyond, j, np.sign(net)
    return at, way
