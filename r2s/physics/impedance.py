"""Functions for the compiled impedance laws (impedance_laws.py), and layout of the laws' parameters and memory.

    tau = J^T (K e) - D (dq - dq_r) + N^T K_n (q_home - q) + feedforward

This Cartesian law contains the task error e, the Jacobian J, the task stiffness K, and the null-space stiffness K_n.
The damping D = 2 zeta (M # K_q) gives every mode the damping ratio zeta. The mass matrix M and the joint stiffness
K_q = J^T K J + N^T K_n N have the geometric mean M # K_q = M (M^-1 K_q)^(1/2). The double diagonalization of
Albu-Schaeffer and others (ICRA 2003) yields the same damping D from eigenvectors. The null-space projector N is
dynamically consistent (Khatib, IEEE Journal of Robotics and Automation 1987). Every spring force has a potential,
even if clipped. An energy tank (Ferraguti et al., ICRA 2013) must supply the energy that a rise of stiffness adds to
the springs; damping refills the tank. The tank ignores the work of moving targets and of the null-space spring
(Dietrich et al., RA-L 2016). The feedforward cancels friction and the errors of gravity compensation. The feedforward
contains bristle friction at the measured angle, or other friction at the reference speed dq_r. A feedforward above
the true friction would accelerate the arm. A feedforward that cancels a bristle stiffness k after a delay d adds
damping k sin(w d) / w > 0 at frequencies w < pi / d.
"""

import numpy as np

from r2s.compiled import njit
from r2s.physics.kinematics import POSE, pose_axes, write_pose
from r2s.physics.newton_euler import (
    COM,
    LINK,
    MASS,
    base_tensor,
    joint_frame,
    rotate,
)

# Parameters: cycles between two updates of D and N, 2 zeta, spring energies J at which force and moment saturate,
# initial level and capacity of the tank J, cycle s. Then indices in the command (-1: none), size of the target,
# number of task axes (3 or 6), whether the law is hybrid, rate of the integrals 1/s, largest force and integral N.
# APPROACH: if above 0, the spring to the target bounds the normal force of hybrid control. 1: dq_r affects only the
# friction feedforward. SLIDES: the target moves on a surface whose slope the law estimates.
HOLD, RATIO, FORCE_LIMIT, MOMENT_LIMIT, FILL, TANK, CYCLE_S = range(7)
DISPLACED, STIFFNESS_AT, TARGET_AT, TARGET_SIZE, TASK_AXES, HYBRID, RATE, FORCE_MAX, INTEGRAL_MAX = range(7, 16)
K_DEFAULT, K_LOW, K_HIGH = 16, 20, 24  # 4 each: x, y, z N/m and rotation Nm/rad
TIP, HOME_AXES, GRAVITY = 28, 31, 40  # tip m in the last link, axes of this link in the home posture, gravity m/s^2
APPROACH, HEAD = 43, 44
SLIDES = 2  # a value of APPROACH
# From HEAD on, one row per joint: row of `links_of`, rotor inertia, errors of mass and first moment, offset, drag,
# friction at NODES speeds per direction, null-space or joint stiffness and its bounds, energy J at which this spring
# saturates, home, presliding distance rad (0: no bristles), breakaway Nm (-, +), load-dependent friction Nm/Nm
ROTOR, MASS_ERROR, MOMENT_ERROR, OFFSET, DRAG, FRICTION = 28, 29, 30, 33, 34, 36
K_JOINT, JOINT_LIMIT, HOME, PRESLIDING, EDGES, LOAD, ROW = 44, 47, 48, 49, 50, 52, 53
# Memory: cycles since the update, whether a motion has begun, level of the tank J, integral N; for a sliding tip,
# integrals N along the path and sideways (2), and slope of the surface (3); stiffnesses. Then ROWS rows (n,): dq_r,
# last damping torque, last q, low-pass filtered q, filtered q at the last update of the bristles, bristle deflection
# in [-1, 1]. Then the matrices D and N^T.
SINCE, BEGUN, LEVEL, INTEGRAL, ACROSS, SLOPE, STIFFNESS = 0, 1, 2, 3, 4, 6, 9
DAMPED, BEFORE, MEAN, ANCHOR, DEFLECTION, ROWS = 1, 2, 3, 4, 5, 6
SPRINGS = 4  # number of stiffnesses in the task's axes
ROUNDS = 14  # iterations of the geometric mean: enough if squared frequencies differ by a factor of 1e4
FREE = 1.0  # rad/s, frequency that sets the damping of modes without a spring
NODES, FIRST_DQ = 4, 0.02  # rad/s, speeds of the friction table: FIRST_DQ 4^k; the first is twice REST_DQ
# SETTLE_S: s, lag of the low-pass on the angles for friction; reduces a Panda's encoder noise, 1.4e-5 rad, to a
# third. STEP: the law updates the bristles after a motion of STEP times the presliding distance, but at least ENCODER
# rad. ENCODER is 10 times the reduced noise.
SETTLE_S, STEP, ENCODER = 5e-3, 0.1, 5e-5
# rad/s. REST_DQ: speed below which a joint may be at rest, 3.5 times the noise of (q - MEAN) / SETTLE_S.
# DIRECTION_DQ: reference speed over which the friction feedforward changes sign; in press.py on twins 0 and 1, values
# from 0.003 to 0.01 perform equally
REST_DQ, DIRECTION_DQ = 0.01, 0.003
# SLOPE_RATE: 1/s, rate of the slope estimate, which settles while a path accelerates (`ramp_s` of 0.4 s). SLIDING:
# m/s, speed below which the estimate adapts more slowly. SLIDING is 5 times the noise of the tip speed, due to 3e-3
# rad/s (Panda) in 7 joints at levers of 0.5 m.
SLOPE_RATE, SLIDING = 10.0, 0.02
SMALLEST = 0.01  # the law halves a requested rise of stiffness down to about this share, then omits the rise
MOBILITY = 1e-3  # 1/kg, 1/(kg m^2): directions with less mobility, near a singularity, are treated as blocked


