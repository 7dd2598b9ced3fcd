"""Kalman filter of the external wrench, of momentum and of friction's deviation from its model; compiled.

State of n joints, N = w + 2 n: the wrench at the tip in base axes, w = 3 (force) or 6 (force and moment); per joint
the deviation b of its friction f = f_model + b, Nm; the generalised momentum p, Nm s, which is measured every cycle
(momentum.py). dp/dt = u - f + J^T wrench, with u all known torques (De Luca and Mattone, ICRA 2003; as a disturbance
in a Kalman filter: Hu and Xiong, IEEE Trans. Ind. Electron. 65(2), 2018).

What is known about f depends on the joint:
- It slides: b is the error of the identified friction, small and of short memory. Such a joint measures the wrench.
- It rests: friction balances the rest of the torques, df = du + J^T dwrench. Such a joint says nothing about a change
  of the wrench, but it keeps what it knew when it stopped (on which side it came to lie), and f stays within the
  breakaway edges.
- It starts to slide, or creeps: f is the model's again.
The wrench changes with the motion of the tip, as a stiff environment would have it. With all joints at rest the tip
is fixed: only a hand may change the force, until the edges hide no more.
"""

from typing import NamedTuple

import numpy as np

from r2s.adaptation import tuning
from r2s.adaptation.arm_model import friction_torque
from r2s.adaptation.momentum import BODY, MOMENTUM_WORK, MomentumTerms, momentum
from r2s.compiled import njit
from r2s.physics.actuation import EARLY, SLOTS, motor_torque
from r2s.physics.kinematics import POSE, hand_kinematics
from r2s.physics.newton_euler import WORK, equations
from r2s.physics.robot import SIM_DT

COMMAND, CYCLE = range(2)  # `WrenchState.counts`
# `WrenchState.contact`: low-passed squared innovations per joint, in variances; squared force in variances, 0 unless
# two joints move; 1 in contact; cycles of the square above the threshold, and below the threshold of release
SURPRISE, SQUARE, TOUCHES, ABOVE, BELOW = range(5)
# rows of `joints`: filtered angle rad; slow and fast speed rad/s; 1 at rest; cycles of little speed; angle where it
# came to rest, motion since, and creep of this cycle, rad; friction model, and that of the cycle before, Nm; known
# torque without motor and friction of the cycle before, known torque of the cycle before, mean known torque of the
# last cycle with friction, motor torque, and its mean in the coming cycle, Nm; variance of the momentum (Nm s)^2
ANGLE, SLOW, FAST, REST, QUIET, ANCHOR, MOVED, CREEP, FRICTION, FRICTION_BEFORE, TORQUE, DRIVE, KNOWN = range(13)
MOTOR, MOTOR_MEAN, MOMENTUM_NOISE, ROWS = range(13, 17)
MASS_EVERY = 20  # cycles between two mass matrices, for the noise of the momentum


class WrenchNoise(NamedTuple):
    """Uncertainty of n joints' friction, and the sensors' noise."""

    friction: np.ndarray  # (n,) Nm, standard deviation of the friction model of a sliding joint
    edges: np.ndarray  # (n, 2) Nm, negative and positive breakaway edge, of all torques but friction
    speed: float  # rad/s, white noise of measured speeds
    angle: float  # rad, of measured angles


class WrenchState(NamedTuple):
    """Memory from cycle to cycle."""

    x: np.ndarray  # (N,)
    P: np.ndarray  # (N, N)
    joints: np.ndarray  # (ROWS, n)
    counts: np.ndarray  # (2,)
    contact: np.ndarray  # (5,), see SURPRISE to BELOW
    payload: np.ndarray  # (10,), carried beside the model's links, payload frame (momentum.py)
    commands: np.ndarray  # (SLOTS, n) Nm
    place: np.ndarray  # (3,) m, tip in the base frame
    jacobian: np.ndarray  # (6, n): of the tip's position, and of the rotation
    frames: np.ndarray  # (n, POSE)
    terms: MomentumTerms
    work: np.ndarray
    column: np.ndarray  # (N,)

    @staticmethod
    def fresh(n: int, components: int) -> "WrenchState":
        """Return the state before the first cycle; components: 3 (force) or 6 (with moment)."""
        N = components + 2 * n
        joints = np.zeros((ROWS, n))
        joints[REST] = 1.0
        arrays = (
            np.zeros(5),
            np.zeros(BODY),
            np.zeros((SLOTS, n)),
            np.zeros(3),
            np.zeros((6, n)),
            np.zeros((n, POSE)),
        )
        work = np.zeros((n, max(MOMENTUM_WORK, WORK)))
        counts = np.array([SLOTS, 0])
        return WrenchState(
            np.zeros(N), np.zeros((N, N)), joints, counts, *arrays, MomentumTerms.empty(n), work, np.zeros(N)
        )


