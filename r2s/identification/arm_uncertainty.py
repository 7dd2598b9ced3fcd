"""Compute how errors in the model of an identified arm change a torque residual."""

from dataclasses import dataclass

import numpy as np

from r2s.identification.link_inertia import LINK
from r2s.identification.parameters import ParameterSpace
from r2s.identification.residuals.modulating_functions import SlidingMotion
from r2s.identification.residuals.torque_residual import TorqueResidual
from r2s.physics.friction import WIDTH_DQ
from r2s.physics.robot import Robot

GAIN = 0.05  # standard deviation of a torque sensor's gain error, the prior of conf/identify
MASSES = 0.1  # standard deviation of a relative error that is the same for all masses in a robot's file


@dataclass(frozen=True, eq=False)
class Arm:
    """An identified arm: parameter space, parameter values x (P,), and posterior draws `samples` (S, P) or None."""

    space: ParameterSpace
    x: np.ndarray
    samples: np.ndarray | None

    @property
    def robot(self) -> Robot:
        """The arm's kinematics, limits and tool."""
        return self.space.robot


def sensor_factor(arm: Arm) -> tuple[np.ndarray, np.ndarray]:
    """Return correction factors (n,) for a payload's joint torques, and the factors' standard deviations (n,).

    The torque of an unloaded arm determines only the product of sensor gain and masses. If every true mass is 1 + e
    times the mass in the robot's file, the identified gains contain the factor 1 + e. A payload's computed torque is
    then 1 + e times too large. Each joint's gain has an independent error with standard deviation GAIN. All masses
    share one relative error, with standard deviation MASSES. With every error divided by its standard deviation, the
    most likely mass error minimizes the sum of squares of all errors.
    """
    space, n = arm.space, arm.robot.n
    if "gain" not in space.blocks or LINK[0] in space.blocks:
        return np.ones(n), np.zeros(n)
    at = space.where("gain")
    gain, sd = arm.x[at], np.zeros(n) if arm.samples is None else arm.samples[:, at].std(0)
    seen = sd < 0.5 * GAIN  # whether the data determine a joint's gain
    information = seen.sum() / GAIN**2 + 1.0 / MASSES**2
    shift = -gain[seen].sum() / GAIN**2 / information
    return np.where(seen, 1.0 + shift / (1.0 + gain), 1.0), np.where(seen, information**-0.5 / (1.0 + gain), 0.0)


def sliding_sign(torque: TorqueResidual) -> np.ndarray:
    """Return the sign of friction (F, n) at F instants of a motion; if joints may rest, the sign changes smoothly."""
    if torque.space.nominal.family.has_memory:
        return torque.motion.bristle
    dq = torque.motion.friction_dq
    return np.sign(dq) if isinstance(torque.motion, SlidingMotion) else np.tanh(dq / WIDTH_DQ)


def arm_directions(
    torque: TorqueResidual, x: np.ndarray, samples: np.ndarray | None, friction_drift: float, offset_drift: np.ndarray
) -> np.ndarray:
    """Return the residual's changes (T, n, r) Nm due to r independent model errors of one standard deviation each.

    Args:
        torque: residual of the joint torque. x: (P,) parameters of the arm.
        samples: (S, P), posterior draws of x; if None, only friction and offsets have errors. offset_drift: (n,) Nm,
            standard deviation of the offsets' drift since the calibration.
        friction_drift: standard deviation of the friction's drift since the calibration, relative to the friction.
    """
    d, n = torque.space.dynamics(x), torque.space.n
    friction = torque.motion.filtered(d.friction(torque.motion.friction_dq, sliding_sign(torque)))
    offset = np.broadcast_to(np.diag(offset_drift), (*friction.shape, n))
    parts = [friction_drift * friction[..., None] * np.eye(n), offset]
    if samples is not None and len(x):
        sd = samples.std(0)
        some = sd > 1e-9 * np.abs(x)
        change = (torque.change(x, x + sd) * torque.scale.reshape(-1, 1))[:, some].reshape(*friction.shape, -1)
        size, axes = np.linalg.eigh(np.atleast_2d(np.corrcoef(samples[:, some].T)))
        parts.append(change @ (axes * np.sqrt(np.maximum(size, 0.0))))
    return np.concatenate(parts, -1)
