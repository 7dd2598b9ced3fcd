"""Compute one driver cycle for m arms (compiled); `DriverBatch` (r2s/arm/driver.py) does so every millisecond."""

from typing import NamedTuple

import numpy as np

from r2s.compiled import njit
from r2s.physics.actuation import condition
from r2s.physics.contact_stop import LEAVES_S, OVER, stop_torque
from r2s.physics.control_laws import control_law
from r2s.physics.fence import Fence, breached
from r2s.physics.kinematics import POSE, link_frames
from r2s.physics.newton_euler import WORK as DESK
from r2s.physics.newton_euler import equations
from r2s.physics.push_limit import PHASE, limit_pushes
from r2s.physics.robot import SIM_DT
from r2s.physics.safety_filter import (
    BRAKE_S,
    DQ_ALLOWED,
    STEP,
    TAU_MAX,
    WORK,
    JointDynamics,
    fade,
    limit_acceleration,
    limit_rate,
)

STILL = 0.02  # rad/s, speed below which a joint is treated as at rest
# rad/s, natural frequency of the spring that `resist` adds to a joint that still slides during a stop
# Our choice: half of RATE of the safety filter, because the filter damps this spring.
SPRING = 15.0
RELEASE = 0.2  # 1/s, share of tau_max per s by which a held torque falls while it acts along the motion; our choice
ADDED = 0.3  # share of tau_max that an adapter may add; enough for friction and 1.5 kg anywhere in a Panda's reach
RUNS, SILENT, NOT_FINITE, OUTSIDE, LAW_NOT_FINITE, REQUESTED = range(6)  # values of `Memory.why`
TOO_NEAR = 100  # `Memory.why` is TOO_NEAR + k if the bodies of pair k in `CollisionCheck` would come too near


class Memory(NamedTuple):
    """State of the driver for m arms; `drive_cycle` updates this state in place.

    Attributes:
        command: (m, c), the last finite commands (no NaN, no infinity). law: (m, k), memory of the control law.
        target: (m, n) Nm, torque of the control law or of a stop. filtered, effort: (m, n) Nm, see `condition_joint`.
        sent: (m, n) Nm, the last torque command.
        held: (m, n) Nm, last sum of adapter torque and `Given.hold`; a stop without contact still applies this sum.
        share: (m,), factor on the allowed speeds; it is 1 in a motion and decreases during a stop (`_brake`).
        cycle, silent, damped: (m,) each, number of cycles since the motion began, since the last finite command, and
            since the stop began.
        why: (m,), reason code of a stop; RUNS: no stop.
        limited: (m,), number of cycles in which the safety filter changed the torque.
        rests: (m,), whether each arm is at rest. commanded: (m,), whether each arm has received a command.
        least: (m, K) m, required distance between the two bodies of each of K pairs (fence.py).
        push: (m, COLUMNS), parameters and state of the push limit (push_limit.py); (m, 0): no push limit.
    """

    command: np.ndarray
    law: np.ndarray
    target: np.ndarray
    filtered: np.ndarray
    effort: np.ndarray
    sent: np.ndarray
    held: np.ndarray
    share: np.ndarray
    cycle: np.ndarray
    silent: np.ndarray
    damped: np.ndarray
    why: np.ndarray
    limited: np.ndarray
    rests: np.ndarray
    commanded: np.ndarray
    least: np.ndarray
    push: np.ndarray

    @staticmethod
    def fresh(m: int, n: int, command: int, law: int, pairs: int, push: np.ndarray) -> "Memory":
        """Return the driver's state before the first cycle, for m arms with n joints each: all torques are zero."""
        own = np.zeros((m, command)), np.zeros((m, law))
        count, flags = np.zeros((5, m), dtype=np.int64), np.zeros((2, m), dtype=bool)
        least = np.full((m, pairs), -np.inf)
        own_push = np.tile(push, (m, 1))
        return Memory(*own, *np.zeros((5, m, n)), np.ones(m), *count, *flags, least, own_push)  # type: ignore[call-arg]


class Given(NamedTuple):
    """Inputs of the driver of m arms in one cycle.

    command: (m, c), commands, used if `new` is True. added: (m, n) Nm, adapter torques, used if `adds` is True.
    hold: (m, n) Nm, part of the target torque that a stop still applies. contact: (m,), whether each arm has contact.
    """

    command: np.ndarray
    new: bool
    added: np.ndarray
    adds: bool
    hold: np.ndarray
    contact: np.ndarray


