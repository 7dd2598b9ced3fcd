"""Correct the identified model by a fit to recordings without a payload.

An identification omits model terms that hardly improve the fit. A payload estimate needs these terms, because a
torque error of 0.1 Nm at a lever arm of 0.5 m looks like a mass of 20 g. The correction therefore fits the terms of
every joint (`TERMS`), the mass and first moments of every link, the compliance of every gear, and inertia and latency
that the model lacks. Each parameter has a prior with mean zero and a typical standard deviation, so the fit is a
ridge regression (Bishop 2006, 3.3). The fit uses momentum residuals (momentum_residual.py), which need no
accelerations.

A compliant gear of stiffness K twists by torque / K. A residual that ignores the twist between motor and link has an
error of M d2(torque)/dt2 / K, where M is the mass matrix. For example, on a Panda with K = 15 kNm/rad, a torque that
varies by 4 Nm at 7 Hz causes an error of 0.7 Nm.
"""

from typing import NamedTuple

import numpy as np

from r2s.adaptation import tuning
from r2s.adaptation.arm_model import BACKWARD, FORWARD, SPEED_ONLY, ArmModel
from r2s.adaptation.momentum_residual import MomentumResidual
from r2s.physics.newton_euler import COM, MASS
from r2s.physics.rigid_body import regressor
from r2s.physics.robot import Robot

ROUNDS = 3  # number of fits; an estimate of the residuals' RMS follows each fit
# terms of a joint with speed v of sign s: share of its friction, offset, s |gravity|, s, s sqrt |v|,
# s / (1 + |v| / STRIBECK_SPEED), v, s sin q, s cos q, sin q, cos q
SHARE, OFFSET, LOAD, LAW, ANGLE, CABLE, TERMS = 0, 1, 2, 3, 7, 9, 11


class ModelCorrection(NamedTuple):
    """Corrections to the model of an n-joint arm: links, gears, joint terms, missing inertia and latency."""

    links: np.ndarray  # (n, 4) kg and kg m, mass and first moment
    compliance: np.ndarray  # (n,) rad/Nm, of the gears
    joints: np.ndarray  # (n, TERMS), terms of each joint
    inertia: np.ndarray  # (n, n) kg m^2, as in `Noise`
    latency: np.ndarray  # (n, n) s, as in `Noise`

    @staticmethod
    def none(n: int) -> "ModelCorrection":
        """Return a correction of zeros, which does not change a model."""
        return ModelCorrection(*map(np.zeros, ((n, 4), (n,), (n, TERMS), (n, n), (n, n))))


def fit_model_correction(robot: Robot, arm: ArmModel, residuals: list[MomentumResidual]) -> ModelCorrection:
    """Fit a correction to residuals of `arm` without a payload; terms of joints that hardly moved stay zero."""
    n = robot.n
    shared, own, y, sliding = _columns(robot, arm, residuals)
    sliding = sliding & (sliding.sum(0) >= tuning.LEAST_SPANS)
    if not sliding.any():
        return ModelCorrection.none(n)
    K, L = own.shape[2], 5 * n
    prior = np.concatenate([_link_prior(arm).ravel(), np.full(n, tuning.GEAR_COMPLIANCE), _joint_prior(arm).ravel()])
    error: np.ndarray = tuning.FRICTION_SHARE * np.maximum(arm.level, 1e-6)  # Nm, RMS of a joint's residuals
    out: np.ndarray = np.zeros(len(prior))
    parts = []
    for j in range(n):
        H = np.column_stack([shared[sliding[:, j], j], own[sliding[:, j], j]])
        at = np.concatenate([np.arange(L), L + j * K + np.arange(K)])
        parts.append((at, H, y[sliding[:, j], j], H.T @ H, H.T @ y[sliding[:, j], j]))
    for _ in range(ROUNDS):
        normal, right = np.diag(prior**-2.0), np.zeros_like(out)
        for j, (at, _, _, square, product) in enumerate(parts):
            weight = 1 / (tuning.CORRELATED_SPANS * error[j] ** 2)
            normal[np.ix_(at, at)] += weight * square
            right[at] += weight * product
        out = np.linalg.solve(normal, right)
        for j, (at, H, measured, _, _) in enumerate(parts):
            if len(measured):
                error[j] = max(np.sqrt(np.mean((measured - H @ out[at]) ** 2)), 1e-6 * arm.level[j])
    links, compliance, terms = out[: 4 * n].reshape(n, 4), out[4 * n : L], out[L:].reshape(n, K)
    return ModelCorrection(links, compliance, terms[:, :TERMS], terms[:, TERMS : TERMS + n], terms[:, TERMS + n :])


