"""Check a recording's units, signs, joint order, gravity and clock against the arm's model.

r2s compares dq with the slope of q, the integral of dq with q (r2s/recordings/clock.py), and tau with nominal torque.
The checks accept errors of nominal torque by a factor of 3, undeclared payloads, any friction, and sensor offsets.
The checks refuse signals that are wrong by a factor of 1000, 57.3 or -1, and a wrong joint order or mounting. Most
checks refuse a recording only if correcting one error removes at least three quarters of the misfit.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from r2s.errors import UserError
from r2s.identification.torque_fit import MASS_LEFT, Moments, Unexplained, mounting, other_masses, other_orders
from r2s.physics.robot import SIM_DT, Robot
from r2s.recordings.clock import check_clock
from r2s.recordings.parts import spread
from r2s.recordings.recording import Recording

# low-pass cutoff; rows per second, largest and least number of compared rows
CUTOFF_HZ, RATE_HZ, MAX_ROWS, MIN_ROWS = 5.0, 20.0, 400, 15
EDGE = 100  # ms, removed from both ends of a trajectory, where the filter has transients
# s, longest examined part of a recording: for units; for the clock, in total and per part
JUDGED_S, CLOCK_S, CLOCK_EACH_S = 240.0, 600.0, 60.0
SLOWEST_HZ = 5.0  # sampling rate below which only the clock is judged
MOVING = 0.03  # rad/s RMS, below which the velocity of a joint is not judged
STILL = 0.02  # rad, range of a joint up to which the joint is treated as at rest
# a signal is refused above this unexplained share; a valid correction leaves at most this fraction of the share
REFUSED, CORRECTED = 0.5, 0.25
SUSPECT = 0.3  # misfit above which other joint orders are tested; correct recordings had 0.006 to 0.21
TURNED = 0.05  # misfit above which other mountings are tested; a valid mounting leaves at most MASS_LEFT of it
HELD = 0.05  # a joint whose RMS nominal torque exceeds this share of tau_max is judged even at rest
# tau's gravity torque / nominal gravity torque: range for tau with gravity; largest value for tau without gravity
HAS_GRAVITY, NO_GRAVITY = (0.7, 2.0), 0.3
CURRENT = 0.005  # A/Nm, least current / torque, because no joint of an arm yields 200 Nm/A
OVER_LIMIT = 3.0  # largest allowed torque over tau_max
RATIO = 4.0  # dq is refused if its ratio to the slope of q is above RATIO or below 1 / RATIO
UNITS = {"tau": {1e3: "mNm", 1e-3: "kNm"}, "dq": {np.degrees(1): "deg/s", 1e3: "mrad/s", np.radians(1): "", 1e-3: ""}}
ORDER, UNITS_OF, GRAVITY, CLOCK, MASSES = "order of joints", "units and signs", "gravity", "clock", "masses"


class DataError(UserError):
    """Error for a recording that a check refuses; `check` is the check's name, such as ORDER."""

    def __init__(self, check: str, message: str):
        super().__init__(message)
        self.check = check


@dataclass(frozen=True)
class Judged:
    """Values that `check_units` measures; a value that the motion does not determine is nan or None.

    Attributes:
        clock: (n,) ratio of the change of q to the integral of dq. scale: (n,) ratio of dq to the slope of q.
        misfit: unexplained share of the squared torque. shares: (K,) ratio of tau's gravity torque to nominal gravity
            torque, for K joints.
    """

    clock: np.ndarray
    scale: np.ndarray
    misfit: float | None = None
    shares: np.ndarray | None = None


def check_units(robot: Robot, recording: Recording) -> Judged | None:
    """Check the clock, dq and tau of a recording; return measured values, or None if there are too few rows.

    Raises:
        DataError: dq or tau has a wrong unit, sign or joint order, tau is implausible, or the clock is wrong.
    """
    moved = np.ptp(recording.q, axis=0) > STILL
    dead = np.flatnonzero(moved & (np.ptp(recording.tau, axis=0) == 0))
    if recording.torque != "commanded" and len(dead):
        raise DataError(
            UNITS_OF,
            f"the recording: tau of joint {dead[0] + 1} is {recording.tau[0, dead[0]]:g} Nm in every row, though the "
            "joint moves: is its sensor dead?",
        )
    if any(s.stop - s.start < 2 for s in recording.stretches):
        return None
    if recording.rate_hz < SLOWEST_HZ:
        _check_clock(recording)
        return None
    some = spread(recording, JUDGED_S)
    smooth, step = some.resample(SIM_DT).smooth(CUTOFF_HZ), round(1 / (RATE_HZ * SIM_DT))
    dq = smooth.derivative(smooth.q)
    rows = np.concatenate([np.arange(s.start + EDGE, s.stop - EDGE, step) for s in smooth.stretches])
    if len(rows) < MIN_ROWS:
        _check_clock(recording)
        return None
    rows = rows[np.linspace(0, len(rows) - 1, min(len(rows), MAX_ROWS)).astype(int)]
    dead = np.flatnonzero(moved & (np.ptp(recording.dq, axis=0) == 0))
    if len(dead):
        raise DataError(
            UNITS_OF,
            f"the recording: dq of joint{_listed(dead)} is {recording.dq[0, dead[0]]:g} rad/s in every row, though q "
            "moves; leave dq out of the file to derive it from q",
        )
    scale = _check_velocity(dq[rows], smooth.dq[rows])
    clock = _check_clock(recording)
    m = Moments(smooth.q[rows], dq[rows], smooth.derivative(dq)[rows], smooth.tau[rows])
    return Judged(clock, scale, *_check_torque(robot, m, some, moved))


