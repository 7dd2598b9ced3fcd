"""The balance of momentum over a few milliseconds: what commands, friction and links do not explain; compiled.

Over time the change of momentum is the integral of all torques, so that nothing is differentiated. A balance is
between two means that are a span of T s apart: y = (mean of what is known, integrated, less the momentum that is
known, now - before) / T, in Nm, is linear in what is not known, y = H x + noise. A mean weighs two spans by a
triangle, so that a torque counts by a quadratic spline over three. Gears that swing at 50 to 60 Hz change a
momentum at a rate of 10 to 30 Nm; sampled once in a span that would be taken for torques that come and go at a few
hertz. Of 60 Hz a triangle leaves 2.4 % and the spline 0.4 %.
"""

from typing import NamedTuple

import numpy as np

from r2s.adaptation.believed import friction
from r2s.adaptation.momentum import BODY, WIDE, momentum
from r2s.compiled import njit
from r2s.physics.actuation import SLOTS, turn
from r2s.physics.newton_euler import WORK, equations
from r2s.physics.robot import SIM_DT

SPAN = 20  # cycles of a balance
BENT = 0.9  # of the bristles, beyond which a joint slides
MOVES = 0.02  # rad/s, below which it may be held
# of the sums: what is not explained, Nm s; friction's Nm s; momentum; q; dq; the motors' torque
LEFT, RUBBED, MOMENTUM, ANGLE, SPEED, MOTOR, SUMS = range(7)
NOW, COMING, BEGUN, BEFORE = range(4)  # sums of a triangle that ends with this span, of one that begins with it, ...
RISES = SPAN * (SPAN + 1) // 2  # weights 1 to SPAN of the side of a triangle that begins; SPAN - 1 to 0 is the other

# of a torque that begins with a span, by how much the balance of that span and the next hears it: the spline's
RAMP = np.array([1 / 6, 5 / 6])


class Kept(NamedTuple):
    """What is remembered of n joints from cycle to cycle; a payload's ten numbers have columns of their own."""

    counts: np.ndarray  # (3,), cycles of the span, of the line of commands, spans that have ended (3 at most)
    line: np.ndarray  # (SLOTS, n) Nm
    motor: np.ndarray  # (n,) Nm
    felt: np.ndarray  # (n,) Nm, mean torque of the motors in the coming step
    bristle: np.ndarray  # (n,)
    known: np.ndarray  # (2, n) Nm, of the cycle before; Nm s, its integral
    rubbed: np.ndarray  # (2, n), friction likewise
    total: np.ndarray  # (4, SUMS, n), weighed sums: NOW, COMING; of the spans before, BEGUN by one, BEFORE of a whole
    pushed: np.ndarray  # (2, n) Nm, the motors' mean torque over the span before, and over the one before that
    slid: np.ndarray  # (2, n), 1 where the joint slid all along the span before, and the one before that
    moment: np.ndarray  # (4, n), of this cycle: momentum, push, pull, weight
    payload_now: np.ndarray  # (n, 10)
    payload_push: np.ndarray  # (3, n, 10): of this cycle, of the one before, its integral
    payload_total: np.ndarray  # (4, n, 10), as `total`
    work: np.ndarray

    @staticmethod
    def fresh(n: int) -> "Kept":
        """Return that of an arm that has not moved yet."""
        shapes = [(SLOTS, n), (n,), (n,), (n,), (2, n), (2, n), (4, SUMS, n), (2, n), (2, n), (4, n)]
        shapes += [(n, BODY), (3, n, BODY), (4, n, BODY), (n, max(WIDE, WORK))]
        return Kept(np.array([0, SLOTS, 0]), *map(np.zeros, shapes))  # type: ignore[arg-type]


class Balance(NamedTuple):
    """What `observe` writes at the end of a span of n joints.

    Attributes:
        y: (n,) Nm, what is not explained. payload: (n, 10), what the payload's ten numbers make of it.
        rub: (n,) Nm, mean friction. path: (n,) Nm, how far friction went in the span. slides: (n,), 1 where a joint
            slid all along. change: (n,) Nm, rate of the momentum. faster: (n,) rad/s^2, mean acceleration. firmer:
            (n,) Nm/s, rate of the motors' torque.
    """

    y: np.ndarray
    payload: np.ndarray
    rub: np.ndarray
    path: np.ndarray
    slides: np.ndarray
    change: np.ndarray
    faster: np.ndarray
    firmer: np.ndarray
    q: np.ndarray
    dq: np.ndarray
    bent: np.ndarray

    @staticmethod
    def empty(n: int) -> "Balance":
        """Return arrays for it."""
        one = {name: np.zeros(n) for name in Balance._fields}
        return Balance(**one | {"payload": np.zeros((n, BODY)), "slides": np.ones(n), "bent": np.zeros((n, n))})


