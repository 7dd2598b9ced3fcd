"""Compute the momentum residual: the mean over 60 ms of the torque that command, friction and links do not explain.

The change of momentum equals the integral of all torques, so the residual needs no accelerations. Let I be the
integral of the model torque, p the momentum, and m the moving average of I - p. The residual y = (m(t) - m(t - T)) /
T in Nm compares two averages that lie one span, T = 20 ms, apart. The residual is linear in the unknown parameters x:
y = H x + noise.

The moving average has triangular weights over two spans (40 ms), so y averages torque with the weights of a quadratic
spline over three spans (60 ms). Elastic gears vibrate at 50 to 60 Hz and change the momentum at a rate of 10 to 30
Nm. Sampling the momentum every 20 ms would alias a vibration of 50 to 60 Hz to a few hertz. The triangular weights
pass 2.4 % of a 60 Hz vibration, the spline weights 0.4 %.
"""

from typing import NamedTuple

import numpy as np

from r2s.adaptation.arm_model import friction_torque
from r2s.adaptation.momentum import BODY, MOMENTUM_WORK, MomentumTerms, momentum
from r2s.adaptation.tuning import SLIDING_DEFLECTION, SLIDING_SPEED, SPAN
from r2s.compiled import njit
from r2s.physics.actuation import SLOTS, motor_torque
from r2s.physics.newton_euler import WORK, equations
from r2s.physics.robot import SIM_DT

CYCLE, COMMAND, ENDED = range(3)  # indices of `counts`: cycles of this span, all commands, ended spans (at most 3)
BEFORE, INTEGRAL = range(2)  # rows of `model`, `friction`, `payload`: value in the last cycle; integral over the span
# rows of `sums`: residual Nm s, friction Nm s, momentum Nm s, q, dq, motor torque Nm
RESIDUAL, FRICTION, MOMENTUM, ANGLE, SPEED, MOTOR, SUMS = range(7)
# first index of `sums`: this span's falling and rising side of a triangle; last span's rising side and whole triangle
FALLING, RISING, LAST_RISING, LAST_WHOLE = range(4)
RISING_SUM = SPAN * (SPAN + 1) // 2  # sum of a rising side's weights 1 to SPAN; a falling side has SPAN - 1 to 0
STEP_RESPONSE = np.array([1 / 6, 5 / 6])  # share of a torque step in the first and the second residual


class ResidualState(NamedTuple):
    """The state of `update_residual` between cycles, for n joints."""

    counts: np.ndarray  # (3,): CYCLE, COMMAND, ENDED
    commands: np.ndarray  # (SLOTS, n) Nm, delay line
    motor: np.ndarray  # (n,) Nm, motor torque after the lag
    motor_mean: np.ndarray  # (n,) Nm, mean motor torque in the coming cycle
    deflection: np.ndarray  # (n,), presliding deflection in [-1, 1]
    model: np.ndarray  # (2, n): BEFORE Nm, INTEGRAL Nm s of the model torque
    friction: np.ndarray  # (2, n): BEFORE Nm, INTEGRAL Nm s of friction
    payload: np.ndarray  # (2, n, 10): BEFORE, INTEGRAL of `MomentumTerms.payload_torque`
    sums: np.ndarray  # (4, SUMS, n), triangle sums
    payload_sums: np.ndarray  # (4, n, 10)
    motor_spans: np.ndarray  # (2, n) Nm, mean motor torque of the last two spans, latest first
    slid: np.ndarray  # (2, n), 1 if the joint slid throughout the span; rows: last span, last but one
    terms: MomentumTerms  # terms of this cycle
    work: np.ndarray

    @staticmethod
    def fresh(n: int) -> "ResidualState":
        """Return the state of `update_residual` for n joints before the first cycle."""
        shapes = [(SLOTS, n), (n,), (n,), (n,), (2, n), (2, n), (2, n, BODY), (4, SUMS, n), (4, n, BODY)]
        arrays = map(np.zeros, [*shapes, (2, n), (2, n)])
        work = np.zeros((n, max(MOMENTUM_WORK, WORK)))
        return ResidualState(np.array([0, SLOTS, 0]), *arrays, MomentumTerms.empty(n), work)  # type: ignore[arg-type,call-arg]