@njit(cache=True, error_model="numpy")
def arm_pose(q, parameters, frames, jacobian, place):
    """Write link poses (n, POSE), the tip's Jacobian (6, n; first translation, then rotation) and position (3,) m."""
    n = len(q)
    R = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
    x, y, z = 0.0, 0.0, 0.0
    for i in range(n):
        (dx, dy, dz), (a, b, c), R = joint_frame(R, parameters[HEAD + i * ROW : HEAD + i * ROW + LINK], q[i])
        x, y, z = x + dx, y + dy, z + dz
        jacobian[3, i], jacobian[4, i], jacobian[5, i] = a, b, c
        write_pose(frames[i], x, y, z, R)
    dx, dy, dz = rotate(R, parameters[TIP], parameters[TIP + 1], parameters[TIP + 2])
    place[0], place[1], place[2] = x + dx, y + dy, z + dz
    for i in range(n):
        x, y, z = place[0] - frames[i, 0], place[1] - frames[i, 1], place[2] - frames[i, 2]
        a, b, c = jacobian[3, i], jacobian[4, i], jacobian[5, i]
        jacobian[0, i], jacobian[1, i], jacobian[2, i] = b * z - c * y, c * x - a * z, a * y - b * x


@njit(cache=True, error_model="numpy")
def arm_tips(q, parameters):
    """Return tip positions (m, 3) m and translational Jacobians (m, 3, n) m/rad of m postures q (m, n) rad.

    parameters: parameters of an impedance law, which also describe the links and the tip.
    """
    m, n = q.shape
    places, out = np.empty((m, 3)), np.empty((m, 3, n))
    frames, jacobian = np.empty((n, POSE)), np.empty((6, n))
    for i in range(m):
        arm_pose(q[i], parameters, frames, jacobian, places[i])
        out[i] = jacobian[:3]
    return places, out


@njit(cache=True, error_model="numpy")
def mass_matrix(parameters, frames, jacobian, mass):
    """Write the mass matrix (n, n) kg m^2: rotor inertias, plus m J_v^T J_v + J_w^T I J_w of each link."""
    n = len(frames)
    moved = np.empty((n, 3))
    for i in range(n):
        for j in range(n):
            mass[i, j] = parameters[HEAD + i * ROW + ROTOR] if i == j else 0.0
    for k in range(n):
        link = parameters[HEAD + k * ROW : HEAD + k * ROW + LINK]
        R, m = pose_axes(frames[k]), link[MASS]
        x, y, z = rotate(R, link[COM], link[COM + 1], link[COM + 2])
        x, y, z = x + frames[k, 0], y + frames[k, 1], z + frames[k, 2]
        xx, xy, xz, yy, yz, zz = base_tensor(R, link)
        for i in range(k + 1):
            a, b, c = jacobian[3, i], jacobian[4, i], jacobian[5, i]
            u, v, w = x - frames[i, 0], y - frames[i, 1], z - frames[i, 2]
            moved[i, 0], moved[i, 1], moved[i, 2] = b * w - c * v, c * u - a * w, a * v - b * u
            u, v, w = xx * a + xy * b + xz * c, xy * a + yy * b + yz * c, xz * a + yz * b + zz * c
            for j in range(i + 1):
                moment = u * jacobian[3, j] + v * jacobian[4, j] + w * jacobian[5, j]
                force = moved[i, 0] * moved[j, 0] + moved[i, 1] * moved[j, 1] + moved[i, 2] * moved[j, 2]
                mass[i, j] += m * force + moment
                mass[j, i] = mass[i, j]


