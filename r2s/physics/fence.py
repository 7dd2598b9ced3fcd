"""The driver's fence stops an arm before it touches itself or the table; the compiled check takes microseconds.

The fence predicts the posture in which the arm would come to rest if it braked now. In this posture, no pair of
`CollisionCheck` may be closer than FENCE_M; at full speed, than FENCE_M (1 + SPREAD), because links swing while they
brake. A stop ramps the allowed speeds down within BRAKE_S, and joints follow the ramp LAG_S late. A joint that uses a
smaller share of its allowed speed than the fastest joint starts to brake when the ramp has fallen to this share. The
predicted posture moves continuously with the arm, so it cannot pass through an obstacle between two cycles.

An arm that starts closer may move away: the allowed distance of a pair is half of the pair's largest distance so far
in the motion, at most FENCE_M. A pair that overlaps at the start is ignored until it is apart.
"""

from typing import NamedTuple

import numpy as np

from r2s.compiled import njit
from r2s.physics.collision import CollisionCheck, Scene, body_poses, pair_distance
from r2s.physics.kinematics import POSE
from r2s.physics.safety_filter import BRAKE_S, DQ_ALLOWED, LATENCY_S, RATE

FENCE_M = 0.01  # m
SPREAD = 3.0  # simulated stops from full speed end up to 0.02 m from the prediction
LAG_S = 1 / RATE + LATENCY_S  # s, lag of a joint's speed behind the ramp


class Fence(NamedTuple):
    """Geometry for `breached`: links from `links_of`, and the scene of a `CollisionCheck`."""

    links: np.ndarray
    scene: Scene


def first_breaches(check: CollisionCheck, limits: np.ndarray, q: np.ndarray, dq: np.ndarray) -> np.ndarray:
    """Return, per motion q, dq (E, T, n), the index (E,) of the pair at which the driver would stop it, -1: none.

    limits: (n, COLUMNS) from `filter_limits`.
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
    """Return the number of the first pair that would come too close if the arm braked now, -1 for none.

    Args:
        fence: `Fence`. limits: (n, COLUMNS) of `filter_limits`.
        q, dq: (n,) rad, rad/s, finite.
        least: (K,) m, smallest allowed distance of each pair, -inf before a motion's first cycle; updated.
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
