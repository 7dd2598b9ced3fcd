"""Whether a recording fits the arm, before anything is fitted to it."""

import numpy as np

from r2s.errors import UserError
from r2s.identification.plausible import OVER_LIMIT, check_numbers
from r2s.identification.windows import MOVED
from r2s.physics.robot import Robot
from r2s.recordings.ramps import Ramps
from r2s.recordings.recording import Recording

SPIKE = 5.0  # times the fastest joint and the largest torque: what no sensor's noise reaches
NONSENSE = 1e9  # times those: no unit is so far off, and squares of more would not be numbers
JUMP = 0.05  # rad, that q may jump beside, as encoders do


def check_recording(robot: Robot, recording: Recording) -> None:
    """Raise UserError if a user's recording does not fit the arm (`check_motion`) or is in other units."""
    check_motion(robot, recording)
    _check_spikes(robot, recording, NONSENSE)
    check_numbers(robot, recording)
    _check_spikes(robot, recording, SPIKE)


def check_motion(robot: Robot, recording: Recording) -> None:
    """Raise UserError if the recording is not of this arm, leaves its limits or hardly moves."""
    if recording.n_joints != robot.n:
        raise UserError(f"the recording has {recording.n_joints} joints, {robot.name} has {robot.n}")
    _check_limits(robot, recording, "the recording")
    moved = np.ptp(recording.q, axis=0)
    if moved.max() < MOVED or recording.duration < 1.0:
        raise UserError(
            f"the recording has not enough motion to identify anything: {recording.duration:.2f} s in which the "
            f"joint that moves most moves {moved.max():.4f} rad; at least 1 s and {MOVED:g} rad are needed"
        )


def _check_spikes(robot: Robot, recording: Recording, most: float) -> None:
    """Raise UserError where a row has `most` times what this arm can, as a damaged file does."""
    r = recording
    speed = most * robot.dq_max
    jumps = np.zeros_like(r.q)
    for s in r.stretches:
        step = np.abs(np.diff(r.q[s], axis=0)) - JUMP
        jumps[s][1:] = step / (np.diff(r.t[s])[:, None] * speed)
    seen = {"q": (jumps, "rad after a jump"), "dq": (np.abs(r.dq) / speed, "rad/s")}
    seen["tau"] = np.abs(r.tau) / (most * robot.tau_max), "Nm"
    for field, (share, unit) in seen.items():
        row, j = np.unravel_index(share.argmax(), share.shape)
        if share[row, j] > 1:
            raise UserError(
                f"the recording: {field} of joint {j + 1} is {getattr(r, field)[row, j]:.4g} {unit} at row {row}, "
                f"more than {most:g} times what {robot.name} can: is the file damaged?"
            )


def check_ramps(robot: Robot, ramps: Ramps) -> None:
    """Raise UserError if the ramps are not of this arm, leave its limits or are in other units."""
    r = ramps.recording
    if r.n_joints != robot.n:
        raise UserError(f"the ramps have {r.n_joints} joints, {robot.name} has {robot.n}")
    _check_limits(robot, r, "the ramps")
    most = np.abs(r.tau).max(0)
    j = int((most / robot.tau_max).argmax())
    if most[j] > OVER_LIMIT * robot.tau_max[j]:
        raise UserError(
            f"the ramps: the command of joint {j + 1} reaches {most[j]:.4g} Nm, {robot.name} has at most "
            f"{robot.tau_max[j]:g}; is it in mNm?"
        )


def _check_limits(robot: Robot, recording: Recording, what: str) -> None:
    """Raise UserError where `what` leaves the position limits."""
    margin = 0.05  # rad: logs of arms that touch their limits are not unheard of
    out = np.maximum(robot.q_min - margin - recording.q.min(0), recording.q.max(0) - robot.q_max - margin)
    if out.max() > 0:
        j = int(out.argmax())
        worst = recording.q[:, j].min() if recording.q[:, j].min() < robot.q_min[j] else recording.q[:, j].max()
        raise UserError(
            f"{what}: joint {j + 1} is at {worst:.3f} rad, {robot.name} allows {robot.q_min[j]:g} to "
            f"{robot.q_max[j]:g}; is it another arm, another joint order, or degrees?"
        )
