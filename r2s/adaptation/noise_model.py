"""Determine the uncertainty of an identified model, from its posterior and from recordings without a payload."""

import numpy as np
from scipy.optimize import nnls

from r2s.adaptation import tuning
from r2s.adaptation.arm_model import ArmModel
from r2s.adaptation.kalman import Filter, Noise, update
from r2s.adaptation.model_correction import ModelCorrection, corrected_residuals, fit_model_correction
from r2s.adaptation.momentum import BODY
from r2s.adaptation.momentum_residual import MomentumResidual, ResidualState, update_residual
from r2s.adaptation.payload_jump import MEAN
from r2s.identification.parameters import ParameterSpace
from r2s.physics.robot import Robot
from r2s.recordings.recording import Recording

Prior = tuple[np.ndarray, np.ndarray]  # standard deviations of relative friction (n,) and of offsets (n,) Nm


def prior_of(space: ParameterSpace, samples: np.ndarray) -> Prior:
    """Compute the prior of friction and offsets from an identification's posterior samples (S, P)."""
    d = space.dynamics(samples)
    sliding = np.full(space.n, tuning.LEVEL_SPEED)
    levels = 0.5 * (d.friction(sliding) - d.friction(-sliding))
    middle = np.maximum(np.abs(np.median(levels, 0)), 1e-9)
    return levels.std(0) / middle, np.broadcast_to(d.offset, levels.shape).std(0)


def default_noise(arm: ArmModel, prior: Prior | None = None) -> Noise:
    """Return the default `Noise` of an arm; `prior` comes from `prior_of`.

    If `prior` is None, the prior standard deviations of friction and offsets are 30 % of the friction level.
    """
    n = len(arm.level)
    zero = np.zeros(n)
    friction, offset = prior or (zero + 0.3, 0.3 * arm.level)
    friction, offset = np.hypot(friction, tuning.WARMED), np.hypot(offset, tuning.OFFSET_DRIFTED * arm.level)
    most, far = arm.payload_max
    mass, tensor = tuning.PAYLOAD_MASS * most, tuning.PAYLOAD_TENSOR * most * far**2
    moment = tuning.PAYLOAD_CENTRE * mass * far
    payload = np.array([mass, *[moment] * 3, *[tensor] * 3, *[0.5 * tensor] * 3])
    model, momentum = tuning.MODEL_SHARE * arm.level, zero + tuning.MOMENTUM_SHARE
    sigma = np.concatenate([payload, friction, offset, model, momentum])
    return Noise(
        white=tuning.WHITE_SHARE * arm.level,
        momentum_share=momentum,
        model=model,
        correlation_s=tuning.CORRELATION_S,
        reversal=zero + tuning.REVERSAL_SHARE,
        level=arm.level,
        breakaway=arm.breakaway,
        inertia=np.zeros((n, n)),
        latency=np.zeros((n, n)),
        payload_friction=tuning.PAYLOAD_FRICTION,
        friction_drift=tuning.FRICTION_DRIFT,
        offset_drift=tuning.OFFSET_DRIFT * arm.level,
        rest_drift=tuning.REST_DRIFT * float(most) ** 2,
        payload_drift=tuning.PAYLOAD_DRIFT,
        adaptation=tuning.NOISE_ADAPTATION,
        prior=sigma,
        mean=np.zeros_like(sigma),
    )


def momentum_residuals(arm: ArmModel, recording: Recording) -> list[MomentumResidual]:
    """Return the momentum residuals of a recording of commanded torque, without each trajectory's first two spans."""
    n, out = recording.n_joints, []
    q, dq, tau = (np.array(x) for x in (recording.q, recording.dq, recording.tau))  # writable, as on an arm
    for stretch in recording.stretches:
        state, r = ResidualState.fresh(n), MomentumResidual.empty(n)
        for k in range(stretch.start, stretch.stop):
            if update_residual(arm, state, q[k], dq[k], tau[k], r):
                out.append(MomentumResidual(*(a.copy() for a in r)))
    return out


def fit_noise(
    robot: Robot, arm: ArmModel, prior: Prior | None, train: list[MomentumResidual], other: list[MomentumResidual]
) -> tuple[ModelCorrection, Noise]:
    """Return the model correction from two motions without a payload, and the noise of the corrected model.

    The motion `train` yields a first model correction. The residuals of the corrected model in the motion `other`
    determine the noise. Covariances of a joint's residuals at lags of 60 to 300 ms yield the joint's model error. The
    remaining variance yields white noise, which grows with the momentum rate. A factor for each joint then scales the
    joint's noise, so that the joint's innovations have the predicted variance. A common factor then scales the noise
    of all joints until the odds of a payload change, which did not occur, are at most the number of residuals. The
    factor SECOND_HALF finally reduces the noise. The returned correction is a fit to `train` and `other` together,
    which also yield the prior means of friction and offsets.
    """
    first = fit_model_correction(robot, arm, train)
    start = default_noise(arm, prior)._replace(adaptation=0.0)
    noise = _fit_to_residuals(start, corrected_residuals(robot, arm, first, other))
    noise = _scaled(noise, np.full(len(arm.level), tuning.SECOND_HALF))
    correction = fit_model_correction(robot, arm, [*train, *other])
    filter = _run(_without_payload(noise), corrected_residuals(robot, arm, correction, [*train, *other]))[0]
    n = len(arm.level)
    mean, sigma = np.zeros_like(noise.prior), noise.prior.copy()
    drift = np.concatenate([np.full(n, tuning.WARMED), tuning.OFFSET_DRIFTED * arm.level])
    slow = slice(BODY, BODY + 2 * n)  # friction and offsets
    mean[slow] = filter.x[slow]
    sigma[slow] = np.hypot(np.sqrt(np.diag(filter.P)[slow]), drift)
    noise = noise._replace(inertia=correction.inertia, latency=correction.latency, prior=sigma, mean=mean)
    return correction, noise._replace(adaptation=tuning.NOISE_ADAPTATION)


