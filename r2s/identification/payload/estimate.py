"""Identify the payload of a loaded arm: mass, center of mass and inertia tensor, with intervals."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from r2s.errors import UserError
from r2s.identification.arm_uncertainty import Arm
from r2s.identification.payload.body import HEAVIEST, BodySpace
from r2s.identification.payload.problem import REACH, LoadedTorque, Rows
from r2s.identification.posterior import posterior
from r2s.identification.result import EDGE, SHARPER
from r2s.physics.payload import Payload
from r2s.physics.rigid_body import tensor_elements
from r2s.recordings.recording import Recording

ROUNDS = 5  # number of fits, each with weights from the residual of the previous one
LEAST_SHARE = 0.02  # least mass of the prior's ball of water, relative to the rated mass
COVERED = 2.5, 97.5  # %, percentiles of a 95 % interval
ELEMENTS = ("xx", "yy", "zz", "xy", "xz", "yz")


@dataclass(frozen=True, eq=False)
class PayloadEstimate:
    """An identified payload, in the end effector's frame.

    Attributes:
        mass: kg. centre: (3,) m, center of mass. tensor: (3, 3) kg m^2 about the center, physically consistent.
        draws: posterior draws {"mass": (S,), "centre": (S, 3), "inertia": (S, 6)}; inertia in the order of ELEMENTS.
        identifiable: {name: bool, or one bool per element}, whether the recording determines the value.
        t: (T,) s, sample times. measured: (T, n) Nm, filtered recorded torque. without, predicted: (T, n) Nm, torque
            of the identified arm without and with payload. seen: (T, n) bool, whether the fit uses this sample of a
            joint's torque.
    """

    mass: float
    centre: np.ndarray
    tensor: np.ndarray
    draws: dict[str, np.ndarray]
    identifiable: dict[str, np.ndarray]
    t: np.ndarray
    measured: np.ndarray
    without: np.ndarray
    predicted: np.ndarray
    seen: np.ndarray

    @property
    def values(self) -> dict[str, np.ndarray]:
        """Estimated mass, center of mass and tensor elements: {"mass": (), "centre": (3,), "inertia": (6,)}."""
        return {"mass": np.array(self.mass), "centre": self.centre, "inertia": tensor_elements(self.tensor)}

    def interval(self, name: str) -> np.ndarray:
        """Return both ends (2, ...) of the 95 % interval of mass, center or inertia."""
        return np.percentile(self.draws[name], COVERED, axis=0)

    @property
    def payload(self) -> Payload:
        """The payload as the `Payload` of a simulated arm."""
        return Payload(np.array(self.mass), self.centre, self.tensor)

    def rmse(self, predicted: np.ndarray) -> np.ndarray:
        """Return the RMSE (n,) Nm between predicted (T, n) and recorded torque; nan for a joint that only rests."""
        square = np.where(self.seen, (predicted - self.measured) ** 2, 0.0).sum(0)
        return np.sqrt(square / np.where(self.seen.any(0), self.seen.sum(0), np.nan))


@dataclass(frozen=True, eq=False)
class _Linearized:
    """Payload problem, linearized for `posterior` at the fitted body z and the errors w of the arm's model."""

    rows: Rows
    space: BodySpace
    z: np.ndarray
    w: np.ndarray

    @property
    def u(self) -> np.ndarray:
        low, high = self.space.bounds
        return np.concatenate([(self.z - low) / (high - low), 0.5 + self.w / (2 * REACH)])

    @property
    def clusters(self) -> np.ndarray:
        return self.rows.clusters

    def linearize(self, u: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
        width, count = np.subtract(*self.space.bounds[::-1]), len(self.w)
        slope = self.space.slope(self.z) * width
        phi = self.space.standard(self.z)
        data = self.rows.error + self.rows.body @ phi + self.rows.arm @ self.w
        prior = np.concatenate([self.space.prior(self.z), self.w])
        jacobian = np.zeros((len(data) + len(prior), len(u)))
        jacobian[: len(data)] = np.concatenate([self.rows.body @ slope, 2 * REACH * self.rows.arm], 1)
        jacobian[len(data) : len(data) + 9, 1:10] = np.diag((width / self.space.sigma)[1:])
        jacobian[len(data) + 9 :, 10:] = 2 * REACH * np.eye(count)
        return [(np.concatenate([data, prior]), jacobian)]


def identify_payload(
    arm: Arm,
    recording: Recording,
    *,
    declared: Payload | None = None,
    cutoff_hz: float = 10.0,
    seed: int = 0,
    report: Callable[[float, str], None] = lambda share, what: None,
) -> PayloadEstimate:
    """Estimate the payload of an arm from a recording of the arm with the payload.

    Args:
        arm: the arm, identified without payload from the recording's kind of torque. Errors of the arm's model widen
            the intervals.
        recording: motion of the arm with the payload.
        declared: payload declared to gravity compensation (only for commanded torque).
        cutoff_hz: cutoff of the low-pass for measured or motor torque. seed: seed of the random posterior draws.
        report: function that is called with the share of finished work and the name of the next task.

    Raises:
        UserError: all joints are too slow, or the estimated payload exceeds HEAVIEST times the rated mass.
    """
    report(0.0, "torque of the loaded arm")
    loaded = LoadedTorque(arm, recording, declared, cutoff_hz)
    if not loaded.torque.seen.any():
        raise UserError("data.loaded: no joint moves fast enough to show its torque")
    rated, far = arm.robot.payload_max
    phi, w, payload, space = np.zeros(10), None, None, BodySpace.about(rated, far, rated)
    for k in range(ROUNDS):
        report((k + 1) / (ROUNDS + 2), "payload")
        rows = loaded.rows(payload, phi, w)
        z = _fit(rows, space)
        phi = space.standard(z)
        w = rows.best_arm(phi)
        space = BodySpace.about(rated, far, max(float(z[0]), LEAST_SHARE * rated))
        payload = Payload(*(np.asarray(x) for x in space.body(z)))
    z = _fit(rows, space)
    return _concluded(loaded, _Linearized(rows, space, z, rows.best_arm(space.standard(z))), seed)


def _fit(rows: Rows, space: BodySpace) -> np.ndarray:
    """Return the body z (10,) that minimizes the sum of squares of data rows and prior residuals."""
    slope, constant = rows.reduced

    def residual(z: np.ndarray) -> np.ndarray:
        return np.concatenate([slope @ space.standard(z) + constant, space.prior(z)])

    def jacobian(z: np.ndarray) -> np.ndarray:
        prior = np.concatenate([np.zeros((9, 1)), np.diag(1.0 / space.sigma[1:])], 1)
        return np.concatenate([slope @ space.slope(z), prior])

    start = np.zeros(10)
    start[0] = 0.5 * space.heaviest
    return least_squares(residual, start, jacobian, space.bounds, xtol=1e-12, ftol=1e-12, x_scale="jac").x


def _concluded(loaded: LoadedTorque, fit: _Linearized, seed: int) -> PayloadEstimate:
    """Return the fitted payload with its posterior draws."""
    rng, (low, high) = np.random.default_rng(seed), fit.space.bounds
    u = fit.u
    if u[0] > 1 - EDGE:
        raise UserError(
            f"data.loaded: the torque wants a payload above {high[0]:g} kg, {HEAVIEST:g} times robot.payload_max="
            f"{fit.space.heaviest:g}; is it of {loaded.arm.robot.name}, and the calibration of the unloaded arm?"
        )
    drawn = np.clip(u + posterior(fit, u, seed).steps, 0.0, 1.0)[:, :10] * (high - low) + low
    mass, centre, tensor = fit.space.body(drawn)
    draws = {"mass": mass, "centre": centre, "inertia": tensor_elements(tensor)}
    # prior draws at the fitted mass; a value is identifiable if its interval is far narrower than their spread
    alone = np.where(
        np.isinf(fit.space.sigma), fit.z, rng.normal(size=drawn.shape) * np.nan_to_num(fit.space.sigma, posinf=0.0)
    )
    wide = {"mass": np.array(fit.space.heaviest / np.sqrt(12)), "centre": np.full(3, fit.space.far)}
    wide["inertia"] = tensor_elements(fit.space.body(alone)[2]).std(0)
    known = {k: 0.5 * np.ptp(np.percentile(x, COVERED, axis=0), axis=0) < wide[k] / SHARPER for k, x in draws.items()}
    m, c, i = fit.space.body(fit.z)
    payload = Payload(np.asarray(m), c, i)
    own = loaded.torque
    x, motion = loaded.arm.x, own.motion
    bare, carrying = (loaded.with_payload(p).errors(x[None])[0] for p in (None, payload))
    carrying = bare + loaded.factor[0] * (carrying - bare)
    measured = own.predict(loaded.arm.space.dynamics(x)) - own.error(loaded.arm.space.dynamics(x))
    torques = measured, measured + bare, measured + carrying
    return PayloadEstimate(float(m), c, i, draws, known, motion.t, *torques, own.seen)
