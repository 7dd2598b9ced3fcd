"""Equations of motion of a serial arm, compiled: mass matrix and bias torque in about a microsecond.

The recursive Newton-Euler algorithm with zero joint accelerations computes the bias torque; the composite-rigid-body
algorithm computes the mass matrix (Featherstone 2008, ch. 5 and 6). All moments are about the base's origin.
`equations` uses neither MuJoCo nor DART; tests compare the results of r2s, MuJoCo and DART.
"""

from dataclasses import replace

import numpy as np

from r2s.compiled import njit
from r2s.physics.description import chain
from r2s.physics.dynamics import Dynamics
from r2s.physics.robot import Robot

# Columns of `links`: position and rotation in the parent link at angle zero, axis, mass, center of mass, tensor about
# this center in link axes.
PLACE, FRAME, AXIS, MASS, COM, TENSOR, LINK = 0, 3, 12, 15, 16, 19, 28
WORK = 22  # columns of the work array of `equations`


def links_of(robot: Robot, mass: np.ndarray, com: np.ndarray, inertia: np.ndarray) -> np.ndarray:
    """Return `links` (n, LINK) from masses (n,) kg, their centers (n, 3) m and central tensors (n, 3, 3) kg m^2."""
    own = replace(Dynamics.of(robot, np.zeros((robot.n, 3))), mass=mass, com=com, inertia=inertia)
    rows = [
        [*link.origin[:3, 3], *link.origin[:3, :3].flat, *link.axis, link.mass, *link.com, *link.inertia.flat]
        for link in chain(robot, own, friction=False)[0]
    ]
    return np.array(rows)


@njit(cache=True, error_model="numpy")
def equations(links, gravity, q, dq, mass, bias, work):
    """Write the mass matrix (n, n) kg m^2 and the bias torque (n,) Nm, with mass ddq + bias = joint torque.

    Args:
        links: output of `links_of`. gravity: (3,) m/s^2 in the base frame.
        q, dq: (n,) rad, rad/s, joint angles and velocities.
        mass, bias: arrays for the results. work: (n, WORK), scratch array.
    """
    R = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
    px, py, pz = 0.0, 0.0, 0.0
    wx, wy, wz, ex, ey, ez = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0  # angular velocity and acceleration of the link
    ax, ay, az = -gravity[0], -gravity[1], -gravity[2]  # linear acceleration; gravity enters as a base acceleration
    for i in range(len(q)):
        k, s = links[i], work[i]
        (rx, ry, rz), (zx, zy, zz), R = joint_frame(R, k, q[i])
        cx, cy, cz = _cross(wx, wy, wz, rx, ry, rz)
        ux, uy, uz = _cross(wx, wy, wz, cx, cy, cz)
        tx, ty, tz = _cross(ex, ey, ez, rx, ry, rz)
        ax, ay, az = ax + tx + ux, ay + ty + uy, az + tz + uz
        px, py, pz = px + rx, py + ry, pz + rz
        v = dq[i]
        tx, ty, tz = _cross(wx, wy, wz, zx, zy, zz)
        ex, ey, ez = ex + tx * v, ey + ty * v, ez + tz * v
        wx, wy, wz = wx + zx * v, wy + zy * v, wz + zz * v
        m = k[MASS]
        rx, ry, rz = rotate(R, k[COM], k[COM + 1], k[COM + 2])
        cx, cy, cz = _cross(wx, wy, wz, rx, ry, rz)
        ux, uy, uz = _cross(wx, wy, wz, cx, cy, cz)
        tx, ty, tz = _cross(ex, ey, ez, rx, ry, rz)
        fx, fy, fz = m * (ax + tx + ux), m * (ay + ty + uy), m * (az + tz + uz)
        gx, gy, gz = px + rx, py + ry, pz + rz
        xx, xy, xz, yy, yz, zz_ = base_tensor(R, k)
        hx, hy, hz = xx * wx + xy * wy + xz * wz, xy * wx + yy * wy + yz * wz, xz * wx + yz * wy + zz_ * wz
        cx, cy, cz = _cross(wx, wy, wz, hx, hy, hz)
        tx, ty, tz = _cross(gx, gy, gz, fx, fy, fz)
        s[0], s[1], s[2] = fx, fy, fz
        s[3] = xx * ex + xy * ey + xz * ez + cx + tx
        s[4] = xy * ex + yy * ey + yz * ez + cy + ty
        s[5] = xz * ex + yz * ey + zz_ * ez + cz + tz
        s[6], s[7], s[8], s[9] = m, m * gx, m * gy, m * gz
        s[10], s[11] = xx + m * (gy * gy + gz * gz), yy + m * (gx * gx + gz * gz)
        s[12] = zz_ + m * (gx * gx + gy * gy)
        s[13], s[14], s[15] = xy - m * gx * gy, xz - m * gx * gz, yz - m * gy * gz
        s[16], s[17], s[18] = zx, zy, zz
        s[19], s[20], s[21] = _cross(px, py, pz, zx, zy, zz)
    _project(mass, bias, work)


