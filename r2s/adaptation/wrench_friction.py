"""Determine, for the wrench filter, which joints rest, and in which direction (side) the other joints slide.

The friction of a joint at rest balances all other torques. The mass matrix M couples joints at rest (r) to joints in
motion (s). With A = M_rs M_ss^-1 and M' = dM/dt, the momentum p_r of the joints at rest changes at the rate dp_r/dt =
A (dp_s/dt - M'_ss dq_s) + M'_rs dq_s. The friction of the joints at rest is f_r = u_r + J_r^T wrench - dp_r/dt, with
the known torque u_r and the Jacobian J_r.
"""

import numpy as np

from r2s.adaptation import tuning
from r2s.adaptation.arm_model import friction_torque
from r2s.adaptation.wrench_state import (
    ANCHOR,
    ANGLE,
    CREEP,
    CYCLE,
    DEFLECTION,
    FAST,
    FRICTION,
    FRICTION_BEFORE,
    KNOWN,
    MOMENTUM_NOISE,
    MOTOR_MEAN,
    MOVED,
    PATH,
    QUIET,
    REST,
    SLOW,
    TORQUE,
)  # fmt: skip
from r2s.compiled import njit
from r2s.physics.newton_euler import equations
from r2s.physics.robot import SIM_DT

MASS_EVERY = 20  # cycles between two computations of the mass matrix


@njit(cache=True, error_model="numpy")
def masses(arm, noise, state, q):
    """Compute the mass matrix, its time derivative, and the variances of the measured momenta."""
    n = len(q)
    mass, before, rest = state.mass, state.mass.copy(), np.zeros(n)
    equations(arm.links, arm.gravity, q, rest, mass, np.empty(n), state.work)
    for j in range(n):
        mass[j, j] += arm.armature[j]
        square = 0.0
        for i in range(n):
            square += mass[j, i] ** 2
            if state.counts[CYCLE] > 0:
                state.mass_rate[j, i] = (mass[j, i] - before[j, i]) / (MASS_EVERY * SIM_DT)
        state.joints[MOMENTUM_NOISE, j] = square * (tuning.MOMENTUM_NOISE * noise.speed) ** 2


@njit(cache=True, error_model="numpy")
def couple(state):
    """Compute the coupling M_rs M_ss^-1 of joints at rest (r) to joints in motion (s); M is the mass matrix."""
    rest, mass = state.joints[REST], state.mass
    state.coupling[:] = 0.0
    sliding, resting = np.flatnonzero(rest == 0.0), np.flatnonzero(rest == 1.0)
    if len(sliding) == 0 or len(resting) == 0:
        return
    own, cross = np.empty((len(sliding), len(sliding))), np.empty((len(sliding), len(resting)))
    for a in range(len(sliding)):
        for b in range(len(sliding)):
            own[a, b] = mass[sliding[a], sliding[b]]
        for b in range(len(resting)):
            cross[a, b] = mass[sliding[a], resting[b]]
    share = np.linalg.solve(own, cross)
    for a in range(len(sliding)):
        for b in range(len(resting)):
            state.coupling[resting[b], sliding[a]] = share[a, b]


@njit(cache=True, error_model="numpy")
def known_torque(arm, noise, state, q):
    """Detect which joints rest; compute, for each joint, the modeled friction and the sum of known torques."""
    joints, terms, x, P = state.joints, state.terms, state.x, state.P
    n = len(q)
    b = len(x) - 2 * n
    for j in range(n):
        rested = joints[REST, j] == 1.0
        _rest_or_motion(noise, joints, j, q[j])
        if joints[REST, j] == 0.0:
            side = joints[CREEP, j]
            now = _unlagged(joints, j)
            if side == 0.0:  # the slow speed has less noise, but changes its sign late
                side = now if abs(now) > tuning.REVERSES * noise.speed else joints[SLOW, j]
            side = 1.0 if side > 0.0 else -1.0
            speed = side * max(side * now, 0.0)
            moved = abs(joints[CREEP, j]) if joints[CREEP, j] != 0.0 else abs(speed) * SIM_DT
            joints[PATH, j] = side * max(side * joints[PATH, j], 0.0) + SIM_DT * joints[SLOW, j]
            model, joints[DEFLECTION, j] = _model(arm, noise, state, j, q[j], side, speed, moved)
            if rested:
                joints[FRICTION_BEFORE, j] = model
                P[b + j, b + j] = noise.friction[j] ** 2
            joints[FRICTION, j] = model
        else:
            if not rested:  # friction at rest follows from the torque balance, without a model error
                x[b + j] = 0.0
                P[b + j] = 0.0
                P[:, b + j] = 0.0
            if noise.presliding[j] > 0.0:  # the angle determines the bristles' deflection
                moved = joints[MOVED, j]
                side = 1.0 if moved > 0.0 else -1.0
                joints[FRICTION, j] = _model(arm, noise, state, j, q[j], side, 0.0, abs(moved))[0]
        torque = arm.offset[j] + arm.drag[j, 0] * np.sin(q[j]) + arm.drag[j, 1] * np.cos(q[j])
        torque += terms.coriolis[j] - terms.uncompensated[j]
        friction = 0.5 * (joints[FRICTION, j] + joints[FRICTION_BEFORE, j])
        joints[KNOWN, j] = joints[MOTOR_MEAN, j] + 0.5 * (torque + joints[TORQUE, j]) - friction
        joints[FRICTION_BEFORE, j], joints[TORQUE, j] = joints[FRICTION, j], torque


