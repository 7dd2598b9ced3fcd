"""The safety filter, the last stage before the arm, limits joint accelerations near speed and position limits.

Training and every arm run the same compiled safety filter. The filter's input is the effort, the target torque after
the low-pass (r2s/physics/actuation.py). The safety filter has three stages:

- Fading: the policy's torque fades out as a joint approaches its velocity limit or a position limit.
- Acceleration limit: each joint's acceleration a = M^-1 (tau - Coriolis torque) satisfies -RATE (v + dq) <= a <= RATE
  (v - dq), with the mass matrix M and the speed v allowed at q. By Gauss' principle of least constraint, the filter
  selects the torque nearest to the effort within the acceleration limit. This torque is the effort plus torques of
  fictitious joint stops. Joint friction only widens the acceleration limit, so overestimated friction never
  accelerates a joint.
- Rate limit: the filter clips each joint's torque, then multiplies the torque rates of all joints by the same factor.
  The command therefore moves straight from the last command to the new torque, within the convex set of the
  acceleration limit. With a separate factor for each joint, the command could violate the acceleration limit if two
  joint axes are almost parallel.

The acceleration limit is a control barrier function (Ames et al., European Control Conference 2019). The command is
continuous in state and effort, so the filter causes no chattering. RATE is low enough for an arm with the latency
LATENCY_S.
"""

import math
from typing import NamedTuple

import mujoco
import numpy as np

from r2s.compiled import njit
from r2s.physics.linear_algebra import factor, solve, unpack
from r2s.physics.rigid_body import InverseInertia
from r2s.physics.robot import Robot

# Latency budget, s: delays up to 8 ms and lags up to 3 ms on real arms, and one cycle.
LATENCY_S = 0.012
# 1/s, rate of the acceleration limit. A first-order loop with delay d does not overshoot for rate * d <= 1/e: at
# equality, s + rate exp(-s d) = 0 has a double real root.
RATE = round(1 / (math.e * LATENCY_S))
APPROACH = 0.25 * RATE  # 1/s, allowed speed / distance from a position limit, for critical damping of the loop
ALLOWED = 0.66  # share of dq_max that the filter allows; model errors add to the speed (docs/explanation/safety.md)
FADED = 0.82  # the policy's torque fades out between the speeds ALLOWED * dq_max and FADED * dq_max
# Q_MARGIN: rad, distance from a position limit at which the allowed speed towards the limit is 0; at most a tenth of
# the range. Closer to the limit, the policy's torque fades out over Q_FADE_SHARE times this distance.
Q_MARGIN, Q_FADE_SHARE = 0.1, 0.6
ENVELOPE_SHARE = 0.55  # share of the position-dependent velocity limit of an FR3 that the filter uses
# s, time in which the allowed speed ramps down while braking. With 0.1 s, the braking torque of the base joint
# reached 60 Nm. At the rate limit of 1 Nm/ms, this torque fell too late, and threw a stretched elbow forward.
BRAKE_S = 0.15
TOLERANCE = 1e-9  # rad/s^2, tolerance of the acceleration bounds
PIVOTS = 5  # number of rounds of block pivoting; single pivots follow, which always terminate (Murty 1974)
ROUNDS = 100
FRICTION_WIDTH = 0.05  # rad/s, width of the sign change of friction
FRICTION_SHARE = 0.5  # share of the friction estimate that widens the bounds; only for joints with added inertia
DELAY_PHASE = 1.25  # rad, largest phase lag due to LATENCY_S in the loop of filter and arm; stable below pi / 2

# Columns of the limits (n, COLUMNS), one row per joint.
Q_LOW, Q_HIGH, Q_FADE, DQ_ALLOWED, DECELERATION, OFFSET, DQ_MAX, ADDED, TAU_MAX, STEP = range(10)
COLUMNS = STEP + 1
WORK = 10  # rows of `work` in addition to 2 n; [_INVERTED, 0]: whether `work` contains M^-1
_DDQ, _LOW, _HIGH, _WIDE_LOW, _WIDE_HIGH, _STOP, _SIDE, _NEXT, _SLACK, _INVERTED = range(WORK)


