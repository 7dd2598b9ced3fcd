"""Compiled control laws for `control=joint_impedance`, `cartesian_impedance` and `hybrid`."""

import numpy as np

from r2s.compiled import njit
from r2s.physics.impedance import (
    ACROSS,
    APPROACH,
    BEFORE,
    BEGUN,
    CYCLE_S,
    DAMPED,
    DISPLACED,
    FORCE_LIMIT,
    FORCE_MAX,
    FREE,
    HEAD,
    HOLD,
    HOME,
    HOME_AXES,
    HYBRID,
    INTEGRAL,
    INTEGRAL_MAX,
    JOINT_LIMIT,
    K_DEFAULT,
    K_HIGH,
    K_JOINT,
    K_LOW,
    LEVEL,
    MOBILITY,
    MOMENT_LIMIT,
    RATE,
    RATIO,
    ROW,
    ROWS,
    SINCE,
    SLIDES,
    SLIDING,
    SLOPE,
    SLOPE_RATE,
    SMALLEST,
    SPRINGS,
    STIFFNESS,
    STIFFNESS_AT,
    TANK,
    TARGET_AT,
    TARGET_SIZE,
    TASK_AXES,
    arm_pose,
    feedforward,
    geometric_mean,
    invert,
    mass_matrix,
    refill,
    spring,
    task_energy,
)
from r2s.physics.kinematics import POSE, pose_axes
from r2s.physics.newton_euler import product, rotate_about


@njit(cache=True, error_model="numpy")
def joint_impedance_law(q, dq, command, parameters, memory, out):
    """Write the torque of `control=joint_impedance`: K (q_t - q) - D (dq - dq_r) + feedforward.

    The command contains the action's optional displacement q_t - q_r (n) rad and stiffness (n) Nm/rad, then the
    task's trajectory q_r (n) rad and dq_r (n) rad/s. Without a trajectory, q_r is the home posture and dq_r is 0.
    """
    n, begins = len(q), memory[BEGUN] == 0.0
    K, at = memory[STIFFNESS : STIFFNESS + n], STIFFNESS + n
    refill(q, n, parameters, memory, at)
    shift, stiff, target = int(parameters[DISPLACED]), int(parameters[STIFFNESS_AT]), int(parameters[TARGET_AT])
    error, asked = np.empty(n), np.empty(n)
    for j in range(n):
        row = parameters[HEAD + j * ROW : HEAD + (j + 1) * ROW]
        error[j] = (command[target + j] if target >= 0 else row[HOME]) - q[j]
        error[j] += command[shift + j] if shift >= 0 else 0.0
        memory[at + j] = command[target + n + j] if target >= 0 else 0.0
        asked[j] = row[K_JOINT]
        if stiff >= 0:
            asked[j] = min(max(command[stiff + j], row[K_JOINT + 1]), row[K_JOINT + 2])
        K[j] = asked[j] if begins else K[j]
    share, pays = 1.0, False
    while not pays:  # halve a rise of stiffness until the tank can supply the energy; a decrease needs no energy
        raised = 0.0
        for j in range(n):
            out[j] = asked[j] if asked[j] <= K[j] else K[j] + share * (asked[j] - K[j])
            s, limit = 0.5 * error[j] ** 2, parameters[HEAD + j * ROW + JOINT_LIMIT]
            raised += spring(s * out[j], limit)[0] - spring(s * K[j], limit)[0]
        pays = raised <= memory[LEVEL] or share == 0.0
        share = 0.5 * share if share > SMALLEST else 0.0
    memory[LEVEL] = min(memory[LEVEL] - raised, parameters[TANK])
    frames, jacobian, place = np.empty((n, POSE)), np.empty((6, n)), np.empty(3)
    arm_pose(q, parameters, frames, jacobian, place)
    D = memory[at + ROWS * n : at + ROWS * n + n * n].reshape((n, n))
    if memory[SINCE] == 0.0:
        mobility, joint_K = np.empty((n, n)), np.zeros((n, n))
        mass_matrix(parameters, frames, jacobian, mobility)
        invert(mobility, n)
        for j in range(n):
            joint_K[j, j] = out[j]
        geometric_mean(joint_K, mobility, D)
    for j in range(n):
        K[j], damping = out[j], 0.0
        for k in range(n):
            damping -= parameters[RATIO] * D[j, k] * (dq[k] - memory[at + k])
        s = 0.5 * K[j] * error[j] ** 2
        out[j] = K[j] * error[j] * spring(s, parameters[HEAD + j * ROW + JOINT_LIMIT])[1] + damping
        memory[at + DAMPED * n + j], memory[at + BEFORE * n + j] = damping, q[j]
    feedforward(q, parameters, frames, jacobian, memory, at, out)
    memory[SINCE] = (memory[SINCE] + 1.0) % parameters[HOLD]