@njit(cache=True, error_model="numpy")
def update_wrench(arm, tip, noise, threshold, state, q, dq, tau):
    """Process one cycle; the wrench and its covariance are the first rows of `state.x` and `state.P`.

    Args:
        arm: `ArmModel`. tip: (3,) m in the last link's frame. noise: `WrenchNoise`.
        threshold: of the squared force in variances, for contact. q, dq: (n,) rad, rad/s, of this cycle.
        tau: (n,) Nm without gravity, the command sent in this cycle.
    """
    joints, counts, n = state.joints, state.counts, len(q)
    if counts[CYCLE] == 0:
        joints[ANGLE] = q
        joints[ANCHOR] = q
    share, slow, fast = SIM_DT * tuning.ANGLE_RATE, SIM_DT * tuning.SLOW_RATE, SIM_DT * tuning.FAST_RATE
    speed = state.column[:n]
    for j in range(n):  # speeds of dq at high and of q at low frequencies, without a lag
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
            state.jacobian[3 + i, j] = state.work[j, i]  # joint axes, of `momentum`
    if counts[CYCLE] % MASS_EVERY == 0:
        _momentum_noise(arm, noise, state, q)
    _known_torque(arm, noise, state, q)
    if counts[CYCLE] == 0:
        _begin(noise, state)
    else:
        _predict(noise, state)
        _measure(state)
    _keep_within_edges(noise, state)
    _detect(threshold, state)
    counts[CYCLE] += 1
    state.commands[counts[COMMAND] % SLOTS] = tau
    delay = arm.latency[0] - EARLY  # no semi-implicit step here
    motor_torque(state.commands, joints[MOTOR], counts[COMMAND], delay, arm.latency[1], joints[MOTOR_MEAN])
    counts[COMMAND] += 1


@njit(cache=True, error_model="numpy")
def _momentum_noise(arm, noise, state, q):
    """Write the variances of the measured momenta."""
    n = len(q)
    mass, rest = np.empty((n, n)), np.zeros(n)
    equations(arm.links, arm.gravity, q, rest, mass, np.empty(n), state.work)
    for j in range(n):
        square = 0.0
        for i in range(n):
            square += (mass[j, i] + (arm.armature[j] if i == j else 0.0)) ** 2
        state.joints[MOMENTUM_NOISE, j] = square * (tuning.MOMENTUM_NOISE * noise.speed) ** 2


@njit(cache=True, error_model="numpy")
def _known_torque(arm, noise, state, q):
    """Decide which joints rest, and write friction and known torques; a joint that starts to slide fixes its b."""
    joints, terms, x = state.joints, state.terms, state.x
    n = len(q)
    b = len(x) - 2 * n
    for j in range(n):
        rested = joints[REST, j] == 1.0
        _rest_or_motion(noise, joints, j, q[j])
        if joints[REST, j] == 0.0:
            side = joints[CREEP, j]
            if side == 0.0:  # the slow speed has less noise, but reverses late
                fast = abs(joints[FAST, j]) > tuning.REVERSES * noise.speed
                side = joints[FAST, j] if fast else joints[SLOW, j]
            side = 1.0 if side > 0.0 else -1.0
            speed = side * max(side * joints[FAST, j], 0.0)
            sin, cos = np.sin(q[j]), np.cos(q[j])
            level = arm.load[j] * abs(terms.compensated[j])
            level += arm.angle_friction[j, 0] * sin + arm.angle_friction[j, 1] * cos
            model = friction_torque(arm.table[j], arm.max_speed[j], speed, side) + level * side
            if rested:  # the friction so far goes on, and is then known to be the model's
                x[b + j] += joints[FRICTION, j] - model
                _scalar_update(state, b + j, -x[b + j], noise.friction[j] ** 2)
                joints[FRICTION_BEFORE, j] = model
            joints[FRICTION, j] = model
        torque = arm.offset[j] + arm.drag[j, 0] * np.sin(q[j]) + arm.drag[j, 1] * np.cos(q[j])
        torque += terms.coriolis[j] - terms.uncompensated[j]
        friction = 0.5 * (joints[FRICTION, j] + joints[FRICTION_BEFORE, j])
        joints[KNOWN, j] = joints[MOTOR_MEAN, j] + 0.5 * (torque + joints[TORQUE, j]) - friction
        joints[FRICTION_BEFORE, j], joints[TORQUE, j] = joints[FRICTION, j], torque


