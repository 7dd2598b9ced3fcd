"""The paper's breakaway protocol: ramp the torque of each joint in turn, in both directions, until the joint moves.

The ramps run on any `Arm`; r2s/identification/friction/breakaway.py estimates breakaway torques from the ramps.
"""

from collections.abc import Callable, Sequence
from itertools import pairwise

import mujoco
import numpy as np

from r2s.arm.command_loop import CommandLoop
from r2s.arm.driver import Driver
from r2s.arm.interface import Arm, ArmState, speed_share
from r2s.arm.realtime import Timing
from r2s.errors import UserError
from r2s.excitation.motion_checks import DEVIATION, Space
from r2s.excitation.paths import approach
from r2s.identification.friction.breakaway import MOVED
from r2s.physics.collision import CollisionCheck
from r2s.physics.robot import SIM_DT, Robot, per_joint
from r2s.recordings.ramps import Ramps
from r2s.recordings.recording import Recording

# The ramp
SLOW_TAU_MAX = 40.0  # Nm: joints with at least this tau_max have a large inertia and get a slower ramp
SLOW_RATE, FAST_RATE = 2.2, 4.0  # Nm/s; at 4 Nm/s light links move visibly within milliseconds
MAX_SHARE = 0.2  # share of tau_max, default of a ramp's largest torque
AFTER_MOTION = 5  # cycles recorded after the joint has moved
STRAY = DEVIATION  # rad: a ramp ends if any joint moves this far; an arm this far off its pose returns to the pose
POSE_MARGIN = 0.15  # rad, least distance of a pose from the position limits; more than any joint moves in one ramp
UNFILTERED_HZ = 1e30  # disables the driver's low-pass, because a ramp has no steps to smooth
# The stop after a ramp: a PID controller with three equal real poles brakes each joint, then the torque fades out
BANDWIDTH = 20.0  # rad/s, frequency of the poles: the loop is well damped with 5 ms of delay and 3 ms of lag
DAMPED_CYCLES = 20  # cycles of damping only, because a spring would slowly pull a joint back to where braking began
BRAKE_SHARE = 0.1  # largest braking torque / tau_max: so small that the rate limit adds no delay
BRAKE_S, STOP_ATTEMPTS = 1.0, 4  # s, longest braking; attempts to stop, after which the next ramp starts anyway
RELEASE_CYCLES = 10  # number of cycles of the fade, of the rest before a ramp, and of each mean angle in braking
# rad/s, mean speeds: braking ends when all joints are below SLOW and the joint of the next ramp is below STILL
# A joint below SLIDING is at rest.
SLOW, STILL, SLIDING = 7e-3, 3e-3, 12e-3


def poses_about(robot: Robot, count: int) -> np.ndarray:
    """Return postures (count, n) rad: posture k is home +-0.3 k rad; all are at least 0.2 rad inside limits."""
    change = np.where(np.arange(robot.n) % 2, -0.3, 0.3)
    poses = robot.q_home + np.arange(count)[:, None] * change
    return np.clip(poses, robot.q_min + 0.2, robot.q_max - 0.2)


def check_paths(robot: Robot, poses: np.ndarray, *, what: str = "ramp.poses") -> None:
    """Raise UserError unless collision-free paths lead from home through all poses (P, n) rad, in this order."""
    space = Space(robot)
    for k, (a, b) in enumerate(pairwise([robot.q_home, *poses]), 1):
        approach(robot, a, b, what=f"{what}: the path to pose {k}", space=space)