class Bounds(NamedTuple):
    """Settings of the driver.

    torque, added: (n,) Nm, largest target torque, and largest torque of an adapter.
    q_low, q_high, dq_max: (n,) rad, rad/s, limits beyond which the driver stops an arm.
    deadline: s, longest time without a finite command; after this time, the driver stops an arm.
    spring: (n,) Nm/rad, stiffness for `resist`. factor: gain of the low-pass. fade: number of soft-start cycles.
    """

    torque: np.ndarray
    added: np.ndarray
    spring: np.ndarray
    q_low: np.ndarray
    q_high: np.ndarray
    dq_max: np.ndarray
    deadline: float
    factor: float
    fade: int


class Model(NamedTuple):
    """Model of the arm: friction (n,) Nm, links from `links_of`, rotors (n,) kg m^2, limits from `filter_limits`."""

    friction: np.ndarray
    links: np.ndarray
    rotors: np.ndarray
    limits: np.ndarray
    fence: Fence


@njit(cache=True)
def _watch(i, q, dq, given, bounds, memory):
    """Check the inputs of arm i; return whether all elements of q and dq are finite.

    Store a new command unless the command or the adapter's torque contains NaN or infinity. Set `why` if the arm must
    stop.
    """
    seen = np.isfinite(q).all() and np.isfinite(dq).all()
    helped = given.adds and np.isfinite(given.added[i]).all()
    if given.new and np.isfinite(given.command[i]).all() and helped == given.adds:
        memory.command[i] = given.command[i]
        memory.commanded[i] = True
        memory.silent[i] = 0
    else:
        memory.silent[i] += 1
    if memory.why[i] == RUNS:
        if memory.silent[i] * SIM_DT > bounds.deadline:
            memory.why[i] = SILENT
        elif not seen:
            memory.why[i] = NOT_FINITE
        elif not ((q >= bounds.q_low).all() and (q <= bounds.q_high).all() and (np.abs(dq) <= bounds.dq_max).all()):
            memory.why[i] = OUTSIDE
    return seen


@njit(cache=True)
def resist(dq, spring, most, held):
    """Adjust the torque `held` (n,) Nm of a stop to brake the joints that still move; dq: (n,) rad/s, joint speeds.

    A joint may continue to move because of an undeclared load, or because `held` compensates its kinetic friction.

    Args:
        spring: (n,) Nm/rad, SPRING^2 times each joint's inertia. most: (n,) Nm, largest magnitude of `held`.
    """
    for j in range(len(held)):
        if abs(dq[j]) > STILL:
            if dq[j] * held[j] > 0.0:
                held[j] -= min(RELEASE * SIM_DT / ADDED * most[j], abs(held[j])) * np.sign(dq[j])
            held[j] = min(max(held[j] - SIM_DT * spring[j] * dq[j], -most[j]), most[j])


@njit(cache=True)
def _compensate(i, dq, stopping, given, bounds, memory, target):
    """Add the adapter's torque to the effort `target` (n,) Nm of arm i; during a stop, add `Memory.held` instead."""
    adds = given.adds and np.isfinite(given.added[i]).all()
    faded = min(1.0, memory.cycle[i] / bounds.fade) if bounds.fade > 0 else 1.0
    if stopping and memory.share[i] == 0.0:
        resist(dq, bounds.spring, bounds.added, memory.held[i])
    for j in range(len(target)):
        most = bounds.added[j]
        if given.contact[i]:  # compensation must not continue to push on an obstacle
            memory.held[i, j] = 0.0
        elif not stopping:
            held = faded * min(max(given.added[i, j], -most), most) if adds else 0.0
            memory.held[i, j] = min(max(held + given.hold[i, j], -most), most)
        if stopping:
            target[j] += memory.held[i, j]
        elif adds:
            target[j] += faded * min(max(given.added[i, j], -most), most)


@njit(cache=True)
def _kinematics(model, q):
    """Return the last link's position and rotation, the link frames, and the joint axes, at q (n,) rad."""
    n = len(q)
    frames, axes = np.empty((n, POSE)), np.empty((n, 3))
    link_frames(model.links, q, frames, axes)
    return frames[n - 1, :3], frames[n - 1, 3:], frames, axes