class JointDynamics(NamedTuple):
    """State and dynamics of an arm in a cycle: q, dq (n,) rad, rad/s; packed mass matrix; Coriolis torque (n,) Nm."""

    q: np.ndarray
    dq: np.ndarray
    mass: np.ndarray
    bias: np.ndarray


def filter_limits(robot: Robot, torque: np.ndarray, speed_share: float = 1.0) -> np.ndarray:
    """Return the argument `limits` (n, COLUMNS) of `filter_torque`.

    The filter adds inertia (column ADDED) to light joints in the mass matrix: just enough for an arm at rest to
    satisfy the acceleration limit under the largest target torque of any joint. Added inertia raises the gain of the
    loop of filter and arm. The added inertia is therefore limited, so that LATENCY_S causes a phase lag of at most
    DELAY_PHASE in this loop.

    Args:
        robot: the arm, for its position, velocity, torque and rate limits and mass matrix in the home posture.
        torque: (n,) Nm, largest target torque.
        speed_share: factor on the speed limits. The added inertia does not depend on this factor.
    """
    out = np.empty((robot.n, COLUMNS))
    inside = np.minimum(Q_MARGIN, 0.1 * (robot.q_max - robot.q_min))
    out[:, Q_LOW], out[:, Q_HIGH], out[:, Q_FADE] = robot.q_min + inside, robot.q_max - inside, Q_FADE_SHARE * inside
    out[:, DQ_ALLOWED], out[:, DQ_MAX] = ALLOWED * robot.dq_max, robot.dq_max
    deceleration, offset = robot.velocity_envelope or (np.full(robot.n, np.inf), np.zeros(robot.n))
    out[:, DECELERATION], out[:, OFFSET] = 2 * ENVELOPE_SHARE**2 * deceleration, ENVELOPE_SHARE * offset
    mobility = InverseInertia(robot)(robot.q_home[None])[0]
    inertia = 1 / np.diag(mobility)
    most = (DELAY_PHASE / (RATE * LATENCY_S) - 1) * inertia
    # Nm, torque at a joint that accelerates the joint as much as any joint's largest target torque can
    equivalent = inertia * (np.abs(mobility) * torque).max(1)
    out[:, ADDED] = np.clip(equivalent / (RATE * out[:, DQ_ALLOWED]) - inertia, 0.0, most)
    out[:, TAU_MAX], out[:, STEP] = robot.tau_max, robot.step_max
    out[:, [DQ_ALLOWED, DQ_MAX]] *= speed_share
    return out


class SafetyFilter:
    """The safety filter of one arm, with the mass matrix of a MuJoCo model.

    Attributes:
        changed: number of cycles in which fading or acceleration limit changed the effort.

    Args:
        model: one arm without gravity. robot, torque: see `filter_limits`. friction: (n,) Nm, estimated friction.
    """

    def __init__(self, model: mujoco.MjModel, robot: Robot, torque: np.ndarray, friction: np.ndarray):
        self._model, self._data, self._limits = model, mujoco.MjData(model), filter_limits(robot, torque)
        self._friction = friction
        self._work = np.empty((2 * robot.n + WORK, robot.n))
        self.changed = 0

    def __call__(self, q: np.ndarray, dq: np.ndarray, effort: np.ndarray, last: np.ndarray) -> np.ndarray:
        """Return the command (n,) Nm for `effort` (n,) Nm at q, dq (n,), after the previous command `last`, Nm."""
        data, out = self._data, np.empty_like(effort)
        data.qpos[:], data.qvel[:] = q, dq
        mujoco.mj_fwdPosition(self._model, data)
        mujoco.mj_fwdVelocity(self._model, data)
        arm = JointDynamics(q, dq, data.M, data.qfrc_bias)
        self.changed += filter_torque(arm, effort, last, 1.0, self._friction, self._limits, self._work, out)
        return out


