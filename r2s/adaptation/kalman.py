"""Estimate payload, friction and offsets with a Kalman filter, in compiled code.

For an arm with n joints, the state has N = 10 + 4 n components:
- the payload's mass, first moments and tensor about the payload frame: kg, kg m, kg m^2;
- per joint the relative error of the friction model, a random walk;
- per joint the error of the offset in Nm, a random walk;
- per joint the model error in Nm, an Ornstein-Uhlenbeck process whose variance grows when friction changes;
- per joint the relative error of the momentum rate, an Ornstein-Uhlenbeck process.

The filter processes the joints' momentum residuals one after the other. Breakaway or a vibrating gear causes large
residuals for one or two spans of 20 ms. Huber's function (Robust Statistics, 1981) therefore reduces the weight of
innovations beyond HUBER standard deviations. A payload change causes large innovations for longer, so the filter
still follows the change.
"""

from typing import NamedTuple

import numpy as np

from r2s.adaptation.momentum import BODY
from r2s.adaptation.payload_jump import (
    JUMP,
    NEXT,
    SINCE_JUMP,
    USED,
    begin_onset,
    detect,
    update_onsets,
    widen_payload,
)
from r2s.adaptation.tuning import HUBER, MOMENTUM_CORRELATION, MOST_SURPRISE, ONSETS, REST_SPANS, STICTION_S, T
from r2s.compiled import njit

SPANS, AT_REST = range(2)  # indices of `Filter.counts`; payload_jump.py defines the indices 2 to 4


class Noise(NamedTuple):
    """Uncertainty of the model of an n-joint arm: noise, missing terms, drift, and prior of the filter's state."""

    white: np.ndarray  # (n,) Nm, white noise of a residual
    momentum_share: np.ndarray  # (n,), relative error of the momentum rate
    model: np.ndarray  # (n,) Nm, model error
    correlation_s: float  # s, correlation time of the model error
    reversal: np.ndarray  # (n,), model error that a change of friction adds, relative to this change
    level: np.ndarray  # (n,) Nm, friction level as in `ArmModel`
    breakaway: np.ndarray  # (n,) Nm, as in `ArmModel`
    inertia: np.ndarray  # (n, n) kg m^2, inertia missing in the model, mostly of rotors
    latency: np.ndarray  # (n, n) s, latency missing in the model
    payload_friction: float  # model error / payload torque, from load-dependent friction and noisy speeds
    friction_drift: float  # 1/sqrt(s), random walk of relative friction
    offset_drift: np.ndarray  # (n,) Nm/sqrt(s), random walk of the offsets
    rest_drift: float  # kg^2/s, growth of the mass variance at rest, where payload changes are invisible
    payload_drift: float  # 1/sqrt(s), random walk of the payload, relative to its prior
    adaptation: float  # growth of white noise per span while innovations exceed the prediction; 0: no growth
    prior: np.ndarray  # (N,) standard deviations of the initial state
    mean: np.ndarray  # (N,), mean of the initial state


class Filter(NamedTuple):
    """State of the Kalman filter, and of the likelihood ratio test for payload jumps."""

    x: np.ndarray  # (N,), mean
    P: np.ndarray  # (N, N), covariance
    signature: np.ndarray  # (ONSETS, N, 4), response of x to a jump
    information: np.ndarray  # (ONSETS, 4, 4), information matrix of the jump
    vector: np.ndarray  # (ONSETS, 4), `information` times the estimated jump
    counts: np.ndarray  # (5,), SPANS: all spans; AT_REST: successive spans at rest; see payload_jump.py
    log_odds: np.ndarray  # (2,), MEAN: log of the mean odds of all onsets; ONSET: index of the likeliest onset
    innovations: np.ndarray  # (2, n) Nm and Nm^2, innovations and their variances
    # (n,), variance of white noise relative to `Noise`, at least 1
    # This variance grows while innovations stay large, for example because a gear vibrates under an unrecorded load.
    noise_scale: np.ndarray
    work: np.ndarray  # (2, N), scratch: P h^T; per joint, variance of friction due to the payload

    @staticmethod
    def fresh(noise: Noise) -> "Filter":
        """Return the filter's state before the first measurement."""
        prior, N = noise.prior, len(noise.prior)
        n = (N - BODY) // 4
        return Filter(
            noise.mean.copy(), np.diag(prior**2), np.zeros((ONSETS, N, JUMP)), np.zeros((ONSETS, JUMP, JUMP)),
            np.zeros((ONSETS, JUMP)), np.zeros(5, dtype=np.int64), np.zeros(2), np.zeros((2, n)), np.ones(n),
            np.zeros((2, N)),
        )  # fmt: skip


@njit(cache=True, error_model="numpy")
def update(filter, noise, residual):
    """Predict and correct the filter's state with the residual of one 20 ms span, and test for a payload jump."""
    predict(filter, noise, residual)
    correct(filter, noise, residual)
    detect(filter, noise)


@njit(cache=True, error_model="numpy")
def predict(filter, noise, residual):
    """Predict the filter's mean, covariance and `signature` (response to payload jumps) one 20 ms span ahead."""
    P, counts, n, moving = filter.P, filter.counts, len(residual.y), False
    for j in range(n):
        moving |= residual.sliding[j] > 0.0
    counts[AT_REST] = 0 if moving else counts[AT_REST] + 1
    if counts[AT_REST] >= REST_SPANS:  # a payload change would be invisible
        for i in range(BODY):
            share = noise.prior[i] / noise.prior[0]
            P[i, i] = min(P[i, i] + noise.rest_drift * T * share * share, max(noise.prior[i] ** 2, P[i, i]))
    for c in range(BODY):
        P[c, c] += (noise.payload_drift * noise.prior[c]) ** 2 * T
    if counts[SINCE_JUMP] > 0:
        counts[SINCE_JUMP] -= 1
        widen_payload(P, noise)
    for j in range(n):
        _predict_joint(filter, noise, residual, j)
    if moving and counts[SINCE_JUMP] == 0:
        begin_onset(filter)


