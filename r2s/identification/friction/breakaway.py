"""Estimate the breakaway torque of each joint from recorded ramps (Table II of the paper that r2s follows).

A ramp raises the command of one joint until the joint has clearly moved (r2s/arm/ramp.py). At the end of a ramp, the
joint has accelerated for 10 to 150 ms, and the command exceeds the breakaway command. Before breakaway, a physical
joint also creeps: bristles bend by millirads, at a growing rate. Neither a threshold of motion nor a fitted parabola
can separate creep from breakaway. In the model that r2s fits, a joint at position x creeps at first, and slides when
the command u exceeds the breakaway command U:

    d2x/dt2 = kappa (u - U + (U - u0) exp(-x / z)) + [u > U] jump - lambda dx/dt,    x = 0 and u = u0 at first

The command u, after delay and lag, is positive in the ramp's direction; kappa is the inverse inertia. Below the
breakaway command U, stiction balances the command u, and bristles bend over the creep length z (Dahl, J. Dyn. Sys.
Meas. Control 98(4), 1976). At breakaway, friction falls from U to a lower value; `jump` is this decrease times kappa.
In eq. 6 of the paper, the creep length z and the lower value are 0. The fit without `Slide` estimates all parameters
of the equation and needs no model of the arm.

If friction falls over a range of velocities (Stribeck), motion begins slowly. The sudden `jump` then makes the fit
without `Slide` overestimate U, by 4 to 22 mNm on an arm with known U. The fit with `Slide` uses parameters of an
identified arm and replaces `jump` by jump (1 - exp(-(v / fall)^2)), with velocity v and Stribeck velocity `fall`. On
the arm with known U, the fit with `Slide` erred by less than 0.2 mNm. r2s uses the fit with `Slide` if it explains
the motion as well as the fit without `Slide`.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from r2s.compiled import njit
from r2s.errors import check_number
from r2s.recordings.ramps import Ramps

MOVED = 5e-3  # rad, motion up to which rows are fitted; before breakaway, joints creep 1 to 3 mrad, also on the twin
MIN_ROWS = 10  # least number of rows in a fit
ENCODER = 2e-5  # rad, standard deviation of position residuals: encoder noise of a Panda
DIFFERENCE = 1e-3  # finite-difference step, relative to the scale of each parameter
BREAKAWAY_S = 2e-3  # s, accuracy of the fitted time of breakaway
STEP = 1e-3  # s, longest integration step
# bounds of log kappa, log z (rad), log lambda (1/s), jump (rad/s^2), rest (rad) and drift (rad/s)
LOW = np.log(1e-5), np.log(2e-6), np.log(0.1), 0.0, -0.1, -0.1
HIGH = np.log(1e4), np.log(3e-3), np.log(1e3), 1e3, 0.1, 0.1
RIGID = 1e-8  # rad, creep length of a joint that does not creep
DRIFT = 3e-4  # rad/s, prior sigma of a slow drift, because a resting joint may still settle
SIDES = "negative", "positive"
KAPPA_SIGMA = 0.1  # prior sigma of log kappa about the value of an identified arm
WORSE = 1.01  # largest misfit with `Slide` / misfit without `Slide` for which r2s uses the fit with `Slide`
BACK = 0.0, 0.03, 0.1  # initial values of U: last command minus these multiples of the ramp's rise
DAMPING = np.log(10.0), 1.5  # prior mean and sigma of log lambda, which a short motion does not determine
# initial values: creep length, rad; sliding time, relative to the sliding time of quadratic motion
STARTS = ((1e-5, 0.3), (4e-4, 0.3), (4e-4, 1.0))


@dataclass(frozen=True, eq=False)
class Breakaway:
    """Commands (without gravity) at which n joints broke away in K ramps.

    Attributes:
        command: (n, 2) Nm, mean command at breakaway in negative and positive direction; NaN without breakaway. The
            breakaway torque is the sum of `command` and the joint's offset, but ramps do not determine the offset.
        spread: (n, 2) Nm, standard deviation of the breakaway command over ramps; NaN for fewer than two ramps.
        count: (n, 2), number of ramps with a breakaway. ramped: (n, 2), number of all ramps.
        held: (n, 2) Nm, largest command without motion if the joint broke away in no ramp; 0 otherwise.
        resolution: (n, 2) Nm, accuracy of a ramp's breakaway command: `BREAKAWAY_S` times the ramp's rate.
        value: (K,) Nm, breakaway command of each ramp; NaN without breakaway.
        misfit: (K,) rad, RMS difference between measured and fitted positions. A misfit well above the encoder noise
            (or above 5e-5 rad for physical stick-slip) shows that the model does not describe the joint's motion.
        joint, sign, pose: (K,), joint, direction and pose of each ramp, see `Ramps`.
    """

    command: np.ndarray
    spread: np.ndarray
    count: np.ndarray
    ramped: np.ndarray
    held: np.ndarray
    resolution: np.ndarray
    value: np.ndarray
    misfit: np.ndarray
    joint: np.ndarray
    sign: np.ndarray
    pose: np.ndarray

    @property
    def unknown(self) -> dict[str, str]:
        """Reasons for missing breakaway torques, {"joint 3, positive": "not reached: held against 2.4 Nm", ...}."""
        reasons = {}
        for j, side in np.argwhere(self.count == 0):
            held = abs(self.held[j, side])
            why = f"held against {held:.3g} Nm" if held else "no usable ramp"
            reasons[f"joint {j + 1}, {SIDES[side]}"] = f"not reached: {why}" if self.ramped[j, side] else "not ramped"
        return reasons


@dataclass(frozen=True, eq=False)
class Slide:
    """Parameters of the motion after breakaway, predicted by an identified arm, for each of K ramps.

    Attributes:
        kappa: (K,) rad/s^2 per Nm, inverse inertia of the ramped joint while the other joints rest.
        level: (K,) Nm, command that sustains sliding just above `fall`: Coulomb friction minus other torques.
        viscous: (K,) Nm s/rad, viscous friction.
        fall: (K,) rad/s, Stribeck velocity: friction falls to `level` as exp(-(v / fall)^2) with the speed v.
        misfit: (K,) rad, `Breakaway.misfit` of the fits without `Slide`, see WORSE.
    """

    kappa: np.ndarray
    level: np.ndarray
    viscous: np.ndarray
    fall: np.ndarray
    misfit: np.ndarray


def estimate_breakaway(
    ramps: Ramps, *, delay: float = 0.0, lag: float = 0.0, slide: Slide | None = None
) -> Breakaway:
    """Estimate, from t, q and tau of the ramps, the commands at which joints broke away.

    The estimate is NaN if the joint moves by less than MOVED rad in the ramp's direction, or if the joint moves
    before the command rises.

    Args:
        ramps: recorded ramps at any rate; in a ramp, the joint starts at rest and the command rises (falls for sign
            -1). For an encoder noise of 2e-5 rad, the estimate's error is the ramp's rate times 0.5 ms (small
            inertia) to 3 ms (large inertia).
        delay, lag: s, delay and lag between command and torque; r2s adds half of the command's hold to `delay`.
        slide: an identified arm's motion after breakaway; if None, r2s uses only the fit without `Slide`.

    Raises:
        UserError: delay or lag is out of range.
    """
    check_number("breakaway: delay", delay, "[0, 0.1)")
    check_number("breakaway: lag", lag, "[0, 0.1)")
    r = ramps.recording
    count, hold = len(r.stretches), r.command_period or 1.0 / r.rate_hz
    delay += 0.5 * hold  # mean latency of a command that is held until the next one
    value, misfit = (np.full(count, np.nan) for _ in range(2))
    held, blur = np.zeros(count), np.zeros(count)
    for k, (t, x, u) in enumerate(_in_direction(ramps)):
        end = int(np.argmax(np.abs(x) >= MOVED)) + 1
        if np.abs(x).max() < MOVED:
            held[k] = max(_delayed(t, u, delay, lag).max(), 0.0)
        if x[end - 1] < MOVED or end < MIN_ROWS:
            continue
        seen = t[:end], x[:end], _delayed(t, u, delay, lag)[:end]
        if slide is not None and not np.isnan(slide.kappa[k]):
            known = slide.kappa[k], slide.level[k], slide.viscous[k], slide.fall[k]
            value[k], misfit[k] = _fit_slide(*seen, *known)
        if np.isnan(value[k]) or (slide is not None and misfit[k] > WORSE * slide.misfit[k]):
            value[k], misfit[k] = _fit_breakaway(*seen)
        value[k] *= ramps.sign[k]
        blur[k] = BREAKAWAY_S * (u[end - 1] - u[end // 2]) / (t[end - 1] - t[end // 2])
    return _summarize(ramps, value, misfit, held, blur)


def _in_direction(ramps: Ramps) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Yield each ramp's time t (T,) s, motion x (T,) rad and command u (T,) Nm, positive in the ramp's direction."""
    r = ramps.recording
    for rows, j, sign in zip(r.stretches, ramps.joint, ramps.sign, strict=True):
        yield r.t[rows] - r.t[rows.start], sign * (r.q[rows, j] - r.q[rows.start, j]), sign * r.tau[rows, j]