class MomentumResidual(NamedTuple):
    """Residual of n joints at the end of a 20 ms span; all means are over the last three spans (60 ms)."""

    y: np.ndarray  # (n,) Nm, the residual
    payload: np.ndarray  # (n, 10), derivative of y with respect to the payload's parameters
    friction: np.ndarray  # (n,) Nm, mean
    friction_path: np.ndarray  # (n,) Nm, total variation of friction in the last span
    sliding: np.ndarray  # (n,), 1 if the joint slid throughout the three spans
    rate: np.ndarray  # (n,) Nm, mean rate of the momentum
    acceleration: np.ndarray  # (n,) rad/s^2, mean
    torque_rate: np.ndarray  # (n,) Nm/s, mean rate of the motor torque
    q: np.ndarray  # (n,) rad, mean
    dq: np.ndarray  # (n,) rad/s, mean
    gear: np.ndarray  # (n, n) Nm^2/rad, derivative of y with respect to the gears' compliances

    @staticmethod
    def empty(n: int) -> "MomentumResidual":
        """Return a residual of n joints, whose values `update_residual` overwrites."""
        arrays = {name: np.zeros(n) for name in MomentumResidual._fields}
        arrays |= {"payload": np.zeros((n, BODY)), "sliding": np.ones(n), "gear": np.zeros((n, n))}
        return MomentumResidual(**arrays)


@njit(cache=True, error_model="numpy")
def update_residual(arm, state, q, dq, tau, out):
    """Process one cycle; return whether a 20 ms span ended and `out` contains this span's residual.

    Args:
        arm: `ArmModel`. state: `ResidualState`, updated in place. q, dq: (n,) rad, rad/s, measured in this cycle.
        tau: (n,) Nm, command sent in this cycle, without gravity. out: `MomentumResidual`, updated in place.
    """
    counts = state.counts
    momentum(arm, q, dq, state.terms, state.work)
    _integrate(arm, state, q, dq, out)
    _add_to_sums(state, q, dq)
    counts[CYCLE] += 1
    ended = counts[CYCLE] == SPAN
    if ended:
        counts[CYCLE], counts[ENDED] = 0, min(counts[ENDED] + 1, 3)
        _close_span(arm, state, out)
    state.commands[counts[COMMAND] % SLOTS] = tau
    motor_torque(state.commands, state.motor, counts[COMMAND], arm.latency[0], arm.latency[1], state.motor_mean)
    counts[COMMAND] += 1
    return ended and counts[ENDED] > 2


@njit(cache=True, error_model="numpy")
def _integrate(arm, state, q, dq, out):
    """Add one cycle to the integrals of model torque, friction and `payload_torque` (momentum.py)."""
    h, counts, terms = SIM_DT, state.counts, state.terms
    model, friction, payload, deflection = state.model, state.friction, state.payload, state.deflection
    path, sliding = out.friction_path, out.sliding
    begun = counts[CYCLE] > 0 or counts[ENDED] > 0
    for j in range(len(q)):
        if counts[CYCLE] == 0:
            path[j], sliding[j] = 0.0, 1.0
        v = dq[j]
        side = 1.0 if v > 0.0 else -1.0
        z = side + (deflection[j] - side) * np.exp(-abs(v) * h / arm.presliding[j])
        deflection[j] = z
        sin, cos = np.sin(q[j]), np.cos(q[j])
        level = arm.load[j] * abs(terms.compensated[j]) + arm.angle_friction[j, 0] * sin
        level += arm.angle_friction[j, 1] * cos
        f = friction_torque(arm.table[j], arm.max_speed[j], v, z) + level * z
        cable = arm.drag[j, 0] * sin + arm.drag[j, 1] * cos
        torque = arm.offset[j] + cable + terms.coriolis[j] - terms.uncompensated[j] - f
        if abs(z) < SLIDING_DEFLECTION or abs(v) < SLIDING_SPEED:
            sliding[j] = 0.0
        if begun:
            model[INTEGRAL, j] += h * (0.5 * (model[BEFORE, j] + torque) + state.motor_mean[j])
            friction[INTEGRAL, j] += 0.5 * h * (friction[BEFORE, j] + f)
            path[j] += abs(f - friction[BEFORE, j])
            for c in range(BODY):
                payload[INTEGRAL, j, c] += 0.5 * h * (terms.payload_torque[j, c] + payload[BEFORE, j, c])
        model[BEFORE, j], friction[BEFORE, j] = torque, f
        for c in range(BODY):
            payload[BEFORE, j, c] = terms.payload_torque[j, c]


