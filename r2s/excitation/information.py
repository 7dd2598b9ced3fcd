"""Compute the information that a recording of a planned motion will contain, for assumed noise and priors."""

import numpy as np

from r2s.excitation.motion_checks import gravity_torque
from r2s.physics.rigid_body import LinkInertia, regressor, tensor_elements
from r2s.physics.robot import Robot

COARSE_HZ = 10  # rate of the samples for information and safety
# Standard deviations of noise and priors: rough values for torque-controlled arms.
NOISE = 0.002  # share of tau_max, per sample
FRICTION_PRIOR = 0.05  # share of tau_max, per friction coefficient
DRAG_PRIOR = 0.01  # share of tau_max, coefficients of sine and cosine of the angle, for example of a cable's torque
MASS_PRIOR = 0.03, 0.005  # share of a link's mass; m, for each coordinate of its center of mass
SCALE_PRIOR = 0.3  # share of a link's tensor, or of its trace
DELAY_PRIOR = 3e-3  # s
SLOPE = 0.05  # share of dq_max, width of the sign change of friction
RESTING = 1e-3  # share of dq_max; a slower joint may stick, so that the joint's torque contains no information


def information(
    robot: Robot, t: np.ndarray, q: np.ndarray, dq: np.ndarray, ddq: np.ndarray, gravity: bool
) -> np.ndarray:
    """Return the information (B,), in nats, of motions (B, T, n) at times (T,) s.

    Information is log(det posterior precision / det prior precision) / 2, with independent normal priors. The
    unknowns of each joint are offset, Coulomb friction (a tanh with unknown width and shift), viscous friction and
    drag. The unknowns of each link are mass and center of mass, whose errors gravity compensation does not remove.
    For commanded torque (`gravity` false), each tensor's scale and a common delay are also unknown; for link-side
    torque, each tensor element is unknown. Samples at 10 Hz have a noise of 0.2 % of tau_max; a resting joint's
    samples are ignored.
    """
    n, shape = robot.n, (len(q), len(t), robot.n)
    flat = q.reshape(-1, n), dq.reshape(-1, n), ddq.reshape(-1, n)
    y = regressor(robot, *flat, gravity=robot.gravity).reshape(*shape, n, 10)
    speed, bend = dq / robot.dq_max, dq / (SLOPE * robot.dq_max)
    step, bump = np.tanh(bend), 1 / np.cosh(np.minimum(np.abs(bend), 50)) ** 2
    curves = FRICTION_PRIOR * np.stack([np.ones_like(dq), step, bend * bump, bump, speed], -1)
    curves = np.concatenate([curves, DRAG_PRIOR * np.stack([np.sin(q), np.cos(q)], -1)], -1)
    friction = np.zeros((*shape, n, 7))
    friction[:, :, range(n), range(n)] = curves * robot.tau_max[:, None]
    mass, center = MASS_PRIOR
    points = y[..., :4] * np.outer(robot.mass, [mass, center, center, center])
    if gravity:
        tensors = y[..., 4:] * (SCALE_PRIOR * np.trace(robot.inertia, axis1=1, axis2=2)[:, None])
        delay = np.zeros((*shape, 0))
    else:
        tensors = SCALE_PRIOR * np.einsum("btjkc,kc->btjk", y[..., 4:], tensor_elements(robot.inertia))
        torque = np.einsum("btjkc,kc->btj", y, LinkInertia(robot.mass, robot.com, robot.inertia).standard())
        torque -= gravity_torque(robot, flat[0]).reshape(shape)
        coulomb = FRICTION_PRIOR * robot.tau_max * bump / (SLOPE * robot.dq_max) * ddq
        delay = DELAY_PRIOR * (np.gradient(torque, t, axis=1) + coulomb)[..., None]
    columns = [x.reshape(*shape, -1) for x in (friction, points, tensors, delay)]
    rows = np.concatenate(columns, -1) / (NOISE * robot.tau_max[:, None])
    rows *= (np.abs(speed) > RESTING)[..., None]
    rows = rows.reshape(len(q), -1, rows.shape[-1])
    return 0.5 * np.linalg.slogdet(np.eye(rows.shape[-1]) + rows.transpose(0, 2, 1) @ rows)[1]
