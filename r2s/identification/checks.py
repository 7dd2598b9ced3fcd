"""Check a recording before a fit: the number of joints, limits, amount of motion, damaged rows and units."""

import numpy as np

from r2s.errors import UserError
from r2s.identification.residuals.windows import MOVED
from r2s.identification.unit_checks import OVER_LIMIT, Judged, check_units
from r2s.physics.robot import Robot
from r2s.recordings.ramps import Ramps
from r2s.recordings.recording import Recording

SPIKE = 5.0  # factor on the limits of speed and torque that no sensor noise exceeds
NONSENSE = 1e9  # factor on the limits of speed and torque that no wrong unit exceeds; larger values may overflow
JUMP = 0.05  # rad, largest accepted jump of an encoder
MARGIN = 0.05  # rad by which a log may exceed the position limits, as can happen when an arm is at a limit
LEAST_S = 1.0  # s, least duration of a recording


def check_recording(robot: Robot, recording: Recording) -> Judged | None:
    """Check a user's recording, and return the result of `check_units`.

    Raises:
        UserError: the recording does not fit the arm (`check_motion`), is damaged or has wrong units.
    """
    check_motion(robot, recording)
    _check_spikes(robot, recording, NONSENSE)
    judged = check_units(robot, recording)
    _check_spikes(robot, recording, SPIKE)
    return judged


def check_rate(cutoff_hz: float, recording: Recording) -> None:
    """Raise UserError unless a cutoff is below the recording's Nyquist frequency."""
    if cutoff_hz >= 0.499 * recording.rate_hz:  # less than 0.5, because a log's clock jitters
        raise UserError(
            f"identify.cutoff_hz: expected less than {0.5 * recording.rate_hz:.4g} Hz, half the rate of "
            f"{recording.name or 'the recording'} ({recording.rate_hz:.4g} Hz), got {cutoff_hz:g}"
        )


def check_motion(robot: Robot, recording: Recording) -> None:
    """Raise UserError for a wrong number of joints, exceeded position limits, or a motion too small or too short."""
    _check_joints(robot, recording, "the recording")
    moved = np.ptp(recording.q, axis=0)
    if moved.max() < MOVED or recording.duration < LEAST_S:
        raise UserError(
            f"the recording: expected at least {LEAST_S:g} s in which a joint moves {MOVED:g} rad, got "
            f"{recording.duration:.2f} s and {moved.max():.4f} rad"
        )


def _check_spikes(robot: Robot, recording: Recording, most: float) -> None:
    """Raise UserError if a row exceeds `most` times the arm's limits, because the file is then damaged."""
    r = recording
    steps = np.diff(r.t)
    steps[np.diff(r.trajectory) != 0] = np.inf
    limits = {"q": robot.dq_max, "dq": robot.dq_max, "tau": robot.tau_max}
    for field, unit in {"q": "rad after a jump", "dq": "rad/s", "tau": "Nm"}.items():
        x, worst = getattr(r, field), (0.0, 0, 0)
        for j, limit in enumerate(most * limits[field]):  # one joint at a time, to save memory for long logs
            if field == "q":
                share = np.append(0.0, (np.abs(np.diff(x[:, j])) - JUMP) / (steps * limit))
            else:
                share = np.abs(x[:, j]) / limit
            row = int(share.argmax())
            worst = max(worst, (share[row], row, j), key=lambda one: one[0])
        if worst[0] > 1:
            _, row, j = worst
            raise UserError(
                f"the recording: {field} of joint {j + 1} is {x[row, j]:.4g} {unit} at row {row}, "
                f"more than {most:g} times the limit of {robot.name}: is the file damaged?"
            )


def check_ramps(robot: Robot, ramps: Ramps) -> None:
    """Raise UserError if ramps have a wrong number of joints, exceed position limits or are not in SI units."""
    _check_joints(robot, ramps.recording, "the ramps")
    most = np.abs(ramps.recording.tau).max(0)
    j = int((most / robot.tau_max).argmax())
    if most[j] > OVER_LIMIT * robot.tau_max[j]:
        raise UserError(
            f"the ramps: the command of joint {j + 1} reaches {most[j]:.4g} Nm, {robot.name} has at most "
            f"{robot.tau_max[j]:g}; is it in mNm?"
        )


def _check_joints(robot: Robot, recording: Recording, what: str) -> None:
    """Raise UserError if the recording `what` has a wrong number of joints or exceeds the position limits."""
    if recording.n_joints != robot.n:
        raise UserError(f"{what}: expected {robot.n} joints of {robot.name}, got {recording.n_joints}")
    out = np.maximum(robot.q_min - MARGIN - recording.q.min(0), recording.q.max(0) - robot.q_max - MARGIN)
    if out.max() > 0:
        j = int(out.argmax())
        worst = recording.q[:, j].min() if recording.q[:, j].min() < robot.q_min[j] else recording.q[:, j].max()
        raise UserError(
            f"{what}: joint {j + 1} is at {worst:.3f} rad, {robot.name} allows {robot.q_min[j]:g} to "
            f"{robot.q_max[j]:g}; is it another arm, another joint order, or degrees?"
        )
