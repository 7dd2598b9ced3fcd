"""Describe a link's mass, center of mass and inertia tensor by ten parameters that are always physically consistent.

Log-Cholesky parameters describe the pseudo-inertia J relative to the nominal U0 U0^T (Rucker and Wensing, RA-L 7(2),
2022): J = U0 V V^T U0^T, V = exp(alpha) [[e^d1, s12, s13, t1], [0, e^d2, s23, t2], [0, 0, e^d3, t3], [0, 0, 0, 1]].
"""

import numpy as np

from r2s.physics.dynamics import Dynamics
from r2s.physics.robot import Robot

CHOLESKY = ("alpha", "d1", "d2", "d3", "s12", "s13", "s23", "t1", "t2", "t3")
LINK = tuple(f"link_{name}" for name in CHOLESKY)
PAYLOAD = ("payload_mass", "payload_x", "payload_y", "payload_z")


def pseudo_inertia(mass: np.ndarray, com: np.ndarray, inertia: np.ndarray) -> np.ndarray:
    """Return the pseudo-inertia [[Sigma, h], [h^T, m]] (..., 4, 4) of links about their origins.

    Sigma, h and m are second moment, first moment and mass (Wensing, Kim and Slotine, RA-L 3(1), 2018). The second
    moment about the center of mass is positive definite if the principal moments satisfy the triangle inequality.
    Otherwise, the function raises its smallest eigenvalues.
    """
    second = 0.5 * np.trace(inertia, axis1=-2, axis2=-1)[..., None, None] * np.eye(3) - inertia
    moments, axes = np.linalg.eigh(second)
    moments = np.maximum(moments, 1e-6 * moments.max(-1, keepdims=True))
    second = axes * moments[..., None, :] @ np.swapaxes(axes, -1, -2)
    out = np.empty((*mass.shape, 4, 4))
    h = mass[..., None] * com
    out[..., :3, :3] = second + mass[..., None, None] * com[..., :, None] * com[..., None, :]
    out[..., :3, 3] = out[..., 3, :3] = h
    out[..., 3, 3] = mass
    return out


def _upper(j: np.ndarray) -> np.ndarray:
    """Return the upper triangular matrix U (..., 4, 4) with U U^T = j."""
    return np.linalg.cholesky(j[..., ::-1, ::-1])[..., ::-1, ::-1]


def links(robot: Robot, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return mass, center of mass and tensor of links with the log-Cholesky parameters theta (..., n, 10).

    Mass (..., n) is in kg, center (..., n, 3) in m, and the tensor (..., n, 3, 3) about the center in kg m^2.
    """
    v = np.zeros((*theta.shape[:-1], 4, 4))
    for i in range(3):
        v[..., i, i] = np.exp(theta[..., 1 + i])
    v[..., 0, 1], v[..., 0, 2], v[..., 1, 2] = theta[..., 4], theta[..., 5], theta[..., 6]
    v[..., :3, 3], v[..., 3, 3] = theta[..., 7:], 1.0
    u = _upper(pseudo_inertia(robot.mass, robot.com, robot.inertia)) @ (np.exp(theta[..., :1])[..., None] * v)
    j = u @ np.swapaxes(u, -1, -2)
    mass = j[..., 3, 3]
    com = j[..., :3, 3] / mass[..., None]
    second = j[..., :3, :3] - mass[..., None, None] * com[..., :, None] * com[..., None, :]
    return mass, com, np.trace(second, axis1=-2, axis2=-1)[..., None, None] * np.eye(3) - second


def log_cholesky(robot: Robot, dynamics: Dynamics) -> np.ndarray:
    """Return the log-Cholesky parameters theta (n, 10) of the links of `dynamics`, relative to nominal links."""
    base = _upper(pseudo_inertia(robot.mass, robot.com, robot.inertia))
    v = np.linalg.solve(base, _upper(pseudo_inertia(dynamics.mass, dynamics.com, dynamics.inertia)))
    scale, v = v[..., 3, 3], v / v[..., 3:, 3:]
    diagonal = [np.log(v[..., i, i]) for i in range(3)]
    rest = [v[..., 0, 1], v[..., 0, 2], v[..., 1, 2], v[..., 0, 3], v[..., 1, 3], v[..., 2, 3]]
    return np.stack([np.log(scale), *diagonal, *rest], -1)


def add_point_mass(
    mass: np.ndarray, com: np.ndarray, inertia: np.ndarray, payload: np.ndarray, place: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return mass (..., n) kg, com (..., n, 3) m, tensor (..., n, 3, 3) with a point mass added to the last link.

    A point mass suffices: a gripper's tensor about its own center is small compared with m r^2, where m is the
    gripper's mass and r its distance from a joint.

    Args:
        mass, com, inertia: mass, center of mass and inertia tensor of each link without the point mass.
        payload: (...) kg, the point mass, at least 0. place: (..., 3) m, the point mass's position in the last link's
            frame.
    """
    lead = np.broadcast_shapes(mass.shape[:-1], np.shape(payload))
    out = [np.broadcast_to(a, (*lead, *a.shape[k:])).copy() for a, k in ((mass, -1), (com, -2), (inertia, -3))]
    own, arm = out[0][..., -1].copy(), place - out[1][..., -1, :]
    share = payload / (own + payload)
    out[0][..., -1] += payload
    out[1][..., -1, :] += share[..., None] * arm
    square = (arm**2).sum(-1)[..., None, None] * np.eye(3) - arm[..., :, None] * arm[..., None, :]
    out[2][..., -1, :, :] += (own * share)[..., None, None] * square
    return out[0], out[1], out[2]


def inertia_scale(inertia: np.ndarray, nominal: np.ndarray) -> np.ndarray:
    """Return ratios (..., n) of the traces of inertia tensors (..., n, 3, 3) to the traces of nominal tensors."""
    return np.trace(inertia, axis1=-2, axis2=-1) / np.trace(nominal, axis1=-2, axis2=-1)