def _summarize(
    ramps: Ramps, value: np.ndarray, misfit: np.ndarray, held_by: np.ndarray, blur: np.ndarray
) -> Breakaway:
    """Summarize the fits to K ramps for each joint and direction."""
    n = ramps.recording.n_joints
    command, spread, held, resolution = (np.full((n, 2), x) for x in (np.nan, np.nan, 0.0, 0.0))
    count, ramped = np.zeros((n, 2), dtype=np.int64), np.zeros((n, 2), dtype=np.int64)
    for j in range(n):
        for side, sign in enumerate((-1, 1)):
            own = (ramps.joint == j) & (ramps.sign == sign)
            released = own & ~np.isnan(value)
            values = value[released]
            count[j, side], ramped[j, side] = len(values), own.sum()
            if len(values):
                resolution[j, side] = np.sqrt((blur[released] ** 2).mean())
            elif own.any():
                held[j, side] = sign * held_by[own].max()
            command[j, side] = values.mean() if len(values) else np.nan
            spread[j, side] = values.std(ddof=1) if len(values) > 1 else np.nan
    cells = command, spread, count, ramped, held, resolution
    return Breakaway(*cells, value, misfit, ramps.joint, ramps.sign, ramps.pose)


def _delayed(t: np.ndarray, u: np.ndarray, delay: float, lag: float) -> np.ndarray:
    """Return the command u (T,) Nm after delay and lag, at times t (T,) s; before t[0], the command is u[0]."""
    late = np.interp(t - delay, t, u)
    if lag == 0:
        return late
    factor = -np.expm1(-np.diff(t) / lag)
    out = late.copy()
    for k in range(len(factor)):
        # response of a first-order lag to a linear segment; in the steady state, the output is `lag` s late
        slope = (late[k + 1] - late[k]) / (t[k + 1] - t[k])
        out[k + 1] = out[k] + factor[k] * (late[k] - out[k] - lag * slope) + (late[k + 1] - late[k])
    return out


