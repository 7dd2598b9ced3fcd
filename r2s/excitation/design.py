"""Design, segment by segment, a motion of up to ten minutes that makes chosen parameters well identifiable.

A segment is the Fourier series (fourier.py) that best complements the earlier segments (sequential design: Chernoff,
Ann. Math. Stat. 30(3), 1959). Between two segments the arm follows a checked path with minimum jerk.
"""

from collections.abc import Callable
from itertools import pairwise
from typing import Protocol

import numpy as np

from r2s.errors import check_number
from r2s.excitation.fourier import ACCELERATION, LEAST_S, SPEED, Candidates
from r2s.excitation.information import COARSE_HZ
from r2s.excitation.minimum_jerk import minimum_jerk
from r2s.excitation.motion import Excitation
from r2s.excitation.motion_checks import TORQUE_SHARE, Space, check_motion, torque_share
from r2s.excitation.paths import approach
from r2s.physics.robot import SIM_DT, Robot

SEGMENT_S = 60.0  # s, longest segment: two minutes of a series need 1 GB
LONGEST_S = 600.0
PEAKS = 1.875, 5.7735  # peak velocity and acceleration of a minimum-jerk motion of 1 rad in 1 s
# s, shortest leg; factor on a leg's duration if the torque is too high; largest number of trials
SHORTEST_WAY_S, SLOWER, MOST_SLOWER = 0.5, 1.5, 8
EVERY = round(1 / (COARSE_HZ * SIM_DT))  # ms between two samples that a design evaluates


class Design(Protocol):
    """The criterion for choosing the next motion, given the motions chosen so far."""

    def score(self, t: np.ndarray, q: np.ndarray, dq: np.ndarray, ddq: np.ndarray) -> np.ndarray:
        """Return the scores (B,) of motions (B, T, n) at times t (T,) s, given the motions chosen so far."""
        ...

    def add(self, t: np.ndarray, q: np.ndarray, dq: np.ndarray, ddq: np.ndarray) -> None:
        """Add a motion t (T,) s and q, dq, ddq (T, n) rad, rad/s, rad/s^2 to the motions chosen so far."""
        ...


def designed(
    robot: Robot,
    design: Design,
    space: Space,
    *,
    seconds: float,
    center: np.ndarray,
    seed: int,
    effort: int,
    report: Callable[[float], None] = lambda share: None,
) -> Excitation:
    """Return a motion that passes `check_motion` and consists of segments and of paths between the segments.

    Args:
        robot: limits and links. space: computes the distances between links and obstacles.
        design: criterion that scores motions.
        seconds: total duration of the segments. center: (n,) rad, center posture, see `fourier.checked_center`.
        seed: random seed. effort: number of motions tried per segment.
        report: function that receives the completed fraction (0 to 1) of the work.

    Raises:
        UserError: an argument is out of range, or r2s finds no safe series or no safe path between two segments.
    """
    check_number("seconds", seconds, f"[{LEAST_S:g}, {LONGEST_S:g}]")
    check_number("effort", effort, "[0, inf)", whole=True)
    rng = np.random.default_rng(seed)
    count = int(np.ceil(seconds / SEGMENT_S))
    parts: list[Excitation] = []
    for k in range(count):
        candidates = Candidates(robot, center, round(seconds / count, 3), design.score, space)
        part = candidates.found(rng, effort, lambda share, k=k: report((k + share) / count))  # type: ignore[misc]
        design.add(*(x[::EVERY] for x in (part.t, part.q, part.dq, part.ddq)))
        parts += [way(robot, parts[-1].q[-1], part.q[0], space), part] if parts else [part]
    motion = joined(parts)
    check_motion(robot, motion, space=space)
    return motion


def way(robot: Robot, q_from: np.ndarray, q_to: np.ndarray, space: Space) -> Excitation:
    """Return a motion from q_from to q_to (n,) rad along the path that `approach` finds, with a stop at each corner.

    Raises:
        UserError: no candidate path is safe.
    """
    path = approach(robot, q_from, q_to, what="excitation: the way between two segments", space=space)
    legs = []
    for a, b in pairwise(path):
        far = np.abs(b - a)
        speed = PEAKS[0] * far / (SPEED * robot.dq_max)
        seconds = max(SHORTEST_WAY_S, speed.max(), np.sqrt(PEAKS[1] * far / (ACCELERATION * robot.ddq_max)).max())
        for _ in range(MOST_SLOWER):
            steps = int(np.ceil(seconds / SIM_DT))
            t = SIM_DT * np.arange(steps + 1)
            leg = Excitation(t, *minimum_jerk(a, b, steps * SIM_DT, t[:, None]))
            if (torque_share(robot, *(x[::10] for x in (leg.q, leg.dq, leg.ddq))) <= TORQUE_SHARE).all():
                break
            seconds *= SLOWER
        legs.append(leg)
    return joined(legs)


def joined(parts: list[Excitation]) -> Excitation:
    """Return one motion that joins several motions; each motion begins where the previous motion ends."""

    def all_of(name: str) -> np.ndarray:
        return np.concatenate([getattr(part, name)[k > 0 :] for k, part in enumerate(parts)])

    q = all_of("q")
    return Excitation(SIM_DT * np.arange(len(q)), q, all_of("dq"), all_of("ddq"))


def trajectory_yaml(motion: Excitation, joints: list[str], rate_hz: float) -> str:
    """Return a motion as YAML of trajectory_msgs/msg/JointTrajectory (ROS 2), sampled at `rate_hz`.

    The last point is the motion's last row. ROS 2 controllers interpolate by quintic polynomials between points
    with position, velocity and acceleration.
    """
    rows = np.union1d(np.arange(0, len(motion.t), max(1, round(1 / (rate_hz * SIM_DT)))), [len(motion.t) - 1])
    lines = ["header: {stamp: {sec: 0, nanosec: 0}, frame_id: ''}", f"joint_names: [{', '.join(joints)}]", "points:"]
    for k in rows.tolist():
        # YAML reads a number without a decimal point, such as 1e-05, as a string
        q, dq, ddq = (", ".join(f"{x:z.9f}" for x in part[k].tolist()) for part in (motion.q, motion.dq, motion.ddq))
        sec, nanosec = divmod(round(1e9 * float(motion.t[k])), 10**9)
        lines.append(
            f"- {{positions: [{q}], velocities: [{dq}], accelerations: [{ddq}], "
            f"time_from_start: {{sec: {sec}, nanosec: {nanosec}}}}}"
        )
    return "\n".join(lines) + "\n"
