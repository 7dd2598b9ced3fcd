"""An arm's generalised momentum, and what ten unknown numbers of a payload add to it; compiled, microseconds a call.

p = M(q) dq obeys dp/dt = tau + C(q, dq)^T dq - g(q), without accelerations (De Luca and Mattone, ICRA 2003). With
S_j a joint's screw about the base's origin and h_j the momentum of everything beyond it, p_j = S_j . h_j, and
(C^T dq)_j = dS_j/dt . h_j; all of it is linear in each body's mass m, first moments h and tensor about its frame.
"""

from r2s.compiled import njit
from r2s.physics.newton_euler import AXIS, COM, MASS, PLACE, product, spun, turned
from r2s.physics.newton_euler import FRAME as TURN
from r2s.physics.newton_euler import TENSOR as INERTIA

BODY = 10  # numbers of a body: m, h, and xx, yy, zz, xy, xz, yz about its frame's origin
WIDE = 18  # of the work of a joint


@njit(cache=True, inline="always")
def _cross(ax, ay, az, bx, by, bz):
    return ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx


@njit(cache=True, error_model="numpy")
def momentum(links, believed, hand, gravity, armature, q, dq, work, p, push, pull, weight, payload_p, payload_push):
    """Write the momentum of an arm at q, dq (n,) rad, rad/s, and what changes it beside commands and friction.

    Args:
        links: (n, LINK), `links_of` the arm. believed: (n, 4) kg and kg m in each link's frame, mass and first moment
            that the arm's gravity compensation reckons with.
        hand: (12,) place and axes, row by row, of the payload's frame in the last link's.
        gravity: (3,) m/s^2. armature: (n,) kg m^2.
        work: (n, WIDE), anything.
        p: (n,) Nm s. push: (n,) Nm, C^T dq. pull: (n,) Nm, gravity of the links that is not compensated. weight: (n,)
            Nm, that which is.
        payload_p, payload_push: (n, 10), what the payload's ten numbers add to p, and to push - pull.
    """
    n = len(q)
    R = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
    px, py, pz = 0.0, 0.0, 0.0
    wx, wy, wz, vx, vy, vz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0  # of the link; its velocity at the base's origin
    gx, gy, gz = gravity[0], gravity[1], gravity[2]
    for i in range(n):
        k, s = links[i], work[i]
        rx, ry, rz = turned(R, k[PLACE], k[PLACE + 1], k[PLACE + 2])
        px, py, pz = px + rx, py + ry, pz + rz
        R = product(R, k, TURN)
        zx, zy, zz = turned(R, k[AXIS], k[AXIS + 1], k[AXIS + 2])
        mx, my, mz = _cross(px, py, pz, zx, zy, zz)
        s[0], s[1], s[2], s[3], s[4], s[5] = zx, zy, zz, mx, my, mz
        s[6], s[7], s[8] = _cross(wx, wy, wz, zx, zy, zz)
        ax, ay, az = _cross(wx, wy, wz, mx, my, mz)
        bx, by, bz = _cross(vx, vy, vz, zx, zy, zz)
        s[9], s[10], s[11] = ax + bx, ay + by, az + bz
        R = spun(R, k[AXIS], k[AXIS + 1], k[AXIS + 2], q[i])
        v = dq[i]
        wx, wy, wz = wx + zx * v, wy + zy * v, wz + zz * v
        vx, vy, vz = vx + mx * v, vy + my * v, vz + mz * v
        m = k[MASS]
        cx, cy, cz = turned(R, k[COM], k[COM + 1], k[COM + 2])
        cx, cy, cz = px + cx, py + cy, pz + cz
        ax, ay, az = _cross(wx, wy, wz, cx, cy, cz)
        lx, ly, lz = m * (vx + ax), m * (vy + ay), m * (vz + az)
        ax = R[0] * wx + R[3] * wy + R[6] * wz  # in the link's own axes
        ay = R[1] * wx + R[4] * wy + R[7] * wz
        az = R[2] * wx + R[5] * wy + R[8] * wz
        t = INERTIA
        bx = k[t] * ax + k[t + 1] * ay + k[t + 2] * az
        by = k[t + 3] * ax + k[t + 4] * ay + k[t + 5] * az
        bz = k[t + 6] * ax + k[t + 7] * ay + k[t + 8] * az
        ax, ay, az = turned(R, bx, by, bz)
        bx, by, bz = _cross(cx, cy, cz, lx, ly, lz)
        s[12], s[13], s[14], s[15], s[16], s[17] = ax + bx, ay + by, az + bz, lx, ly, lz
        b = believed[i]
        ax, ay, az = turned(R, b[1], b[2], b[3])
        bx, by, bz = ax + b[0] * px, ay + b[0] * py, az + b[0] * pz
        ax, ay, az = _cross(m * cx - bx, m * cy - by, m * cz - bz, gx, gy, gz)
        bx, by, bz = _cross(bx, by, bz, gx, gy, gz)
        pull[i], weight[i] = 0.0, 0.0
        for j in range(i + 1):  # the weight of a link is felt by the joints before it
            o = work[j]
            down = o[3] * gx + o[4] * gy + o[5] * gz
            pull[j] -= o[0] * ax + o[1] * ay + o[2] * az + (m - b[0]) * down
            weight[j] -= o[0] * bx + o[1] * by + o[2] * bz + b[0] * down
    _payload(R, px, py, pz, wx, wy, wz, vx, vy, vz, hand, gravity, work, payload_p, payload_push)
    for j in range(n - 1, -1, -1):
        s = work[j]
        p[j] = s[0] * s[12] + s[1] * s[13] + s[2] * s[14] + s[3] * s[15] + s[4] * s[16] + s[5] * s[17]
        p[j] += armature[j] * dq[j]
        push[j] = s[6] * s[12] + s[7] * s[13] + s[8] * s[14] + s[9] * s[15] + s[10] * s[16] + s[11] * s[17]
        if j > 0:
            for c in range(12, 18):
                work[j - 1, c] += s[c]