def apply_correction(arm: ArmModel, correction: ModelCorrection) -> ArmModel:
    """Return the arm with all corrections except `inertia` and `latency`, which are part of `Noise`."""
    links, table = arm.links.copy(), arm.table.copy()
    before, has_mass = arm.links[:, MASS, None], arm.links[:, MASS] > 0.0
    mass = np.maximum(before + correction.links[:, :1], 0.5 * before)[has_mass]
    moment = (before * arm.links[:, COM : COM + 3] + correction.links[:, 1:])[has_mass]
    links[has_mass, MASS], links[has_mass, COM : COM + 3] = mass[:, 0], moment / mass
    grid = np.linspace(-1, 1, table.shape[2])
    v = grid**2 * arm.max_speed[:, None]
    terms, scale = correction.joints, 1.0 + correction.joints[:, SHARE]
    coulomb, root, stribeck, viscous = terms[:, LAW:ANGLE].T[..., None]
    signed = coulomb + root * np.sqrt(v) + stribeck / (1 + v / tuning.STRIBECK_SPEED)
    table *= scale[:, None, None]
    table[:, FORWARD] += signed
    table[:, BACKWARD] += signed
    table[:, SPEED_ONLY] += viscous * np.sign(grid) * v
    return arm._replace(
        links=links, table=table, compliance=arm.compliance + correction.compliance,
        offset=arm.offset - terms[:, OFFSET], load=scale * arm.load + terms[:, LOAD],
        angle_friction=scale[:, None] * arm.angle_friction + terms[:, ANGLE:CABLE], drag=arm.drag - terms[:, CABLE:],
    )  # fmt: skip


def corrected_residuals(
    robot: Robot, arm: ArmModel, correction: ModelCorrection, residuals: list[MomentumResidual]
) -> list[MomentumResidual]:
    """Convert `residuals` of `arm` to residuals of the model with corrected links, friction, inertia and latency."""
    shared, own, y, _ = _columns(robot, arm, residuals)
    terms = own * np.concatenate([correction.joints, correction.inertia, correction.latency], 1)
    y = y - shared @ np.concatenate([correction.links.ravel(), correction.compliance]) - terms.sum(-1)
    friction = np.array([r.friction for r in residuals]) + terms[..., SHARE] + terms[..., LOAD:CABLE].sum(-1)
    return [r._replace(y=one, friction=two) for r, one, two in zip(residuals, y, friction, strict=True)]


def _columns(
    robot: Robot, arm: ArmModel, residuals: list[MomentumResidual]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the regressors of links and gears (T, n, 5 n) and of joint terms (T, n, K), and two arrays (T, n).

    The former contains the residuals, Nm; the latter is True where a joint slides.
    """
    names = ("q", "dq", "friction", "y", "sliding", "acceleration", "torque_rate")
    q, v, friction, y, sliding, ddq, torque_rate = (np.array([getattr(r, name) for r in residuals]) for name in names)
    samples, n = q.shape
    zero = np.zeros_like(q)
    mass = arm.links[:, MASS, None]
    moments = np.concatenate([mass, mass * arm.links[:, COM : COM + 3]], 1)
    weight = np.abs(np.einsum("tjkc,kc->tj", regressor(robot, q, zero, zero, arm.gravity)[..., :4], moments))
    links = regressor(robot, q, v, ddq, arm.gravity)[..., :4].reshape(samples, n, 4 * n)
    shared = np.concatenate([links, -np.array([r.gear for r in residuals])], -1)
    s, speed = np.sign(v), np.abs(v)
    terms = [friction, np.ones_like(q), s * weight, s, s * np.sqrt(speed), s / (1 + speed / tuning.STRIBECK_SPEED), v]
    terms += [s * np.sin(q), s * np.cos(q), np.sin(q), np.cos(q)]
    coupled = [np.broadcast_to(x[:, None], (samples, n, n)) for x in (ddq, torque_rate)]
    return shared, np.concatenate([np.stack(terms, -1), *coupled], -1), y, sliding > 0


def _link_prior(arm: ArmModel) -> np.ndarray:
    """Return the prior standard deviations (n, 4) of the links' masses (kg) and first moments (kg m)."""
    mass = np.maximum(arm.links[:, MASS, None], 1e-6)
    return np.concatenate([tuning.LINK_MASS_SHARE * mass, np.repeat(tuning.LINK_CENTRE_M * mass, 3, 1)], 1)


def _joint_prior(arm: ArmModel) -> np.ndarray:
    """Return the prior standard deviations (n, K) of the joints' correction terms."""
    n, level = len(arm.level), np.maximum(arm.level, 1e-6)[:, None]
    one = np.ones((n, 1))
    parts = [
        tuning.FRICTION_SHARE * one,
        tuning.OFFSET_NM * one,
        tuning.LOAD_FRICTION * one,
        *[tuning.FRICTION_LAW_SHARE * level] * 4,
    ]
    parts += [*[tuning.ANGLE_FRICTION_SHARE * level] * 2, *[tuning.CABLE_TORQUE * one] * 2]
    return np.concatenate([*parts, np.full((n, n), tuning.ROTOR_INERTIA), np.full((n, n), tuning.LATENCY_S)], 1)
