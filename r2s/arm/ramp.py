"""Ramp the torque of one joint after the other, both ways, until it moves: the paper's breakaway protocol.

It runs on any arm behind the arm interface; r2s/identification/breakaway.py makes torques of what it records.
"""

from collections.abc import Callable, Sequence
from itertools import pairwise

import mujoco
import numpy as np

from r2s.arm.driven import Driven
from r2s.arm.driver import Driver
from r2s.arm.interface import Arm, ArmState
from r2s.errors import UserError
from r2s.excitation.paths import approach
from r2s.excitation.safety import TABLE_M, TOOL_M, Space
from r2s.identification.breakaway import MOVED
from r2s.physics.robot import SIM_DT, Robot, per_joint
from r2s.recordings.ramps import Ramps
from r2s.recordings.recording import Recording

BIG = 40.0  # Nm of tau_max: joints with so much inertia that they move late, and are to be ramped slowly
KEPT = 5  # cycles recorded after the joint has moved
QUIET = 10  # cycles of letting go, as many at rest before each ramp, and of each mean that a speed is told from
BANDWIDTH = 20.0  # rad/s, three poles of the stop: well damped with 5 ms of delay and 3 of lag
DAMPED = 20  # cycles of a stop without spring, which would bring back, slowly, what a joint goes until it stops
BRAKE_S, STOPS = 1.0, 4  # after which the next ramp comes whatever the arm does
SLOW, STILL, SLIDING = 7e-3, 3e-3, 12e-3  # rad/s: to let go, of the joint to be ramped next, after letting go
STRAY = 0.05  # rad: a joint that goes so far in a ramp ends it, whichever it is; so far off, the arm is placed anew
MARGIN = 0.15  # rad that a pose keeps from the position limits: no joint gets there in one ramp
BRAKE_SHARE = 0.1  # of tau_max: so little that the rate limit never adds to the delay of the stop
UNFILTERED_HZ = 1e30  # of the driver's low-pass: a ramp has no steps, and joints at rest are to have no command
LARGEST = 0.2  # of tau_max, at which a ramp gives up by default


def poses_about(robot: Robot, count: int) -> np.ndarray:
    """Return (count, n) rad: postures at and about home, a turn of 0.3 rad of every joint apart."""
    turn = np.where(np.arange(robot.n) % 2, -0.3, 0.3)
    poses = robot.q_home + np.arange(count)[:, None] * turn
    return np.clip(poses, robot.q_min + 0.2, robot.q_max - 0.2)


def check_ways(
    robot: Robot, poses: np.ndarray, *, what: str = "ramp.poses", table: float = TABLE_M, z_min: float = TOOL_M
) -> None:
    """Raise UserError where from home, or from the pose before, there is no way to one of the poses (P, n) rad."""
    space = Space(robot, table=table, z_min=z_min)
    for k, (a, b) in enumerate(pairwise([robot.q_home, *poses]), 1):
        approach(robot, a, b, what=f"{what}: the way to pose {k}", space=space)


