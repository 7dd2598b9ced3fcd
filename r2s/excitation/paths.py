"""Find a joint-space path to a posture, and check limits and clearances along the path before an arm moves.

A path is an array of postures (k, n) rad without speeds; straight lines in joint space connect the postures.
motion_checks.py computes distances and clearances.
"""

from collections.abc import Iterator

import numpy as np

from r2s.errors import UserError
from r2s.excitation.motion_checks import CLEARANCE_M, Space
from r2s.physics.robot import Robot

CLOSER_M = 1e-3  # m; an arm that starts too near to an obstacle may come closer by CLOSER_M before it moves away
SAME = 1e-3  # rad; a joint closer than this to the target angle need not move


def approach(robot: Robot, q_from: np.ndarray, q_to: np.ndarray, *, what: str, space: Space) -> np.ndarray:
    """Return the first candidate path (k, n) rad from q_from to q_to without `path_violation`.

    The candidates are, in this order: the straight line; two lines through q_home; two paths that move one joint at a
    time, starting with the last or the first joint; two paths through q_home that also move one joint at a time.

    Args:
        robot: limits and links.
        q_from, q_to: (n,) rad, first and last posture.
        what: name of the path in the error message. space: object that computes the arm's distances.

    Raises:
        UserError: every candidate has a violation; the message describes the violation on the straight line.
    """
    first = ""
    for path in _candidates(robot, np.asarray(q_from, dtype=float), np.asarray(q_to, dtype=float)):
        violation = path_violation(robot, path, space)
        if not violation:
            return path
        first = first or violation
    raise UserError(f"{what}: {first}; no path through q_home or joint by joint is free either")


def _candidates(robot: Robot, a: np.ndarray, b: np.ndarray) -> Iterator[np.ndarray]:
    """Yield the candidate paths (k, n) rad from a to b (n,) rad, in the order of `approach`'s docstring."""
    home, last_first = robot.q_home, np.arange(robot.n)[::-1]
    yield np.array([a, b])
    yield np.array([a, home, b])
    for order in (last_first, last_first[::-1]):
        yield _one_by_one(a, b, order)
    for order in (last_first, last_first[::-1]):  # to q_home in this order, from q_home in the opposite order
        yield np.concatenate([_one_by_one(a, home, order), _one_by_one(home, b, order[::-1])[1:]])


def _one_by_one(a: np.ndarray, b: np.ndarray, order: np.ndarray) -> np.ndarray:
    """Return the path (k, n) rad from a to b (n,) that moves one joint after the other in the order `order`."""
    path = [a]
    for joint in order:
        if abs(b[joint] - path[-1][joint]) > SAME:
            path.append(np.where(np.arange(len(a)) == joint, b, path[-1]))
    return np.array([*path[: max(1, len(path) - 1)], b])


def path_violation(robot: Robot, path: np.ndarray, space: Space) -> str:
    """Return a description of the first violation of limits or clearances on a path (k, n) rad, or "".

    A distance that is already too small at the first posture (the present posture) may decrease by CLOSER_M at most.
    """
    if path.ndim != 2 or len(path) < 2 or path.shape[1] != robot.n:
        return f"expected postures of shape (2 or more, {robot.n}), got {path.shape}"
    if not np.isfinite(path).all():
        k, i = np.argwhere(~np.isfinite(path))[0]
        return f"joint {i + 1} of posture {k + 1} is {path[k, i]}"
    out = np.argwhere((path[1:] < robot.q_min) | (path[1:] > robot.q_max))
    if len(out):
        k, i = out[0]
        return (
            f"joint {i + 1} would be at {path[k + 1, i]:.4g} rad{_where(k, len(path), 1.0)}, allowed "
            f"{robot.q_min[i]:g} to {robot.q_max[i]:g}"
        )
    here = space.gaps(path[:1])[0]
    least = np.where(here < 0, here - CLOSER_M, 0.0)
    for k in range(len(path) - 1):
        # dense samples: between two of them, no point of the arm moves more than twice the clearance
        count = 1 + int(np.ceil(np.abs(path[k + 1] - path[k]).sum() * space.reach / (2 * CLEARANCE_M)))
        share = np.linspace(0, 1, count + 1)[1:]
        postures = path[k] + share[:, None] * (path[k + 1] - path[k])
        gaps = space.gaps(postures)
        bad = np.argwhere(~(gaps >= least))
        if len(bad):
            row, which = bad[0]
            return space.explain(int(which), postures[row], _where(k, len(path), share[row]).strip())
    return ""


def _where(leg: int, count: int, share: float) -> str:
    """Describe, for an error message, the point at the fraction `share` of a path's leg number `leg`."""
    which = "" if count == 2 else f", from posture {leg + 1} to {leg + 2} of {count}"
    return f" {100 * share:.0f} % of the way{which}"