@njit(cache=True, error_model="numpy")
def _add_to_sums(state, q, dq):
    """Add this cycle to two sums with triangular weights: one peaks at the start of this span, one at the end."""
    rising, p, payload_p = state.counts[CYCLE] + 1, state.terms.p, state.terms.payload_p
    for k, weight in ((FALLING, SPAN - rising), (RISING, rising)):
        sums, payload_sums = state.sums[k], state.payload_sums[k]
        for j in range(len(q)):
            sums[RESIDUAL, j] += weight * (state.model[INTEGRAL, j] - p[j])
            sums[FRICTION, j] += weight * state.friction[INTEGRAL, j]
            sums[MOMENTUM, j] += weight * p[j]
            sums[ANGLE, j] += weight * q[j]
            sums[SPEED, j] += weight * dq[j]
            sums[MOTOR, j] += weight * state.motor_mean[j]
            for c in range(BODY):
                payload_sums[j, c] += weight * (payload_p[j, c] - state.payload[INTEGRAL, j, c])


@njit(cache=True, error_model="numpy")
def _close_span(arm, state, out):
    """Write the residual at the end of a 20 ms span; reset all integrals to zero, so that no integral grows large."""
    whole = SPAN * SPAN  # sum of the weights of a triangle
    scale = 1.0 / (whole * SPAN * SIM_DT)  # converts a difference of sums to the rate of change of a mean
    sums, slid, n = state.sums, state.slid, len(out.y)
    curvature = np.empty(n)  # Nm/s^2, second derivative of the motor torque
    for j in range(n):
        motor = (sums[FALLING, MOTOR, j] + sums[RISING, MOTOR, j]) / whole  # a cycle's weights add up to SPAN
        spans = state.motor_spans
        curvature[j] = (motor - 2.0 * spans[0, j] + spans[1, j]) / (SPAN * SIM_DT) ** 2
        spans[1, j], spans[0, j] = spans[0, j], motor
        for i in range(SUMS):
            sums[FALLING, i, j] += sums[LAST_RISING, i, j]
        out.y[j] = (sums[FALLING, RESIDUAL, j] - sums[LAST_WHOLE, RESIDUAL, j]) * scale
        out.friction[j] = (sums[FALLING, FRICTION, j] - sums[LAST_WHOLE, FRICTION, j]) * scale
        out.rate[j] = (sums[FALLING, MOMENTUM, j] - sums[LAST_WHOLE, MOMENTUM, j]) * scale
        out.acceleration[j] = (sums[FALLING, SPEED, j] - sums[LAST_WHOLE, SPEED, j]) * scale
        out.torque_rate[j] = (sums[FALLING, MOTOR, j] - sums[LAST_WHOLE, MOTOR, j]) * scale
        out.q[j] = 0.5 * (sums[FALLING, ANGLE, j] + sums[LAST_WHOLE, ANGLE, j]) / whole
        out.dq[j] = 0.5 * (sums[FALLING, SPEED, j] + sums[LAST_WHOLE, SPEED, j]) / whole
        now = out.sliding[j]
        out.sliding[j], slid[0, j], slid[1, j] = now * slid[0, j] * slid[1, j], now, slid[0, j]
        for i in range(SUMS):
            start = (
                state.model[INTEGRAL, j] if i == RESIDUAL else state.friction[INTEGRAL, j] if i == FRICTION else 0.0
            )
            sums[LAST_WHOLE, i, j] = sums[FALLING, i, j] - whole * start
            sums[LAST_RISING, i, j] = sums[RISING, i, j] - RISING_SUM * start
            sums[FALLING, i, j], sums[RISING, i, j] = 0.0, 0.0
        state.model[INTEGRAL, j], state.friction[INTEGRAL, j] = 0.0, 0.0
        for c in range(BODY):
            of, start = state.payload_sums[:, j, c], -state.payload[INTEGRAL, j, c]
            of[FALLING] += of[LAST_RISING]
            out.payload[j, c] = (of[FALLING] - of[LAST_WHOLE]) * scale
            of[LAST_WHOLE] = of[FALLING] - whole * start
            of[LAST_RISING] = of[RISING] - RISING_SUM * start
            of[FALLING], of[RISING], state.payload[INTEGRAL, j, c] = 0.0, 0.0, 0.0
    equations(arm.links, arm.gravity, out.q, np.zeros(n), out.gear, np.empty(n), state.work)
    for j in range(n):
        for i in range(n):
            out.gear[j, i] *= curvature[i]
            out.y[j] += out.gear[j, i] * arm.compliance[i]