def _check_clock(recording: Recording) -> np.ndarray:
    try:
        return check_clock(spread(recording, CLOCK_S, CLOCK_EACH_S))
    except UserError as error:
        raise DataError(CLOCK, str(error)) from None


def _check_velocity(slope: np.ndarray, dq: np.ndarray) -> np.ndarray:
    """Check dq (T, n) against the slope of q (T, n), rad/s; return their ratio (n,), nan for joints at rest.

    Raises:
        DataError: unit, sign or order of the joints differ.
    """
    size = np.sqrt((slope**2).mean(0))
    seen, ratios = np.flatnonzero(size > MOVING), np.full(len(size), np.nan)
    if not len(seen):
        return ratios
    s, v = slope[:, seen], dq[:, seen]
    cross = s.T @ v / len(s)  # mean product of joint j's slope and column k of dq
    square = np.maximum((v**2).mean(0), 1e-12)
    left = 1.0 - cross**2 / (size[seen, None] ** 2 * square)  # share of dq's square that no factor explains
    own = np.diag(left)
    if (swap := _swapped(left, own)) is not None:
        fits = _fits(seen, swap, "dq", "the slope of q of ")
        raise DataError(ORDER, f"the recording: dq and q have their joints in another order: {fits}")
    factor = ratios[seen] = np.diag(cross) / size[seen] ** 2
    scaled = (factor > RATIO) | (abs(factor) < 1 / RATIO)
    for wrong, what in ((factor < -REFUSED, "of the other sign than"), (scaled, "")):
        bad = np.flatnonzero(wrong & (own < REFUSED))
        if not len(bad):
            continue
        ratio = float(np.median(factor[bad]))
        near = min(UNITS["dq"], key=lambda f: abs(np.log(f / abs(ratio))))
        known = abs(np.log(near / abs(ratio))) < 0.3
        unit = f": {UNITS['dq'][near]}, not rad/s?" if known and UNITS["dq"][near] else ""
        unit = unit or (": q is not in rad, or t not in s?" if known else "")
        what = what or f"{ratio:.{3 if abs(ratio) < 999.5 else 4}g} times"
        words = f"dq of joint{_listed(seen[bad])} is {what} the slope of its q{unit}"
        raise DataError(UNITS_OF, f"the recording: {words}")
    strange = np.flatnonzero((own > REFUSED) & (size[seen] > 3 * MOVING))
    if len(strange):
        raise DataError(
            UNITS_OF,
            f"the recording: dq of joint{_listed(seen[strange])} does not follow the slope of its q "
            f"({100 * own[strange[0]]:.0f} % of its square is unexplained)",
        )
    return ratios