@njit(cache=True, error_model="numpy")
def _payload(R, px, py, pz, wx, wy, wz, vx, vy, vz, hand, gravity, work, payload_p, payload_push):
    n = len(work)
    rx, ry, rz = turned(R, hand[0], hand[1], hand[2])
    px, py, pz = px + rx, py + ry, pz + rz
    R = product(R, hand, 3)
    gx, gy, gz = gravity[0], gravity[1], gravity[2]
    ax, ay, az = _cross(wx, wy, wz, px, py, pz)
    ux, uy, uz = vx + ax, vy + ay, vz + az  # of the hand
    ox = R[0] * wx + R[3] * wy + R[6] * wz
    oy = R[1] * wx + R[4] * wy + R[7] * wz
    oz = R[2] * wx + R[5] * wy + R[8] * wz
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
            hx, hy, hz = turned(R, ox, 0.0, 0.0)
        elif c == 5:
            hx, hy, hz = turned(R, 0.0, oy, 0.0)
        elif c == 6:
            hx, hy, hz = turned(R, 0.0, 0.0, oz)
        elif c == 7:
            hx, hy, hz = turned(R, oy, ox, 0.0)
        elif c == 8:
            hx, hy, hz = turned(R, oz, 0.0, ox)
        else:
            hx, hy, hz = turned(R, 0.0, oz, oy)
        for j in range(n):
            s = work[j]
            payload_p[j, c] = s[0] * hx + s[1] * hy + s[2] * hz + s[3] * lx + s[4] * ly + s[5] * lz
            payload_push[j, c] = (
                s[6] * hx + s[7] * hy + s[8] * hz + s[9] * lx + s[10] * ly + s[11] * lz
                + s[0] * tx + s[1] * ty + s[2] * tz + s[3] * fx + s[4] * fy + s[5] * fz
            )  # fmt: skip
