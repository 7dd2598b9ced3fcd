"""Estimate payload, friction and offsets of a working arm, with 95 % intervals.

    estimator = Estimator(arm, noise)
    for each millisecond: estimator(state.q, state.dq, command)
    estimator.now

Most calls take about 15 us; the call that ends a 20 ms span takes 50 us. Reading `now` takes longer. `now` reports a
physically possible payload: its second-moment matrix about the center is positive semi-definite (Wensing, Kim,
Slotine, RA-L 3(1), 2018).
"""

from dataclasses import dataclass

import numpy as np

from r2s.adaptation.arm_model import ArmModel
from r2s.adaptation.kalman import AT_REST, Filter, Noise, pause, update
from r2s.adaptation.momentum import BODY
from r2s.adaptation.momentum_residual import MomentumResidual, ResidualState, update_residual
from r2s.adaptation.payload_jump import JUMP, MEAN, apply_jump
from r2s.adaptation.tuning import FRICTION_CURVE, LEAST_MASS, REPLACED, REST_SPANS, SETTLING_SPANS, THRESHOLD
from r2s.errors import UserError
from r2s.identification.posterior import Z_95
from r2s.physics.robot import SIM_DT


@dataclass(frozen=True)
class Estimate:
    """Estimate of payload, friction and offsets at the time t; fields `_half` are half widths of 95 % intervals."""

    cycle: int  # cycles since the start
    t: float  # s since the start, pauses included
    mass: float  # kg
    mass_half: float
    centre: np.ndarray  # (3,) m in the payload frame; nan if the mass is not significant
    centre_half: np.ndarray
    tensor: np.ndarray  # (3, 3) kg m^2 about the center, of a physical body
    friction: np.ndarray  # (n,), friction / the model's friction
    friction_half: np.ndarray
    offset: np.ndarray  # (n,) Nm, difference from the model's offset
    offset_half: np.ndarray
    rests: bool  # no joint slides
    odds: float  # log odds of a payload change
    changed: bool  # whether a payload change was detected in this span
    beyond: bool = False  # whether mass - mass_half exceeds the largest payload mass that r2s compensates


