"""Compute an arm's momentum and its derivatives (columns) with respect to the inertial parameters of a payload.

The momentum p = M(q) dq obeys dp/dt = tau + C(q, dq)^T dq - g(q) (De Luca and Mattone, ICRA 2003). Let S_j be the
screw axis of joint j about the base origin, and h_j the total momentum of all bodies that joint j moves. Then p_j is
S_j . h_j, and element j of C^T dq is dS_j/dt . h_j. The products S_j . h_j and dS_j/dt . h_j are linear in each
body's inertial parameters.
"""

from typing import NamedTuple

import numpy as np

from r2s.compiled import njit
from r2s.physics.newton_euler import AXIS, COM, FRAME, MASS, PLACE, TENSOR, product, rotate, rotate_about

BODY = 10  # number of inertial parameters: mass, first moments, and xx, yy, zz, xy, xz, yz about the frame's origin
MOMENTUM_WORK = 18  # columns of the workspace, which has a row per joint


class MomentumTerms(NamedTuple):
    """Momentum of n joints, and the Coriolis and gravity torques that change this momentum."""

    p: np.ndarray  # (n,) Nm s
    coriolis: np.ndarray  # (n,) Nm, C^T dq
    uncompensated: np.ndarray  # (n,) Nm, part of the links' gravity torque that gravity compensation does not cancel
    compensated: np.ndarray  # (n,) Nm, gravity torque that gravity compensation cancels
    declared: np.ndarray  # (n,) Nm, the declared payload's part of `compensated`
    payload_p: np.ndarray  # (n, 10), derivative of p with respect to the payload's parameters
    payload_torque: np.ndarray  # (n, 10), derivative of `coriolis` - `uncompensated` with respect to these parameters

    @staticmethod
    def empty(n: int) -> "MomentumTerms":
        """Return the terms of n joints, filled with zeros."""
        return MomentumTerms(*np.zeros((5, n)), *np.zeros((2, n, BODY)))  # type: ignore[call-arg]


@njit(cache=True, inline="always")
def _cross(ax, ay, az, bx, by, bz):
    return ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx


@njit(cache=True, error_model="numpy")
def momentum(arm, q, dq, terms, work):
    """Write an arm's momentum and torques at q, dq (n,) rad, rad/s to `terms`; work (n, MOMENTUM_WORK): workspace."""
    n = len(q)
    R = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
    px, py, pz = 0.0, 0.0, 0.0
    wx, wy, wz, vx, vy, vz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0  # twist of the link about the base origin
    gx, gy, gz = arm.gravity[0], arm.gravity[1], arm.gravity[2]
    links, cancelled, pull, weight = arm.links, arm.compensated, terms.uncompensated, terms.compensated
    for i in range(n):
        k, s = links[i], work[i]
        rx, ry, rz = rotate(R, k[PLACE], k[PLACE + 1], k[PLACE + 2])
        px, py, pz = px + rx, py + ry, pz + rz
        R = product(R, k, FRAME)
        zx, zy, zz = rotate(R, k[AXIS], k[AXIS + 1], k[AXIS + 2])
        mx, my, mz = _cross(px, py, pz, zx, zy, zz)
        s[0], s[1], s[2], s[3], s[4], s[5] = zx, zy, zz, mx, my, mz
        s[6], s[7], s[8] = _cross(wx, wy, wz, zx, zy, zz)
        ax, ay, az = _cross(wx, wy, wz, mx, my, mz)
        bx, by, bz = _cross(vx, vy, vz, zx, zy, zz)
        s[9], s[10], s[11] = ax + bx, ay + by, az + bz
        R = rotate_about(R, k[AXIS], k[AXIS + 1], k[AXIS + 2], q[i])
        v = dq[i]
        wx, wy, wz = wx + zx * v, wy + zy * v, wz + zz * v
        vx, vy, vz = vx + mx * v, vy + my * v, vz + mz * v
        m = k[MASS]
        cx, cy, cz = rotate(R, k[COM], k[COM + 1], k[COM + 2])
        cx, cy, cz = px + cx, py + cy, pz + cz
        ax, ay, az = _cross(wx, wy, wz, cx, cy, cz)
        lx, ly, lz = m * (vx + ax), m * (vy + ay), m * (vz + az)
        ax = R[0] * wx + R[3] * wy + R[6] * wz  # in link axes
        ay = R[1] * wx + R[4] * wy + R[7] * wz
        az = R[2] * wx + R[5] * wy + R[8] * wz
        bx = k[TENSOR] * ax + k[TENSOR + 1] * ay + k[TENSOR + 2] * az
        by = k[TENSOR + 3] * ax + k[TENSOR + 4] * ay + k[TENSOR + 5] * az
        bz = k[TENSOR + 6] * ax + k[TENSOR + 7] * ay + k[TENSOR + 8] * az
        ax, ay, az = rotate(R, bx, by, bz)
        bx, by, bz = _cross(cx, cy, cz, lx, ly, lz)
        s[12], s[13], s[14], s[15], s[16], s[17] = ax + bx, ay + by, az + bz, lx, ly, lz
        b = cancelled[i]
        ax, ay, az = rotate(R, b[1], b[2], b[3])
        bx, by, bz = ax + b[0] * px, ay + b[0] * py, az + b[0] * pz
        ax, ay, az = _cross(m * cx - bx, m * cy - by, m * cz - bz, gx, gy, gz)
        bx, by, bz = _cross(bx, by, bz, gx, gy, gz)
        pull[i], weight[i] = 0.0, 0.0
        for j in range(i + 1):  # a link's weight acts on all joints between base and link
            o = work[j]
            down = o[3] * gx + o[4] * gy + o[5] * gz
            pull[j] -= o[0] * ax + o[1] * ay + o[2] * az + (m - b[0]) * down
            weight[j] -= o[0] * bx + o[1] * by + o[2] * bz + b[0] * down
    b = arm.declared
    ax, ay, az = rotate(R, b[1], b[2], b[3])
    bx, by, bz = _cross(ax + b[0] * px, ay + b[0] * py, az + b[0] * pz, gx, gy, gz)
    for j in range(n):
        o = work[j]
        down = o[3] * gx + o[4] * gy + o[5] * gz
        terms.declared[j] = -(o[0] * bx + o[1] * by + o[2] * bz + b[0] * down)
    _payload_columns(arm, R, (px, py, pz), (wx, wy, wz), (vx, vy, vz), terms, work)
    for j in range(n - 1, -1, -1):
        s = work[j]
        terms.p[j] = s[0] * s[12] + s[1] * s[13] + s[2] * s[14] + s[3] * s[15] + s[4] * s[16] + s[5] * s[17]
        terms.p[j] += arm.armature[j] * dq[j]
        c = s[6] * s[12] + s[7] * s[13] + s[8] * s[14] + s[9] * s[15] + s[10] * s[16] + s[11] * s[17]
        terms.coriolis[j] = c
        if j > 0:
            for i in range(12, 18):
                work[j - 1, i] += s[i]