@njit(cache=True, error_model="numpy")
def task_stiffness(command, error, tilt, begins, parameters, memory):
    """Set the stiffness (4,) in `memory` to the requested value; the energy in the tank limits a rise."""
    K, asked, new = memory[STIFFNESS : STIFFNESS + SPRINGS], np.empty(SPRINGS), np.empty(SPRINGS)
    at, given = int(parameters[STIFFNESS_AT]), 4 if parameters[TASK_AXES] == 6.0 else 3
    for k in range(SPRINGS):
        asked[k] = parameters[K_DEFAULT + k]
        if at >= 0 and k < given:
            asked[k] = min(max(command[at + k], parameters[K_LOW + k]), parameters[K_HIGH + k])
        K[k] = asked[k] if begins else K[k]
    before, share, pays = task_energy(K, error, tilt, parameters), 1.0, False
    while not pays:  # halve a rise of stiffness until the tank can supply the energy; a decrease needs no energy
        for k in range(SPRINGS):
            new[k] = asked[k] if asked[k] <= K[k] else K[k] + share * (asked[k] - K[k])
        raised = task_energy(new, error, tilt, parameters) - before
        pays = raised <= memory[LEVEL] or share == 0.0
        share = 0.5 * share if share > SMALLEST else 0.0
    memory[LEVEL] = min(memory[LEVEL] - raised, parameters[TANK])
    for k in range(SPRINGS):
        K[k] = new[k]


@njit(cache=True, error_model="numpy")
def rotation_error(R, command, parameters, error):
    """Write the rotation error (3,), axis * sine of the angle to the target; return 1 - cosine of this angle.

    The sum of the action's and the task's rotation vectors rotates the home orientation to the target orientation.
    Luh, Walker and Paul define the rotation error (IEEE TAC 1980, eq. 22).
    """
    x, y, z = 0.0, 0.0, 0.0
    if parameters[DISPLACED] >= 0.0:
        at = int(parameters[DISPLACED]) + 3
        x, y, z = command[at], command[at + 1], command[at + 2]
    if parameters[TARGET_SIZE] >= 9.0:
        at = int(parameters[TARGET_AT]) + 6
        x, y, z = x + command[at], y + command[at + 1], z + command[at + 2]
    angle = np.sqrt(x * x + y * y + z * z)
    w = 1.0 / angle if angle > 0.0 else 0.0
    T = rotate_about((1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0), x * w, y * w, z * w, angle)
    T = product(T, parameters, HOME_AXES)
    error[0], error[1], error[2] = 0.0, 0.0, 0.0
    trace = 0.0
    for k in range(3):  # columns
        a, b, c, u, v, w = R[k], R[3 + k], R[6 + k], T[k], T[3 + k], T[6 + k]
        error[0] += 0.5 * (b * w - c * v)
        error[1] += 0.5 * (c * u - a * w)
        error[2] += 0.5 * (a * v - b * u)
        trace += a * u + b * v + c * w
    return max(0.5 * (3.0 - trace), 0.0)