@njit(cache=True, error_model="numpy")
def invert(matrix, n):
    """Replace a symmetric positive definite matrix (n, n) by its inverse, with Gauss-Jordan elimination."""
    for k in range(n):
        pivot = 1.0 / matrix[k, k]
        matrix[k, k] = 1.0
        for j in range(n):
            matrix[k, j] *= pivot
        for i in range(n):
            if i != k:
                factor = matrix[i, k]
                matrix[i, k] = 0.0
                for j in range(n):
                    matrix[i, j] -= factor * matrix[k, j]


@njit(cache=True, error_model="numpy")
def geometric_mean(K, mobility, out):
    """Write the geometric mean K # M = M (M^-1 K)^(1/2), (n, n), of positive definite matrices; mobility: M^-1.

    From P = K and Q = M^-1, iterate P <- (P + Q^-1) / 2, Q <- (Q + P^-1) / 2. This is the iteration of Denman and
    Beavers (Higham, Functions of Matrices, 2008, eq. 6.28) with iterates multiplied by M or M^-1, so that P and Q
    stay symmetric.
    """
    n = len(K)
    scale = 0.0  # mean squared frequency
    for i in range(n):
        for j in range(n):
            scale += K[i, j] * mobility[j, i] / n
    Q, P_inverse, Q_inverse = mobility.copy(), np.empty((n, n)), np.empty((n, n))
    for i in range(n):
        for j in range(n):
            out[i, j] = K[i, j] / scale
    for _ in range(ROUNDS):
        P_inverse[:, :] = out
        Q_inverse[:, :] = Q
        invert(P_inverse, n)
        invert(Q_inverse, n)
        for i in range(n):
            for j in range(n):
                out[i, j] = 0.5 * (out[i, j] + Q_inverse[i, j])
                Q[i, j] = 0.5 * (Q[i, j] + P_inverse[i, j])
    root = np.sqrt(scale)
    for i in range(n):
        for j in range(n):
            out[i, j] *= root


@njit(cache=True, error_model="numpy")
def spring(s, limit):
    """Return a saturating spring's energy U, J, and the factor on the linear force K e; s: J, linear spring's energy.

    The energy U is s for s <= limit, else 2 sqrt(s limit) - limit. The linear spring has the energy s = e^T K e / 2.
    U depends on the error e only through s, so U is a potential of the force for every K. U rises with K. The force
    is at most sqrt(2 K limit). If limit is clip^2 / (2 K_high), the force is at most `clip` for every K up to K_high.
    """
    if s <= limit:
        return s, 1.0
    factor = np.sqrt(limit / s)
    return 2.0 * factor * s - limit, factor


@njit(cache=True, error_model="numpy")
def task_energy(K, error, tilt, parameters):
    """Return the energy, J, of springs K (4,) at a position error (3,) m; tilt: 1 - cos(rotation error)."""
    s = 0.5 * (K[0] * error[0] ** 2 + K[1] * error[1] ** 2 + K[2] * error[2] ** 2)
    return spring(s, parameters[FORCE_LIMIT])[0] + spring(K[3] * tilt, parameters[MOMENT_LIMIT])[0]


@njit(cache=True, error_model="numpy")
def refill(q, n, parameters, memory, at):
    """Add to the tank the energy, J, that damping dissipated since the last cycle; at: index of dq_r in `memory`."""
    if memory[BEGUN] == 0.0:
        memory[BEGUN], memory[LEVEL] = 1.0, parameters[FILL]
        for j in range(n):
            memory[at + MEAN * n + j], memory[at + ANCHOR * n + j] = q[j], q[j]
    else:
        for j in range(n):
            follows = 0.0 if parameters[APPROACH] == 1.0 else memory[at + j]
            moved = q[j] - memory[at + BEFORE * n + j] - follows * parameters[CYCLE_S]
            memory[LEVEL] -= memory[at + DAMPED * n + j] * moved
    memory[LEVEL] = min(max(memory[LEVEL], 0.0), parameters[TANK])


@njit(cache=True, error_model="numpy")
def friction_at(v, row, load):
    """Return a joint's friction, Nm, at v rad/s, including load-dependent friction of `load` Nm.

    `row` contains friction at the speeds FIRST_DQ 4^k; `friction_at` interpolates and extrapolates linearly.
    """
    side, k = FRICTION if v >= 0.0 else FRICTION + NODES, 0
    sign = 1.0 if v >= 0.0 else -1.0
    low, level, high, top = 0.0, 0.0, FIRST_DQ, row[side] + sign * load
    while abs(v) > high and k < NODES - 1:
        k += 1
        low, level, high, top = high, top, 4.0 * high, row[side + k] + sign * load
    return level + (top - level) * (abs(v) - low) / (high - low)