@njit(cache=True, error_model="numpy")
def _rest_or_motion(noise, joints, j, q):
    """Decide whether joint j rests; a joint that has crept since it came to rest slides for this cycle."""
    joints[CREEP, j] = 0.0
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
    if stopped or abs(joints[SLOW, j]) < tuning.RESTS * noise.speed:
        if stopped:
            joints[SLOW, j] = joints[FAST, j]
        joints[REST, j], joints[QUIET, j], joints[ANCHOR, j], joints[MOVED, j] = 1.0, 0.0, joints[ANGLE, j], 0.0


@njit(cache=True, error_model="numpy")
def _begin(noise, state):
    """Set the first cycle's state: measured momentum, hardly any force, friction in balance."""
    x, P, joints, J = state.x, state.P, state.joints, state.jacobian
    n = joints.shape[1]
    w = len(x) - 2 * n
    x[:] = 0.0
    P[:] = 0.0
    for i in range(w):
        P[i, i] = (tuning.FREE_FORCE if i < 3 else tuning.FREE_FORCE * tuning.MOMENT_ARM) ** 2
    for j in range(n):
        joints[DRIVE, j] = joints[TORQUE, j] + joints[MOTOR_MEAN, j]
        if joints[REST, j] == 1.0:
            x[w + j] = joints[DRIVE, j]
        x[w + n + j] = state.terms.p[j]
        P[w + j, w + j] = noise.friction[j] ** 2
        P[w + n + j, w + n + j] = state.joints[MOMENTUM_NOISE, j]
    _add_wrench_noise(state, P[0, 0], J)


@njit(cache=True, error_model="numpy")
def _predict(noise, state):
    """Advance state and covariance by one cycle."""
    x, P, joints, J, column = state.x, state.P, state.joints, state.jacobian, state.column
    n, N = joints.shape[1], len(x)
    w = N - 2 * n
    for j in range(n):
        net = joints[KNOWN, j] - x[w + j]
        for c in range(w):
            net += J[c, j] * x[c]
        drive = joints[TORQUE, j] + joints[MOTOR_MEAN, j]
        decay = np.exp(-SIM_DT / tuning.FRICTION_NOISE_S)
        for i in range(N):  # P = A P A^T, in the row and the column of p
            total = -P[w + j, i]
            for c in range(w):
                total += J[c, j] * P[c, i]
            column[i] = SIM_DT * total
        m = w + n + j
        own = -column[w + j]
        for c in range(w):
            own += J[c, j] * column[c]
        for i in range(N):
            P[m, i] += column[i]
            P[i, m] = P[m, i]
        P[m, m] += column[m] + SIM_DT * own
        x[m] += SIM_DT * net
        if joints[REST, j] == 1.0:
            x[w + j] += drive - joints[DRIVE, j]
            if P[w + j, w + j] < _hidden(noise, j):
                P[w + j, w + j] += (tuning.STOP_DRIFT * noise.friction[j]) ** 2 * SIM_DT
        else:
            x[w + j] *= decay
            for i in range(N):
                P[w + j, i] *= decay
                P[i, w + j] = P[w + j, i]
            P[w + j, w + j] *= decay
            sigma = noise.friction[j] ** 2 + (tuning.INERTIA_SHARE * net) ** 2
            if abs(joints[FAST, j]) < tuning.REVERSING * noise.speed:  # it may rest, or reverse
                sigma += _hidden(noise, j)
            P[w + j, w + j] += (1.0 - decay * decay) * sigma
        joints[DRIVE, j] = drive
        P[m, m] += 1e-10  # (Nm s)^2: round-off of the integration
    _add_wrench_noise(state, _wrench_variance(noise, state), J)


@njit(cache=True, error_model="numpy")
def _hidden(noise, j):
    """Return the variance, Nm^2, of a torque anywhere between the edges of joint j."""
    return (noise.edges[j, 1] - noise.edges[j, 0]) ** 2 / 12.0


@njit(cache=True, error_model="numpy")
def _wrench_variance(noise, state):
    """Return the variance, N^2, by which a force component may change in this cycle."""
    joints, J, P = state.joints, state.jacobian, state.P
    n = joints.shape[1]
    w = len(state.x) - 2 * n
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
    hides = True
    for j in range(n):
        if joints[REST, j] == 1.0 and P[w + j, w + j] > _hidden(noise, j):
            hides = False
    if hides:
        variance += tuning.HAND_RATE**2 * SIM_DT
    return variance + tuning.CREEP_SHARE * tuning.STIFFNESS**2 * creep


