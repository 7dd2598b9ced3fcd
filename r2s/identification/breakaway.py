"""The torque at which a joint lets go, from recorded ramps: the paper's Table II.

A ramp raises the command of one joint until the joint has clearly moved (r2s/arm/ramp.py runs them on an arm; any
recording of that kind will do). By the time motion is beyond doubt the joint has been accelerating for 10 to 150 ms,
in which the command rose on; and before it lets go a real joint creeps: its bristles bend, ever faster, by
millirads. Neither a threshold nor a parabola through the first motion tells creep from release. So the motion of
one joint that does both is fitted to the positions, and the release is one of its parameters:

    d2x/dt2 = kappa (u - U + (U - u0) exp(-x / z)) + [u > U] jump - lambda dx/dt,    x = 0 and u = u0 at first

u is the command felt in the ramp's direction and kappa one over the inertia. Stiction balances u up to U while it is
stretched over the creep length z (the loading curve of Dahl, J. Dyn. Sys. Meas. Control 98(4), 1976). What drags
after release is less than U (Stribeck; the dead zone of eq. 6 nullifies it altogether, and has z = 0): `jump` is that
difference as an acceleration. Thus creep, however far it goes, is motion that stiction still balances, and breakaway
is the command from which it no longer can. No model of the arm is needed.

Where friction falls over a range of velocities (Stribeck), motion begins so slowly that `jump`, which is sudden,
reads the release late: by 4 to 22 mNm on an arm of known truth. Once an arm is identified, `Slide` says how its
joints move from release on, with jump (1 - exp(-(v / fall)^2)) in place of `jump`, and U alone is left to find: to
0.2 mNm there. It counts where it explains the motion as well as the free fit does.
"""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from r2s.compiled import njit
from r2s.errors import UserError
from r2s.recordings.ramps import Ramps

MOVED = 5e-3  # rad; real joints and the twin creep by 1 to 3 mrad before they let go
MIN_ROWS = 10  # up to there
ENCODER = 2e-5  # rad, what positions are good for: the scale of residuals
RELEASE_S = 2e-3  # s, to which the moment of release is known
STEP = 1e-3  # s, the longest step of the fitted motion
# bounds of log kappa, log z (rad), log lambda (1/s), jump (rad/s^2), and of rest (rad) and drift (rad/s) beside it
LOW = np.log(1e-2), np.log(2e-6), np.log(0.1), 0.0, -0.1, -0.1
HIGH = np.log(1e4), np.log(3e-3), np.log(1e3), 1e3, 0.1, 0.1
RIGID = 1e-8  # rad, a creep length that is none
DRIFT = 3e-4  # rad/s: a joint at rest may still settle so fast
SIDES = "negative", "positive"
SURE = 0.1  # of log kappa, where it is of an identified arm
WORSE = 1.01  # times what a free fit leaves: a slide that leaves more is not this joint's
BACK = 0.0, 0.03, 0.1  # below the last command, in terms of its rise: where a search for U starts
DAMPING = np.log(10.0), 1.5  # log lambda and its spread: a weak prior, where the motion is too short to tell
STARTS = ((1e-5, 0.3), (4e-4, 0.3), (4e-4, 1.0))  # creep length, rad; time since release, in terms of the guess