@njit(cache=True, error_model="numpy")
def _payload_columns(arm, R, p, w, v, terms, work):
    """Write a payload's columns to `terms`.

    (R, p): pose of the last link in the base frame; (w, v): its twist about the base origin.
    """
    frame, (px, py, pz), (wx, wy, wz), (vx, vy, vz) = arm.payload_frame, p, w, v
    rx, ry, rz = rotate(R, frame[0], frame[1], frame[2])
    px, py, pz = px + rx, py + ry, pz + rz
    R = product(R, frame, 3)
    gx, gy, gz = arm.gravity[0], arm.gravity[1], arm.gravity[2]
    ax, ay, az = _cross(wx, wy, wz, px, py, pz)
    ux, uy, uz = vx + ax, vy + ay, vz + az  # velocity of the payload frame
    ox = R[0] * wx + R[3] * wy + R[6] * wz
    oy = R[1] * wx + R[4] * wy + R[7] * wz
    oz = R[2] * wx + R[5] * wy + R[8] * wz
    columns, torques = terms.payload_p, terms.payload_torque
    for c in range(BODY):
        lx, ly, lz, fx, fy, fz, tx, ty, tz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        if c == 0:
            lx, ly, lz = ux, uy, uz
            hx, hy, hz = _cross(px, py, pz, ux, uy, uz)
            fx, fy, fz = gx, gy, gz
            tx, ty, tz = _cross(px, py, pz, gx, gy, gz)
        elif c < 4:
            ex, ey, ez = R[c - 1], R[c + 2], R[c + 5]
            lx, ly, lz = _cross(wx, wy, wz, ex, ey, ez)
            ax, ay, az = _cross(ex, ey, ez, ux, uy, uz)
            hx, hy, hz = _cross(px, py, pz, lx, ly, lz)
            hx, hy, hz = hx + ax, hy + ay, hz + az
            tx, ty, tz = _cross(ex, ey, ez, gx, gy, gz)
        elif c == 4:
            hx, hy, hz = rotate(R, ox, 0.0, 0.0)
        elif c == 5:
            hx, hy, hz = rotate(R, 0.0, oy, 0.0)
        elif c == 6:
            hx, hy, hz = rotate(R, 0.0, 0.0, oz)
        elif c == 7:
            hx, hy, hz = rotate(R, oy, ox, 0.0)
        elif c == 8:
            hx, hy, hz = rotate(R, oz, 0.0, ox)
        else:
            hx, hy, hz = rotate(R, 0.0, oz, oy)
        for j in range(len(work)):
            s = work[j]
            columns[j, c] = s[0] * hx + s[1] * hy + s[2] * hz + s[3] * lx + s[4] * ly + s[5] * lz
            torques[j, c] = (
                s[6] * hx + s[7] * hy + s[8] * hz + s[9] * lx + s[10] * ly + s[11] * lz
                + s[0] * tx + s[1] * ty + s[2] * tz + s[3] * fx + s[4] * fy + s[5] * fz
            )  # fmt: skip