@njit(cache=True)
def _brake(i, seen, arm, bounds, model, memory):
    """Set the target torque of arm i in a stop, and lower the allowed speeds from the present speed toward zero.

    If the driver has a push limit and the stop code is SILENT, LAW_NOT_FINITE or REQUESTED, `stop_torque` computes
    the torque that holds or ends a contact.
    """
    needs, why = 0.0, memory.why[i]
    memory.target[i] = 0.0
    if seen and memory.damped[i] == 1:
        memory.share[i] = min(1.0, (np.abs(arm.dq) / model.limits[:, DQ_ALLOWED]).max())
    if seen and len(memory.push[i]) > 0 and why in (SILENT, LAW_NOT_FINITE, REQUESTED):
        if memory.damped[i] * SIM_DT > LEAVES_S:
            memory.push[i, PHASE] = OVER
        own = memory.push[i], arm, _kinematics(model, arm.q)
        needs = stop_torque(*own, model.friction, model.limits, memory.held[i], memory.target[i])
        memory.target[i] = np.minimum(np.maximum(memory.target[i], -bounds.torque), bounds.torque)
        memory.rests[i] &= memory.push[i, PHASE] == OVER
    memory.share[i] = max(needs, memory.share[i] - SIM_DT / BRAKE_S)


@njit(cache=True)
def drive_cycle(q, dq, applied, given, control, bounds, model, memory):
    """Return the torque commands (m, n) Nm of this cycle.

    Args:
        q, dq: (m, n) rad, rad/s, measured. applied: (m, n) Nm, torques that the arms applied in the last cycle.
        given, bounds, model: see `Given`, `Bounds`, `Model`. control: number and parameters of the control law.
        memory: `Memory`, updated in place.
    """
    out, (m, n) = np.empty_like(memory.sent), q.shape
    number, parameters = control
    limits = model.limits
    work, effort = np.empty((2 * n + WORK, n)), np.empty((1, 1, n))
    inertia, bias, desk, weightless = np.empty((n, n)), np.zeros(n), np.empty((n, DESK)), np.zeros(3)
    mass, law_torque = np.empty(n * (n + 1) // 2), np.empty(n)  # mass: lower triangle of the mass matrix, by rows
    for i in range(m):
        seen = _watch(i, q[i], dq[i], given, bounds, memory)
        if seen and memory.why[i] == RUNS:
            pair = breached(model.fence, limits, q[i], dq[i], memory.least[i])
            if pair >= 0:
                memory.why[i] = TOO_NEAR + pair
        stopping = memory.why[i] != RUNS
        memory.damped[i] += stopping
        memory.rests[i] = seen and (np.abs(dq[i]) < STILL).all()
        arm = JointDynamics(q[i], dq[i], mass, bias)
        if seen:
            equations(model.links, weightless, q[i], dq[i], inertia, bias, desk)
            for j in range(n):
                inertia[j, j] += model.rotors[j]
                for k in range(j + 1):
                    mass[j * (j + 1) // 2 + k] = inertia[j, k]
        if stopping:
            _brake(i, seen, arm, bounds, model, memory)
        elif memory.commanded[i]:
            control_law(number, q[i], dq[i], memory.command[i], parameters, memory.law[i], law_torque)
            if np.isfinite(law_torque).all():
                memory.target[i] = np.minimum(np.maximum(law_torque, -bounds.torque), bounds.torque)
            else:
                memory.why[i] = LAW_NOT_FINITE
                memory.target[i] = 0.0
        at = slice(i, i + 1)
        conditioned = memory.filtered[at], memory.effort[at], memory.cycle[at]
        settings = bounds.factor, bounds.fade, limits[:, TAU_MAX], limits[:, STEP]
        condition(memory.target[at], conditioned, settings, 1, effort)
        last = applied[i] if np.isfinite(applied[i]).all() else memory.sent[i]
        if seen:
            share, now = memory.share[i], effort[0, 0]
            _compensate(i, dq[i], stopping, given, bounds, memory, now)
            changed = fade(q[i], dq[i], now, limits, out[i])
            if len(memory.push[i]) == 0:
                changed |= limit_acceleration(arm, share, model.friction, limits, work, out[i])
            else:
                own = memory.push[i], arm, _kinematics(model, q[i])
                changed |= limit_pushes(*own, last, share, model.friction, limits, out[i])
            limit_rate(last, limits, out[i])
            memory.limited[i] += changed
        else:
            for j in range(n):
                out[i, j] = last[j] + min(max(-last[j], -limits[j, STEP]), limits[j, STEP])
        memory.sent[i] = out[i]
    return out