@njit(cache=True, error_model="numpy")
def update(velocity, parameters, frames, jacobian, memory):
    """Update damping D, projector N^T (n, n) and dq_r (n,) rad/s in `memory`; velocity: (3,) m/s, target velocity."""
    n, a, at = len(frames), int(parameters[TASK_AXES]), STIFFNESS + SPRINGS
    K = memory[STIFFNESS : STIFFNESS + SPRINGS]
    D = memory[at + ROWS * n : at + ROWS * n + n * n].reshape((n, n))
    N = memory[at + ROWS * n + n * n : at + ROWS * n + 2 * n * n].reshape((n, n))
    mass, mobility, W, G = np.empty((n, n)), np.empty((n, n)), np.empty((a, a)), np.empty((a, n))
    mass_matrix(parameters, frames, jacobian, mass)
    mobility[:, :] = mass
    invert(mobility, n)
    for i in range(a):  # W = J M^-1 J^T, then G = W^-1 J M^-1
        for j in range(n):
            N[0, j] = 0.0
            for k in range(n):
                N[0, j] += jacobian[i, k] * mobility[k, j]
        for k in range(a):
            W[i, k] = MOBILITY if i == k else 0.0
            for j in range(n):
                W[i, k] += N[0, j] * jacobian[k, j]
    invert(W, a)
    for i in range(a):
        for j in range(n):
            G[i, j] = 0.0
            for k in range(n):
                along = 0.0
                for c in range(a):
                    along += W[i, c] * jacobian[c, k]
                G[i, j] += along * mobility[k, j]
    for i in range(n):
        memory[at + i] = G[0, i] * velocity[0] + G[1, i] * velocity[1] + G[2, i] * velocity[2]
        for j in range(n):
            N[i, j] = 1.0 if i == j else 0.0
            for k in range(a):
                N[i, j] -= jacobian[k, i] * G[k, j]
    stiff = mass  # K_q, in place: J^T K J + N^T K_n N + FREE^2 M
    for i in range(n):
        for j in range(i + 1):
            stiff[i, j] *= FREE * FREE
            for k in range(n):
                stiff[i, j] += N[i, k] * parameters[HEAD + k * ROW + K_JOINT] * N[j, k]
            for k in range(a):
                stiff[i, j] += jacobian[k, i] * K[min(k, 3)] * jacobian[k, j]
            stiff[j, i] = stiff[i, j]
    geometric_mean(stiff, mobility, D)


@njit(cache=True, error_model="numpy")
def normal_force(command, shift, parameters, memory):
    """Return the desired tip force, N, against the normal: the reference plus an integral of the force error.

    The command contains the normal (3,), reference and measured force, N, and a flag, above 0 if force is measured.
    The reference includes the stiffness times the action's displacement into the surface. Saturation stops the
    integral.
    """
    at = int(parameters[TARGET_AT]) + int(parameters[TARGET_SIZE])
    asked = command[at + 3]
    if shift >= 0:
        for k in range(3):
            asked -= parameters[K_DEFAULT] * command[at + k] * command[shift + k]
    most, limit = parameters[FORCE_MAX], parameters[INTEGRAL_MAX]
    asked = min(max(asked, 0.0), most)
    if command[at + 5] > 0.0:
        missing = asked - command[at + 4]
        total = asked + memory[INTEGRAL]
        if (missing > 0.0 and total < most) or (missing < 0.0 and total > 0.0):
            memory[INTEGRAL] += parameters[RATE] * parameters[CYCLE_S] * missing
            memory[INTEGRAL] = min(max(memory[INTEGRAL], -limit), limit)
    return min(max(asked + memory[INTEGRAL], 0.0), most)


@njit(cache=True, error_model="numpy")
def slide(normal, error, dq, jacobian, velocity, parameters, memory, aside):
    """Estimate the slope of the surface under a sliding tip; write the force (3,) N that corrects the tip's motion.

    The gradient method (Widrow and Hoff, 1960) fits a slope g so that g . target velocity is the tip's speed along
    the normal. `slide` adds g . target velocity times the normal to `velocity` (3,) m/s. The correcting force
    is the sum of two clamped integrals of the position error, one along the motion, where friction acts, and one
    across the motion.
    """
    up, rises, fast = 0.0, 0.0, SLIDING * SLIDING
    for k in range(3):
        up += velocity[k] * normal[k]
        for j in range(len(dq)):
            rises += normal[k] * jacobian[k, j] * dq[j]
    along = velocity - up * normal
    for k in range(3):
        fast += along[k] * along[k]
        rises -= memory[SLOPE + k] * along[k]
    learns = SLOPE_RATE * parameters[CYCLE_S] * rises / fast
    for k in range(3):
        memory[SLOPE + k] += learns * along[k]
        velocity += memory[SLOPE + k] * along[k] * normal
    along /= np.sqrt(fast)
    side, most = along.copy(), parameters[INTEGRAL_MAX]
    rate = parameters[CYCLE_S] * parameters[RATE] * parameters[K_DEFAULT]
    aside[:] = 0.0
    for i in range(2):
        for k in range(3):
            memory[ACROSS + i] += rate * error[k] * side[k]
        memory[ACROSS + i] = min(max(memory[ACROSS + i], -most), most)
        aside += memory[ACROSS + i] * side
        for k in range(3):
            a, b = (k + 1) % 3, (k + 2) % 3
            side[k] = normal[a] * along[b] - normal[b] * along[a]