@njit(cache=True, error_model="numpy", forceinline=True)
def filter_torque(arm, effort, last, share, friction, limits, work, out):
    """Write a cycle's command (n,) Nm into `out`; return whether fading or acceleration limit changed the effort.

    Args:
        arm: `JointDynamics` with finite values.
        effort: (n,) Nm, requested torque. last: (n,) Nm, command that the arm applied last.
        share: factor on the allowed joint speeds: 1, or less while the arm brakes.
        friction: (n,) Nm, estimated friction, at least 0.
        limits: (n, COLUMNS) of `filter_limits`. work: (2 n + WORK, n), scratch array.
    """
    fades = fade(arm.q, arm.dq, effort, limits, out)
    changed = limit_acceleration(arm, share, friction, limits, work, out)
    limit_rate(last, limits, out)
    return fades or changed


@njit(cache=True, error_model="numpy", forceinline=True)
def fade(q, dq, effort, limits, out):
    """Write the effort (n,) Nm to `out`, faded near speed and position limits; return whether fading reduced it."""
    kept = _torque_share(q, dq, limits)
    for j in range(len(q)):
        out[j] = kept * effort[j]
    return kept < 1.0


@njit(cache=True, error_model="numpy", forceinline=True)
def limit_acceleration(arm, share, friction, limits, work, out):
    """Apply the acceleration limit of `filter_torque` to the torques `out` (n,) Nm; return whether `out` changed."""
    joint_bounds(arm, share, limits, work)
    return bounded(arm, friction, limits, work, work[: len(out)], out)


@njit(cache=True, error_model="numpy", forceinline=True)
def joint_bounds(arm, share, limits, work):
    """Write the Cholesky root of the mass matrix and the acceleration bounds of a cycle into `work`."""
    q, dq, n = arm.q, arm.dq, len(arm.q)
    low, high, root = work[2 * n + _LOW], work[2 * n + _HIGH], work[:n]
    unpack(arm.mass, 1.0, limits[:, ADDED], root)
    factor(root, root)
    for j in range(n):
        up = _speed_limit(limits[j, Q_HIGH] - q[j], share, limits[j])
        down = _speed_limit(q[j] - limits[j, Q_LOW], share, limits[j])
        high[j], low[j] = RATE * (up - dq[j]), -RATE * (down + dq[j])
    work[2 * n + _INVERTED, 0] = 0.0


@njit(cache=True, error_model="numpy", forceinline=True)
def bounded(arm, friction, limits, work, desk, out):
    """Limit the torques `out` (n,) Nm by the bounds of `joint_bounds`; return whether `out` exceeded a bound.

    desk: (n, n), scratch array. If `desk` is `work[:n]`, `bounded` overwrites the root, so call `joint_bounds` before
    each call of `bounded`.
    """
    n, dq = len(out), arm.dq
    ddq, low, high = work[2 * n + _DDQ], work[2 * n + _LOW], work[2 * n + _HIGH]
    for j in range(n):
        ddq[j] = out[j] - arm.bias[j]
    solve(work[:n], ddq)
    inside = True
    for j in range(n):
        inside &= low[j] <= ddq[j] <= high[j]
    if not inside:
        _widen(dq, out, friction, limits, work)
        low, high, inside = work[2 * n + _WIDE_LOW], work[2 * n + _WIDE_HIGH], True
        for j in range(n):
            inside &= low[j] <= ddq[j] <= high[j]
    if not inside:
        _stop_torque(ddq, low, high, work, desk)
        for j in range(n):
            out[j] += work[2 * n + _STOP, j]
    return not inside


@njit(cache=True, error_model="numpy", forceinline=True)
def limit_rate(last, limits, out):
    """Limit the torques `out` (n,) Nm, and their change since the previous command `last` (n,) Nm."""
    n, scale = len(out), 1.0
    for j in range(n):
        out[j] = min(max(out[j], -limits[j, TAU_MAX]), limits[j, TAU_MAX]) - last[j]
        if abs(out[j]) > limits[j, STEP]:
            scale = min(scale, limits[j, STEP] / abs(out[j]))
    for j in range(n):
        out[j] = last[j] + min(max(scale * out[j], -limits[j, STEP]), limits[j, STEP])


