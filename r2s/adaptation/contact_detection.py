"""Detect contacts (forces far above their standard deviation) and a payload's weight, in compiled code."""

import numpy as np

from r2s.adaptation import tuning
from r2s.adaptation.wrench_state import (
    ABOVE,
    BELOW,
    FAST,
    HANGING,
    IMPACT_ABOVE,
    IMPACT_SQUARE,
    REST,
    SQUARE,
    SURPRISE,
    SURPRISED,
    TOUCHES,
    USUAL,
)
from r2s.compiled import njit
from r2s.physics.robot import SIM_DT


@njit(cache=True, error_model="numpy")
def detect(thresholds, floor, state):
    """Detect the start and the end of a contact, but only while a joint moves: at rest, joint friction hides forces.

    A force test and an impact test check the hypothesis that no force acts. An impact raises the variances of the
    wrench filter, and high variances hide the impact from the force test. After a sudden rise of the innovations, the
    impact test therefore uses the covariance from before the rise, for at most IMPACT cycles. The impact test
    low-passes the force, because vibrating gears make the estimated force oscillate.
    """
    x, P, contact, calm, smooth = state.x, state.P, state.contact, state.calm, state.smooth
    n = state.joints.shape[1]
    moves = n - state.joints[REST].sum() >= 1
    sudden = moves and contact[SURPRISE] > max(1.0, tuning.SUDDEN * contact[USUAL])
    contact[SURPRISED] = contact[SURPRISED] + 1.0 if sudden else 0.0
    contact[USUAL] += SIM_DT * tuning.USUAL_RATE * (contact[SURPRISE] - contact[USUAL])
    if contact[SURPRISED] == 0.0 or contact[SURPRISED] > tuning.IMPACT:
        calm[:] = P[:3, :3]
    for c in range(3):
        smooth[c] = smooth[c] + SIM_DT * tuning.IMPACT_RATE * (x[c] - smooth[c]) if moves else x[c]
    contact[SQUARE] = _square(P, floor, x) if moves else 0.0
    contact[IMPACT_SQUARE] = _square(calm, floor, smooth) if moves else 0.0
    contact[ABOVE] = contact[ABOVE] + 1.0 if contact[SQUARE] > thresholds[0] else 0.0
    contact[IMPACT_ABOVE] = contact[IMPACT_ABOVE] + 1.0 if contact[IMPACT_SQUARE] > thresholds[1] else 0.0
    if moves and not sudden:
        contact[BELOW] = contact[BELOW] + 1.0 if contact[SQUARE] < tuning.RELEASE * thresholds[0] else 0.0
    if max(contact[ABOVE], contact[IMPACT_ABOVE]) >= tuning.CONFIRMED:
        contact[TOUCHES], contact[BELOW] = 1.0, 0.0
    elif contact[BELOW] >= tuning.RELEASED:
        contact[TOUCHES] = 0.0


@njit(cache=True, error_model="numpy")
def _square(P, floor, force):
    """Return the squared force f^T C^-1 f with f = `force` (3,) N and the covariance C = P[:3, :3] + floor^2 I."""
    square = floor**2
    a, b, c = P[0, 0] + square, P[1, 0], P[2, 0]
    d, e, f = P[1, 1] + square, P[2, 1], P[2, 2] + square
    l21, l31 = b / a, c / a  # L D L^T of the covariance
    d2 = d - l21 * b
    l32 = (e - l31 * b) / d2
    d3 = f - l31 * c - l32 * l32 * d2
    y2 = force[1] - l21 * force[0]
    y3 = force[2] - l31 * force[0] - l32 * y2
    return force[0] * force[0] / a + y2 * y2 / d2 + y3 * y3 / d3


@njit(cache=True, error_model="numpy")
def weigh(arm, state):
    """In contact, measure the tip's path with a downward force; after 5 cm, this force is a payload's weight."""
    x, P, joints, J, contact = state.x, state.P, state.joints, state.jacobian, state.contact
    g = np.sqrt((arm.gravity * arm.gravity).sum())
    if contact[TOUCHES] == 0.0 or g == 0.0:
        contact[HANGING] = 0.0
        return
    weight = square = speed = 0.0
    for c in range(3):
        weight += x[c] * arm.gravity[c] / g
        square += x[c] * x[c]
        moved = 0.0
        for j in range(joints.shape[1]):
            moved += J[c, j] * joints[FAST, j]
        speed += moved * moved
    across, allowed = square - weight * weight, 9.0 * (P[0, 0] + P[1, 1] + P[2, 2])
    path = np.sqrt(speed) * SIM_DT
    if weight > 0.0 and across < (tuning.WEIGHT_SHARE * weight) ** 2 + allowed:
        contact[HANGING] += path
    elif contact[HANGING] < tuning.WEIGHT_PATH:
        contact[HANGING] = max(contact[HANGING] - tuning.WEIGHT_LOSS * path, 0.0)
