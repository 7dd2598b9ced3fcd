"""Detect contacts by forces far above their standard deviation, and recognize a payload's weight; compiled."""

import numpy as np

from r2s.adaptation import tuning
from r2s.adaptation.wrench_state import ABOVE, BELOW, FAST, HANGING, REST, SQUARE, TOUCHES
from r2s.compiled import njit
from r2s.physics.robot import SIM_DT


@njit(cache=True, error_model="numpy")
def detect(threshold, floor, state):
    """Test whether a contact begins or ends, if any joint moves; friction of resting joints hides forces."""
    x, P, contact = state.x, state.P, state.contact
    square = floor**2
    a, b, c = P[0, 0] + square, P[1, 0], P[2, 0]
    d, e, f = P[1, 1] + square, P[2, 1], P[2, 2] + square
    l21, l31 = b / a, c / a  # L D L^T of the force's covariance
    d2 = d - l21 * b
    l32 = (e - l31 * b) / d2
    d3 = f - l31 * c - l32 * l32 * d2
    y2 = x[1] - l21 * x[0]
    y3 = x[2] - l31 * x[0] - l32 * y2
    n = state.joints.shape[1]
    moves = n - state.joints[REST].sum() >= 1
    contact[SQUARE] = x[0] * x[0] / a + y2 * y2 / d2 + y3 * y3 / d3 if moves else 0.0
    contact[ABOVE] = contact[ABOVE] + 1.0 if contact[SQUARE] > threshold else 0.0
    if moves:
        contact[BELOW] = contact[BELOW] + 1.0 if contact[SQUARE] < tuning.RELEASE * threshold else 0.0
    if contact[ABOVE] >= tuning.CONFIRMED:
        contact[TOUCHES], contact[BELOW] = 1.0, 0.0
    elif contact[BELOW] >= tuning.RELEASED:
        contact[TOUCHES] = 0.0


@njit(cache=True, error_model="numpy")
def weigh(arm, state):
    """Add up the tip's travel while the force points down; beyond 5 cm, the force is a payload's weight."""
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