@njit(cache=True, error_model="numpy")
def _model(arm, noise, state, j, angle, side, speed, moved):
    """Return joint j's modeled friction (Nm) and bristle deflection (-1 to 1) after a motion by `moved` rad."""
    level = arm.load[j] * abs(state.terms.compensated[j])
    level += arm.angle_friction[j, 0] * np.sin(angle) + arm.angle_friction[j, 1] * np.cos(angle)
    z = side
    if noise.presliding[j] > 0.0:
        z += (state.joints[DEFLECTION, j] - side) * np.exp(-moved / noise.presliding[j])
    slow = tuning.EXCESS_MEAN * excess_friction(noise, j, side, speed)
    return friction_torque(arm.table[j], arm.max_speed[j], speed, z) + level * z + slow, z


@njit(cache=True, error_model="numpy")
def excess_friction(noise, j, side, speed):
    """Return the largest torque (Nm) by which joint j's friction at `speed` (rad/s) may exceed the modeled friction.

    An identification from fast motion may miss the Stribeck effect. If the breakaway torque then exceeds the modeled
    friction, the friction of a slow joint lies between these two values.
    """
    return noise.excess[j, 1 if side > 0.0 else 0] * np.exp(-abs(speed) / noise.excess_speed[j])


@njit(cache=True, error_model="numpy")
def _rest_or_motion(noise, joints, j, q):
    """Detect whether joint j rests.

    A resting joint whose angle has crept by more than the noise becomes a moving joint. A joint that has crept can
    rest again in the next cycle if its speed is low.
    """
    crept, joints[CREEP, j] = joints[CREEP, j], 0.0
    if joints[REST, j] == 1.0:
        joints[MOVED, j] += SIM_DT * tuning.CREEP_RATE * (q - joints[ANCHOR, j] - joints[MOVED, j])
        if abs(joints[SLOW, j]) > tuning.MOVES * noise.speed:
            joints[REST, j] = 0.0
        elif abs(joints[MOVED, j]) > tuning.CREPT * noise.angle:
            joints[REST, j], joints[CREEP, j] = 0.0, joints[MOVED, j]
        return
    still = abs(joints[FAST, j]) < tuning.STILL_SPEED * noise.speed
    joints[QUIET, j] = joints[QUIET, j] + 1.0 if still else 0.0
    stopped = joints[QUIET, j] >= tuning.STILL
    if stopped or (still and abs(joints[SLOW, j]) < tuning.RESTS * noise.speed):
        if stopped:
            joints[SLOW, j] = joints[FAST, j]
        joints[ANCHOR, j] = joints[ANCHOR, j] + crept if crept != 0.0 else joints[ANGLE, j]
        joints[REST, j], joints[QUIET, j], joints[MOVED, j] = 1.0, 0.0, 0.0


@njit(cache=True, error_model="numpy")
def _unlagged(joints, j):
    """Return joint j's speed (rad/s) without the lag that its low-passes have at constant acceleration."""
    return joints[FAST, j] + tuning.LAG * (joints[FAST, j] - joints[SLOW, j])


@njit(cache=True, error_model="numpy")
def side_variance(noise, joints, j):
    """Return the variance (Nm^2) of a moving joint's friction due to uncertain sign, presliding and Stribeck effect.

    If the sign of a friction f is wrong with probability p, the variance is 4 f^2 p (1 - p). After a reversal, p is
    larger, because friction changes its sign only when the gear has untwisted.
    """
    now = _unlagged(joints, j)
    lag = tuning.LAG * (joints[FAST, j] - joints[SLOW, j])
    twist = np.exp(-abs(joints[PATH, j]) / tuning.REVERSAL_PATH)
    share = tuning.SIDE_NOISE + (tuning.REVERSAL_NOISE - tuning.SIDE_NOISE) * twist
    sd = np.sqrt((share * noise.speed) ** 2 + lag**2)
    p = 1.0 / (1.0 + np.exp(min(1.7 * abs(now) / sd, 50.0)))  # approximately the normal cdf
    unbent = tuning.BRISTLES * (1.0 - joints[DEFLECTION, j] ** 2)  # due to presliding, whose law is uncertain
    slow = tuning.EXCESS_ERROR * excess_friction(noise, j, now, now)
    return (noise.edges[j, 1] - noise.edges[j, 0]) ** 2 * (p * (1.0 - p) + unbent) + slow * slow


@njit(cache=True, error_model="numpy")
def holding_friction(state, j, gain):
    """Return joint j's friction at rest (Nm); write its gradient with respect to the state to `gain` (N,)."""
    x, joints, J = state.x, state.joints, state.jacobian
    n = joints.shape[1]
    w = len(x) - 2 * n
    gain[:] = 0.0
    friction = joints[TORQUE, j] + joints[MOTOR_MEAN, j]
    for c in range(w):
        gain[c] = J[c, j]
    for s in range(n):
        if joints[REST, s] == 0.0:
            A, known = state.coupling[j, s], joints[KNOWN, s]
            for i in range(n):
                if joints[REST, i] == 0.0:
                    known -= state.mass_rate[s, i] * joints[FAST, i]
            friction -= A * known + state.mass_rate[j, s] * joints[FAST, s]
            gain[w + s] = A
            for c in range(w):
                gain[c] -= A * J[c, s]
    for i in range(w + n):
        friction += gain[i] * x[i]
    return friction
