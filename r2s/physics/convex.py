"""Compute the distance of two convex bodies: spheres, capsules, cylinders, boxes, ellipsoids or convex hulls.

A body consists of its core and all points within a given radius of the core; a support function describes the core.
The algorithm of Gilbert, Johnson and Keerthi (IEEE Journal of Robotics and Automation 4(2), 1988) computes the
distance of two cores. The cases of a simplex follow Ericson (Real-Time Collision Detection, 2005, ch. 5).
"""

import numpy as np

from r2s.compiled import njit

# Columns of a body: kind, radius around the core, half sizes of the core, first vertex and number of vertices, radius
# of the bounding sphere.
KIND, RADIUS, SIZE, FIRST, COUNT, BOUND, BODY = 0, 1, 2, 5, 6, 7, 8
POINT, SEGMENT, CYLINDER, BOX, ELLIPSOID, HULL = range(6)
CLOSE = 1e-7  # m, gap between upper and lower bound of the distance at which the iteration ends
ITERATIONS = 64


@njit(cache=True, error_model="numpy")
def support_point(body, vertices, pose, dx, dy, dz):
    """Return the support point (x, y, z) m of a body's core in the direction dx, dy, dz; pose: body pose (POSE,)."""
    x = pose[3] * dx + pose[6] * dy + pose[9] * dz
    y = pose[4] * dx + pose[7] * dy + pose[10] * dz
    z = pose[5] * dx + pose[8] * dy + pose[11] * dz
    kind = int(body[KIND])
    a, b, c = body[SIZE], body[SIZE + 1], body[SIZE + 2]
    if kind == POINT:
        x, y, z = 0.0, 0.0, 0.0
    elif kind == SEGMENT:
        x, y, z = 0.0, 0.0, c if z > 0 else -c
    elif kind == CYLINDER:
        across = np.sqrt(x * x + y * y)
        share = a / across if across > 0 else 0.0
        x, y, z = x * share, y * share, c if z > 0 else -c
    elif kind == BOX:
        x, y, z = a if x > 0 else -a, b if y > 0 else -b, c if z > 0 else -c
    elif kind == ELLIPSOID:
        length = np.sqrt(a * a * x * x + b * b * y * y + c * c * z * z)
        x, y, z = a * a * x / length, b * b * y / length, c * c * z / length
    else:
        first, best, at = int(body[FIRST]), -np.inf, 0
        for k in range(first, first + int(body[COUNT])):
            along = x * vertices[k, 0] + y * vertices[k, 1] + z * vertices[k, 2]
            if along > best:
                best, at = along, k
        x, y, z = vertices[at, 0], vertices[at, 1], vertices[at, 2]
    return (
        pose[0] + pose[3] * x + pose[4] * y + pose[5] * z,
        pose[1] + pose[6] * x + pose[7] * y + pose[8] * z,
        pose[2] + pose[9] * x + pose[10] * y + pose[11] * z,
    )


@njit(cache=True, error_model="numpy")
def separation(enough, a, pose_a, b, pose_b, vertices, work):
    """Return two bodies' distance, m (0 or less: overlap), or a lower bound of it that exceeds `enough` m."""
    around = a[RADIUS] + b[RADIUS]
    if a[KIND] <= SEGMENT and b[KIND] <= SEGMENT:
        return np.sqrt(_segments(a, pose_a, b, pose_b)) - around
    s = work[:4]
    s[0, 0], s[0, 1], s[0, 2] = pose_a[0] - pose_b[0], pose_a[1] - pose_b[1], pose_a[2] - pose_b[2]
    x, y, z, count = s[0, 0], s[0, 1], s[0, 2], 0
    for _ in range(ITERATIONS):
        far = np.sqrt(x * x + y * y + z * z)  # upper bound: the point lies in the Minkowski difference
        if far <= CLOSE:
            return -around
        ax, ay, az = support_point(a, vertices, pose_a, -x, -y, -z)
        bx, by, bz = support_point(b, vertices, pose_b, x, y, z)
        px, py, pz = ax - bx, ay - by, az - bz
        least = (x * px + y * py + z * pz) / far  # lower bound
        if least > enough + around or far - least < CLOSE:
            return least - around
        s[count, 0], s[count, 1], s[count, 2] = px, py, pz
        count += 1
        x, y, z, count = _nearest(s, count, work[4:])
        if count == 4:
            return -around
    return far - around


@njit(cache=True, error_model="numpy")
def _segments(a, p, b, r):
    """Return the squared distance, m^2, of two cores, each a segment or a point."""
    la = a[SIZE + 2] if a[KIND] == SEGMENT else 0.0
    lb = b[SIZE + 2] if b[KIND] == SEGMENT else 0.0
    x, y, z = p[0] - r[0], p[1] - r[1], p[2] - r[2]
    along = p[5] * r[5] + p[8] * r[8] + p[11] * r[11]
    c, f = p[5] * x + p[8] * y + p[11] * z, r[5] * x + r[8] * y + r[11] * z
    straight = 1.0 - along * along
    s = (along * f - c) / straight if straight > 1e-12 else 0.0
    s = min(max(s, -la), la)
    t = min(max(along * s + f, -lb), lb)
    s = min(max(along * t - c, -la), la)
    x, y, z = x + s * p[5] - t * r[5], y + s * p[8] - t * r[8], z + s * p[11] - t * r[11]
    return x * x + y * y + z * z


