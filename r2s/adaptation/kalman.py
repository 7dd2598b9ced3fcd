"""The recursive estimate, compiled: a Kalman filter of payload, friction and offsets, and a test for sudden changes.

State of n joints, N = 10 + 4 n: the payload's mass, first moments and tensor about the hand (kg, kg m, kg m^2); of
each joint the share by which friction is above what is believed, a torque offset that goes slowly (Nm), and the
model's own error (Nm), which comes and goes (Ornstein and Uhlenbeck) and with every change of the friction, and the
share by which its momentum changes less than is believed, which comes and goes too.

The test is Willsky and Jones' (IEEE TAC 21(1), 1976): for each of the last LATEST spans the filter's signature of a
jump of the payload that began there, and with a prior of that jump the odds that there was one. Under the model the
mean of these odds has expectation 1 without a jump, so that by Markov's inequality odds of x have a probability of
1 / x at most: a threshold of as many as there are tests in ten hours allows for one false alarm in that time. Errors
of a model are not as tame as the filter's noise, so that one in an hour needs more than the tests of an hour.

Nor are errors normal: a joint that lets go, or a gear that swings, is far off for a span or two. Beyond TAME standard
deviations a balance weighs less, by Huber's function (Robust Statistics, 1981); what is put on or taken off goes on.
"""

from typing import NamedTuple

import numpy as np

from r2s.adaptation.balance import RAMP, SPAN
from r2s.adaptation.momentum import BODY
from r2s.compiled import njit
from r2s.physics.robot import SIM_DT

T = SPAN * SIM_DT
LATEST = 10  # onsets that are tried: 0.2 s
JUMP = 4  # numbers of a payload that a jump has: mass and first moments
THRESHOLD = np.log(36000.0 / T)  # tests in ten hours


class Noise(NamedTuple):
    """What is known of the errors of n joints.

    Attributes:
        white: (n,) Nm of a balance. moving: (n,), share of the momentum's change. model: (n,) Nm, of the model's
            error, whose correlation lasts `lasting` s. turning: (n,), share of friction's level that a change of
            friction by that level leaves in doubt. level, edge: (n,) Nm, as of `Believed`.
        inertia: (n, n) kg m^2, late: (n, n) s: what motion without a payload says that the model lacks of inertia, of
            rotors above all, and of delay.
        loaded: share of a payload's torque by which friction, and what noisy speeds make of it, are in doubt.
        warming: 1/sqrt(s), of friction's share. drifting: (n,) Nm/sqrt(s), of the offsets.
        resting: kg^2/s, what may be put into the hand while nothing is seen of it.
        creeping: 1/sqrt(s), share of the payload's prior by which it is never known for good.
        learning: how fast white noise grows with what surprises, per span, as of `Filter.rough`; 0: it is what it is.
        prior, start: (N,) standard deviations and means before anything is seen.
    """

    white: np.ndarray
    moving: np.ndarray
    model: np.ndarray
    lasting: float
    turning: np.ndarray
    level: np.ndarray
    edge: np.ndarray
    inertia: np.ndarray
    late: np.ndarray
    loaded: float
    warming: float
    drifting: np.ndarray
    resting: float
    creeping: float
    learning: float
    prior: np.ndarray
    start: np.ndarray


class Filter(NamedTuple):
    """x (N,), P (N, N); of each onset f (LATEST, N, 4), information (LATEST, 4, 4) and vector (LATEST, 4).

    counts: (5,): spans, onsets in use, spans at rest in a row, the next onset, spans whose balances still reach back
    before the last jump. odds: (3,): log of the mean odds of a jump, that of the likeliest onset, its number. seen:
    (2, n): innovations and their variances. rough: (n,), how many times the variance that is known of it a joint's
    white noise has now: what surprises for long is taken for noise, as of a gear that swings under a load that was
    never heard before. It is never less than 1.
    """

    x: np.ndarray
    P: np.ndarray
    f: np.ndarray
    information: np.ndarray
    vector: np.ndarray
    counts: np.ndarray
    odds: np.ndarray
    seen: np.ndarray
    rough: np.ndarray
    work: np.ndarray

    @staticmethod
    def fresh(noise: Noise) -> "Filter":
        """Return the filter before anything is seen."""
        prior, N = noise.prior, len(noise.prior)
        n = (N - BODY) // 4
        return Filter(
            noise.start.copy(), np.diag(prior**2), np.zeros((LATEST, N, JUMP)), np.zeros((LATEST, JUMP, JUMP)),
            np.zeros((LATEST, JUMP)), np.zeros(5, dtype=np.int64), np.zeros(3), np.zeros((2, n)), np.ones(n),
            np.zeros((2, N)),
        )  # fmt: skip