@dataclass(frozen=True, eq=False)
class Breakaway:
    """Commands at which n joints let go in K ramps; without gravity, as commanded.

    Attributes:
        command: (n, 2) Nm, negative and positive direction, the mean over ramps; NaN where none got there. Plus the
            offset these are the dead zone's edges: ramps alone tell its width, not where its middle lies.
        spread: (n, 2) Nm, standard deviation over ramps: repeatability. NaN for fewer than two.
        count: (n, 2) ramps that got there. ramped: (n, 2) ramps in all.
        tried: (n, 2) Nm, where none got there the command that the joint was held against; 0 where none was ramped.
        resolution: (n, 2) Nm, what the fit of one ramp is good for: `RELEASE_S` times its rate.
        value: (K,) Nm, of each ramp; NaN where its joint did not let go.
        misfit: (K,) rad RMS between positions and the fitted motion; much more than the encoder's noise (or, where
            stick-slip is real, than some 5e-5) says that the motion was another.
        joint, sign, pose: (K,) as in `Ramps`.
    """

    command: np.ndarray
    spread: np.ndarray
    count: np.ndarray
    ramped: np.ndarray
    tried: np.ndarray
    resolution: np.ndarray
    value: np.ndarray
    misfit: np.ndarray
    joint: np.ndarray
    sign: np.ndarray
    pose: np.ndarray

    @property
    def not_reached(self) -> list[str]:
        """The ramps whose joint did not let go, as "joint 3, positive, pose 1" (counted from 1)."""
        return [
            f"joint {self.joint[k] + 1}, {SIDES[int(self.sign[k] > 0)]}, pose {self.pose[k] + 1}"
            for k in np.flatnonzero(np.isnan(self.value))
        ]

    @property
    def open(self) -> dict[str, str]:
        """Return in words why an edge is not known: {"joint 3, positive": "not reached: held against 2.4 Nm"}."""
        words = {}
        for j, side in np.argwhere(self.count == 0):
            tried = abs(self.tried[j, side])
            held = f"held against {tried:.3g} Nm" if tried else "no ramp tells"
            words[f"joint {j + 1}, {SIDES[side]}"] = f"not reached: {held}" if self.ramped[j, side] else "not ramped"
        return words


@dataclass(frozen=True, eq=False)
class Slide:
    """How the joints of K ramps slide once they have let go, in each ramp's direction, by an identified model.

    Attributes:
        kappa: (K,) rad/s^2 per Nm, one over the inertia, the other joints at rest.
        level: (K,) Nm, the command that balances a slow slide above `fall`: Coulomb's level, without what else pulls.
        viscous: (K,) Nm s/rad.
        fall: (K,) rad/s, over which friction falls from breakaway to `level` as exp(-(v / fall)^2).
        misfit: (K,) rad RMS, what a fit that knows nothing of this leaves.
    """

    kappa: np.ndarray
    level: np.ndarray
    viscous: np.ndarray
    fall: np.ndarray
    misfit: np.ndarray