def _fit_to_residuals(noise: Noise, residuals: list[MomentumResidual]) -> Noise:
    """Fit `noise` to the residuals of a motion without a payload, then scale the noise, as `fit_noise` describes."""
    n = len(noise.level)
    white, momentum, model = noise.white.copy(), noise.momentum_share.copy(), noise.model.copy()
    for j in range(n):
        if sum(r.sliding[j] > 0 for r in residuals) >= tuning.LEAST_SPANS:
            white[j], momentum[j], model[j] = _fit_joint(residuals, j, noise.level[j], model[j])
    prior = _with_model(noise.prior, model, momentum)
    noise = noise._replace(white=white, momentum_share=momentum, model=model, prior=prior)
    for _ in range(2):
        noise = _scaled(noise, np.maximum(_innovation_scale(noise, residuals), tuning.LEAST_SCALE))
    allowed = np.log(len(residuals))
    for _ in range(tuning.SCALINGS):
        if (most := _largest_odds(noise, residuals)) <= allowed:
            break
        noise = _scaled(noise, np.full(n, min(np.sqrt(most / allowed), tuning.MOST_SCALE)))
    return noise


def _fit_joint(residuals: list[MomentumResidual], j: int, level: float, model: float) -> tuple[float, float, float]:
    """Return joint j's white noise (Nm), the growth of white noise with the momentum rate, and the model error (Nm).

    If the joint slides too rarely for covariances, the model error is `model`, clipped to plausible values.
    """
    columns = np.array([[r.friction[j], 1.0] for r in residuals])
    y, sliding = np.array([r.y[j] for r in residuals]), np.array([r.sliding[j] > 0 for r in residuals])
    fitted = columns @ np.linalg.lstsq(columns[sliding], y[sliding], rcond=None)[0]
    error, covariances = np.where(sliding, y - fitted, 0.0), []
    for lag in tuning.LAGS:
        both = sliding[lag:] & sliding[:-lag]
        if both.sum() > tuning.LEAST_SPANS:
            product = (error[lag:] * error[:-lag])[both].mean()
            covariances.append(product / np.exp(-lag * tuning.T / tuning.CORRELATION_S))
    most, finest = error[sliding].std(), tuning.FINEST_SHARE * level
    model = np.sqrt(max(np.mean(covariances), 0.0)) if covariances else model
    model = max(min(model, most), finest)
    square, rate = error[sliding] ** 2, np.array([r.rate[j] for r in residuals])[sliding] ** 2
    weight = 1 / (square.mean() + rate * 1e-2)
    (floor, growth), _ = nnls(np.column_stack([np.ones(sliding.sum()), rate]) * weight[:, None], square * weight)
    return np.sqrt(max(floor - model**2, (0.1 * most) ** 2, finest**2)), np.sqrt(growth), model


def _scaled(noise: Noise, scale: np.ndarray) -> Noise:
    """Return `noise` with each joint's white noise and errors multiplied by the joint's factor in `scale` (n,)."""
    parts = {name: getattr(noise, name) * scale for name in ("white", "momentum_share", "model", "reversal")}
    return noise._replace(**parts, prior=_with_model(noise.prior, parts["model"], parts["momentum_share"]))


def _with_model(prior: np.ndarray, model: np.ndarray, momentum: np.ndarray) -> np.ndarray:
    """Return a copy of `prior` with new standard deviations (n,) of the model errors and the momentum-rate errors."""
    out = prior.copy()
    out[-2 * len(model) :] = np.concatenate([model, momentum])
    return out


def _without_payload(noise: Noise) -> Noise:
    """Return `noise` with a payload prior near zero, for an arm without a payload."""
    prior = noise.prior.copy()
    prior[:BODY] = 1e-6
    return noise._replace(prior=prior, rest_drift=0.0)


def _run(noise: Noise, residuals: list[MomentumResidual]) -> tuple[Filter, np.ndarray, np.ndarray]:
    """Filter M residuals; return the `Filter`, normalized innovations (M, n; nan at rest) and log odds (M,)."""
    filter, innovations, odds = Filter.fresh(noise), [], []
    for r in residuals:
        update(filter, noise, r)
        v, S = filter.innovations
        innovations.append(np.where(r.sliding > 0, v / np.sqrt(S), np.nan))
        odds.append(filter.log_odds[MEAN])
    return filter, np.array(innovations), np.array(odds)


def _largest_odds(noise: Noise, residuals: list[MomentumResidual]) -> float:
    """Return the largest log odds of a payload change after the first tenth of a motion without a payload change."""
    return float(_run(noise, residuals)[2][len(residuals) // 10 :].max())


def _innovation_scale(noise: Noise, residuals: list[MomentumResidual]) -> np.ndarray:
    """Return the root mean square (n,) of each joint's normalized innovations, for an arm without a payload."""
    size = np.abs(_run(_without_payload(noise), residuals)[1])[len(residuals) // 10 :]  # offsets have settled
    scale = np.ones(size.shape[1])
    for j in range(len(scale)):
        own = size[np.isfinite(size[:, j]), j]
        if len(own) >= tuning.LEAST_SPANS:
            scale[j] = np.sqrt(np.mean(np.minimum(own, tuning.OUTLIER) ** 2))
    return scale