@njit(cache=True, error_model="numpy")
def _add_wrench_noise(state, variance, J):
    """Add noise to the wrench; the friction of joints at rest balances it."""
    P, joints = state.P, state.joints
    n = joints.shape[1]
    w = len(state.x) - 2 * n
    for c in range(w):
        own = variance if c < 3 else variance * tuning.MOMENT_ARM**2
        P[c, c] += own
        for j in range(n):
            if joints[REST, j] == 0.0:
                continue
            P[c, w + j] += own * J[c, j]
            P[w + j, c] = P[c, w + j]
            for k in range(j + 1):
                if joints[REST, k] == 1.0:
                    P[w + j, w + k] += own * J[c, j] * J[c, k]
                    P[w + k, w + j] = P[w + j, w + k]


@njit(cache=True, error_model="numpy")
def _measure(state):
    """Update with the measured momenta, one joint after the other."""
    n, N = state.joints.shape[1], len(state.x)
    square = 0.0
    for j in range(n):
        m = N - n + j
        innovation = state.terms.p[j] - state.x[m]
        square += innovation * innovation / (state.P[m, m] + state.joints[MOMENTUM_NOISE, j])
        _scalar_update(state, m, innovation, state.joints[MOMENTUM_NOISE, j])
    state.contact[SURPRISE] += tuning.TOUCH_SHARE * (square / n - state.contact[SURPRISE])


@njit(cache=True, error_model="numpy")
def _keep_within_edges(noise, state):
    """Put the friction of each joint at rest back within its edges."""
    joints, x, P = state.joints, state.x, state.P
    n = joints.shape[1]
    w = len(x) - 2 * n
    for j in range(n):
        if joints[REST, j] == 1.0:
            friction = joints[FRICTION, j] + x[w + j]
            beyond = min(max(friction, noise.edges[j, 0]), noise.edges[j, 1]) - friction
            if beyond != 0.0:
                share = tuning.EDGE_SHARE * beyond / max(P[w + j, w + j], 1e-9)
                for i in range(len(x)):  # P stays: the same edge, met again in the next cycle, tells nothing new
                    x[i] += share * P[i, w + j]


@njit(cache=True, error_model="numpy")
def _scalar_update(state, m, innovation, variance):
    """Update with a measurement of component m of the state."""
    x, P, column = state.x, state.P, state.column
    N = len(x)
    share = 1.0 / (P[m, m] + variance)
    for i in range(N):
        column[i] = P[i, m]
    for i in range(N):
        gain = share * column[i]
        x[i] += gain * innovation
        for k in range(i + 1):
            P[i, k] -= gain * column[k]
            P[k, i] = P[i, k]


@njit(cache=True, error_model="numpy")
def _detect(threshold, state):
    """Compare the force with what its variance explains; a contact ends in motion only: friction hides it at rest."""
    x, P, contact = state.x, state.P, state.contact
    floor = tuning.FORCE_FLOOR**2
    a, b, c = P[0, 0] + floor, P[1, 0], P[2, 0]
    d, e, f = P[1, 1] + floor, P[2, 1], P[2, 2] + floor
    l21, l31 = b / a, c / a  # L D L^T of the force's covariance
    d2 = d - l21 * b
    l32 = (e - l31 * b) / d2
    d3 = f - l31 * c - l32 * l32 * d2
    y2 = x[1] - l21 * x[0]
    y3 = x[2] - l31 * x[0] - l32 * y2
    n = state.joints.shape[1]
    moves = n - state.joints[REST].sum() >= min(2, n)  # one joint alone may err about its breakaway edge
    contact[SQUARE] = x[0] * x[0] / a + y2 * y2 / d2 + y3 * y3 / d3 if moves else 0.0
    contact[ABOVE] = contact[ABOVE] + 1.0 if contact[SQUARE] > threshold else 0.0
    if moves:
        contact[BELOW] = contact[BELOW] + 1.0 if contact[SQUARE] < tuning.RELEASE * threshold else 0.0
    if contact[ABOVE] >= tuning.CONFIRMED:
        contact[TOUCHES], contact[BELOW] = 1.0, 0.0
    elif contact[BELOW] >= tuning.RELEASED:
        contact[TOUCHES] = 0.0