def ramp(
    arm: Arm,
    poses: np.ndarray | Sequence[Sequence[float]],
    *,
    rate: np.ndarray | Sequence[float] | float | None = None,
    largest: np.ndarray | Sequence[float] | float | None = None,
    progress: Callable[[int, int], None] | None = None,
    timing: Timing | None = None,
) -> Ramps:
    """Ramp every joint in both directions at every pose and return one trajectory per ramp.

    A ramp begins with a short rest at zero command. Then the command of one joint changes from 0 at +rate or -rate;
    the commands of all other joints stay 0. The ramp ends when the ramped joint has moved by MOVED, |command| reaches
    `largest`, or any joint has moved by STRAY. The recording omits the stop after each ramp. The rows have the format
    of `r2s.arm.recorder`. If the error of gravity compensation exceeds a joint's friction, the joint slides at zero
    command. `ramp` brakes a sliding joint, and starts its ramp at the constant command under which the joint rests.

    Args:
        arm: the arm, which moves to each pose and always stops at the end.
        poses: (P, n) rad, at least 0.15 rad inside the position limits. No motion starts if the arm would come too
            close to the table or to itself at a pose or on a path (r2s/excitation/paths.py).
        rate: (n,) or one number, Nm/s, slope of the ramps; default: 2.2 for joints with tau_max of at least 40 Nm,
            4 min(1, tau_max / 12 Nm) for weaker joints.
        largest: (n,) or one number, Nm, largest command of a ramp; default 20 % of tau_max.
        progress: called after every ramp with (ramps done, total); it must return within the 1 kHz cycle.
        timing: receives the durations of the cycles.

    Raises:
        ArmStopped: the arm or the driver ended the motion, or a real-time arm missed more than 1 % of the commands;
            no recording is returned.
        UserError: an argument is out of range, or no path leads to a pose.
    """
    robot = arm.robot
    places = _poses(robot, poses)
    check_paths(robot, places)
    rising = _positive("rate", rate, _default_rate(robot), 0.1 * robot.dtau_max)
    limit = _positive("largest", largest, MAX_SHARE * robot.tau_max, robot.tau_max)
    # all joints in one direction, then in the other, so that each joint rests in between
    each = [(j, sign) for sign in (1, -1) for j in range(robot.n)]
    which = [(p, j, sign) for p in range(len(places)) for j, sign in each]
    # most: a ramp's largest command, plus the largest braking command; 2 * most is an upper bound of friction
    most = np.minimum(limit + BRAKE_SHARE * robot.tau_max, robot.tau_max)
    timing = timing or Timing()
    how = {"cutoff_hz": UNFILTERED_HZ, "fence": CollisionCheck(robot), "speed_share": speed_share(arm)}
    drive, recorded = _Drive(CommandLoop(arm, Driver(robot, most, 2 * most, **how)), timing), []
    try:
        for place in places:
            drive.place(place)
            for i, (j, sign) in enumerate(each):
                recorded.append(drive.push(j, sign * rising[j], limit[j]))
                drive.stop(next_joint=each[(i + 1) % len(each)][0])
                if np.abs(drive.state.q - place).max() > STRAY:
                    drive.end()
                    drive.place(place)
                if progress is not None:
                    progress(len(recorded), len(which))
            drive.settle()
            drive.end()
        timing.check(arm)
    finally:
        drive.end()
    pose, joint, sign = np.array(which).T
    return Ramps(_recording(recorded, robot.name), joint, sign, pose)


def _default_rate(robot: Robot) -> np.ndarray:
    small = np.minimum(1.0, robot.tau_max / 12)
    return np.where(robot.tau_max >= SLOW_TAU_MAX, SLOW_RATE, FAST_RATE * small)


def _recording(ramps: list[list], name: str) -> Recording:
    t, q, dq, tau = (np.concatenate([np.array([row[i] for row in rows]) for rows in ramps]) for i in range(4))
    trajectory = np.repeat(np.arange(len(ramps)), [len(rows) for rows in ramps])
    return Recording(t=t, q=q, dq=dq, tau=tau, torque="commanded", trajectory=trajectory, name=name)


