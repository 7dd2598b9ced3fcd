"""Stop an arm before it touches itself or the table: the driver runs a compiled check that takes microseconds.

The fence predicts the posture in which the arm would rest if it braked now. In the predicted posture, the bodies of
each pair of `CollisionCheck` must be at least FENCE_M apart. The required distance grows with speed, to FENCE_M (1 +
SPREAD) at full speed, because links swing while they brake. A stop ramps the allowed joint speeds down to 0 within
BRAKE_S, and joints follow the ramp with a lag of LAG_S. A joint begins to brake when the ramp has fallen to the
joint's ratio of speed to allowed speed, so the joint with the largest ratio brakes first. During a motion, the
predicted posture changes continuously, so it cannot jump over a body.

If two bodies are closer than FENCE_M at a motion's start, the arm may move them apart. The required distance of these
bodies is then half of their largest distance in the motion so far, but at most FENCE_M. The fence ignores initially
overlapping bodies until they separate.
"""

from typing import NamedTuple

import numpy as np

from r2s.compiled import njit
from r2s.physics.collision import CollisionCheck, Scene, body_poses, pair_distance
from r2s.physics.kinematics import POSE
from r2s.physics.safety_filter import BRAKE_S, DQ_ALLOWED, LATENCY_S, RATE

FENCE_M = 0.01  # m, required distance
SPREAD = 3.0  # in simulation, an arm that brakes from full speed rests up to 0.02 m from the predicted posture
LAG_S = 1 / RATE + LATENCY_S  # s, lag of a joint's speed behind the ramp


class Fence(NamedTuple):
    """Geometry for `breached`: the links that `links_of` returns, and the `scene` of a `CollisionCheck`."""

    links: np.ndarray
    scene: Scene


def first_breaches(check: CollisionCheck, limits: np.ndarray, q: np.ndarray, dq: np.ndarray) -> np.ndarray:
    """Return the index (E,) of the pair for which the driver would stop each motion q, dq (E, T, n); -1: no stop.

    limits: (n, COLUMNS), limits of the joints from `filter_limits`.
    """
    fence, out = Fence(check.links, check.scene), np.full(len(q), -1)
    for e in range(len(q)):
        least = np.full(len(check.names), -np.inf)
        for now, speed in zip(q[e], dq[e], strict=True):
            if out[e] < 0:
                out[e] = breached(fence, limits, now, speed, least)
    return out


@njit(cache=True, error_model="numpy")
def breached(fence, limits, q, dq, least):
    """Return the index of the first pair of bodies that would be too close if the arm braked now; -1: no pair.

    Args:
        fence: geometry. limits: (n, COLUMNS) of `filter_limits`.
        q, dq: (n,) rad, rad/s, finite joint angles and velocities.
        least: (K,) m, required distance of each pair, -inf before a motion; updated in place.
    """
    if len(least) == 0:
        return -1
    scene, n = fence.scene, len(q)
    frames, poses, work = np.empty((n, POSE)), np.empty((len(scene.bodies), POSE)), np.empty((10, 3))
    if least.min() < FENCE_M:
        body_poses(fence.links, scene.bodies, q, frames, poses)
        for k in range(len(least)):
            if least[k] < FENCE_M:
                distance = pair_distance(scene, k, 2 * FENCE_M, poses, work)
                if distance > 0.0:
                    least[k] = max(least[k], min(FENCE_M, 0.5 * distance))
    rest, fastest = np.empty(n), 0.0
    for j in range(n):
        fastest = max(fastest, abs(dq[j]) / limits[j, DQ_ALLOWED])
    for j in range(n):
        own = abs(dq[j]) / limits[j, DQ_ALLOWED]
        rest[j] = q[j] + dq[j] * (LAG_S + BRAKE_S * (fastest - 0.5 * own))
    body_poses(fence.links, scene.bodies, rest, frames, poses)
    wider = 1.0 + SPREAD * min(1.0, fastest)
    for k in range(len(least)):
        if pair_distance(scene, k, wider * least[k], poses, work) < wider * least[k]:
            return k
    return -1