class Estimator:
    """Estimate one arm's payload, friction and offsets recursively; a new estimate follows every 20 ms.

    Attributes:
        changes: times in s at which the estimator detected payload changes.
        held: whether the estimate is frozen, for example while the arm is in contact.

    Args:
        arm: model of the arm. noise: uncertainty of the model.
    """

    def __init__(self, arm: ArmModel, noise: Noise):
        self._arm, self._noise, self._n = arm, noise, len(arm.level)
        self._least = LEAST_MASS * float(arm.payload_max[0])  # kg
        self.changes: list[float] = []
        self.held = False
        self._filter = Filter.fresh(noise)
        self._cycle, self._paused_s, self._changed = 0, 0.0, False
        self._before = self._payload()
        self._moved = 0  # spans of motion since a rest, up to SETTLING_SPANS
        self._now: Estimate | None = None
        apply_jump(Filter.fresh(noise), noise)  # compile now, while no arm waits
        self.begin()

    def begin(self, pause_s: float = 0.0) -> None:
        """Start a motion from rest with the last estimate; a pause of `pause_s` s before it adds variance."""
        if pause_s:
            pause(self._filter, self._noise, pause_s)
            self._paused_s, self._now = self._paused_s + pause_s, None
        self._state, self._residual = ResidualState.fresh(self._n), MomentumResidual.empty(self._n)

    def __call__(self, q: np.ndarray, dq: np.ndarray, tau: np.ndarray) -> bool:
        """Process q, dq (n,) rad, rad/s and command tau (n,) Nm without gravity; return whether the estimate changed.

        If a value is not finite, the estimator ignores this cycle and calls `begin`.

        Raises:
            UserError: an array does not have one value per joint.
        """
        if q.shape != (self._n,) or dq.shape != (self._n,) or tau.shape != (self._n,):
            raise UserError(f"expected q, dq and tau of {self._n} joints, got {q.shape}, {dq.shape} and {tau.shape}")
        self._cycle += 1
        if not (np.isfinite(q).all() and np.isfinite(dq).all() and np.isfinite(tau).all()):
            self.begin()
            return False
        cycle = np.array(q), np.array(dq), np.array(tau)  # arrays of one type, so that numba compiles once
        if not update_residual(self._arm, self._state, *cycle, self._residual) or self.held:
            return False
        update(self._filter, self._noise, self._residual)
        jumped, replaced = bool(self._filter.log_odds[MEAN] > THRESHOLD), self._replaced_at_rest()
        self._changed, self._now = jumped or replaced, None
        if self._changed:
            self.changes.append(self._t)
            self._moved = SETTLING_SPANS
        if jumped:
            apply_jump(self._filter, self._noise)
        return True

    @property
    def _t(self) -> float:
        return self._cycle * SIM_DT + self._paused_s

    def _payload(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the payload's mass and first moments (4,), and their covariance (4, 4)."""
        return self._filter.x[:JUMP].copy(), self._filter.P[:JUMP, :JUMP].copy()

    def _replaced_at_rest(self) -> bool:
        """Return whether the payload after a rest differs from the payload before that rest.

        At rest the payload's variance grows; the Kalman filter then follows a payload change without detecting a
        jump.
        """
        if self._filter.counts[AT_REST] >= REST_SPANS:
            self._moved = 0
            return False
        if self._moved >= SETTLING_SPANS:
            self._before = self._payload()
            return False
        self._moved += 1
        (x, P), (x_before, P_before) = self._payload(), self._before
        off = x - x_before
        return bool(off @ np.linalg.solve(P + P_before, off) > REPLACED)

    @property
    def now(self) -> Estimate:
        """The estimate at the end of the last 20 ms span; computed on request, because `__call__` must be fast."""
        if self._now is None:
            self._now = self._report(self._changed)
        return self._now

    @property
    def payload(self) -> np.ndarray:
        """Return the payload's inertial parameters (10,) in the payload frame; zeros if the mass is insignificant."""
        x = self._filter.x[:BODY]
        return x.copy() if x[0] > max(Z_95 * np.sqrt(self._filter.P[0, 0]), self._least) else np.zeros(BODY)

    @property
    def internals(self) -> tuple[Filter, ResidualState, MomentumResidual]:
        """Return the Kalman filter, the state of `update_residual` and the last residual, all for reading only."""
        return self._filter, self._state, self._residual

    def _report(self, changed: bool) -> Estimate:
        x, P, n = self._filter.x, self._filter.P, self._n
        half = Z_95 * np.sqrt(np.maximum(np.diag(P), 0.0))
        mass, centre, tensor = nearest_body(x[:BODY])
        of_centre = np.column_stack([-centre, np.eye(3)]) / max(mass, self._least)
        spread = Z_95 * np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", of_centre, P[:4, :4], of_centre), 0.0))
        heavy = mass > max(half[0], self._least)
        return Estimate(
            cycle=self._cycle,
            t=self._t,
            mass=mass,
            mass_half=float(half[0]),
            centre=centre if heavy else np.full(3, np.nan),
            centre_half=spread if heavy else np.full(3, np.nan),
            tensor=tensor,
            friction=1.0 + x[BODY : BODY + n],
            friction_half=np.hypot(half[BODY : BODY + n], Z_95 * FRICTION_CURVE),
            offset=-(x[BODY + n : BODY + 2 * n]),
            offset_half=half[BODY + n : BODY + 2 * n],
            rests=not (self._residual.sliding > 0).any(),
            odds=float(self._filter.log_odds[MEAN]),
            changed=changed,
            beyond=bool(mass - half[0] > self._arm.payload_max[0]),
        )


def nearest_body(x: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Return mass kg, center (3,) m and tensor (3, 3) kg m^2 of the physical body nearest to the parameters x (10,).

    The tensor is about the center. Mass and first moments stay unchanged, because the data determine them well. The
    nearest positive semi-definite matrix replaces the second moment about the center, so that the pseudo-inertia
    [[Sigma, h], [h, m]] is positive semi-definite, too.
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