def _fit_breakaway(t: np.ndarray, x: np.ndarray, u: np.ndarray) -> tuple[float, float]:
    """Fit motion x (T,) rad to command u (T,) Nm; return breakaway command, Nm, and misfit, rad.

    The returned command is NaN if the fitted breakaway command is close to the first command, u[0].
    """
    far, span = x[-1], u[-1] - u[0]
    if span <= 0:
        return np.nan, np.nan
    near, used = _parts(x)
    guess = 1.5 * (t[-1] - t[near])  # time since breakaway, for quadratic motion
    low, high = np.array([u[0] + 1e-3 * span, *LOW]), np.array([u[-1], *HIGH])

    def residuals(p: np.ndarray) -> np.ndarray:
        U, jump, rest, drift = p[:, [0, 4, 5, 6]].T
        kappa, creep, damping = np.exp(p[:, 1:4].T)
        motion = rest[:, None] + drift[:, None] * t + _slides(t, u, U, kappa, creep, damping, jump, 0.0)
        priors = (p[:, 3] - DAMPING[0]) / DAMPING[1], drift / DRIFT
        return np.column_stack([(motion - x)[:, used] / ENCODER, *priors])

    fits = []
    for creep, share in STARTS:
        since = share * guess
        U = max(np.interp(t[-1] - since, t, u), u[0] + 0.02 * span)
        kappa = 3 * far / (max(u[-1] - U, 1e-3 * span) * since**2)
        jump, rest = far / since**2, np.median(x[near // 4 : near + 1])
        first = np.array([U, np.log(kappa), np.log(creep), DAMPING[0], jump, rest, 0.0])
        first = np.clip(first, low + 1e-6 * (high - low), high - 1e-6 * (high - low))
        scale = np.array([0.02 * span, 0.3, 0.3, 0.5, 0.2 * jump, ENCODER, DRIFT])
        fits.append(_solve(residuals, first, low, high, scale))
    best = min(fits, key=lambda fit: fit.cost)
    misfit = ENCODER * float(np.sqrt(np.mean(best.fun[:-2] ** 2)))
    return (float(best.x[0]) if best.x[0] > u[0] + 5e-3 * span else np.nan), misfit


def _fit_slide(
    t: np.ndarray, x: np.ndarray, u: np.ndarray, kappa: float, level: float, viscous: float, fall: float
) -> tuple[float, float]:
    """Return breakaway command, Nm, and misfit, rad, from motion x (T,) rad, commands u (T,) Nm and known `Slide`."""
    span = u[-1] - u[0]
    if span <= 0:
        return np.nan, np.nan
    near, used = _parts(x)

    def residuals(p: np.ndarray) -> np.ndarray:
        U, change, rest, drift = p.T
        k = kappa * np.exp(change)
        jump = k * np.maximum(U - level, 0.0)
        motion = rest[:, None] + drift[:, None] * t + _slides(t, u, U, k, 0 * k + RIGID, k * viscous, jump, fall)
        return np.column_stack([(motion - x)[:, used] / ENCODER, change / KAPPA_SIGMA, drift / DRIFT])

    fits = []
    low, high = np.array([u[0], -1.0, *LOW[-2:]]), np.array([u[-1], 1.0, *HIGH[-2:]])
    for back in BACK:
        first = np.array([u[-1] - (back + 1e-3) * span, 0.0, np.median(x[near // 4 : near + 1]), 0.0])
        fits.append(_solve(residuals, first, low, high, np.array([0.02 * span, 0.5 * KAPPA_SIGMA, ENCODER, DRIFT])))
    best = min(fits, key=lambda fit: fit.cost)
    return float(best.x[0]), ENCODER * float(np.sqrt(np.mean(best.fun[:-2] ** 2)))


def _solve(
    residuals: Callable[[np.ndarray], np.ndarray],
    first: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    scale: np.ndarray,
) -> Any:
    """Minimize `residuals`, a function (C, P) -> (C, R); one call computes all finite differences."""

    def at(p: np.ndarray) -> np.ndarray:
        return residuals(p[None])[0]

    def jacobian(p: np.ndarray) -> np.ndarray:
        h = np.where(p + DIFFERENCE * scale > high, -DIFFERENCE, DIFFERENCE) * scale
        r = residuals(np.concatenate([p[None], p + np.diag(h)]))
        return ((r[1:] - r[0]) / h[:, None]).T

    how: dict[str, Any] = {"bounds": (low, high), "x_scale": scale, "max_nfev": 40}
    return least_squares(at, first, jac=jacobian, **how)


def _parts(x: np.ndarray) -> tuple[int, slice]:
    """Return the index of the last row before clear motion in x (T,) rad, and the slice of rows to fit."""
    near = int(np.flatnonzero(x < x[-1] / 9)[-1])
    return near, slice(near // 4, None)  # in the first rows the joint may still settle


@njit(cache=True)
def _slides(t, u, U, kappa, z, damping, jump, fall):
    """Return the positions (C, T) of `_slide` for C values of each parameter (C,) and one value of `fall`."""
    out = np.empty((len(U), len(t)))
    for c in range(len(U)):
        out[c] = _slide(t, u, U[c], kappa[c], z[c], damping[c], jump[c], fall)
    return out


@njit(cache=True)
def _slide(t, u, U, kappa, z, damping, jump, fall):
    """Integrate the module docstring's equation; return the joint's positions x (T,) rad at t (T,) s.

    If `fall` is 0, friction falls at once at breakaway. The integration is implicit in velocity, and therefore stable
    even for creep lengths far below the encoder noise.
    """
    x = np.zeros(len(t))
    v = 0.0
    for k in range(len(t) - 1):
        parts = int(np.ceil((t[k + 1] - t[k]) / STEP - 1e-6))
        h, rise = (t[k + 1] - t[k]) / parts, (u[k + 1] - u[k]) / parts
        at = x[k]
        for i in range(parts):
            before = u[k] + i * rise
            after = before + rise
            # share of the step with u > U
            beyond = min(max((max(before, after) - U) / max(abs(rise), 1e-12), 0.0), 1.0)
            push = v + h * kappa * (0.5 * (before + after) - U)
            drop = h * jump * beyond
            hold = h * kappa * (U - u[0])
            w = v
            for _ in range(60):
                e = hold * np.exp(-max(at + 0.5 * h * (v + w), 0.0) / z)
                left, steeper = 0.0, 0.0  # remaining share of friction's decrease, and the slope of the decrease
                if fall > 0.0:
                    ratio = 0.5 * (v + w) / fall
                    left = np.exp(-ratio * ratio)
                    steeper = min(drop * left * ratio / fall, 0.5)
                off = w * (1.0 + h * damping) - push - e - drop * (1.0 - left)
                change = off / (1.0 + h * damping + e * 0.5 * h / z - steeper)
                w -= change
                if abs(change) < 1e-10:
                    break
            at += 0.5 * h * (v + w)
            v = w
        x[k + 1] = at
    return x