@njit(cache=True, error_model="numpy")
def _nearest(s, count, t):
    """Return the simplex point x, y, z nearest to the origin, and the number of corners that span this point.

    The number of corners is 4 if the origin is inside the simplex. s: (4, 3) m, whose first `count` rows are the
    simplex corners; `_nearest` moves the spanning corners to the front. t: scratch.
    """
    if count == 1:
        return s[0, 0], s[0, 1], s[0, 2], 1
    if count == 2:
        return _on_edge(s)
    best, x, y, z, kept = np.inf, 0.0, 0.0, 0.0, 4
    for face in range(4 if count == 4 else 1):  # a loop with one call of _on_triangle halves the compile time
        i, j, k = (face, face + 1, face + 2) if face < 2 else (0, face, 3 if face == 2 else 1)
        if count == 4:
            nx, ny, nz = _normal(s[i], s[j], s[k])
            m = 6 - i - j - k
            inner = nx * (s[m, 0] - s[i, 0]) + ny * (s[m, 1] - s[i, 1]) + nz * (s[m, 2] - s[i, 2])
            if inner * -(nx * s[i, 0] + ny * s[i, 1] + nz * s[i, 2]) > 0:
                continue
        _copy(t, 0, s, i)
        _copy(t, 1, s, j)
        _copy(t, 2, s, k)
        fx, fy, fz, n = _on_triangle(t)
        square = fx * fx + fy * fy + fz * fz
        if square < best:
            best, x, y, z, kept = square, fx, fy, fz, n
            for m in range(3):
                _copy(t, 3 + m, t, m)
    for m in range(3 if kept < 4 else 0):
        _copy(s, m, t, 3 + m)
    return x, y, z, kept


@njit(cache=True, error_model="numpy")
def _copy(to, i, s, k):
    to[i, 0], to[i, 1], to[i, 2] = s[k, 0], s[k, 1], s[k, 2]


@njit(cache=True, error_model="numpy")
def _normal(a, b, c):
    ux, uy, uz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    vx, vy, vz = c[0] - a[0], c[1] - a[1], c[2] - a[2]
    return uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx


@njit(cache=True, error_model="numpy")
def _on_edge(s):
    ux, uy, uz = s[1, 0] - s[0, 0], s[1, 1] - s[0, 1], s[1, 2] - s[0, 2]
    along = -(s[0, 0] * ux + s[0, 1] * uy + s[0, 2] * uz)
    square = ux * ux + uy * uy + uz * uz
    if along <= 0.0 or square == 0.0:
        return s[0, 0], s[0, 1], s[0, 2], 1
    if along >= square:
        _copy(s, 0, s, 1)
        return s[0, 0], s[0, 1], s[0, 2], 1
    share = along / square
    return s[0, 0] + share * ux, s[0, 1] + share * uy, s[0, 2] + share * uz, 2


@njit(cache=True, error_model="numpy")
def _on_triangle(s):
    a, b, c = s[0], s[1], s[2]
    ux, uy, uz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    vx, vy, vz = c[0] - a[0], c[1] - a[1], c[2] - a[2]
    ua, va = -(ux * a[0] + uy * a[1] + uz * a[2]), -(vx * a[0] + vy * a[1] + vz * a[2])
    ub, vb = -(ux * b[0] + uy * b[1] + uz * b[2]), -(vx * b[0] + vy * b[1] + vz * b[2])
    uc, vc = -(ux * c[0] + uy * c[1] + uz * c[2]), -(vx * c[0] + vy * c[1] + vz * c[2])
    if ua <= 0 and va <= 0:
        return a[0], a[1], a[2], 1
    if ub >= 0 and vb <= ub:
        _copy(s, 0, s, 1)
        return b[0], b[1], b[2], 1
    if vc >= 0 and uc <= vc:
        _copy(s, 0, s, 2)
        return c[0], c[1], c[2], 1
    wa, wb, wc = ub * vc - uc * vb, uc * va - ua * vc, ua * vb - ub * va
    if wc <= 0 and ua >= 0 and ub <= 0:
        return _on_edge(s)
    other = wb <= 0 and va >= 0 and vc <= 0
    if other or (wa <= 0 and vb - ub >= 0 and uc - vc >= 0):
        _copy(s, 1 if other else 0, s, 2)
        return _on_edge(s)
    share = 1.0 / (wa + wb + wc)
    p, q = wb * share, wc * share  # coordinates along the edges a b and a c
    return a[0] + p * ux + q * vx, a[1] + p * uy + q * vy, a[2] + p * uz + q * vz, 3