SLOW = 5.0  # times as long as the model's error lasts that of the momentum
AFRESH = 0.2  # of the prior, by which a payload that was just put on is unknown
REST_S = 0.25  # of what friction hides at rest: how long it stays the same
TAME = 1.5  # standard deviations of a balance, beyond which it weighs less
MOST_SURPRISE = 9.0  # of a span, as a square of standard deviations: one that is a jump says little of the noise
RESTS = 5  # spans without sliding, from which an arm rests


@njit(cache=True, error_model="numpy")
def update(filter, noise, b):
    """Take a balance into the estimate.

    Args:
        filter: `Filter`. noise: `Noise`. b: `Balance`.
    """
    x, P, count = filter.x, filter.P, filter.counts
    N, n = len(x), len(b.y)
    payload, rub, path, slides = b.payload, b.rub, b.path, b.slides
    S0, O0, E0, A0 = BODY, BODY + n, BODY + 2 * n, BODY + 3 * n
    moves = False
    for j in range(n):
        moves |= slides[j] > 0.0
    count[2] = 0 if moves else count[2] + 1
    if count[2] >= RESTS:  # what is in the hand may become other unseen
        for i in range(BODY):
            share = noise.prior[i] / noise.prior[0]
            P[i, i] = min(P[i, i] + noise.resting * T * share * share, max(noise.prior[i] ** 2, P[i, i]))
    for c in range(BODY):
        P[c, c] += (noise.creeping * noise.prior[c]) ** 2 * T
    if count[4] > 0:
        count[4] -= 1
        _afresh(P, noise)
    fade, unsure = np.exp(-T / noise.lasting), filter.work[1]
    for j in range(n):
        e, used, load = E0 + j, slides[j] > 0.0, 0.0
        for c in range(BODY):
            load += (payload[j, c] * x[c]) ** 2
        unsure[j] = noise.loaded**2 * load
        model = np.sqrt(noise.model[j] ** 2 + unsure[j])
        if used:
            x[e] *= fade
            for i in range(N):
                P[e, i] *= fade
                P[i, e] *= fade
            P[e, e] += model**2 * (1.0 - fade * fade)
        P[e, e] += noise.turning[j] ** 2 * noise.level[j] * path[j]
        most = model**2 + (2.0 * noise.turning[j] * noise.level[j]) ** 2
        if P[e, e] > most:  # it has come to where nothing is known of it
            for i in range(N):
                if i != e:
                    P[e, i] *= np.sqrt(most / P[e, e])
                    P[i, e] = P[e, i]
            P[e, e] = most
        a, slow = A0 + j, np.exp(-T / (SLOW * noise.lasting))
        x[a] *= slow
        for i in range(N):
            P[a, i] *= slow
            P[i, a] *= slow
        P[a, a] += noise.moving[j] ** 2 * (1.0 - slow * slow)
        P[S0 + j, S0 + j] += noise.warming**2 * T
        P[O0 + j, O0 + j] += noise.drifting[j] ** 2 * T
        for k in range(count[1]):
            for c in range(JUMP):
                filter.f[k, e, c] *= fade if used else 1.0
                filter.f[k, a, c] *= slow
    if moves and count[4] == 0:
        _begin_onset(filter)
    h, g = filter.work[0], np.empty(JUMP)
    for j in range(n):
        R = filter.rough[j] * (noise.white[j] ** 2 + (noise.moving[j] * b.change[j]) ** 2 + unsure[j])
        if slides[j] == 0.0:
            R += noise.edge[j] ** 2 / 3.0 * REST_S / T
        for i in range(N):
            s = P[i, S0 + j] * rub[j] + P[i, O0 + j] + P[i, E0 + j] + P[i, A0 + j] * b.change[j]
            for c in range(BODY):
                s += P[i, c] * payload[j, c]
            h[i] = s
        S = R + h[S0 + j] * rub[j] + h[O0 + j] + h[E0 + j] + h[A0 + j] * b.change[j]
        v = b.y[j] - x[S0 + j] * rub[j] - x[O0 + j] - x[E0 + j] - x[A0 + j] * b.change[j]
        for i in range(n):
            v -= noise.inertia[j, i] * b.faster[i] + noise.late[j, i] * b.firmer[i]
        for c in range(BODY):
            S += h[c] * payload[j, c]
            v -= x[c] * payload[j, c]
        filter.seen[0, j], filter.seen[1, j] = v, S
        S *= max(1.0, np.sqrt(v * v / S) / TAME)
        if slides[j] > 0.0:
            surprise = min(v * v / filter.seen[1, j], MOST_SURPRISE) - 1.0
            filter.rough[j] = max(1.0, filter.rough[j] * (1.0 + noise.learning * surprise))
        for k in range(count[1]):
            f, C, d = filter.f[k], filter.information[k], filter.vector[k]
            age = (count[3] - 1 - k) % LATEST
            share = RAMP[age] if age < len(RAMP) else 1.0
            for c in range(JUMP):
                s = share * payload[j, c] - f[S0 + j, c] * rub[j] - f[O0 + j, c]
                s -= f[E0 + j, c] + f[A0 + j, c] * b.change[j]
                for i in range(BODY):
                    s -= payload[j, i] * f[i, c]
                g[c] = s
            for c in range(JUMP):
                d[c] += g[c] * v / S
                for i in range(JUMP):
                    C[c, i] += g[c] * g[i] / S
                for i in range(N):
                    f[i, c] += h[i] / S * g[c]
        for i in range(N):
            gain = h[i] / S
            x[i] += gain * v
            for k in range(N):
                P[i, k] -= gain * h[k]
    count[0] += 1
    _weigh(filter, noise)


