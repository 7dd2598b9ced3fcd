"""Detect sudden payload changes (jumps), and correct the Kalman filter after a jump, in compiled code.

The generalized likelihood ratio test (Willsky and Jones, IEEE TAC 21(1), 1976) treats each of the last ONSETS spans
of 20 ms as a possible onset of a jump. For each onset, the test stores the Kalman filter's response to a jump
(signature) and computes the odds of a jump under a prior. If no jump occurs, the mean odds over all onsets have
expectation 1, so they exceed x with a probability of at most 1 / x (Markov's inequality). A threshold equal to the
number of tests in ten hours thus allows one false alarm in ten hours. Model errors have heavier tails than normal
errors and cause further alarms; the aim is one false alarm per hour.
"""

import numpy as np

from r2s.adaptation.momentum import BODY
from r2s.adaptation.momentum_residual import STEP_RESPONSE
from r2s.adaptation.tuning import NEW_PAYLOAD, ONSETS
from r2s.compiled import njit

JUMP = 4  # parameters of a jump: mass and first moments
# indices of `Filter.counts`: onsets in use, index of the next onset, remaining spans that the last jump affects
USED, NEXT, SINCE_JUMP = range(2, 5)
MEAN, ONSET = range(2)  # indices of `Filter.log_odds`


@njit(cache=True)
def begin_onset(filter):
    """Make this 20 ms span a possible onset of a jump; if all slots are used, the span replaces the oldest onset."""
    at = filter.counts[NEXT]
    filter.signature[at] = 0.0
    filter.information[at] = 0.0
    filter.vector[at] = 0.0
    filter.counts[NEXT] = (at + 1) % ONSETS
    filter.counts[USED] = min(filter.counts[USED] + 1, ONSETS)


@njit(cache=True, error_model="numpy")
def update_onsets(filter, residual, j, v, S):
    """Update all onsets with joint j's innovation v, its variance S, and filter.work[0], see `kalman._innovation`."""
    g, h, payload, N, n = np.empty(JUMP), filter.work[0], residual.payload, len(filter.x), len(residual.y)
    friction, offset, error, rate = BODY + j, BODY + n + j, BODY + 2 * n + j, BODY + 3 * n + j
    for k in range(filter.counts[USED]):
        f, C, d = filter.signature[k], filter.information[k], filter.vector[k]
        age = (filter.counts[NEXT] - 1 - k) % ONSETS
        share = STEP_RESPONSE[age] if age < len(STEP_RESPONSE) else 1.0
        for c in range(JUMP):
            s = share * payload[j, c] - f[friction, c] * residual.friction[j] - f[offset, c]
            s -= f[error, c] + f[rate, c] * residual.rate[j]
            for i in range(BODY):
                s -= payload[j, i] * f[i, c]
            g[c] = s
        for c in range(JUMP):
            d[c] += g[c] * v / S
            for i in range(JUMP):
                C[c, i] += g[c] * g[i] / S
            for i in range(N):
                f[i, c] += h[i] / S * g[c]


@njit(cache=True, error_model="numpy")
def detect(filter, noise):
    """Write the log of the mean odds of a jump over all onsets, and the likeliest onset, to `Filter.log_odds`."""
    best, at, mean, total = -np.inf, -1, -np.inf, 0.0
    A, b = np.empty((JUMP, JUMP)), np.empty(JUMP)
    logs = np.empty(ONSETS)
    for k in range(filter.counts[USED]):
        logs[k] = _solve(filter.information[k], filter.vector[k], noise.prior, A, b)
        if logs[k] > best:
            best, at = logs[k], k
    if at >= 0:
        mean = best
        for k in range(filter.counts[USED]):
            total += np.exp(logs[k] - best)
        mean += np.log(total / filter.counts[USED])
    filter.log_odds[MEAN], filter.log_odds[ONSET] = mean, at


@njit(cache=True, error_model="numpy")
def _solve(C, d, prior, A, b):
    """Return an onset's log odds of a jump from the onset's `information` C (4, 4) and `vector` d (4,), see `Filter`.

    The log odds are d (C + P0^-1)^-1 d / 2 - log(det(1 + P0 C)) / 2, where P0 is the prior covariance of a jump.
    """
    log = 0.0  # A: Cholesky factor of C + P0^-1, its diagonal inverted; b: the jump
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
def apply_jump(filter, noise):
    """Add the likeliest payload jump to the estimate, and discard all onsets."""
    k, N = int(filter.log_odds[ONSET]), len(filter.x)
    A, b = np.empty((JUMP, JUMP)), np.empty(JUMP)
    _solve(filter.information[k], filter.vector[k], noise.prior, A, b)
    B = -filter.signature[k]
    for c in range(JUMP):
        B[c, c] += 1.0
    inverse = np.zeros((JUMP, JUMP))  # inverse Cholesky factor
    for c in range(JUMP):
        inverse[c, c] = A[c, c]
        for i in range(c + 1, JUMP):
            s = 0.0
            for m in range(c, i):
                s -= A[i, m] * inverse[m, c]
            inverse[i, c] = s * A[i, i]
    root = np.zeros((N, JUMP))  # B (C + P0^-1)^-1 B^T = root root^T
    for i in range(N):
        for m in range(JUMP):
            for c in range(m + 1):
                root[i, m] += B[i, c] * inverse[m, c]
        for c in range(JUMP):
            filter.x[i] += B[i, c] * b[c]
    for i in range(N):
        for k2 in range(N):
            for m in range(JUMP):
                filter.P[i, k2] += root[i, m] * root[k2, m]
    widen_payload(filter.P, noise)  # because the jump may have happened within the span
    for c in range(JUMP, BODY):
        filter.P[c, c] += noise.prior[c] ** 2
    filter.counts[USED] = 0
    filter.counts[NEXT] = 0
    filter.counts[SINCE_JUMP] = len(STEP_RESPONSE)


@njit(cache=True)
def widen_payload(P, noise):
    """Increase the variances of the payload's mass and first moments by the variances of a new payload."""
    for c in range(JUMP):
        P[c, c] += (NEW_PAYLOAD * noise.prior[c]) ** 2