@njit(cache=True, error_model="numpy")
def friction_ahead(v, q, j, load, parameters, memory, at):
    """Return the friction feedforward, Nm, of joint j at q rad; v: reference speed of the joint, rad/s.

    With bristles, the feedforward is the bristle deflection z times the smaller of the friction magnitudes at
    reference speed and measured speed. The measured joint motion drives the deflection: dz/dt = (dq - |dq| z) /
    presliding (Dahl 1968). Without bristles and with APPROACH = 1, the feedforward is the friction at v. Without
    bristles and with another APPROACH, the feedforward has the sign of v. On a joint at rest, its magnitude is at
    least the breakaway torque for |v| >> DIRECTION_DQ. load: Nm, load-dependent friction. at: index of dq_r in
    `memory`.
    """
    row, n = parameters[HEAD + j * ROW : HEAD + (j + 1) * ROW], (len(parameters) - HEAD) // ROW
    mean, anchor, deflection = at + MEAN * n + j, at + ANCHOR * n + j, at + DEFLECTION * n + j
    speed, distance = (q - memory[mean]) / SETTLE_S, row[PRESLIDING]
    memory[mean] += parameters[CYCLE_S] * speed
    moved, fast = memory[mean] - memory[anchor], max(abs(v), FIRST_DQ)
    if distance > 0.0:
        if abs(moved) > max(STEP * distance, ENCODER):
            side = 1.0 if moved > 0.0 else -1.0
            memory[deflection] = side + (memory[deflection] - side) * np.exp(-abs(moved) / distance)
            memory[anchor] = memory[mean]
        z, now = memory[deflection], max(abs(speed), FIRST_DQ)
        side = 1.0 if z >= 0.0 else -1.0
        return z * min(abs(friction_at(side * fast, row, load)), abs(friction_at(side * now, row, load)))
    if parameters[APPROACH] == 1.0:
        return friction_at(v, row, load)
    level = abs(friction_at(fast if v >= 0.0 else -fast, row, load))
    beyond = max(abs(row[EDGES + 1] if v >= 0.0 else row[EDGES]) - level, 0.0)
    return (level + beyond * max(1.0 - abs(speed) / REST_DQ, 0.0)) * np.tanh(v / DIRECTION_DQ)


@njit(cache=True, error_model="numpy")
def weight_about(j, mass, x, y, z, parameters, frames, jacobian):
    """Return the gravity torque, Nm, about joint j, of a body with mass `mass` kg and first moment x, y, z kg m."""
    x, y, z = x - mass * frames[j, 0], y - mass * frames[j, 1], z - mass * frames[j, 2]
    a, b, c = parameters[GRAVITY], parameters[GRAVITY + 1], parameters[GRAVITY + 2]
    a, b, c = y * c - z * b, z * a - x * c, x * b - y * a
    return jacobian[3, j] * a + jacobian[4, j] * b + jacobian[5, j] * c


@njit(cache=True, error_model="numpy")
def feedforward(q, parameters, frames, jacobian, memory, at, out):
    """Add to `out` the torques that compensate friction, offset, drag, and errors of gravity compensation.

    at: index of dq_r in `memory`.
    """
    n = len(q)
    m, x, y, z = 0.0, 0.0, 0.0, 0.0  # sums over all links beyond a joint: errors of mass and first moment
    M, X, Y, Z = 0.0, 0.0, 0.0, 0.0  # sums over these links: mass and first moment
    for j in range(n - 1, -1, -1):
        row, R = parameters[HEAD + j * ROW : HEAD + (j + 1) * ROW], pose_axes(frames[j])
        u, v, w = rotate(R, row[MOMENT_ERROR], row[MOMENT_ERROR + 1], row[MOMENT_ERROR + 2])
        e = row[MASS_ERROR]
        m, x, y, z = m + e, x + u + e * frames[j, 0], y + v + e * frames[j, 1], z + w + e * frames[j, 2]
        u, v, w = rotate(R, row[COM], row[COM + 1], row[COM + 2])
        e = row[MASS]
        M, X, Y, Z = M + e, X + e * (u + frames[j, 0]), Y + e * (v + frames[j, 1]), Z + e * (w + frames[j, 2])
        load = row[LOAD] * abs(weight_about(j, M, X, Y, Z, parameters, frames, jacobian))
        out[j] -= weight_about(j, m, x, y, z, parameters, frames, jacobian)
        out[j] -= row[OFFSET] + row[DRAG] * np.sin(q[j]) + row[DRAG + 1] * np.cos(q[j])
        out[j] += friction_ahead(memory[at + j], q[j], j, load, parameters, memory, at)