@njit(cache=True, error_model="numpy", inline="always")
def _project(mass, bias, work):
    """Sum forces and inertias of all links beyond each joint, and project the sums onto the joint axes."""
    for j in range(len(bias) - 1, -1, -1):
        s = work[j]
        bias[j] = s[16] * s[3] + s[17] * s[4] + s[18] * s[5] + s[19] * s[0] + s[20] * s[1] + s[21] * s[2]
        zx, zy, zz, vx, vy, vz = (
            s[16],
            s[17],
            s[18],
            s[19],
            s[20],
            s[21],
        )  # joint axis, and velocity at the base's origin when the joint turns at 1 rad/s
        m, hx, hy, hz = s[6], s[7], s[8], s[9]
        tx, ty, tz = _cross(zx, zy, zz, hx, hy, hz)
        lx, ly, lz = m * vx + tx, m * vy + ty, m * vz + tz
        tx, ty, tz = _cross(hx, hy, hz, vx, vy, vz)
        kx = s[10] * zx + s[13] * zy + s[14] * zz + tx
        ky = s[13] * zx + s[11] * zy + s[15] * zz + ty
        kz = s[14] * zx + s[15] * zy + s[12] * zz + tz
        for i in range(j + 1):
            o = work[i]
            mass[i, j] = o[16] * kx + o[17] * ky + o[18] * kz + o[19] * lx + o[20] * ly + o[21] * lz
            mass[j, i] = mass[i, j]
        if j > 0:
            for c in range(16):
                work[j - 1, c] += s[c]


@njit(cache=True, inline="always")
def joint_frame(R, link, angle):
    """Advance forward kinematics by one joint.

    Args:
        R: rotation of the parent link (9 numbers, row by row). link: row of `links_of`. angle: joint angle, rad.

    Returns:
        Offset (m) of the link from the parent link, joint axis, and rotation matrix of the link, all in base axes.
    """
    offset = rotate(R, link[PLACE], link[PLACE + 1], link[PLACE + 2])
    R = product(R, link, FRAME)
    axis = rotate(R, link[AXIS], link[AXIS + 1], link[AXIS + 2])
    return offset, axis, rotate_about(R, link[AXIS], link[AXIS + 1], link[AXIS + 2], angle)


@njit(cache=True, inline="always")
def _cross(ax, ay, az, bx, by, bz):
    return ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx


@njit(cache=True, inline="always")
def rotate(R, x, y, z):
    """Return the vector x, y, z multiplied by the matrix R (9 numbers, row by row)."""
    return R[0] * x + R[1] * y + R[2] * z, R[3] * x + R[4] * y + R[5] * z, R[6] * x + R[7] * y + R[8] * z


@njit(cache=True, inline="always")
def product(R, k, at):
    """Return the product of the matrices R and k[at : at + 9], as 9 numbers, row by row."""
    return (
        R[0] * k[at] + R[1] * k[at + 3] + R[2] * k[at + 6],
        R[0] * k[at + 1] + R[1] * k[at + 4] + R[2] * k[at + 7],
        R[0] * k[at + 2] + R[1] * k[at + 5] + R[2] * k[at + 8],
        R[3] * k[at] + R[4] * k[at + 3] + R[5] * k[at + 6],
        R[3] * k[at + 1] + R[4] * k[at + 4] + R[5] * k[at + 7],
        R[3] * k[at + 2] + R[4] * k[at + 5] + R[5] * k[at + 8],
        R[6] * k[at] + R[7] * k[at + 3] + R[8] * k[at + 6],
        R[6] * k[at + 1] + R[7] * k[at + 4] + R[8] * k[at + 7],
        R[6] * k[at + 2] + R[7] * k[at + 5] + R[8] * k[at + 8],
    )


@njit(cache=True, inline="always")
def rotate_about(R, x, y, z, angle):
    """Return R times the rotation matrix for `angle`, rad, about the unit axis x, y, z (Rodrigues)."""
    c, s = np.cos(angle), np.sin(angle)
    d = 1.0 - c
    k = (
        *(c + d * x * x, d * x * y - s * z, d * x * z + s * y),
        *(d * x * y + s * z, c + d * y * y, d * y * z - s * x),
        *(d * x * z - s * y, d * y * z + s * x, c + d * z * z),
    )
    return product(R, k, 0)


@njit(cache=True, inline="always")
def base_tensor(R, k):
    """Return the elements xx, xy, xz, yy, yz, zz of a link's inertia tensor in base axes."""
    A = product(R, k, TENSOR)
    return (
        A[0] * R[0] + A[1] * R[1] + A[2] * R[2],
        A[0] * R[3] + A[1] * R[4] + A[2] * R[5],
        A[0] * R[6] + A[1] * R[7] + A[2] * R[8],
        A[3] * R[3] + A[4] * R[4] + A[5] * R[5],
        A[3] * R[6] + A[4] * R[7] + A[5] * R[8],
        A[6] * R[6] + A[7] * R[7] + A[8] * R[8],
    )