@njit(cache=True, error_model="numpy")
def observe(arm, kept, q, dq, tau, out):
    """Take one cycle's state and command; return whether a span has ended, whose balance is then in `out`.

    Args:
        arm: `Believed`. kept: `Kept`. q, dq: (n,) rad, rad/s, of this cycle. tau: (n,) Nm without gravity, the
            command that is sent in it.
        out: `Balance`.
    """
    n, h = len(q), SIM_DT
    rises, falls = kept.counts[0] + 1, SPAN - 1 - kept.counts[0]
    begun = kept.counts[0] > 0 or kept.counts[2] > 0
    momentum(
        arm.links, arm.moments, arm.hand, arm.gravity, arm.armature, q, dq, kept.work, kept.moment[0], kept.moment[1],
        kept.moment[2], kept.moment[3], kept.payload_now, kept.payload_push[0],
    )  # fmt: skip
    if kept.counts[0] == 0:
        for j in range(n):
            out.path[j], out.slides[j] = 0.0, 1.0
    for j in range(n):
        v = dq[j]
        side = 1.0 if v > 0.0 else -1.0
        z = side + (kept.bristle[j] - side) * np.exp(-abs(v) * h / arm.presliding[j])
        kept.bristle[j] = z
        sin, cos = np.sin(q[j]), np.cos(q[j])
        level = arm.load[j] * abs(kept.moment[3, j]) + arm.turn[j, 0] * sin + arm.turn[j, 1] * cos
        f = friction(arm.table[j], arm.fastest[j], v, z) + level * z
        pulled = arm.drag[j, 0] * sin + arm.drag[j, 1] * cos
        known = arm.offset[j] + pulled + kept.moment[1, j] - kept.moment[2, j] - f
        if abs(z) < BENT or abs(v) < MOVES:
            out.slides[j] = 0.0
        if begun:
            kept.known[1, j] += h * (0.5 * (kept.known[0, j] + known) + kept.felt[j])
            kept.rubbed[1, j] += 0.5 * h * (kept.rubbed[0, j] + f)
            out.path[j] += abs(f - kept.rubbed[0, j])
            for c in range(BODY):
                kept.payload_push[2, j, c] += 0.5 * h * (kept.payload_push[0, j, c] + kept.payload_push[1, j, c])
        kept.known[0, j], kept.rubbed[0, j] = known, f
        for k, weight in ((NOW, falls), (COMING, rises)):
            total = kept.total[k]
            total[LEFT, j] += weight * (kept.known[1, j] - kept.moment[0, j])
            total[RUBBED, j] += weight * kept.rubbed[1, j]
            total[MOMENTUM, j] += weight * kept.moment[0, j]
            total[ANGLE, j] += weight * q[j]
            total[SPEED, j] += weight * v
            total[MOTOR, j] += weight * kept.felt[j]
            for c in range(BODY):
                kept.payload_total[k, j, c] += weight * (kept.payload_now[j, c] - kept.payload_push[2, j, c])
        for c in range(BODY):
            kept.payload_push[1, j, c] = kept.payload_push[0, j, c]
    kept.counts[0] += 1
    ended = kept.counts[0] == SPAN
    if ended:
        kept.counts[0], kept.counts[2] = 0, min(kept.counts[2] + 1, 3)
        _close(arm, kept, out)
    kept.line[kept.counts[1] % SLOTS] = tau
    turn(kept.line, kept.motor, kept.counts[1], arm.late[0], arm.late[1], kept.felt)
    kept.counts[1] += 1
    return ended and kept.counts[2] > 2


@njit(cache=True, error_model="numpy")
def _close(arm, kept, out):
    """Write the balance of the span that ends; integrals begin anew, so that they do not grow."""
    whole = SPAN * SPAN
    scale = 1.0 / (whole * SPAN * SIM_DT)  # sums to means, and their change per second
    total, slid = kept.total, kept.slid
    n = len(out.y)
    bends = np.empty(n)  # Nm/s^2
    for j in range(n):
        pushed = (total[NOW, MOTOR, j] + total[COMING, MOTOR, j]) / whole  # the two weights of a cycle are SPAN
        bends[j] = (pushed - 2.0 * kept.pushed[0, j] + kept.pushed[1, j]) / (SPAN * SIM_DT) ** 2
        kept.pushed[1, j], kept.pushed[0, j] = kept.pushed[0, j], pushed
        for i in range(SUMS):
            total[NOW, i, j] += total[BEGUN, i, j]
        out.y[j] = (total[NOW, LEFT, j] - total[BEFORE, LEFT, j]) * scale
        out.rub[j] = (total[NOW, RUBBED, j] - total[BEFORE, RUBBED, j]) * scale
        out.change[j] = (total[NOW, MOMENTUM, j] - total[BEFORE, MOMENTUM, j]) * scale
        out.faster[j] = (total[NOW, SPEED, j] - total[BEFORE, SPEED, j]) * scale
        out.firmer[j] = (total[NOW, MOTOR, j] - total[BEFORE, MOTOR, j]) * scale
        out.q[j] = 0.5 * (total[NOW, ANGLE, j] + total[BEFORE, ANGLE, j]) / whole
        out.dq[j] = 0.5 * (total[NOW, SPEED, j] + total[BEFORE, SPEED, j]) / whole
        slides = out.slides[j]
        out.slides[j], slid[0, j], slid[1, j] = slides * slid[0, j] * slid[1, j], slides, slid[0, j]
        for i in range(SUMS):
            begins = kept.known[1, j] if i == LEFT else kept.rubbed[1, j] if i == RUBBED else 0.0
            total[BEFORE, i, j] = total[NOW, i, j] - whole * begins
            total[BEGUN, i, j] = total[COMING, i, j] - RISES * begins
            total[NOW, i, j], total[COMING, i, j] = 0.0, 0.0
        kept.known[1, j], kept.rubbed[1, j] = 0.0, 0.0
        for c in range(BODY):
            sums, begins = kept.payload_total[:, j, c], -kept.payload_push[2, j, c]
            sums[NOW] += sums[BEGUN]
            out.payload[j, c] = (sums[NOW] - sums[BEFORE]) * scale
            sums[BEFORE] = sums[NOW] - whole * begins
            sums[BEGUN] = sums[COMING] - RISES * begins
            sums[NOW], sums[COMING], kept.payload_push[2, j, c] = 0.0, 0.0, 0.0
    equations(arm.links, arm.gravity, out.q, np.zeros(n), out.bent, np.empty(n), kept.work)
    for j in range(n):
        for i in range(n):
            out.bent[j, i] *= bends[i]
            out.y[j] += out.bent[j, i] * arm.gives[i]
