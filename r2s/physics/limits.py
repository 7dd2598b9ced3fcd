"""The driver's law: what reaches an arm, whatever a policy says; compiled, the same in training and on every arm.

Three rules, on a target that has come through the low-pass (r2s/physics/actuation.py), with M the arm's inertia:

1. All torque fades where a joint gets too fast or too close to a position limit, whatever made it so.
2. No joint accelerates beyond what can be taken back in time. With v the speed that is allowed at q,
   -RATE (v + dq) <= a <= RATE (v - dq), a = M^-1 (tau - Coriolis torque), wider by what friction is believed to eat.
   Of all torques that keep to this the nearest is sent, in the sense of Gauss' principle of least constraint: what
   stops at the joints would add. Friction widens the bounds only: one that is not there must not push.
3. The sum is clipped to the torque range, and its rate is limited, last: a cycle goes a part of the way from what the
   arm applied last, the same part in all joints. The torques that keep to rule 2 are a convex set, so what lies on
   the way keeps to it too. Joint by joint it would not: of two nearly parallel axes the torques must come together.

Rule 2 is a control barrier function in each joint (Ames et al., European Control Conference 2019). It is continuous
in states and targets, and its gains are what a late arm bears: nothing switches, nothing shakes.
"""

import math

import mujoco
import numpy as np

from r2s.compiled import njit
from r2s.physics.rigid_body import InverseInertia
from r2s.physics.robot import SIM_DT, Robot

# 1/s: a loop of this rate that is LATE seconds late answers without overshoot, rate x delay <= 1/e
# (from s + rate exp(-s delay) = 0 having a double real root).
LATE = 0.012  # s, of torque and measurement: delays of 8 ms and lags of 3 ms have been seen, and a cycle
RATE = round(1 / (math.e * LATE))
# of RATE, at which a joint may close in on a position limit: second-order, critically damped
APPROACH = 0.25 * RATE
ALLOWED = 0.66  # of the velocity limits: what friction that nobody knows adds beyond is measured in docs/safety.md
NOTHING = 0.82  # of the velocity limits, where no torque of the policy is left; it fades from ALLOWED on
# rad within the position limits, where the allowed speed towards them has come down to nothing; at most a tenth of
# a joint's range. In Q_FADES of it, from there on, the torque of the policy fades.
Q_ALLOWED, Q_FADES = 0.1, 0.6
SLOWER = 0.55  # of the speed that an FR3 allows near its position limits
# s, in which the allowed speeds come down to nothing when an arm is brought to rest. In 0.1 s the base's torque grew
# to 60 Nm, and came off, a Nm a ms, too late: it threw a stretched elbow forward (docs/safety.md).
BRAKE_S = 0.15

# Columns of a matrix of limits (n, COLUMNS), one row for each joint.
Q_LOW, Q_HIGH, Q_FADE, MOST, SLOWING, OFFSET, DQ_MAX, ADDED, TAU_MAX, STEP = range(10)
COLUMNS = STEP + 1
WORK = 7  # rows that `guard` works in, beside 2 n
EXACT = 1e-9  # rad/s^2, to which accelerations keep to their bounds
PIVOTS = 5  # rounds in which all joints change sides at once; then one by one, which always ends (Murty 1974)
ROUNDS = 100
DRY = 0.05  # rad/s, over which friction changes sign
SURE = 0.5  # of the friction that is believed; of light joints only, for which it is not small
MARGIN = 1.25  # rad, of the phase that a delay may cost: pi / 2 is where a loop swings for ever


def limits(robot: Robot, torque: np.ndarray) -> np.ndarray:
    """Return what `guard` holds an arm to, (n, COLUMNS).

    A joint is added inertia where a full action of it, or of one that it is coupled to, would throw it, so that an
    action of 1 from rest is just allowed; but no more than its loop bears, faster than RATE by what is added.

    Args:
        robot: gives position, velocity, torque and rate limits, and what it weighs at home.
        torque: (n,) Nm, the most that a target asks for.
    """
    out = np.empty((robot.n, COLUMNS))
    inside = np.minimum(Q_ALLOWED, 0.1 * (robot.q_max - robot.q_min))
    out[:, Q_LOW], out[:, Q_HIGH], out[:, Q_FADE] = robot.q_min + inside, robot.q_max - inside, Q_FADES * inside
    out[:, MOST], out[:, DQ_MAX] = ALLOWED * robot.dq_max, robot.dq_max
    deceleration, offset = robot.slowing or (np.full(robot.n, np.inf), np.zeros(robot.n))
    out[:, SLOWING], out[:, OFFSET] = 2 * SLOWER**2 * deceleration, SLOWER * offset
    mobility = InverseInertia(robot)(robot.q_home[None])[0]
    felt = 1 / np.diag(mobility)
    most = (MARGIN / (RATE * LATE) - 1) * felt
    throws = felt * (np.abs(mobility) * torque).max(1)  # Nm, of the joint's own, that would throw it as far
    out[:, ADDED] = np.clip(throws / (RATE * out[:, MOST]) - felt, 0.0, most)
    out[:, TAU_MAX], out[:, STEP] = robot.tau_max, robot.dtau_max * SIM_DT
    return out


