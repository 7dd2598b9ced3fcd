"""Whether the numbers of a recording can be this arm's: their units, signs and joint order.

Units are not guessed, but judged: dq against the slope of q, and torque against what the nominal arm needs for the
motion. The judgement is coarse on purpose. The nominal arm may be wrong by a factor of 3, carry a load that nobody
told of, have friction of any size and sensors with an offset: all that passes. A factor of 1000, of 57.3 or of -1, or
joints in another order, does not. Something is said only where the recording as it is leaves more than half
unexplained, and with one such mistake mended at most a quarter of that.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from scipy.optimize import linear_sum_assignment, lsq_linear

from r2s.errors import UserError
from r2s.physics.friction import WIDTH_DQ
from r2s.physics.robot import SIM_DT, Robot
from r2s.recordings.recording import Recording

CUTOFF_HZ, RATE_HZ = 5.0, 20.0  # of the motion that torques are compared at
MOST_ROWS, LEAST_ROWS = 400, 15
MOVING = 0.03  # rad/s RMS: a slower joint says nothing of its velocity
STILL = 0.02  # rad from end to end
WRONG, MENDED = 0.5, 0.25  # unexplained shares of a square: of what is refused, and of that when it is mended
HELD = 0.05  # of tau_max RMS: a joint that carries so much is judged even where it stands
INERTIA = 0.3, 4.0  # what the nominal torque may be multiplied by: published tensors, loads, gains of sensors
FRICTION, OFFSET = 0.5, 0.1  # of tau_max, at most
MOST_LEFT = 2.0  # unexplained share of a square that a joint counts with: more says no more
HAS_GRAVITY, NO_GRAVITY = (0.7, 2.0), 0.3  # shares of the nominal gravity with which a torque has it, and has not
CHANGES, CORRELATED, SURE = 0.01, 3.0, 0.15  # of tau_max: a change that tells; its share's error, as errors last
OVER_LIMIT = 3.0  # times tau_max, at most
UNITS = {"tau": {1e3: "mNm", 1e-3: "kNm"}, "dq": {np.degrees(1): "deg/s", 1e3: "mrad/s", np.radians(1): "", 1e-3: ""}}


@dataclass(frozen=True)
class Moments:
    """What torque is compared at: q, dq, ddq, tau (T, n), low-passed both ways; dq and ddq are the slopes of q."""

    q: np.ndarray
    dq: np.ndarray
    ddq: np.ndarray
    tau: np.ndarray


def check_numbers(robot: Robot, recording: Recording) -> None:
    """Raise UserError where dq or tau are in other units, of another sign or another joint order than they should be.

    A recording that is too short or hardly moves is not judged, nor is a joint that hardly moves.
    """
    moved = np.ptp(recording.q, axis=0) > STILL
    if recording.torque != "commanded":
        dead = np.flatnonzero(moved & (np.ptp(recording.tau, axis=0) == 0))
        if len(dead):
            j, value = dead[0], recording.tau[0, dead[0]]
            raise UserError(
                f"the recording: tau of joint {j + 1} is {value:g} Nm in every row, though the joint moves: its "
                "sensor says nothing"
            )
    if any(s.stop - s.start < 2 for s in recording.stretches) or 1 / recording.rate_hz > 0.2:
        return
    grid = recording.resample(SIM_DT)
    smooth = grid.smooth(CUTOFF_HZ)
    dq = smooth.derivative(smooth.q)
    rows = np.concatenate(
        [np.arange(s.start + 100, s.stop - 100, round(1 / (RATE_HZ * SIM_DT))) for s in smooth.stretches]
    )
    if len(rows) < LEAST_ROWS:
        return
    rows = rows[np.linspace(0, len(rows) - 1, min(len(rows), MOST_ROWS)).astype(int)]
    dead = np.flatnonzero(moved & (np.ptp(recording.dq, axis=0) == 0))
    if len(dead):
        raise UserError(
            f"the recording: dq of joint{_listed(dead)} is {recording.dq[0, dead[0]]:g} rad/s in every row, though q "
            "moves; leave dq out of the file, and it is derived"
        )
    _check_velocity(dq[rows], smooth.dq[rows])
    m = Moments(smooth.q[rows], dq[rows], smooth.derivative(dq)[rows], smooth.tau[rows])
    _check_torque(robot, m, recording, moved)


def _check_velocity(slope: np.ndarray, dq: np.ndarray) -> None:
    """Compare the slope of q (T, n) with dq (T, n), both rad/s."""
    size = np.sqrt((slope**2).mean(0))
    seen = np.flatnonzero(size > MOVING)
    if not len(seen):
        return
    s, v = slope[:, seen], dq[:, seen]
    cross = s.T @ v / len(s)  # of joint j's slope and column k
    square = np.maximum((v**2).mean(0), 1e-12)
    left = 1.0 - cross**2 / (size[seen, None] ** 2 * square)  # unexplained by any factor
    own = np.diag(left)
    order = linear_sum_assignment(left)[1]
    off = order != np.arange(len(seen))
    if off.any() and own[off].mean() > WRONG and left[off, order[off]].mean() < MENDED * own[off].mean():
        raise UserError(
            f"the recording: dq and q have their joints in another order: column{_listed(seen[order[off]])} of dq "
            f"{'fit' if off.sum() > 1 else 'fits'} the slope of q of joint{_listed(seen[off])}"
        )
    factor = np.diag(cross) / size[seen] ** 2
    for wrong, what in ((factor < -WRONG, "of the other sign than"), ((factor > 4) | (abs(factor) < 0.25), "")):
        bad = np.flatnonzero(wrong & (own < WRONG))
        if not len(bad):
            continue
        ratio = float(np.median(factor[bad]))
        near = min(UNITS["dq"], key=lambda f: abs(np.log(f / abs(ratio))))
        known = abs(np.log(near / abs(ratio))) < 0.3
        unit = f": {UNITS['dq'][near]}, not rad/s?" if known and UNITS["dq"][near] else ""
        unit = unit or (": q is not in rad, or t not in s?" if known else "")
        what = what or f"{ratio:.{3 if abs(ratio) < 999.5 else 4}g} times"
        raise UserError(f"the recording: dq of joint{_listed(seen[bad])} is {what} the slope of its q{unit}")
    strange = np.flatnonzero((own > WRONG) & (size[seen] > 3 * MOVING))
    if len(strange):
        raise UserError(
            f"the recording: dq of joint{_listed(seen[strange])} does not follow the slope of its q "
            f"({100 * own[strange[0]]:.0f} % is something else)"
        )


def _check_torque(robot: Robot, m: Moments, recording: Recording, moved: np.ndarray) -> None:
    """Compare the torque with what the nominal arm needs for the motion."""
    gravity = recording.torque != "commanded"
    most = np.quantile(np.abs(recording.tau), 0.99, axis=0) / robot.tau_max
    left = _Left(robot, m)
    need = left.needed(gravity)
    held = np.sqrt((need**2).mean(0)) > HELD * robot.tau_max
    seen = left.seen = np.flatnonzero(moved | held)
    if not len(seen):
        return
    own = left.each(need, m.tau)
    said = f"the recording: tau, said to be {recording.torque},"
    mended = []  # (what is left unexplained of all, what mends it)
    if own.mean() > WRONG or most.max() > OVER_LIMIT:
        for factor, unit in UNITS["tau"].items():
            words = f"is {factor:g} times what {robot.name} needs for this motion: {unit}, not Nm?"
            mended.append((left.each(need, m.tau / factor).mean(), words))
    if own.mean() > WRONG:
        words = f"has the other sign in all joints: negated, it fits what {robot.name} needs"
        mended.append((left.each(need, -m.tau).mean(), words))
        mended += _other_orders(robot, m, gravity)
    mended = [x for x in mended if x[0] < MENDED * own.mean()]
    if own.max() > WRONG:
        pairs = left.pairs(need, m.tau)
        order = linear_sum_assignment(pairs)[1]
        off = order != np.arange(len(seen))
        words = (
            f"has its joints in another order than q: column{_listed(seen[order[off]])} of tau "
            f"{'fit' if off.sum() > 1 else 'fits'} joint{_listed(seen[off])}"
        )
        if off.any() and own[off].mean() > WRONG and pairs[off, order[off]].mean() < MENDED * own[off].mean():
            mended.append((pairs[np.arange(len(seen)), order].mean(), words))
        signs = left.each(need, -m.tau)
        flipped = (own > WRONG) & (signs < MENDED * own)
        words = f"has the other sign in joint{_listed(seen[flipped])}: negated, it fits what {robot.name} needs"
        if flipped.any() and not flipped.all():
            mended.append((np.where(flipped, signs, own).mean(), words))
    if mended:
        raise UserError(f"{said} {min(mended)[1]}")
    if most.max() > OVER_LIMIT:
        j = int(most.argmax())
        raise UserError(
            f"{said} reaches {most[j] * robot.tau_max[j]:.4g} Nm in joint {j + 1}, {robot.name} has at most "
            f"{robot.tau_max[j]:g}; is it in Nm, and the right arm?"
        )
    shares = left.gravity()
    if shares is None:
        return
    mean = f"({100 * shares.mean():.0f} % of {robot.name}'s)"
    if gravity and shares.max() < -HAS_GRAVITY[0]:
        raise UserError(f"{said} contains gravity with the other sign {mean}")
    if gravity and np.abs(shares).max() < NO_GRAVITY:
        raise UserError(f"{said} hardly contains gravity {mean}: is it data.torque=commanded?")
    # a load that nobody told of weighs on each joint in another proportion
    if not gravity and shares.min() > HAS_GRAVITY[0] and shares.max() < HAS_GRAVITY[1]:
        raise UserError(f"{said} contains gravity {mean}: is it data.torque=measured?")


def _other_orders(robot: Robot, m: Moments, gravity: bool) -> list[tuple[float, str]]:
    """Return what is left unexplained with all columns turned or reversed, where the limits allow it."""
    every, out = np.arange(robot.n), []
    for order in [*(np.roll(every, k) for k in range(1, robot.n)), every[::-1]]:
        turned = Moments(*(x[:, order] for x in (m.q, m.dq, m.ddq, m.tau)))
        if (turned.q >= robot.q_min).all() and (turned.q <= robot.q_max).all():
            left = _Left(robot, turned)
            columns = " ".join(str(k + 1) for k in order)
            words = f"and the motion fit {robot.name} only with the joints in another order: columns {columns}"
            out.append((left.each(left.needed(gravity), turned.tau).mean(), words))
    return out


class _Left:
    """What of a torque its own joint's motion leaves unexplained, as shares of its square."""

    def __init__(self, robot: Robot, m: Moments):
        self.robot, self.m = robot, m
        self.seen = np.arange(robot.n)

    def needed(self, gravity: bool) -> np.ndarray:
        """Return (T, n) Nm, what the nominal arm needs for the motion, without friction."""
        model = self.robot.model(gravity=gravity)
        model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_LIMIT)
        data, out = mujoco.MjData(model), np.empty_like(self.m.q)
        for k in range(len(out)):
            data.qpos, data.qvel, data.qacc = self.m.q[k], self.m.dq[k], self.m.ddq[k]
            mujoco.mj_inverse(model, data)
            out[k] = data.qfrc_inverse
        return out

    def gravity(self) -> np.ndarray | None:
        """Return which share of the nominal gravity is in tau, of each joint where the motion tells, or None."""
        inertial = self.needed(False)
        weight, shares = self.needed(True) - inertial, []
        for j in self.seen:
            parts = inertial[:, j], np.tanh(self.m.dq[:, j] / WIDTH_DQ), self.m.dq[:, j], np.ones(len(weight))
            rest = np.column_stack(parts)
            a, b = (x - rest @ np.linalg.lstsq(rest, x, rcond=None)[0] for x in (weight[:, j], self.m.tau[:, j]))
            square = max(a @ a, 1e-12)
            share = a @ b / square
            if CORRELATED * np.sqrt(((b - a * share) ** 2).mean() / square) < SURE and (
                square / len(a) > (CHANGES * self.robot.tau_max[j]) ** 2
            ):
                shares.append(share)
        return np.array(shares) if shares else None

    def each(self, need: np.ndarray, tau: np.ndarray) -> np.ndarray:
        """Return (S,) of the joints seen, each by its own."""
        return np.array([self._share(need, j, tau[:, j]) for j in self.seen.tolist()])

    def pairs(self, need: np.ndarray, tau: np.ndarray) -> np.ndarray:
        """Return (S, S): of column k of tau, by what joint j does."""
        return np.array([[self._share(need, j, tau[:, k]) for k in self.seen] for j in self.seen.tolist()])

    def _share(self, need: np.ndarray, j: int, tau: np.ndarray) -> float:
        """Explain tau (T,) Nm by joint j's motion: inertia and gravity, a rotor, Coulomb and viscous friction."""
        most, m = self.robot.tau_max[j], self.m
        slow = [m.ddq[:, j], np.tanh(m.dq[:, j] / WIDTH_DQ), m.dq[:, j]]
        scale = most / np.maximum([np.sqrt((x**2).mean()) for x in slow], 1e-9)
        columns = np.column_stack(
            [need[:, j], *(x * s for x, s in zip(slow, scale, strict=True)), np.full(len(tau), most)]
        )
        low, high = [INERTIA[0], 0.0, 0.0, 0.0, -OFFSET], [INERTIA[1], *[FRICTION] * 3, OFFSET]
        fit = lsq_linear(columns, tau, bounds=(low, high))
        return min(float(2.0 * fit.cost / max((tau**2).sum(), 1e-12)), MOST_LEFT)


def _listed(joints: Sequence[int] | np.ndarray) -> str:
    """Return " 3" or "s 1, 2, 3" for joints from 0."""
    return f"{'s' * (len(joints) > 1)} {', '.join(str(j + 1) for j in joints)}"