def ramp(
    arm: Arm,
    poses: np.ndarray | Sequence[Sequence[float]],
    *,
    rate: np.ndarray | Sequence[float] | float | None = None,
    largest: np.ndarray | Sequence[float] | float | None = None,
    moved: float = MOVED,
    table: float = TABLE_M,
    z_min: float = TOOL_M,
    progress: Callable[[int, int], None] | None = None,
) -> Ramps:
    """Ramp every joint both ways at every pose and return one trajectory for each ramp.

    A ramp is a short rest without command, then a command of one joint that rises from 0 at `rate`, the others at
    0, until the joint is `moved` away (or the command is `largest`, or another joint strays). Then all joints are
    stopped, and let go once at rest; that is not recorded. Rows are as in `r2s.arm.tracking`: the state read in a
    cycle and the command sent in it. A joint that slides without command, because what gravity compensation leaves
    is more than its friction holds, rests and is ramped from the command that stopped it instead.

    Args:
        arm: moved to each pose, and stopped at the end whatever happens.
        poses: (P, n) rad, at least 0.15 rad inside the position limits, and away from table and arm, as the ways
            to them are (r2s/excitation/paths.py), or nothing moves.
        rate: (n,) or one, Nm/s; 2.2 for joints of tau_max from 40 Nm, 4 below, where light links are seen to move
            within milliseconds; in proportion to tau_max below 12 Nm.
        largest: (n,) or one, Nm, at which a ramp gives up; 20 % of tau_max.
        moved: rad, well beyond what bristles bend before they let go.
        table, z_min: m, as in `r2s.excitation.safety.check_motion`.
        progress: called after every ramp with (ramps done, ramps in all).

    Raises:
        ArmStopped: the arm ended the motion, or the driver did; nothing is returned of it.
        UserError: an argument out of range, or no way to a pose.
    """
    robot = arm.robot
    places = _poses(robot, poses)
    check_ways(robot, places, table=table, z_min=z_min)
    small = np.minimum(1.0, robot.tau_max / 12)
    rising = _positive("rate", rate, np.where(robot.tau_max >= BIG, 2.2, 4.0 * small), 0.1 * robot.dtau_max)
    limit = _positive("largest", largest, LARGEST * robot.tau_max, robot.tau_max)
    if not 1e-4 <= moved <= 0.02:
        raise UserError(f"ramp.moved={moved} rad, allowed 0.0001 to 0.02")
    # a joint rests while the others are ramped one way, before its turn comes the other way
    each = [(j, sign) for sign in (1, -1) for j in range(robot.n)]
    which = [(p, j, sign) for p in range(len(places)) for j, sign in each]
    most = limit + BRAKE_SHARE * robot.tau_max  # an arm that slides is ramped from the command that held it
    most = np.minimum(most, robot.tau_max)  # which friction may hold, as far as one knows
    drive, recorded = _Drive(Driven(arm, Driver(robot, most, 2 * most, cutoff_hz=UNFILTERED_HZ))), []
    try:
        for place in places:
            drive.place(place)
            for i, (j, sign) in enumerate(each):
                recorded.append(drive.push(j, sign * rising[j], limit[j], moved))
                drive.stop(coming=each[(i + 1) % len(each)][0])
                if np.abs(drive.state.q - place).max() > STRAY:
                    drive.end()
                    drive.place(place)
                if progress is not None:
                    progress(len(recorded), len(which))
            drive.end()
    finally:
        drive.end()
    t, q, dq, tau = (np.concatenate([np.array([row[i] for row in rows]) for rows in recorded]) for i in range(4))
    trajectory = np.repeat(np.arange(len(which)), [len(rows) for rows in recorded])
    motion = Recording(t=t, q=q, dq=dq, tau=tau, torque="commanded", trajectory=trajectory, name=robot.name)
    pose, joint, sign = np.array(which).T
    return Ramps(motion, joint, sign, pose)