class Guard:
    """The law for one arm, with the inertia of its model; `guard` for arguments.

    Attributes:
        changed: in how many cycles so far the law changed what was asked for.

    Args:
        model: one arm without gravity. robot, torque: as of `limits`. friction: (n,) Nm, as of `guard`.
    """

    def __init__(self, model: mujoco.MjModel, robot: Robot, torque: np.ndarray, friction: np.ndarray):
        self._model, self._data, self._limits = model, mujoco.MjData(model), limits(robot, torque)
        self._friction = friction
        self._work = np.empty((2 * robot.n + WORK, robot.n))
        self.changed = 0

    def __call__(self, q: np.ndarray, dq: np.ndarray, effort: np.ndarray, last: np.ndarray) -> np.ndarray:
        """Return the command (n,) Nm for the effort (n,) Nm at q, dq (n,), after the command `last` (n,) Nm."""
        data, out = self._data, np.empty_like(effort)
        data.qpos[:], data.qvel[:] = q, dq
        mujoco.mj_fwdPosition(self._model, data)
        mujoco.mj_fwdVelocity(self._model, data)
        now = self._friction, data.M, data.qfrc_bias, self._limits, self._work
        self.changed += guard(q, dq, effort, last, 1.0, *now, out)
        return out


@njit(cache=True, error_model="numpy", forceinline=True)
def guard(q, dq, effort, last, share, friction, mass, bias, limits, work, out):
    """Write the command (n,) Nm of a cycle into `out`; return whether the law changed anything but the rate.

    Args:
        q, dq: (n,) rad, rad/s, finite. effort: (n,) Nm, what is asked for. last: (n,) Nm, what the arm applied last.
        share: of the allowed speeds that is left, 1 unless the arm is being brought to rest.
        friction: (n,) Nm, how much is believed to hold each joint, at least 0.
        mass: (n (n + 1) / 2,) kg m^2, the lower triangle, row by row. bias: (n,) Nm, Coriolis torque.
        limits: (n, COLUMNS), of `limits`. work: (2 n + WORK, n), anything.
    """
    n = len(q)
    ddq, low, high = work[2 * n], work[2 * n + 1], work[2 * n + 2]
    left = _left(q, dq, limits)
    for j in range(n):
        out[j] = left * effort[j]
        ddq[j] = out[j] - bias[j]
    _factor(mass, limits, work)
    _solve(work, ddq)
    within = True
    for j in range(n):
        up = _allowed(limits[j, Q_HIGH] - q[j], share, limits[j])
        down = _allowed(q[j] - limits[j, Q_LOW], share, limits[j])
        high[j], low[j] = RATE * (up - dq[j]), -RATE * (down + dq[j])
        within &= low[j] <= ddq[j] <= high[j]
    if not within:
        _widen(low, high, dq, out, friction, limits, work)
        within = True
        for j in range(n):
            within &= low[j] <= ddq[j] <= high[j]
    if not within:
        _push(ddq, low, high, work)
        for j in range(n):
            out[j] += work[2 * n + 3, j]
    part = 1.0
    for j in range(n):
        out[j] = min(max(out[j], -limits[j, TAU_MAX]), limits[j, TAU_MAX]) - last[j]
        if abs(out[j]) > limits[j, STEP]:
            part = min(part, limits[j, STEP] / abs(out[j]))
    for j in range(n):
        out[j] = last[j] + min(max(part * out[j], -limits[j, STEP]), limits[j, STEP])
    return left < 1.0 or not within


@njit(cache=True, error_model="numpy", forceinline=True)
def _left(q, dq, limits):
    """Return the share of its torque that a policy keeps: rule 1."""
    near = 0.0
    for j in range(len(q)):
        near = max(near, (abs(dq[j]) / limits[j, DQ_MAX] - ALLOWED) / (NOTHING - ALLOWED))
        near = max(near, max(q[j] - limits[j, Q_HIGH], limits[j, Q_LOW] - q[j]) / limits[j, Q_FADE])
    return 1.0 - min(near, 1.0)