def _swapped(pairs: np.ndarray, own: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Return joints that other columns fit far better, with the columns, or None. pairs: misfit [joint, column]."""
    order = linear_sum_assignment(pairs)[1]
    off = np.flatnonzero(order != np.arange(len(own)))
    if len(off) and own[off].mean() > REFUSED and pairs[off, order[off]].mean() < CORRECTED * own[off].mean():
        return off, order[off]
    return None


def _check_torque(
    robot: Robot, m: Moments, recording: Recording, moved: np.ndarray
) -> tuple[float | None, np.ndarray | None]:
    """Compare tau with the nominal arm's torque for the same motion; return (`Judged.misfit`, `Judged.shares`)."""
    gravity = recording.torque != "commanded"
    most = np.quantile(np.abs(recording.tau), 0.99, axis=0) / robot.tau_max
    left = Unexplained(robot, m, gravity)
    held = np.sqrt((left.need**2).mean(0)) > HELD * robot.tau_max
    left.seen = np.flatnonzero(moved | held)
    if not len(left.seen):
        return None, None
    own = left.each(m.tau)
    tau = f"the recording: {recording.torque} tau"
    corrections = []  # (remaining share of the misfit, check, description)
    if own.mean() > REFUSED or most.max() > OVER_LIMIT:
        for factor, unit in UNITS["tau"].items():
            words = f"is {factor:g} times what {robot.name} needs for this motion: {unit}, not Nm?"
            corrections.append((left.each(m.tau / factor).mean() / own.mean(), UNITS_OF, words))
    if own.mean() > REFUSED:
        words = f"has the other sign in all joints: negated, it fits what {robot.name} needs"
        corrections.append((left.each(-m.tau).mean() / own.mean(), UNITS_OF, words))
    misfit = left.misfit()
    if misfit > SUSPECT:
        kind = left.with_need(left.inverse_dynamics(not gravity)).misfit()  # with the opposite assumption on gravity
        limit = min(SUSPECT, kind)
        orders = [(after / misfit, ORDER, words) for after, words in other_orders(left, gravity) if after < limit]
        corrections += orders
    if misfit > TURNED and gravity:
        turned = [(after / misfit, GRAVITY, words) for after, words in mounting(left) if after < MASS_LEFT * misfit]
        corrections += turned
    corrections = [x for x in corrections if x[0] < CORRECTED]
    if own.max() > REFUSED:
        corrections += [(after / own.mean(), *rest) for after, *rest in _corrected_joints(left, own)]
    if misfit > SUSPECT and not corrections:
        masses = [(after / misfit, MASSES, words) for after, words in other_masses(left, gravity)]
        corrections = [x for x in masses if x[0] < MASS_LEFT]
    if corrections:
        _, check, words = min(corrections, key=lambda x: (x[0], x[2]))
        raise DataError(check, f"{tau} {words}")
    if most.max() > OVER_LIMIT:
        j = int(most.argmax())
        raise DataError(
            UNITS_OF,
            f"{tau} reaches {most[j] * robot.tau_max[j]:.4g} Nm in joint {j + 1}, {robot.name} has at most "
            f"{robot.tau_max[j]:g}; is it in Nm, and the right arm?",
        )
    shares = left.gravity_shares()
    if shares is None:
        return misfit, None
    mean = f"({100 * shares.mean():.0f} % of {robot.name}'s)"
    if gravity and shares.max() < -HAS_GRAVITY[0]:
        raise DataError(GRAVITY, f"{tau} contains gravity with the other sign {mean}")
    if gravity and np.abs(shares).max() < NO_GRAVITY:
        (factors, rest), other = left.scaled(), left.with_need(left.inverse_dynamics(False)).scaled()[1]
        if rest < min(SUSPECT, other) and np.median(factors) > CURRENT:
            raise DataError(
                UNITS_OF,
                f"{tau} is {np.median(factors):.2g} times what {robot.name} needs: is it a current in A? Then set "
                "data.torque=motor and data.torque_constant=[Nm/A of each joint, gear included]",
            )
        raise DataError(GRAVITY, f"{tau} hardly contains gravity {mean}: is it data.torque=commanded?")
    # an undeclared payload would make shares differ between joints
    if not gravity and shares.min() > HAS_GRAVITY[0] and shares.max() < HAS_GRAVITY[1]:
        raise DataError(GRAVITY, f"{tau} contains gravity {mean}: is it data.torque=measured?")
    return misfit, shares


def _corrected_joints(left: Unexplained, own: np.ndarray) -> list[tuple[float, str, str]]:
    """Return (remaining misfit, check, description) for swapped columns, and for opposite signs in some joints."""
    seen, out, pairs = left.seen, [], left.pairs()
    if (swap := _swapped(pairs, own)) is not None:
        order = np.arange(len(seen))
        order[swap[0]] = swap[1]
        words = f"has its joints in another order than q: {_fits(seen, swap, 'tau', '')}"
        out.append((pairs[np.arange(len(seen)), order].mean(), ORDER, words))
    signs = left.each(-left.m.tau)
    flipped = (own > REFUSED) & (signs < CORRECTED * own)
    if flipped.any() and not flipped.all():
        words = f"has the other sign in joint{_listed(seen[flipped])}: negated, it fits what {left.robot.name} needs"
        out.append((np.where(flipped, signs, own).mean(), UNITS_OF, words))
    return out


def _listed(joints: Sequence[int] | np.ndarray) -> str:
    """Return the text that follows "joint" for joint indices from 0: " 3" or "s 1, 2, 3", counted from 1."""
    return f"{'s' * (len(joints) > 1)} {', '.join(str(j + 1) for j in joints)}"


def _fits(seen: np.ndarray, swap: tuple[np.ndarray, np.ndarray], field: str, what: str) -> str:
    verb = "fit" if len(swap[0]) > 1 else "fits"
    return f"column{_listed(seen[swap[1]])} of {field} {verb} {what}joint{_listed(seen[swap[0]])}"