@njit(cache=True, error_model="numpy")
def pause(filter, noise, seconds):
    """Increase variances, at most to the prior variances: the payload may change during a pause of `seconds` s."""
    P, prior, n = filter.P, noise.prior, len(noise.level)
    for i in range(BODY + 2 * n):
        if i < BODY:
            share = prior[i] / prior[0]
            drift = noise.rest_drift * share * share + (noise.payload_drift * prior[i]) ** 2
        else:
            drift = noise.friction_drift**2 if i < BODY + n else noise.offset_drift[i - BODY - n] ** 2
        P[i, i] = min(P[i, i] + drift * seconds, max(prior[i] ** 2, P[i, i]))
    for i in range(BODY + 2 * n, len(prior)):  # discard the model errors of the last posture
        filter.x[i] = 0.0
        P[i, :] = 0.0
        P[:, i] = 0.0
        P[i, i] = prior[i] ** 2
    filter.counts[USED] = 0
    filter.counts[NEXT] = 0


@njit(cache=True, error_model="numpy")
def _predict_joint(filter, noise, residual, j):
    x, P, N, n = filter.x, filter.P, len(filter.x), len(residual.y)
    friction, offset, error, rate = BODY + j, BODY + n + j, BODY + 2 * n + j, BODY + 3 * n + j
    fade, slow = np.exp(-T / noise.correlation_s), np.exp(-T / (MOMENTUM_CORRELATION * noise.correlation_s))
    sliding, load = residual.sliding[j] > 0.0, 0.0
    for c in range(BODY):
        load += (residual.payload[j, c] * x[c]) ** 2
    filter.work[1, j] = noise.payload_friction**2 * load
    model = np.sqrt(noise.model[j] ** 2 + filter.work[1, j])
    if sliding:
        x[error] *= fade
        for i in range(N):
            P[error, i] *= fade
            P[i, error] *= fade
        P[error, error] += model**2 * (1.0 - fade * fade)
    P[error, error] += noise.reversal[j] ** 2 * noise.level[j] * residual.friction_path[j]
    most = model**2 + (2.0 * noise.reversal[j] * noise.level[j]) ** 2
    if P[error, error] > most:  # limit the variance to that of an unknown model error; keep the correlations
        for i in range(N):
            if i != error:
                P[error, i] *= np.sqrt(most / P[error, error])
                P[i, error] = P[error, i]
        P[error, error] = most
    x[rate] *= slow
    for i in range(N):
        P[rate, i] *= slow
        P[i, rate] *= slow
    P[rate, rate] += noise.momentum_share[j] ** 2 * (1.0 - slow * slow)
    P[friction, friction] += noise.friction_drift**2 * T
    P[offset, offset] += noise.offset_drift[j] ** 2 * T
    for k in range(filter.counts[USED]):
        for c in range(JUMP):
            filter.signature[k, error, c] *= fade if sliding else 1.0
            filter.signature[k, rate, c] *= slow


@njit(cache=True, error_model="numpy")
def correct(filter, noise, residual):
    """Correct the state's mean and covariance by the joints' residuals, one after the other."""
    x, P, h, N = filter.x, filter.P, filter.work[0], len(filter.x)
    for j in range(len(residual.y)):
        v, S = _innovation(filter, noise, residual, j)
        filter.innovations[0, j], filter.innovations[1, j] = v, S
        if residual.sliding[j] > 0.0:
            surprise = min(v * v / S, MOST_SURPRISE) - 1.0
            filter.noise_scale[j] = max(1.0, filter.noise_scale[j] * (1.0 + noise.adaptation * surprise))
        S *= max(1.0, np.sqrt(v * v / S) / HUBER)
        update_onsets(filter, residual, j, v, S)
        for i in range(N):
            gain = h[i] / S
            x[i] += gain * v
            for k in range(N):
                P[i, k] -= gain * h[k]
    filter.counts[SPANS] += 1


@njit(cache=True, error_model="numpy")
def _innovation(filter, noise, residual, j):
    """Return joint j's innovation (Nm) and its variance; write its covariance with the state to filter.work[0]."""
    x, P, h, n = filter.x, filter.P, filter.work[0], len(residual.y)
    friction, offset, error, rate = BODY + j, BODY + n + j, BODY + 2 * n + j, BODY + 3 * n + j
    of_friction, of_rate, payload = residual.friction[j], residual.rate[j], residual.payload
    R = noise.white[j] ** 2 + (noise.momentum_share[j] * of_rate) ** 2 + filter.work[1, j]
    R = filter.noise_scale[j] * R
    if residual.sliding[j] == 0.0:  # stiction may be any torque up to breakaway: variance of a uniform distribution
        R += noise.breakaway[j] ** 2 / 3.0 * STICTION_S / T
    for i in range(len(x)):
        s = P[i, friction] * of_friction + P[i, offset] + P[i, error] + P[i, rate] * of_rate
        for c in range(BODY):
            s += P[i, c] * payload[j, c]
        h[i] = s
    S = R + h[friction] * of_friction + h[offset] + h[error] + h[rate] * of_rate
    v = residual.y[j] - x[friction] * of_friction - x[offset] - x[error] - x[rate] * of_rate
    for i in range(n):
        v -= noise.inertia[j, i] * residual.acceleration[i] + noise.latency[j, i] * residual.torque_rate[i]
    for c in range(BODY):
        S += h[c] * payload[j, c]
        v -= x[c] * payload[j, c]
    return v, S
