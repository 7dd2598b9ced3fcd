"""Estimate external wrench, momentum and friction error with a Kalman filter, in compiled code.

The state has N = w + 2 n components: the wrench at the tip in base axes, with w = 3 (force) or 6 (force and moment),
and for each joint a friction error b, Nm, and the generalized momentum p, Nm s. Friction is f = f_model + b. The
filter measures p in every cycle (momentum.py); p obeys dp/dt = u - f + J^T wrench with the known torque u (De Luca
and Mattone, ICRA 2003; in a Kalman filter: Hu and Xiong, IEEE Transactions on Industrial Electronics 65(2), 2018).

The uncertainty of a joint's friction depends on whether the joint moves (wrench_friction.py).
- The momentum of a joint in motion determines the wrench precisely, because the friction error b is small and has a
  short correlation time. Near zero speed, b is larger for two reasons: sensor noise makes the direction of motion
  uncertain, and the model may lack a Stribeck effect (`excess_friction`).
- A joint at rest yields only bounds on the wrench. Friction at rest balances all other torques, and may be any torque
  between the negative and the positive breakaway torque (edges). The variance of friction at rest is at most that of
  a uniform distribution between the edges. If the friction family has bristles, the joint angle determines the
  bristle deflection and thereby the friction, with a smaller variance. The filter treats the edges as uncertain
  (EDGE_ERROR); otherwise, a joint at rest with a larger breakaway torque than identified would look like a force.
The filter assumes that the wrench changes when the tip moves against stiff surroundings. If all joints rest, the
filter assumes that only a person's hand changes the force. Joint friction hides any force change that is too small to
make a joint slide.
"""

import numpy as np

from r2s.adaptation import tuning
from r2s.adaptation.contact_detection import detect, weigh
from r2s.adaptation.momentum import BODY, momentum
from r2s.adaptation.wrench_friction import MASS_EVERY, couple, holding_friction, known_torque, masses, side_variance
from r2s.adaptation.wrench_state import (
    ANCHOR,
    ANGLE,
    COMMAND,
    CREEP,
    CYCLE,
    FAST,
    FAST_P,
    FRICTION,
    KNOWN,
    MOMENTUM_NOISE,
    MOTOR,
    MOTOR_MEAN,
    REST,
    SHAKE,
    SLOW,
    SLOW_P,
    SURPRISE,
)  # fmt: skip
from r2s.compiled import njit
from r2s.physics.actuation import EARLY, SLOTS, motor_torque
from r2s.physics.kinematics import hand_kinematics
from r2s.physics.robot import SIM_DT


@njit(cache=True, error_model="numpy")
def update_wrench(arm, tip, noise, thresholds, state, q, dq, tau):
    """Process one cycle; the first elements of `state.x` and `state.P` are the wrench and its covariance.

    Args:
        arm: `ArmModel`. tip: (3,) m, position of the tip in the last link's frame. noise: `WrenchNoise`.
        thresholds: (2,), squared forces above which the arm is in contact, see `detect`.
        q, dq: (n,) rad, rad/s, measured in this cycle. tau: (n,) Nm, command of this cycle, without gravity.
    """
    joints, counts, n = state.joints, state.counts, len(q)
    if counts[CYCLE] == 0:
        joints[ANGLE] = q
        joints[ANCHOR] = q
    share, slow, fast = SIM_DT * tuning.ANGLE_RATE, SIM_DT * tuning.SLOW_RATE, SIM_DT * tuning.FAST_RATE
    speed = state.column[:n]
    for j in range(n):  # complementary filter: speed from dq at high and from q at low frequencies
        speed[j] = dq[j] + (q[j] - joints[ANGLE, j]) * tuning.ANGLE_RATE
        joints[ANGLE, j] += share * (q[j] - joints[ANGLE, j]) + SIM_DT * dq[j]
        joints[SLOW, j] += slow * (speed[j] - joints[SLOW, j])
        joints[FAST, j] += fast * (speed[j] - joints[FAST, j])
    momentum(arm, q, speed, state.terms, state.work)
    for j in range(n):
        for c in range(BODY):
            state.terms.p[j] += state.terms.payload_p[j, c] * state.payload[c]
            state.terms.coriolis[j] += state.terms.payload_torque[j, c] * state.payload[c]
    hand_kinematics(arm.links, tip, q, state.frames, state.place, state.jacobian[:3])
    for j in range(n):
        for i in range(3):
            state.jacobian[3 + i, j] = state.work[j, i]  # joint axes, from `momentum`
    if counts[CYCLE] % MASS_EVERY == 0:
        masses(arm, noise, state, q)
    resting = joints[REST].copy()
    known_torque(arm, noise, state, q)
    _shake(state)
    if counts[CYCLE] % MASS_EVERY == 0 or (resting != joints[REST]).any():
        couple(state)
    if counts[CYCLE] == 0:
        _begin(noise, state)
    else:
        _predict(noise, state)
        _measure(state)
    _keep_within_edges(noise, state)
    detect(thresholds, noise.floor, state)
    weigh(arm, state)
    counts[CYCLE] += 1
    state.commands[counts[COMMAND] % SLOTS] = tau
    delay = arm.latency[0] - EARLY  # EARLY is for simulations only
    motor_torque(state.commands, joints[MOTOR], counts[COMMAND], delay, arm.latency[1], joints[MOTOR_MEAN])
    counts[COMMAND] += 1