@njit(cache=True)
def _begin_onset(filter):
    """Let a jump that begins with this span take the place of the oldest."""
    at = filter.counts[3]
    filter.f[at] = 0.0
    filter.information[at] = 0.0
    filter.vector[at] = 0.0
    filter.counts[3] = (at + 1) % LATEST
    filter.counts[1] = min(filter.counts[1] + 1, LATEST)


@njit(cache=True, error_model="numpy")
def _weigh(filter, noise):
    """Write the odds of a jump: of each onset exp(d (C + P0^-1)^-1 d / 2) / sqrt(det(1 + P0 C))."""
    best, at, most, total = -np.inf, -1, -np.inf, 0.0
    A, b = np.empty((JUMP, JUMP)), np.empty(JUMP)
    logs = np.empty(LATEST)
    for k in range(filter.counts[1]):
        logs[k] = _solve(filter.information[k], filter.vector[k], noise.prior, A, b)
        if logs[k] > best:
            best, at = logs[k], k
    if at >= 0:
        most = best
        for k in range(filter.counts[1]):
            total += np.exp(logs[k] - most)
        most += np.log(total / filter.counts[1])
    filter.odds[0], filter.odds[1], filter.odds[2] = most, best, at


@njit(cache=True, error_model="numpy")
def _solve(C, d, prior, A, b):
    """Return the log odds; leave Cholesky's root of C + P0^-1 in A, its diagonal inverted, and its solution in b."""
    log = 0.0
    for i in range(JUMP):
        for k in range(i + 1):
            s = C[i, k] + (1.0 / prior[i] ** 2 if i == k else 0.0)
            for c in range(k):
                s -= A[i, c] * A[k, c]
            A[i, k] = s * A[k, k] if k < i else 1.0 / np.sqrt(s)
        log += np.log(A[i, i]) - np.log(prior[i])
    for i in range(JUMP):
        s = d[i]
        for c in range(i):
            s -= A[i, c] * b[c]
        b[i] = s * A[i, i]
        log += 0.5 * b[i] * b[i]
    for i in range(JUMP - 1, -1, -1):
        s = b[i]
        for c in range(i + 1, JUMP):
            s -= A[c, i] * b[c]
        b[i] = s * A[i, i]
    return log


@njit(cache=True, error_model="numpy")
def jump(filter, noise):
    """Take the likeliest jump into the estimate; forget the onsets."""
    k, N = int(filter.odds[2]), len(filter.x)
    A, b = np.empty((JUMP, JUMP)), np.empty(JUMP)
    _solve(filter.information[k], filter.vector[k], noise.prior, A, b)
    B = -filter.f[k]
    for c in range(JUMP):
        B[c, c] += 1.0
    inverse = np.zeros((JUMP, JUMP))  # of the root
    for c in range(JUMP):
        inverse[c, c] = A[c, c]
        for i in range(c + 1, JUMP):
            s = 0.0
            for m in range(c, i):
                s -= A[i, m] * inverse[m, c]
            inverse[i, c] = s * A[i, i]
    spread = np.zeros((N, JUMP))  # B (C + P0^-1)^-1 B^T = spread spread^T
    for i in range(N):
        for m in range(JUMP):
            for c in range(m + 1):
                spread[i, m] += B[i, c] * inverse[m, c]
        for c in range(JUMP):
            filter.x[i] += B[i, c] * b[c]
    for i in range(N):
        for k2 in range(N):
            for m in range(JUMP):
                filter.P[i, k2] += spread[i, m] * spread[k2, m]
    _afresh(filter.P, noise)  # it may have been within the span: what is found now is a beginning
    for c in range(JUMP, BODY):
        filter.P[c, c] += noise.prior[c] ** 2
    filter.counts[1] = 0
    filter.counts[3] = 0
    filter.counts[4] = len(RAMP)


@njit(cache=True)
def _afresh(P, noise):
    """Let mass and first moments be known no better than those of what was just put on."""
    for c in range(JUMP):
        P[c, c] += (AFRESH * noise.prior[c]) ** 2