def breakaway(
    ramps: Ramps, *, delay: float = 0.0, lag: float = 0.0, moved: float = MOVED, slide: Slide | None = None
) -> Breakaway:
    """Estimate the command at which each ramped joint let go, from t, q and tau alone.

    Of each ramp the rows count up to where the joint is `moved` away from its first position; what follows (a
    stop, the way back) does not matter. A ramp that does not get there in its own direction, or whose joint went
    before the command rose, gives NaN and is listed as `not_reached`; the others are unaffected.

    Args:
        ramps: the command rises (or, for sign -1, falls) from where the joint rests, at any rate; the rate times
            0.5 to 3 ms is the error to expect from an encoder of 2e-5 rad, the most where the inertia is largest.
        delay: s, from a command to its torque. lag: s, of the first-order lag after it: both shift the result.
        moved: rad, well beyond creep; the ramps must go at least as far.
        slide: how these joints slide, where that is identified.

    Raises:
        UserError: a delay, lag or distance out of range.
    """
    for name, seconds in (("delay", delay), ("lag", lag)):
        if not 0 <= seconds < 0.1:
            raise UserError(f"breakaway: {name}={seconds} must be at least 0 and less than 0.1 s")
    if not 10 * ENCODER <= moved < 0.1:
        raise UserError(f"breakaway: moved={moved} must be at least {10 * ENCODER:g} and less than 0.1 rad")
    r, stretches = ramps.recording, ramps.recording.stretches
    value, misfit = (np.full(len(stretches), np.nan) for _ in range(2))
    most, blur = np.zeros(len(stretches)), np.zeros(len(stretches))
    for k, (rows, j, sign) in enumerate(zip(stretches, ramps.joint, ramps.sign, strict=True)):
        t, x, u = r.t[rows] - r.t[rows.start], sign * (r.q[rows, j] - r.q[rows.start, j]), sign * r.tau[rows, j]
        end = int(np.argmax(np.abs(x) >= moved)) + 1
        if np.abs(x).max() < moved:
            most[k] = max(_delayed(t, u, delay, lag).max(), 0.0)
        if x[end - 1] < moved or end < MIN_ROWS:
            continue
        seen = t[:end], x[:end], _delayed(t, u, delay, lag)[:end]
        if slide is not None and not np.isnan(slide.kappa[k]):
            known = slide.kappa[k], slide.level[k], slide.viscous[k], slide.fall[k]
            value[k], misfit[k] = _release_of(*seen, *known)
        if np.isnan(value[k]) or (slide is not None and misfit[k] > WORSE * slide.misfit[k]):
            value[k], misfit[k] = _release(*seen)
        value[k] *= sign
        blur[k] = RELEASE_S * (u[end - 1] - u[end // 2]) / (t[end - 1] - t[end // 2])
    shape = r.n_joints, 2
    command, spread, tried, resolution = (np.full(shape, x) for x in (np.nan, np.nan, 0.0, 0.0))
    count, ramped = np.zeros(shape, dtype=np.int64), np.zeros(shape, dtype=np.int64)
    for j in range(r.n_joints):
        for side, sign in enumerate((-1, 1)):
            own = (ramps.joint == j) & (ramps.sign == sign)
            there = own & ~np.isnan(value)
            told = value[there]
            count[j, side], ramped[j, side] = len(told), own.sum()
            if len(told):
                resolution[j, side] = np.sqrt((blur[there] ** 2).mean())
            elif own.any():
                tried[j, side] = sign * most[own].max()
            command[j, side] = told.mean() if len(told) else np.nan
            spread[j, side] = told.std(ddof=1) if len(told) > 1 else np.nan
    cells = command, spread, count, ramped, tried, resolution
    return Breakaway(*cells, value, misfit, ramps.joint, ramps.sign, ramps.pose)


def _delayed(t: np.ndarray, u: np.ndarray, delay: float, lag: float) -> np.ndarray:
    """Return what arrives of the command u (T,) Nm at t (T,) s, after rest under its first value."""
    late = np.interp(t - delay, t, u)
    if lag == 0:
        return late
    factor = -np.expm1(-np.diff(t) / lag)
    out = late.copy()
    for k in range(len(factor)):
        # a ramp behind a lag is the ramp `lag` later: no sample is held while the next one arrives
        slope = (late[k + 1] - late[k]) / (t[k + 1] - t[k])
        out[k + 1] = out[k] + factor[k] * (late[k] - out[k] - lag * slope) + (late[k + 1] - late[k])
    return out


def _release(t: np.ndarray, x: np.ndarray, u: np.ndarray) -> tuple[float, float]:
    """Fit the motion to x (T,) rad under u (T,) Nm; return its U, Nm (NaN: below any command), and misfit, rad."""
    far, span = x[-1], u[-1] - u[0]
    if span <= 0:
        return np.nan, np.nan
    near, used = _parts(x)
    guess = 1.5 * (t[-1] - t[near])  # since release, if x grew as its square
    low, high = np.array([u[0] + 1e-3 * span, *LOW]), np.array([u[-1], *HIGH])

    def residuals(p: np.ndarray) -> np.ndarray:
        motion = p[5] + p[6] * t + _slide(t, u, p[0], np.exp(p[1]), np.exp(p[2]), np.exp(p[3]), p[4], 0.0)
        priors = (p[3] - DAMPING[0]) / DAMPING[1], p[6] / DRIFT
        return np.concatenate([(motion - x)[used] / ENCODER, priors])

    fits = []
    for creep, share in STARTS:
        since = share * guess
        U = max(np.interp(t[-1] - since, t, u), u[0] + 0.02 * span)
        kappa = 3 * far / (max(u[-1] - U, 1e-3 * span) * since**2)
        jump, rest = far / since**2, np.median(x[near // 4 : near + 1])
        first = np.array([U, np.log(kappa), np.log(creep), DAMPING[0], jump, rest, 0.0])
        first = np.clip(first, low + 1e-6 * (high - low), high - 1e-6 * (high - low))
        scale = np.array([0.02 * span, 0.3, 0.3, 0.5, 0.2 * jump, ENCODER, DRIFT])
        step = [1e-5, 1e-4, 1e-4, 1e-4, 1e-4, 1e-3, 1e-3]
        fits.append(least_squares(residuals, first, bounds=(low, high), x_scale=scale, diff_step=step, max_nfev=40))
    best = min(fits, key=lambda fit: fit.cost)
    misfit = ENCODER * float(np.sqrt(np.mean(best.fun[:-2] ** 2)))
    return (float(best.x[0]) if best.x[0] > u[0] + 5e-3 * span else np.nan), misfit


def _release_of(
    t: np.ndarray, x: np.ndarray, u: np.ndarray, kappa: float, level: float, viscous: float, fall: float
) -> tuple[float, float]:
    """Fit the slide of a `Slide` to x (T,) rad under u (T,) Nm; return its U, Nm, and misfit, rad."""
    span = u[-1] - u[0]
    if span <= 0:
        return np.nan, np.nan
    near, used = _parts(x)

    def residuals(p: np.ndarray) -> np.ndarray:
        k = kappa * np.exp(p[1])
        motion = p[2] + p[3] * t + _slide(t, u, p[0], k, RIGID, k * viscous, k * max(p[0] - level, 0.0), fall)
        return np.concatenate([(motion - x)[used] / ENCODER, [p[1] / SURE, p[3] / DRIFT]])

    fits = []
    low, high = [u[0], -1.0, *LOW[-2:]], [u[-1], 1.0, *HIGH[-2:]]
    for back in BACK:
        first = np.array([u[-1] - (back + 1e-3) * span, 0.0, np.median(x[near // 4 : near + 1]), 0.0])
        scale, step = [0.02 * span, 0.5 * SURE, ENCODER, DRIFT], [1e-5, 1e-4, 1e-3, 1e-3]
        fits.append(least_squares(residuals, first, bounds=(low, high), x_scale=scale, diff_step=step, max_nfev=40))
    best = min(fits, key=lambda fit: fit.cost)
    return float(best.x[0]), ENCODER * float(np.sqrt(np.mean(best.fun[:-2] ** 2)))


def _parts(x: np.ndarray) -> tuple[int, slice]:
    """Return the last row before x (T,) clearly moves, and the rows that are used."""
    near = int(np.flatnonzero(x < x[-1] / 9)[-1])
    return near, slice(near // 4, None)  # at first the arm may still settle from the motion before


@njit(cache=True)
def _slide(t, u, U, kappa, z, damping, jump, fall):
    """Return x (T,) of the motion that this module's docstring describes; u is linear between samples.

    With fall = 0 the jump is sudden.
    Each step solves for the coming velocity, so that creep lengths far below the encoder's noise stay stable.
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
            beyond = min(max((max(before, after) - U) / max(abs(rise), 1e-12), 0.0), 1.0)  # share of the step
            push = v + h * kappa * (0.5 * (before + after) - U)
            drop = h * jump * beyond
            hold = h * kappa * (U - u[0])
            w = v
            for _ in range(60):
                e = hold * np.exp(-max(at + 0.5 * h * (v + w), 0.0) / z)
                left, steeper = 0.0, 0.0  # of the friction that is yet to fall
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