@njit(cache=True, error_model="numpy", forceinline=True)
def _allowed(way, share, limits):
    """Return rad/s, how fast a joint may go that has `way` rad left; back, where there is none left."""
    speed = min(share * limits[MOST], APPROACH * way)
    if way > 0.0 and limits[SLOWING] < np.inf:
        speed = min(speed, np.sqrt(limits[SLOWING] * way + limits[OFFSET] ** 2) - limits[OFFSET])
    return speed


@njit(cache=True, error_model="numpy", forceinline=True)
def _factor(mass, limits, work):
    """Write Cholesky's root of the inertia, its diagonal inverted, into the first n rows of `work`."""
    for i in range(len(limits)):
        row = i * (i + 1) // 2
        d = mass[row + i] + limits[i, ADDED]
        for k in range(i):
            r = mass[row + k]
            for c in range(k):
                r -= work[i, c] * work[k, c]
            r *= work[k, k]
            work[i, k] = r
            d -= r * r
        work[i, i] = 1.0 / np.sqrt(d)


@njit(cache=True, error_model="numpy", forceinline=True)
def _solve(root, x):
    """Divide x (n,) by the inertia that `root` is of, in place."""
    n = len(x)
    for i in range(n):
        s = x[i]
        for k in range(i):
            s -= root[i, k] * x[k]
        x[i] = s * root[i, i]
    for i in range(n - 1, -1, -1):
        s = x[i]
        for c in range(i + 1, n):
            s -= root[c, i] * x[c]
        x[i] = s * root[i, i]


@njit(cache=True, error_model="numpy", forceinline=True)
def _widen(low, high, dq, out, friction, limits, work):
    """Widen the bounds by what friction may do to each joint, its neighbours' included; M^-1 is left in `work`."""
    n = len(low)
    root, mobility, eaten = work[:n], work[n : 2 * n], work[2 * n + 6]
    for j in range(n):
        eaten[j] = 0.0
        if friction[j] > 0.0 and limits[j, ADDED] > 0.0:  # of a joint that moves, or whose torque would move it
            eaten[j] = SURE * friction[j] * abs(np.tanh(dq[j] / DRY + out[j] / friction[j]))
    for k in range(n):
        for j in range(n):
            mobility[k, j] = 1.0 if j == k else 0.0
        _solve(root, mobility[k])
        wider = 0.0
        for j in range(n):
            wider += abs(mobility[k, j]) * eaten[j]
        low[k] -= wider
        high[k] += wider


@njit(cache=True, error_model="numpy", forceinline=True)
def _push(ddq, low, high, work):
    """Write the torques (n,) Nm that stops at the joints would add into row 2 n + 3 of `work`, which has M^-1.

    They solve the linear complementarity problem of low <= ddq + M^-1 push <= high, a joint's push towards the inside
    and only at a bound, by block principal pivoting (Judice and Pires, Computers & Operations Research 21(5), 1994).
    """
    n = len(ddq)
    root, mobility, push, side, other = work[:n], work[n : 2 * n], work[2 * n + 3], work[2 * n + 4], work[2 * n + 5]
    for k in range(n):
        side[k] = 1.0 if ddq[k] > high[k] else (-1.0 if ddq[k] < low[k] else 0.0)
    for turn in range(ROUNDS):
        for i in range(n):  # the pushes of the joints that are at a bound; Cholesky's root of their mobility
            push[i] = 0.0
            if side[i] == 0.0:
                continue
            s, d = (high[i] if side[i] > 0.0 else low[i]) - ddq[i], mobility[i, i]
            for k in range(i):
                if side[k] == 0.0:
                    continue
                r = mobility[i, k]
                for c in range(k):
                    if side[c] != 0.0:
                        r -= root[i, c] * root[k, c]
                r *= root[k, k]
                root[i, k] = r
                d -= r * r
                s -= r * push[k]
            root[i, i] = 1.0 / np.sqrt(d)
            push[i] = s * root[i, i]
        for i in range(n - 1, -1, -1):
            if side[i] == 0.0:
                continue
            s = push[i]
            for c in range(i + 1, n):
                if side[c] != 0.0:
                    s -= root[c, i] * push[c]
            push[i] = s * root[i, i]
        done = True
        for j in range(n - 1, -1, -1):
            reached = ddq[j]
            for k in range(n):
                reached += mobility[j, k] * push[k]
            other[j] = side[j]
            if side[j] * push[j] > 0.0:
                other[j] = 0.0  # it would pull outwards
            elif side[j] == 0.0:
                other[j] = 1.0 if reached > high[j] + EXACT else (-1.0 if reached < low[j] - EXACT else 0.0)
            done &= other[j] == side[j]
        if done:
            return
        for j in range(n - 1, -1, -1):
            if other[j] != side[j]:
                side[j] = other[j]
                if turn >= PIVOTS:
                    break