class _Drive:
    """An arm at a pose, cycle by cycle.

    `rows` holds t, q, dq and command of every cycle since it was emptied, `base` (n,) Nm the command to rest with,
    `held` (n,) Nm what kept the arm from sliding in the last stop.
    """

    def __init__(self, driven: Driven):
        robot = driven.arm.robot
        self._driven, self._tau_max = driven, robot.tau_max
        self.rows: list[tuple[float, np.ndarray, np.ndarray, np.ndarray]] = []
        self._model = robot.model(gravity=False)
        self._mass = np.zeros((robot.n, robot.n))

    @property
    def state(self) -> ArmState:
        """What was read last."""
        return self._driven.state

    def end(self) -> None:
        """Stop the arm."""
        self._driven.end()

    def place(self, q: np.ndarray) -> None:
        """Bring the arm to q (n,) rad and let it go there."""
        data = mujoco.MjData(self._model)
        data.qpos[:] = q
        mujoco.mj_forward(self._model, data)
        mujoco.mj_fullM(self._model, data, self._mass)
        self._driven.place(q)
        self.held, self.base = np.zeros(len(q)), np.zeros(len(q))
        if not self.rest().all():
            self.stop(coming=0)

    def send(self, tau: np.ndarray) -> ArmState:
        """Ask for tau (n,) Nm in this cycle, and return the state after it; `rows` has what the driver made of it."""
        s = self.state
        after = self._driven(tau)
        self.rows.append((s.t, s.q, s.dq, self._driven.sent))
        return after

    def push(self, joint: int, rate: float, largest: float, moved: float) -> list:
        """Ramp one joint at `rate` Nm/s (signed); return all rows since the arm was let go."""
        tau, start, left = self.base.copy(), self.rows[0][1], KEPT
        while left and abs(tau[joint]) < largest:
            away = np.abs(self.send(tau).q - start)
            if left < KEPT or away[joint] >= moved or away.max() > STRAY:
                left -= 1
            tau[joint] += rate * SIM_DT
        return self.rows

    def stop(self, coming: int) -> None:
        """Stop all joints and let them go, again where one slides on; `coming` is to be quieter than the others."""
        for attempt in range(STOPS):
            self._brake(coming)
            last = self.state.tau_J_d
            for k in range(QUIET):
                self.send(self.base + (last - self.base) * (1 - (k + 1) / QUIET))
            still = self.rest()
            if still.all():
                return
            if attempt:  # once, it may be bristles that spring back
                self.base = np.where(still, self.base, self.held)

    def rest(self) -> np.ndarray:
        """Send what the arm should rest with, for the first cycles of new rows; return which joints do, (n,)."""
        self.rows = []
        for _ in range(QUIET):
            self.send(self.base)
        return self._speed(QUIET // 2) < SLIDING

    def _speed(self, cycles: int) -> np.ndarray:
        """Return (n,) rad/s, from the means of so many cycles and of as many before."""
        q = np.array([row[1] for row in self.rows[-2 * cycles :]]).reshape(2, cycles, -1).mean(1)
        return np.abs(q[1] - q[0]) / (cycles * SIM_DT)

    def _brake(self, coming: int) -> None:
        """Bring all joints to rest where they are."""
        self.rows = []
        q, total, w = self.state.q, np.zeros(len(self._tau_max)), BANDWIDTH
        most = BRAKE_SHARE * self._tau_max
        for k in range(round(BRAKE_S / SIM_DT)):
            if k <= DAMPED:
                q = self.state.q
            lag = q - self.state.q
            total += lag * SIM_DT
            pull = self.held + self._mass @ (w**3 * total + 3 * w**2 * lag - 3 * w * self.state.dq)
            self.send(np.clip(pull, -most, most))
            if k % QUIET == 0 and k >= DAMPED + QUIET:
                speed = self._speed(QUIET)
                if speed.max() < SLOW and speed[coming] < STILL:
                    break
        self.held = np.mean([row[3] for row in self.rows[-QUIET:]], axis=0)


def _poses(robot: Robot, poses: np.ndarray | Sequence[Sequence[float]]) -> np.ndarray:
    """Return (P, n) rad if every pose keeps away from the limits."""
    try:
        places = np.atleast_2d(np.array(poses, dtype=float))
    except (TypeError, ValueError):
        raise UserError(f"ramp.poses are not rows of {robot.n} joint angles") from None
    if places.ndim != 2 or not len(places) or places.shape[1] != robot.n:
        raise UserError(f"ramp.poses have shape {places.shape}; {robot.name} has {robot.n} joints")
    low, high = robot.q_min + MARGIN, robot.q_max - MARGIN
    bad = np.argwhere(~((places >= low) & (places <= high)))
    if len(bad):
        p, i = bad[0]
        raise UserError(
            f"ramp.poses: joint {i + 1} of pose {p + 1} at {places[p, i]:g} rad, allowed {low[i]:g} to {high[i]:g}"
        )
    return places


def _positive(name: str, value, default: np.ndarray, most: np.ndarray) -> np.ndarray:
    """Return (n,) numbers above 0 and up to `most` (n,)."""
    n = len(default)
    array = per_joint(f"ramp.{name}", default if value is None else value, n, f"{n} joints")
    good = (array > 0) & (array <= most)
    if not good.all():
        i = int(np.argmin(good))
        raise UserError(f"ramp.{name} of joint {i + 1} is {array[i]:g}, allowed above 0 and up to {most[i]:g}")
    return array
