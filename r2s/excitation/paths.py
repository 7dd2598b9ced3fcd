"""Ways from posture to posture, checked before an arm is driven along them: limits, the table, the arm itself.

A path is a few postures (k, n) rad; from each to the next an arm goes straight in joint angles, however fast. The
distances and clearances are those of motions (r2s/excitation/safety.py).
"""

from collections.abc import Iterator

import numpy as np

from r2s.errors import UserError
from r2s.excitation.safety import CLEARANCE_M, TABLE_M, TOOL_M, Space
from r2s.physics.robot import Robot

NEARER_M = 1e-3  # that an arm which is too near to something already may still come on its way off
SAME = 1e-3  # rad: a joint nearer than this to where it is to go is there


def check_path(
    robot: Robot,
    path: np.ndarray,
    *,
    what: str = "the path",
    table: float = TABLE_M,
    z_min: float = TOOL_M,
    space: Space | None = None,
) -> None:
    """Raise UserError where a path leaves the limits or comes too near to the table or to the arm itself.

    The first posture is where the arm is, whether that is allowed or not: from there, distances that are less than
    allowed may not become less still.

    Args:
        robot: its limits and links.
        path: (k, n) rad, k >= 2.
        what: it is, for the message.
        table, z_min: m, as in `check_motion`. space: made of them before, which saves time.

    Raises:
        UserError: which joint or link, where on which leg, the value, and what is allowed.
    """
    space = space or Space(robot, table=table, z_min=z_min)
    if why := _forbids(robot, np.asarray(path, dtype=float), space):
        raise UserError(f"{what}: {why}")


def approach(
    robot: Robot,
    q_from: np.ndarray,
    q_to: np.ndarray,
    *,
    what: str = "the approach",
    table: float = TABLE_M,
    z_min: float = TOOL_M,
    space: Space | None = None,
) -> np.ndarray:
    """Return a path (k, n) rad from where the arm is to q_to that `check_path` allows: the first of a few.

    Straight; by way of home; joint by joint, from the hand to the base or from the base to the hand; and so to home
    first. The first posture of the path is q_from, the last one q_to.

    Args:
        robot: its limits and links.
        q_from, q_to: (n,) rad.
        what: it is, for the message.
        table, z_min: m, as in `check_motion`. space: made of them before, which saves time.

    Raises:
        UserError: what forbids the straight way, where all others are forbidden, too.
    """
    space = space or Space(robot, table=table, z_min=z_min)
    first = ""
    for path in _ways(robot, np.asarray(q_from, dtype=float), np.asarray(q_to, dtype=float)):
        why = _forbids(robot, path, space)
        if not why:
            return path
        first = first or why
    raise UserError(f"{what}: {first}; by way of home and joint by joint there is no way, either")


def _ways(robot: Robot, a: np.ndarray, b: np.ndarray) -> Iterator[np.ndarray]:
    """Yield paths (k, n) from a to b (n,), the simplest first."""
    home, hand_first = robot.q_home, np.arange(robot.n)[::-1]
    yield np.array([a, b])
    yield np.array([a, home, b])
    for order in (hand_first, hand_first[::-1]):
        yield _one_by_one(a, b, order)
    for order in (hand_first, hand_first[::-1]):  # away in this order, and there in the opposite one
        yield np.concatenate([_one_by_one(a, home, order), _one_by_one(home, b, order[::-1])[1:]])


def _one_by_one(a: np.ndarray, b: np.ndarray, order: np.ndarray) -> np.ndarray:
    """Return the path (k, n) on which one joint after the other goes from a to b (n,)."""
    path = [a]
    for joint in order:
        if abs(b[joint] - path[-1][joint]) > SAME:
            path.append(np.where(np.arange(len(a)) == joint, b, path[-1]))
    return np.array([*path[: max(1, len(path) - 1)], b])


def _forbids(robot: Robot, path: np.ndarray, space: Space) -> str:
    """Return what forbids a path (k, n), "" where nothing does."""
    if path.ndim != 2 or len(path) < 2 or path.shape[1] != robot.n:
        return f"postures of shape {path.shape} are no path of {robot.name}; (2 or more, {robot.n}) are"
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
    least = np.where(here < 0, here - NEARER_M, 0.0)
    for k in range(len(path) - 1):
        # no point of the arm goes farther between two samples than twice the clearance
        count = 1 + int(np.ceil(np.abs(path[k + 1] - path[k]).sum() * space.reach / (2 * CLEARANCE_M)))
        share = np.linspace(0, 1, count + 1)[1:]
        gaps = space.gaps(path[k] + share[:, None] * (path[k + 1] - path[k]))
        bad = np.argwhere(~(gaps >= least))
        if len(bad):
            row, which = bad[0]
            return space.explain(int(which), gaps[row, which], _where(k, len(path), share[row]).strip())
    return ""


def _where(leg: int, count: int, share: float) -> str:
    """Return in words where on a path of `count` postures this share of a leg is."""
    which = "" if count == 2 else f", from posture {leg + 1} to {leg + 2} of {count}"
    return f" {100 * share:.0f} % of the way{which}"
