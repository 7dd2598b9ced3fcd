"""The balance of momentum over a few milliseconds: what commands, friction and links do not explain; compiled.

Over time the change of momentum is the integral of all torques, so that nothing is differentiated. A balance is
between the means over one span of T s and over the span before: y = (mean of what is known, integrated, less the
momentum that is known, now - before) / T, in Nm, is linear in what is not known, y = H x + noise. So a torque counts
by a triangle of two spans. Between two moments instead of two means, elastic gears that swing at 50 Hz would be
taken for torques that come and go, of Newton metres.
"""

from typing import NamedTuple

import numpy as np

from r2s.adaptation.believed import friction
from r2s.adaptation.momentum import BODY, WIDE, momentum
from r2s.compiled import njit
from r2s.physics.actuation import SLOTS, turn
from r2s.physics.robot import SIM_DT

SPAN = 20  # cycles of a balance
BENT = 0.9  # of the bristles, beyond which a joint slides
MOVES = 0.02  # rad/s, below which it may be held
LEFT, RUBBED, MOMENTUM, SPEED, MOTOR, SUMS = range(6)  # what is not explained, Nm s; friction's Nm s; momentum; ...


class Kept(NamedTuple):
    """What is remembered of n joints from cycle to cycle; a payload's ten numbers have columns of their own."""

    counts: np.ndarray  # (3,), cycles of the span, of the line of commands, spans that have ended (2 at most)
    line: np.ndarray  # (SLOTS, n) Nm
    motor: np.ndarray  # (n,) Nm
    felt: np.ndarray  # (n,) Nm, mean torque of the motors in the coming step
    bristle: np.ndarray  # (n,)
    known: np.ndarray  # (2, n) Nm, of the cycle before; Nm s, its integral
    rubbed: np.ndarray  # (2, n), friction likewise
    total: np.ndarray  # (SUMS, n), sums over the span
    before: np.ndarray  # (SUMS, n), those of the span before
    slid: np.ndarray  # (n,), 1 where the joint slid all along the span before
    moment: np.ndarray  # (4, n), of this cycle: momentum, push, pull, weight
    payload_now: np.ndarray  # (n, 10)
    payload_push: np.ndarray  # (3, n, 10): of this cycle, of the one before, its integral
    payload_total: np.ndarray  # (2, n, 10), sum over the span, and over the one before
    work: np.ndarray

    @staticmethod
    def fresh(n: int) -> "Kept":
        """Return that of an arm that has not moved yet."""
        shapes = [(SLOTS, n), (n,), (n,), (n,), (2, n), (2, n), (SUMS, n), (SUMS, n), (n,), (4, n)]
        shapes += [(n, BODY), (3, n, BODY), (2, n, BODY), (n, WIDE)]
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

    @staticmethod
    def empty(n: int) -> "Balance":
        """Return arrays for it."""
        return Balance(np.zeros(n), np.zeros((n, BODY)), np.zeros(n), np.zeros(n), np.ones(n), *np.zeros((3, n)))


@njit(cache=True, error_model="numpy")
def observe(arm, kept, q, dq, tau, out):
    """Take one cycle's state and command; return whether a span has ended, whose balance is then in `out`.

    Args:
        arm: `Believed`. kept: `Kept`. q, dq: (n,) rad, rad/s, of this cycle. tau: (n,) Nm without gravity, the
            command that is sent in it.
        out: `Balance`.
    """
    n, h = len(q), SIM_DT
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
        f = friction(arm.table[j], arm.fastest[j], v, z) + arm.load[j] * abs(kept.moment[3, j]) * z
        pulled = arm.drag[j, 0] * np.sin(q[j]) + arm.drag[j, 1] * np.cos(q[j])
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
        kept.total[LEFT, j] += kept.known[1, j] - kept.moment[0, j]
        kept.total[RUBBED, j] += kept.rubbed[1, j]
        kept.total[MOMENTUM, j] += kept.moment[0, j]
        kept.total[SPEED, j] += v
        kept.total[MOTOR, j] += kept.felt[j]
        for c in range(BODY):
            kept.payload_push[1, j, c] = kept.payload_push[0, j, c]
            kept.payload_total[0, j, c] += kept.payload_now[j, c] - kept.payload_push[2, j, c]
    kept.counts[0] += 1
    ended = kept.counts[0] == SPAN
    if ended:
        kept.counts[0], kept.counts[2] = 0, min(kept.counts[2] + 1, 2)
        _close(kept, out)
    kept.line[kept.counts[1] % SLOTS] = tau
    turn(kept.line, kept.motor, kept.counts[1], arm.late[0], arm.late[1], kept.felt)
    kept.counts[1] += 1
    return ended and kept.counts[2] > 1


@njit(cache=True, error_model="numpy")
def _close(kept, out):
    """Write the balance of the span that ends with that before; integrals begin anew, so that they do not grow."""
    scale = 1.0 / (SPAN * SPAN * SIM_DT)  # sums to means, and their change per second
    total, before = kept.total, kept.before
    for j in range(len(out.y)):
        out.y[j] = (total[LEFT, j] - before[LEFT, j]) * scale
        out.rub[j] = (total[RUBBED, j] - before[RUBBED, j]) * scale
        out.change[j] = (total[MOMENTUM, j] - before[MOMENTUM, j]) * scale
        out.faster[j] = (total[SPEED, j] - before[SPEED, j]) * scale
        out.firmer[j] = (total[MOTOR, j] - before[MOTOR, j]) * scale
        slides = out.slides[j]
        out.slides[j], kept.slid[j] = slides * kept.slid[j], slides
        for i in range(SUMS):
            before[i, j], total[i, j] = total[i, j], 0.0
        before[LEFT, j] -= SPAN * kept.known[1, j]
        before[RUBBED, j] -= SPAN * kept.rubbed[1, j]
        kept.known[1, j], kept.rubbed[1, j] = 0.0, 0.0
        for c in range(BODY):
            out.payload[j, c] = (kept.payload_total[0, j, c] - kept.payload_total[1, j, c]) * scale
            kept.payload_total[1, j, c] = kept.payload_total[0, j, c] + SPAN * kept.payload_push[2, j, c]
            kept.payload_total[0, j, c], kept.payload_push[2, j, c] = 0.0, 0.0
