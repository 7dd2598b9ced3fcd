"""What an arm carries and how its friction and offsets drift, told while it works, with 95 % intervals.

    estimator = Estimator(robot, dynamics, noise)
    for each millisecond: estimator(state.q, state.dq, command)
    estimator.now

A cycle takes some ten microseconds, every SPAN-th some forty, without what is told of it. The numbers of a payload
are reported as a body that exists: mass, centre, and a second moment about it that is not negative (Wensing, Kim and
Slotine, RA-L 3(1), 2018).
"""

from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from r2s.adaptation.balance import Balance, Kept, observe
from r2s.adaptation.believed import Believed
from r2s.adaptation.kalman import JUMP, RESTS, THRESHOLD, Filter, Noise, T, jump, update
from r2s.adaptation.momentum import BODY
from r2s.errors import UserError
from r2s.physics.robot import SIM_DT

Z = 1.96  # standard deviations of a 95 % interval
LEAST_KG = 0.02  # below that nobody asks where its centre is
AFTER = round(0.5 / T)  # spans of motion after a rest, in which what is carried now and before are compared
# squared distance that two estimates of one thing have once in an hour of tests; twice, as errors of a model last
OTHER = 2.0 * chi2.isf(T / 3600.0, JUMP)
CURVE = 0.02  # of friction: it changes by more than one share says, as its curve over speed is not what was believed


@dataclass(frozen=True)
class Estimate:
    """What is known at one moment; intervals are half widths at 95 %.

    Attributes:
        t: s. mass: kg. mass_half: kg.
        centre, centre_half: (3,) m in the hand's frame; nan where the mass may as well be none.
        tensor: (3, 3) kg m^2 about the centre, of a body that exists.
        friction, friction_half: (n,), of what was believed: 1 is as believed.
        offset, offset_half: (n,) Nm, beyond what was believed.
        rests: whether no joint moves. odds: log odds that the payload has just changed.
        changed: whether that was said at this moment.
    """

    t: float
    mass: float
    mass_half: float
    centre: np.ndarray
    centre_half: np.ndarray
    tensor: np.ndarray
    friction: np.ndarray
    friction_half: np.ndarray
    offset: np.ndarray
    offset_half: np.ndarray
    rests: bool
    odds: float
    changed: bool


class Estimator:
    """The estimate of one arm, cycle by cycle.

    Attributes:
        changes: s, when a payload was put on or taken off.

    Args:
        arm: what is believed of it. noise: how wrong that may be.
    """

    def __init__(self, arm: Believed, noise: Noise):
        self._arm, self._noise, self._n = arm, noise, len(arm.level)
        self.changes: list[float] = []
        self._filter = Filter.fresh(noise)
        self._cycle, self._changed = 0, False
        self._before = self._carried()
        self._moved = 0  # spans since a rest, as far as they count
        self._now: Estimate | None = None
        self.begin()

    def begin(self) -> None:
        """Begin a motion from rest: nothing is under way, what was learnt stays."""
        self._kept, self._balance = Kept.fresh(self._n), Balance.empty(self._n)

    def __call__(self, q: np.ndarray, dq: np.ndarray, tau: np.ndarray) -> bool:
        """Take one cycle's q, dq (n,) rad, rad/s and command (n,) Nm without gravity; return whether `now` is new.

        Raises:
            UserError: they are not of n joints; values that are not finite are passed over.
        """
        if q.shape != (self._n,) or dq.shape != (self._n,) or tau.shape != (self._n,):
            raise UserError(f"an estimate of {self._n} joints was given {q.shape}, {dq.shape} and {tau.shape}")
        self._cycle += 1
        if not (np.isfinite(q).all() and np.isfinite(dq).all() and np.isfinite(tau).all()):
            self.begin()
            return False
        b = self._balance
        if not observe(self._arm, self._kept, q, dq, tau, b):
            return False
        update(self._filter, self._noise, b)
        jumped, other = bool(self._filter.odds[0] > THRESHOLD), self._is_other()
        self._changed, self._now = jumped or other, None
        if self._changed:
            self.changes.append(self._cycle * SIM_DT)
            self._moved = AFTER
        if jumped:
            jump(self._filter, self._noise)
        return True

    def _carried(self) -> tuple[np.ndarray, np.ndarray]:
        """Return mass and first moments of what is carried (4,), and their covariance (4, 4)."""
        return self._filter.x[:JUMP].copy(), self._filter.P[:JUMP, :JUMP].copy()

    def _is_other(self) -> bool:
        """Say whether what is carried after a rest is not what it was before.

        A rest lets the estimate go, as anything may be put on unseen, so that no sudden change has to explain it.
        """
        if self._filter.counts[2] >= RESTS:
            self._moved = 0
            return False
        if self._moved >= AFTER:
            self._before = self._carried()
            return False
        self._moved += 1
        now, before = self._carried(), self._before
        off = now[0] - before[0]
        return bool(off @ np.linalg.solve(now[1] + before[1], off) > OTHER)

    @property
    def now(self) -> Estimate:
        """What is known at the end of the last span; made when it is asked for, as that takes longer than a cycle."""
        if self._now is None:
            self._now = self._told(self._changed)
        return self._now

    @property
    def inside(self) -> tuple[Filter, Kept, Balance]:
        """The filter, what is kept from cycle to cycle, and the last span's balance; not to be written."""
        return self._filter, self._kept, self._balance

    @property
    def innovations(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The last span's innovations (n,) Nm, their variances (n,) Nm^2, and whether each joint slid (n,)."""
        return self._filter.seen[0], self._filter.seen[1], self._balance.slides > 0

    def _told(self, changed: bool) -> Estimate:
        x, P, n = self._filter.x, self._filter.P, self._n
        half = Z * np.sqrt(np.maximum(np.diag(P), 0.0))
        mass, centre, tensor = body(x[:BODY])
        of_centre = np.column_stack([-centre, np.eye(3)]) / max(mass, LEAST_KG)
        spread = Z * np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", of_centre, P[:4, :4], of_centre), 0.0))
        heavy = mass > max(half[0], LEAST_KG)
        return Estimate(
            t=self._cycle * SIM_DT,
            mass=mass,
            mass_half=float(half[0]),
            centre=centre if heavy else np.full(3, np.nan),
            centre_half=spread if heavy else np.full(3, np.nan),
            tensor=tensor,
            friction=1.0 + x[BODY : BODY + n],
            friction_half=np.hypot(half[BODY : BODY + n], Z * CURVE),
            offset=-(x[BODY + n : BODY + 2 * n]),
            offset_half=half[BODY + n : BODY + 2 * n],
            rests=not (self._balance.slides > 0).any(),
            odds=float(self._filter.odds[0]),
            changed=changed,
        )


def body(x: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Return mass kg, centre (3,) m and tensor (3, 3) kg m^2 about it of the nearest body that exists to x (10,).

    Mass and first moments are kept, which the data see well; the second moment about the centre is the nearest that
    is not negative. Its pseudo-inertia [[Sigma, h], [h, m]] is then positive semi-definite.
    """
    m = float(x[0])
    if m <= 0.0:
        return 0.0, np.zeros(3), np.zeros((3, 3))
    c = x[1:4] / m
    xx, yy, zz, xy, xz, yz = x[4:10]
    tensor = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    second = 0.5 * np.trace(tensor) * np.eye(3) - tensor - m * np.outer(c, c)
    moments, axes = np.linalg.eigh(second)
    second = (axes * np.maximum(moments, 0.0)) @ axes.T
    return m, c, np.trace(second) * np.eye(3) - second