@njit(cache=True, error_model="numpy", forceinline=True)
def _torque_share(q, dq, limits):
    """Return the factor on the policy's torque, which falls from 1 to 0 near a velocity or position limit."""
    near = 0.0
    for j in range(len(q)):
        near = max(near, (abs(dq[j]) / limits[j, DQ_MAX] - ALLOWED) / (FADED - ALLOWED))
        near = max(near, max(q[j] - limits[j, Q_HIGH], limits[j, Q_LOW] - q[j]) / limits[j, Q_FADE])
    return 1.0 - min(near, 1.0)


@njit(cache=True, error_model="numpy", forceinline=True)
def _speed_limit(distance, share, limits):
    """Return the allowed speed, rad/s, at a distance (rad) from a position limit; negative beyond the limit."""
    speed = min(share * limits[DQ_ALLOWED], APPROACH * distance)
    if distance > 0.0 and limits[DECELERATION] < np.inf:
        speed = min(speed, np.sqrt(limits[DECELERATION] * distance + limits[OFFSET] ** 2) - limits[OFFSET])
    return speed


@njit(cache=True, error_model="numpy", forceinline=True)
def _widen(dq, out, friction, limits, work):
    """Write M^-1 and the acceleration bounds, widened by accelerations that friction can cancel, into `work`."""
    n = len(out)
    root, mobility, slack = work[:n], work[n : 2 * n], work[2 * n + _SLACK]
    for j in range(n):
        slack[j] = 0.0
        if friction[j] > 0.0 and limits[j, ADDED] > 0.0:  # friction opposes motion or, at rest, the torque
            slack[j] = FRICTION_SHARE * friction[j] * abs(np.tanh(dq[j] / FRICTION_WIDTH + out[j] / friction[j]))
    if work[2 * n + _INVERTED, 0] == 0.0:
        work[2 * n + _INVERTED, 0] = 1.0
        for k in range(n):
            for j in range(n):
                mobility[k, j] = 1.0 if j == k else 0.0
            solve(root, mobility[k])
    for k in range(n):
        wider = 0.0
        for j in range(n):
            wider += abs(mobility[k, j]) * slack[j]
        work[2 * n + _WIDE_LOW, k] = work[2 * n + _LOW, k] - wider
        work[2 * n + _WIDE_HIGH, k] = work[2 * n + _HIGH, k] + wider


@njit(cache=True, error_model="numpy", forceinline=True)
def _stop_torque(ddq, low, high, work, root):
    """Write the torque (n,) Nm of fictitious joint stops into row _STOP of `work`; other rows of `work` contain M^-1.

    The torque `stop` solves the linear complementarity problem low <= ddq + M^-1 stop <= high: a stop acts only at a
    bound and pushes inward. The solver is block principal pivoting (Judice and Pires, Computers & Operations Research
    21(5), 1994). root: (n, n), scratch array.
    """
    n = len(ddq)
    mobility = work[n : 2 * n]
    stop, side, following = work[2 * n + _STOP], work[2 * n + _SIDE], work[2 * n + _NEXT]
    for k in range(n):
        side[k] = 1.0 if ddq[k] > high[k] else (-1.0 if ddq[k] < low[k] else 0.0)
    for iteration in range(ROUNDS):
        for i in range(n):
            if side[i] != 0.0:
                stop[i] = (high[i] if side[i] > 0.0 else low[i]) - ddq[i]
        factor(mobility, root, side)
        solve(root, stop, side)
        done = True
        for j in range(n - 1, -1, -1):
            reached = ddq[j]
            for k in range(n):
                reached += mobility[j, k] * stop[k]
            following[j] = side[j]
            if side[j] * stop[j] > 0.0:
                following[j] = 0.0  # this stop would pull outward
            elif side[j] == 0.0:
                beyond = -1.0 if reached < low[j] - TOLERANCE else 0.0
                following[j] = 1.0 if reached > high[j] + TOLERANCE else beyond
            done &= following[j] == side[j]
        if done:
            return
        for j in range(n - 1, -1, -1):
            if following[j] != side[j]:
                side[j] = following[j]
                if iteration >= PIVOTS:
                    break