@njit(cache=True, error_model="numpy")
def _shake(state):
    """Update the mean square of each joint's high-frequency momentum, which gear vibration causes."""
    joints, rate = state.joints, SIM_DT * tuning.SHAKE_BAND
    for j in range(joints.shape[1]):
        if state.counts[CYCLE] == 0:
            joints[SLOW_P, j] = state.terms.p[j]
        first = state.terms.p[j] - joints[SLOW_P, j]
        joints[SLOW_P, j] += rate * first
        second = first - joints[FAST_P, j]
        joints[FAST_P, j] += rate * second
        joints[SHAKE, j] += SIM_DT * tuning.SHAKE_RATE * (second * second - joints[SHAKE, j])


@njit(cache=True, error_model="numpy")
def _begin(noise, state):
    """Initialize the filter with the measured momentum and with a zero wrench of small variance."""
    x, P, joints = state.x, state.P, state.joints
    n = joints.shape[1]
    w = len(x) - 2 * n
    x[:] = 0.0
    P[:] = 0.0
    for i in range(w):
        P[i, i] = (tuning.FREE_FORCE if i < 3 else tuning.FREE_FORCE * tuning.MOMENT_ARM) ** 2
    for j in range(n):
        x[w + n + j] = state.terms.p[j]
        P[w + n + j, w + n + j] = state.joints[MOMENTUM_NOISE, j]


@njit(cache=True, error_model="numpy")
def _predict(noise, state):
    """Predict the filter's state and covariance one cycle ahead."""
    x, P, joints, J, column = state.x, state.P, state.joints, state.jacobian, state.column
    n, N = joints.shape[1], len(x)
    w = N - 2 * n
    decay = np.exp(-SIM_DT / tuning.FRICTION_NOISE_S)
    for j in range(n):
        m = w + n + j
        if joints[REST, j] == 1.0:  # joints in motion determine the momentum of a joint at rest
            x[m] = state.terms.p[j]
            P[m] = 0.0
            P[:, m] = 0.0
            P[m, m] = joints[MOMENTUM_NOISE, j]
            continue
        net = joints[KNOWN, j] - x[w + j]
        for c in range(w):
            net += J[c, j] * x[c]
        for i in range(N):  # P = A P A^T changes only the row and the column of p
            total = -P[w + j, i]
            for c in range(w):
                total += J[c, j] * P[c, i]
            column[i] = SIM_DT * total
        own = -column[w + j]
        for c in range(w):
            own += J[c, j] * column[c]
        for i in range(N):
            P[m, i] += column[i]
            P[i, m] = P[m, i]
        P[m, m] += column[m] + SIM_DT * own + 1e-10  # (Nm s)^2: round-off of the integration
        x[m] += SIM_DT * net
        x[w + j] *= decay
        for i in range(N):
            P[w + j, i] *= decay
            P[i, w + j] = P[w + j, i]
        P[w + j, w + j] *= decay
        sigma = noise.friction[j] ** 2 + (noise.inertia * net) ** 2 + side_variance(noise, joints, j)
        P[w + j, w + j] += (1.0 - decay * decay) * sigma
    variance = _wrench_variance(noise, state)
    for c in range(w):
        P[c, c] += variance if c < 3 else variance * tuning.MOMENT_ARM**2