@njit(cache=True, error_model="numpy")
def cartesian_impedance_law(q, dq, command, parameters, memory, out):
    """Write the torque of `control=cartesian_impedance` or, with a force along the normal, of `control=hybrid`.

    The command begins with the optional action: target displacement (3) m and, for six axes, (3) rad; stiffness (3)
    N/m and, for six axes, (1) Nm/rad. The task's target follows the action: position (3) m, optionally velocity (3)
    m/s and rotation vector from home (3) rad. For hybrid control, the entries that `normal_force` describes follow
    the target. If APPROACH > 0, the normal force is at most the stiffness times the depth of the target below the
    tip. If APPROACH is SLIDES, the target is valid for the middle of the control period, and the command ends with a
    feedforward force (3) N.
    """
    n, begins, a, at = len(q), memory[BEGUN] == 0.0, int(parameters[TASK_AXES]), STIFFNESS + SPRINGS
    frames, jacobian, place, velocity = np.empty((n, POSE)), np.empty((6, n)), np.empty(3), np.zeros(3)
    arm_pose(q, parameters, frames, jacobian, place)
    refill(q, n, parameters, memory, at)
    shift, target, error, wrench = int(parameters[DISPLACED]), int(parameters[TARGET_AT]), np.empty(3), np.zeros(6)
    aside = np.zeros(3)
    for k in range(3):
        error[k] = command[target + k] - place[k] + (command[shift + k] if shift >= 0 else 0.0)
    normal, along, slides = target + int(parameters[TARGET_SIZE]), 0.0, parameters[APPROACH] == SLIDES
    if parameters[TARGET_SIZE] >= 6.0:
        velocity[:] = command[target + 3 : target + 6]
    if slides:  # the target of a sliding tip moves within a control period
        error += parameters[CYCLE_S] * (memory[SINCE] - 0.5 * parameters[HOLD]) * velocity
    if parameters[HYBRID] > 0.0:
        along = error[0] * command[normal] + error[1] * command[normal + 1] + error[2] * command[normal + 2]
        for k in range(3):
            error[k] -= along * command[normal + k]
    if slides:
        slide(command[normal : normal + 3], error, dq, jacobian, velocity, parameters, memory, aside)
    tilt = rotation_error(pose_axes(frames[n - 1]), command, parameters, wrench[3:]) if a == 6 else 0.0
    task_stiffness(command, error, tilt, begins, parameters, memory)
    K = memory[STIFFNESS : STIFFNESS + SPRINGS]
    s = 0.5 * (K[0] * error[0] ** 2 + K[1] * error[1] ** 2 + K[2] * error[2] ** 2)
    force, moment = spring(s, parameters[FORCE_LIMIT])[1], spring(K[3] * tilt, parameters[MOMENT_LIMIT])[1]
    for k in range(3):
        wrench[k] = force * K[k] * error[k]
        wrench[3 + k] *= moment * K[3]
    if parameters[HYBRID] > 0.0:
        push = normal_force(command, shift, parameters, memory)
        if parameters[APPROACH] > 0.0:
            push = min(push, max(-parameters[K_DEFAULT] * along, 0.0))
        along = wrench[0] * command[normal] + wrench[1] * command[normal + 1] + wrench[2] * command[normal + 2]
        along += push
        for k in range(3):
            wrench[k] -= along * command[normal + k]
            if slides:
                wrench[k] += command[normal + 6 + k] + aside[k] + push * memory[SLOPE + k]
    if memory[SINCE] == 0.0:
        update(velocity, parameters, frames, jacobian, memory)
    D, N, follows = at + ROWS * n, at + ROWS * n + n * n, 0.0 if parameters[APPROACH] == 1.0 else 1.0
    for j in range(n):
        damping, torque = 0.0, 0.0
        for k in range(n):
            damping -= parameters[RATIO] * memory[D + j * n + k] * (dq[k] - follows * memory[at + k])
            row = HEAD + k * ROW
            torque += memory[N + j * n + k] * parameters[row + K_JOINT] * (parameters[row + HOME] - q[k])
        for k in range(a):
            torque += jacobian[k, j] * wrench[k]
        out[j] = torque + damping
        memory[at + DAMPED * n + j], memory[at + BEFORE * n + j] = damping, q[j]
    feedforward(q, parameters, frames, jacobian, memory, at, out)
    memory[SINCE] = (memory[SINCE] + 1.0) % parameters[HOLD]
