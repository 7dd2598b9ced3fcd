"""Record an arm to identify its gears: one joint at a time slides slowly, excited by a multisine torque."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from r2s.arm.interface import Arm, ArmStopped, speed_share
from r2s.arm.realtime import Timing
from r2s.arm.recorder import record
from r2s.errors import UserError
from r2s.excitation.motion_checks import Space, check_limits, check_space, check_torque
from r2s.excitation.multisine import PERIOD_S, TORQUE_SHARE, gear_motion, multisine, slides
from r2s.physics.robot import Robot
from r2s.recordings.recording import Recording

PAUSE_S = 1.0  # s, gap in the recorded time between two sliding motions


def check_gear_motions(robot: Robot, share: float = 1.0) -> None:
    """Raise UserError unless `gear_motion` of every joint is within the limits; `share` scales the speeds."""
    space = Space(robot)
    for joint in range(robot.n):
        motion = gear_motion(robot, joint, share)
        try:
            check_limits(robot, motion)
            check_torque(replace(robot, tau_max=(1.0 - TORQUE_SHARE) * robot.tau_max), motion)
            check_space(robot, motion, space=space)
        except UserError as error:
            raise UserError(f"data.gears: slide of joint {joint + 1} about robot.q_home: {error}") from None


def record_gear_motions(
    arm: Arm, *, progress: Callable[[int, int], None] | None = None, timing: Timing | None = None
) -> Recording:
    """Run `gear_motion` plus `multisine` torque for each joint; return each steady sliding motion as a trajectory.

    The rows have the format of `r2s.arm.recorder.record` with commanded torque.

    Args:
        arm: the arm, which always stops at the end. progress: called after every joint with (joints done, joints).
        timing: receives the durations of the cycles.

    Raises:
        ArmStopped: as in `r2s.arm.recorder.record`. The exception's `recording` contains the sliding motions of the
            joints that were completed before the stop; None: no joint was completed.
        UserError: as in `r2s.arm.recorder.record`.
    """
    robot, share = arm.robot, speed_share(arm)
    parts: list[tuple[np.ndarray, ...]] = []
    for joint in range(robot.n):
        motion = gear_motion(robot, joint, share)
        added = np.zeros_like(motion.q)
        added[:, joint] = multisine(robot, joint, motion)
        try:
            out = record(arm, motion, added=added, timing=timing)
        except ArmStopped as stop:
            stop.recording = _recording(parts, robot.name) if parts else None
            raise
        parts += [(out.q[rows], out.dq[rows], out.tau[rows], out.t[rows]) for rows in slides()]
        if progress is not None:
            progress(joint + 1, robot.n)
    return _recording(parts, robot.name)


def _recording(parts: list[tuple[np.ndarray, ...]], name: str) -> Recording:
    """Join sliding motions, each given as (q, dq, tau, t), into one recording, as one trajectory each."""
    q, dq, tau, t = (np.concatenate(x) for x in zip(*parts, strict=True))
    index = np.repeat(np.arange(len(parts)), [len(part[0]) for part in parts])
    starts = np.repeat([part[3][0] for part in parts], [len(part[0]) for part in parts])
    t = t - starts + index * (PERIOD_S + PAUSE_S)
    return Recording(t=t, q=q, dq=dq, tau=tau, torque="commanded", trajectory=index, name=name)