@njit(cache=True, error_model="numpy")
def _hidden(noise, joints, j):
    """Return mean (Nm) and variance (Nm^2) of the friction of joint j at rest, before a measurement.

    With bristles, the angle determines friction; else friction may lie anywhere between the breakaway edges.
    """
    square = (noise.edges[j, 1] - noise.edges[j, 0]) ** 2
    if noise.presliding[j] > 0.0:
        return joints[FRICTION, j], tuning.BRISTLES_AT_REST * square
    return 0.5 * (noise.edges[j, 0] + noise.edges[j, 1]), square / 12.0


@njit(cache=True, error_model="numpy")
def _wrench_variance(noise, state):
    """Return the process noise (N^2) of this cycle, by which the variance of each force component grows."""
    joints, J = state.joints, state.jacobian
    n = joints.shape[1]
    speed = creep = 0.0
    for c in range(3):
        moved = crept = 0.0
        for j in range(n):
            if joints[REST, j] == 0.0:
                moved += J[c, j] * joints[SLOW, j]
            crept += J[c, j] * joints[CREEP, j]
        speed += moved * moved
        creep += crept * crept
    rate = min(tuning.STIFFNESS * np.sqrt(speed), tuning.FORCE_RATE)
    if state.contact[SURPRISE] > tuning.TOUCH:
        rate = tuning.TOUCH_RATE
    variance = rate * rate * SIM_DT * tuning.FORCE_RATE_S
    variance += tuning.HAND_RATE**2 * SIM_DT
    share = tuning.BRISTLE_CREEP if noise.presliding.any() else tuning.CREEP_SHARE
    return variance + share * tuning.STIFFNESS**2 * creep


@njit(cache=True, error_model="numpy")
def _measure(state):
    """Update the state sequentially with the measured momentum of each moving joint."""
    n, N = state.joints.shape[1], len(state.x)
    square, count = 0.0, 0
    gain = np.zeros(N)
    for j in range(n):
        if state.joints[REST, j] == 1.0:
            continue
        m = N - n + j
        gain[m] = 1.0
        innovation = state.terms.p[j] - state.x[m]
        own = state.joints[MOMENTUM_NOISE, j]
        own += tuning.SHAKE_SHARE * max(state.joints[SHAKE, j] - 2.0 * own, 0.0)
        square += innovation * innovation / (state.P[m, m] + own)
        count += 1
        _update(state, gain, innovation, own)
        gain[m] = 0.0
    if count > 0:
        state.contact[SURPRISE] += tuning.TOUCH_SHARE * (square / count - state.contact[SURPRISE])


@njit(cache=True, error_model="numpy")
def _keep_within_edges(noise, state):
    """Keep friction at rest between the breakaway torques (edges), and limit its variance to that of `_hidden`."""
    joints, P = state.joints, state.P
    n, N = joints.shape[1], len(state.x)
    gain = np.empty(N)
    for j in range(n):
        if joints[REST, j] == 1.0:
            friction = holding_friction(state, j, gain)
            variance = gain @ P @ gain
            beyond = min(max(friction, noise.edges[j, 0]), noise.edges[j, 1]) - friction
            mean, hidden = _hidden(noise, joints, j)
            if variance > hidden:
                _update(state, gain, mean - friction, hidden * variance / (variance - hidden))
            if beyond != 0.0:  # leave P unchanged: repeated use of an edge adds no information
                error = tuning.EDGE_ERROR * 0.5 * (noise.edges[j, 1] - noise.edges[j, 0])
                total = max(variance + error**2, 1e-9)  # a joint may have no friction at all
                state.x[:] += tuning.EDGE_SHARE * beyond / total * (P @ gain)


@njit(cache=True, error_model="numpy")
def _update(state, gain, innovation, variance):
    """Correct the state by a scalar measurement whose gradient with respect to the state is `gain` (N,)."""
    x, P, column = state.x, state.P, state.column
    N = len(x)
    total = variance
    for i in range(N):
        column[i] = 0.0
    for k in range(N):
        if gain[k] != 0.0:
            for i in range(N):
                column[i] += P[i, k] * gain[k]
    for i in range(N):
        total += gain[i] * column[i]
    for i in range(N):
        share = column[i] / total
        x[i] += share * innovation
        for k in range(i + 1):
            P[i, k] -= share * column[k]
            P[k, i] = P[i, k]