class _Drive:
    """Drives an arm at a pose, cycle by cycle, and records the cycles.

    Attributes:
        rows: t, q, dq and command of every cycle since the list was last emptied.
        base: (n,) Nm, command under which the arm rests. held: (n,) Nm, mean of the last braking commands.
    """

    def __init__(self, loop: CommandLoop, timing: Timing):
        robot = loop.arm.robot
        self._loop, self._timing, self._tau_max = loop, timing, robot.tau_max
        timing.begin()
        self.rows: list[tuple[float, np.ndarray, np.ndarray, np.ndarray]] = []
        self._model = robot.model(gravity=False)
        self._mass = np.zeros((robot.n, robot.n))

    @property
    def state(self) -> ArmState:
        """The latest state."""
        return self._loop.state

    def settle(self) -> None:
        """If the driver is stopping the arm, complete the stop and raise ArmStopped."""
        self._loop.settle()

    def end(self) -> None:
        """Stop the arm."""
        self._loop.end()

    def place(self, q: np.ndarray) -> None:
        """Move the arm to q (n,) rad and bring all joints to rest there."""
        data = mujoco.MjData(self._model)
        data.qpos[:] = q
        mujoco.mj_forward(self._model, data)
        mujoco.mj_fullM(self._model, data, self._mass)
        self._loop.place(q)
        self.held, self.base = np.zeros(len(q)), np.zeros(len(q))
        if not self.rest().all():
            self.stop(next_joint=0)

    def send(self, tau: np.ndarray) -> ArmState:
        """Run one cycle with the target torque tau (n,) Nm, append a row to `rows`, and return the next state."""
        s = self.state
        after = self._loop(tau, self.base)
        self._timing.cycle(self._loop.clock, after)
        self.rows.append((s.t, s.q, s.dq, self._loop.sent))
        return after

    def push(self, joint: int, rate: float, largest: float) -> list:
        """Ramp one joint at `rate` Nm/s (signed); return the rows, which include the rest before the ramp."""
        tau, start, left = self.base.copy(), self.rows[0][1], AFTER_MOTION
        while left and abs(tau[joint]) < largest:
            distance = np.abs(self.send(tau).q - start)
            if left < AFTER_MOTION or distance[joint] >= MOVED or distance.max() > STRAY:
                left -= 1
            tau[joint] += rate * SIM_DT
        return self.rows

    def stop(self, next_joint: int) -> None:
        """Brake all joints (`next_joint` below STILL), then fade to the command `base`; repeat if a joint moves."""
        for attempt in range(STOP_ATTEMPTS):
            self._brake(next_joint)
            last = self.state.tau_J_d
            for k in range(RELEASE_CYCLES):
                self.send(self.base + (last - self.base) * (1 - (k + 1) / RELEASE_CYCLES))
            still = self.rest()
            if still.all():
                return
            if attempt:  # not after the first attempt: bristles that spring back may still cause motion
                self.base = np.where(still, self.base, self.held)

    def rest(self) -> np.ndarray:
        """Clear `rows`, send the command `base` for RELEASE_CYCLES, and return (n,) bool: which joints rest."""
        self.rows = []
        for _ in range(RELEASE_CYCLES):
            self.send(self.base)
        return self._speed(RELEASE_CYCLES // 2) < SLIDING

    def _speed(self, cycles: int) -> np.ndarray:
        """Return joint speeds (n,) rad/s, computed from the mean angles of the last two groups of `cycles` rows."""
        q = np.array([row[1] for row in self.rows[-2 * cycles :]]).reshape(2, cycles, -1).mean(1)
        return np.abs(q[1] - q[0]) / (cycles * SIM_DT)

    def _brake(self, next_joint: int) -> None:
        """Bring all joints to rest at their present angles (PID with three equal poles)."""
        self.rows = []
        q, integral, w = self.state.q, np.zeros(len(self._tau_max)), BANDWIDTH
        limit = BRAKE_SHARE * self._tau_max
        for k in range(round(BRAKE_S / SIM_DT)):
            if k <= DAMPED_CYCLES:
                q = self.state.q
            error = q - self.state.q
            integral += error * SIM_DT
            tau = self.held + self._mass @ (w**3 * integral + 3 * w**2 * error - 3 * w * self.state.dq)
            self.send(np.clip(tau, -limit, limit))
            if k % RELEASE_CYCLES == 0 and k >= DAMPED_CYCLES + RELEASE_CYCLES:
                speed = self._speed(RELEASE_CYCLES)
                if speed.max() < SLOW and speed[next_joint] < STILL:
                    break
        self.held = np.mean([row[3] for row in self.rows[-RELEASE_CYCLES:]], axis=0)


def _poses(robot: Robot, poses: np.ndarray | Sequence[Sequence[float]]) -> np.ndarray:
    """Return the poses (P, n) rad; raise UserError unless each is at least POSE_MARGIN inside the limits."""
    try:
        places = np.atleast_2d(np.array(poses, dtype=float))
    except (TypeError, ValueError):
        raise UserError(f"ramp.poses: expected rows of {robot.n} joint angles") from None
    if places.ndim != 2 or not len(places) or places.shape[1] != robot.n:
        raise UserError(f"ramp.poses: expected {robot.n} joints, got shape {places.shape} ({robot.name})")
    low, high = robot.q_min + POSE_MARGIN, robot.q_max - POSE_MARGIN
    bad = np.argwhere(~((places >= low) & (places <= high)))
    if len(bad):
        p, i = bad[0]
        raise UserError(
            f"ramp.poses: joint {i + 1} of pose {p + 1} at {places[p, i]:g} rad, allowed {low[i]:g} to {high[i]:g}"
        )
    return places


def _positive(name: str, value, default: np.ndarray, most: np.ndarray) -> np.ndarray:
    """Return `value` (if None, `default`) as an array (n,); raise UserError unless 0 < element <= `most`."""
    n = len(default)
    array = per_joint(f"ramp.{name}", default if value is None else value, n, f"{n} joints")
    good = (array > 0) & (array <= most)
    if not good.all():
        i = int(np.argmin(good))
        raise UserError(f"ramp.{name} of joint {i + 1} is {array[i]:g}, allowed above 0 and up to {most[i]:g}")
    return array
