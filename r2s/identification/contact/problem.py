"""Set up the torque residual of an arm in contact with an unknown surface, given the posterior of the arm."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from r2s.identification.arm_uncertainty import arm_directions
from r2s.identification.contact.surface_space import SURFACE, SurfaceSpace
from r2s.identification.contact.tip import TipMotion
from r2s.identification.parameters import ParameterSpace
from r2s.identification.residuals.modulating_functions import CUTOFF_HZ, RATE_HZ, SlidingMotion
from r2s.identification.residuals.torque_residual import TorqueResidual
from r2s.identification.search.levenberg_marquardt import minimize
from r2s.physics.inverse_dynamics import InverseDynamics
from r2s.physics.robot import SIM_DT
from r2s.recordings.recording import Recording

SLOWEST = 0.01  # rad/s, slowest sliding; slower joints may stick and slip, which increases the residual
DRIFT = 0.02  # standard deviation of friction and offset drift since calibration, relative to a joint's friction
EXACT = 1e-4  # least sigma of a row, relative to the joint's friction; effective for noise-free simulations
# a model error of the arm is dropped if the norm of its effect on all rows, in standard deviations, is at most this
SEEN = 0.03
FTOL = 1e-6  # a search ends when a step reduces the cost by less than this share
STEP = 1e-5  # finite-difference step on the unit cube
REACH = 10.0  # half-width of the unit cube along w, in standard deviations of w
PLAY = 3.0  # `TipMotion.play`, in standard deviations of the tip's position due to encoder noise below 40 Hz


@dataclass(frozen=True, eq=False)
class ContactProblem:
    """Least-squares problem for u (U,), which describes surface and gears, and the arm's model errors w (r,).

    Each of the residual's R rows is a mean over a window in which a joint slides in one direction (see
    `TorqueResidual`). Resting joints have no rows, because their friction may have any value between the breakaway
    torques. Because the residual is linear in the model errors w ~ N(0, I), a closed form eliminates w (variable
    projection: Golub and Pereyra, SIAM J. Numer. Anal. 10, 1973).

    Encoders on the motors do not measure the gears' deflection due to gravity (`sag`) and contact. In contact, gears
    and surface are springs in series. Presses with different lever arms distinguish the stiffness of the gears from
    that of the surface.

    Attributes:
        torque: torque residual without contact. x: (P,) the arm's parameters. tip: tip motion at F instants.
        error: (T, n) Nm, residual torque of the arm with the parameters x, before subtraction of the contact torque.
        directions: (T, n, r) Nm, derivative of the residual torque with respect to w.
        sigma: (T, n) Nm, standard deviation of each residual torque; the fit treats residual torques as independent.
        space: the space of the vectors u.
        sag: (F, n, 3) m per rad/Nm; gravity moves the tip by -sum_j c[j] sag[:, j] for compliances c (n,) rad/Nm.
    """

    torque: TorqueResidual
    x: np.ndarray
    tip: TipMotion
    error: np.ndarray
    directions: np.ndarray
    sigma: np.ndarray
    space: SurfaceSpace
    sag: np.ndarray

    @property
    def motion(self) -> SlidingMotion:
        """The arm's motion in the recording, with the windows in which joints slide."""
        assert isinstance(self.torque.motion, SlidingMotion)
        return self.torque.motion

    @property
    def rows(self) -> np.ndarray:
        """(T, n) bool, whether the residual has a row for this window and joint."""
        return self.torque.seen

    @property
    def clusters(self) -> np.ndarray:
        """(R,) block number of each row; errors in different blocks are treated as independent."""
        return np.unique(self.torque.clusters[self.rows.ravel()], return_inverse=True)[1]

    def contact(self, u: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return joint torque (F, n) Nm, normal force (F,) N, depth (F,) m, depth rate (F,) m/s at vector u (U,)."""
        tip = self.tip
        if len(u) > SURFACE:
            soft = self.space.compliance(u)
            tip = replace(tip, centre=tip.centre - np.einsum("fjk,j->fk", self.sag, soft), compliance=soft)
        return tip.contact_of(*self.space.plane(u), self.space.law(u))

    def contact_torque(self, u: np.ndarray) -> np.ndarray:
        """Return the joint torque (T, n) Nm of contact for the surface vector u (U,), averaged over each window."""
        return self.motion.filtered(self.contact(u)[0])

    def data(self, u: np.ndarray) -> np.ndarray:
        """Return the residual (R,), in standard deviations, for the surface vector u (U,) and model errors w = 0."""
        return ((self.error - self.contact_torque(u)) / self.sigma)[self.rows]

    def slope(self, u: np.ndarray) -> np.ndarray:
        """Return the derivative (R, U) of `data` with respect to the surface vector u (U,)."""
        h, here = np.where(u > 0.5, -STEP, STEP), self.data(u)
        return np.stack([(self.data(stepped) - here) / s for stepped, s in zip(u + np.diag(h), h, strict=True)], 1)

    @cached_property
    def arm(self) -> np.ndarray:
        """Derivative (R, r) of the scaled residual with respect to the arm's model errors w."""
        return (self.directions / self.sigma[..., None])[self.rows]

    @cached_property
    def _gain(self) -> np.ndarray:
        return -np.linalg.solve(self.arm.T @ self.arm + np.eye(self.arm.shape[1]), self.arm.T)

    def best_arm(self, u: np.ndarray) -> np.ndarray:
        """Return the arm's model errors w (r,) that minimize the cost for a given surface vector u (U,)."""
        return self._gain @ self.data(u)

    def _projected(self, rows: np.ndarray) -> np.ndarray:
        w = self._gain @ rows
        return np.concatenate([rows + self.arm @ w, w])

    def residual(self, trials: np.ndarray) -> np.ndarray:
        """Return residuals (C, R + r + U) of vectors u (C, U): data rows at `best_arm(u)`, then priors of w and u."""
        center, weight = self.space.prior(trials.shape[1])
        return np.stack([np.concatenate([self._projected(self.data(u)), weight * (u - center)]) for u in trials])

    def jacobian(self, u: np.ndarray) -> np.ndarray:
        """Return the derivative (R + r + U, U) of `residual` at u (U,)."""
        return np.concatenate([self._projected(self.slope(u)), np.diag(self.space.prior(len(u))[1])])

    def minimized(self, u: np.ndarray, steps: int) -> tuple[np.ndarray, float]:
        """Return the u (U,) of a local minimum near the given u, and the sum of squares at this minimum."""
        u = minimize(self.residual, lambda u: [(self.residual(u[None])[0], self.jacobian(u))], u, steps, FTOL)
        return u, float((self.residual(u[None]) ** 2).sum())

    def reweighted(self, u: np.ndarray) -> "ContactProblem":
        """Return the problem with new row weights, from the size and correlation of the residual at u (U,)."""
        explained = self.contact_torque(u) - self.directions @ self.best_arm(u)
        own = self.torque.with_external(explained).reweighted(self.x, fitted=True)
        return replace(self, sigma=_sigma(own, self.x))

    def within(self, kept: np.ndarray) -> "ContactProblem":
        """Return the problem restricted to the moments at which `kept` (T,) is true."""
        return replace(self, torque=self.torque.within(kept))

    def whole(self, u: np.ndarray) -> np.ndarray:
        """Return one vector (U + r,) on the unit cube: u (U,), then the model errors w (r,) from `best_arm`."""
        return np.concatenate([u, 0.5 + self.best_arm(u) / (2 * REACH)])

    def linearize(self, whole: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return a list of one pair: the residual (R + U + r,) and its derivative at the vector `whole` (U + r,)."""
        count = len(whole) - self.arm.shape[1]
        u, w = whole[:count], (whole[count:] - 0.5) * 2 * REACH
        center, weight = self.space.prior(count)
        r = np.concatenate([self.data(u) + self.arm @ w, weight * (u - center), w])
        prior = np.diag(np.concatenate([weight, np.full(len(w), 2 * REACH)]))
        return [(r, np.concatenate([np.concatenate([self.slope(u), 2 * REACH * self.arm], 1), prior]))]


def contact_problem(
    space: ParameterSpace, x: np.ndarray, samples: np.ndarray | None, recording: Recording, surfaces: SurfaceSpace
) -> ContactProblem:
    """Return the least-squares problem for a recording with contact.

    Args:
        space: parameter space of an arm with a tool. x: (P,), values of the arm's parameters.
        samples: (S, P), posterior draws of x; if None, the arm's only uncertainty is the drift DRIFT.
        recording: recording with commanded torque. surfaces: the space of the unknown surface.
    """
    torque = TorqueResidual(space, recording, slowest=SLOWEST)
    motion = torque.motion
    assert isinstance(motion, SlidingMotion)
    tip = TipMotion.of(space.robot, motion.q, motion.dq, 1 / RATE_HZ, motion.starts, 0.0)
    lever = np.linalg.norm(np.cross(tip.axes, tip.centre[:, None] - tip.origins), axis=-1).max(0)
    noise = np.sqrt(2 * CUTOFF_HZ * SIM_DT) * np.linalg.norm(lever * motion.encoder)
    tip = replace(tip, play=PLAY * float(noise))
    own = torque.reweighted(x, fitted=True)
    directions = arm_directions(own, x, samples, DRIFT, DRIFT * space.dynamics(x).level)
    effect = np.linalg.norm((directions / own.scale[..., None])[own.seen], axis=0)
    d = space.dynamics(x)
    gravity = InverseDynamics(space.robot, d).gravity(motion.q)
    sag = np.cross(tip.axes, tip.centre[:, None] - tip.origins) * gravity[..., None]
    return ContactProblem(own, x, tip, own.error(d), directions[..., effect > SEEN], _sigma(own, x), surfaces, sag)


def _sigma(torque: TorqueResidual, x: np.ndarray) -> np.ndarray:
    """Return the standard deviation (T, n) Nm of each residual, at least EXACT times the joint's friction."""
    return np.maximum(torque.scale, EXACT * torque.space.dynamics(x).level)
