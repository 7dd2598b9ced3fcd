"""Run a policy on an arm that waits for commands: observe, query the policy at its rate, command the arm at 1 kHz.

The clock of a twin, or of the emulator in lock-step, stands still while the policy computes. Repeated
evaluations are therefore bit-identical. For arms whose clock does not wait, see r2s/arm/realtime_process.py.
"""

import time
from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import chain, repeat

import numpy as np
from scipy.signal import savgol_filter

from r2s.adaptation.adapter import Adapter
from r2s.arm.command_loop import CommandLoop
from r2s.arm.driver import Driver
from r2s.arm.interface import Arm, ArmState, ArmStopped, NotCleared, Operated, StopRequested, speed_share
from r2s.arm.realtime import Timing
from r2s.arm.stop_request import requested
from r2s.physics.collision import CollisionCheck
from r2s.physics.rigid_body import Kinematics
from r2s.physics.robot import SIM_DT, Robot
from r2s.tasks.task import State, Task

LOGGED_S = 1.0  # s of motion before a stop that are logged, at 1 kHz
SMOOTHING_CYCLES = 20  # cycles, half window of `smooth_speeds`; encoder noise then causes speed errors of 2e-4 rad/s
ATTEMPTS = 3  # most attempts to bring an `Operated` arm to its start; the operator must agree to each new attempt


@dataclass(frozen=True)
class Stop:
    """Why an episode ended early.

    Attributes:
        episode: index from 0. when: time of the stop in the episode, or "on the way to its start".
        reason: reason of the stop. log: (k, 1 + 4 n), last second before the stop, at 1 kHz: t s, q rad,
            dq rad/s, tau_J_d Nm, command Nm.
    """

    episode: int
    when: str
    reason: str
    log: np.ndarray

    def __str__(self) -> str:
        return f"episode {self.episode + 1}, {self.when}: {self.reason}"


def episode_driver(
    robot: Robot,
    task: Task,
    soft_start_s: float,
    friction: np.ndarray,
    rotors: np.ndarray | None = None,
    speed_share: float = 1.0,
) -> Driver:
    """Return the driver for an episode of `task`; `DriverBatch` explains `friction`, `rotors`, `speed_share`."""
    period = {"period_s": 1 / task.ctrl_hz, "cutoff_hz": task.cutoff_hz}
    own = {"soft_start_s": soft_start_s, "rotors": rotors, "control": task.control(robot)}
    fence = CollisionCheck(robot, table=None, may_touch=task.may_touch)
    bounds = {"speed_share": speed_share, "push_limit": task.push_limit}
    return Driver(robot, task.torque_limit(robot), friction, **period, **own, **bounds, fence=fence)


class PolicyRunner:
    """Runs episodes on one arm through the driver, one control period per step; implements `r2s.tasks.rollout.Arms`.

    Attributes:
        stops: stops that ended episodes early. timing: see `Timing`.
        done: number of episodes that began, that is, calls of `place` after which `halted` was None.
        speeds: (1, T, n) rad/s, joint speeds after each control step of the last episode, see `smooth_speeds`.
        halted: reason why no further episode will run (a stop request, the operator's refusal after a stop, or too
            many failed attempts to reach a start); None: further episodes may run.
        blocked: reason of a stop that the operator had not cleared when the last episode ended, or None.

    Args:
        arm: an arm whose clock waits for commands.
        task: provides rates, torque limits and controller.
        friction: (n,) Nm, friction level of each joint: `Dynamics.level` of the training dynamics.
        soft_start_s: s over which an episode's torque fades in; recommended on hardware, 0 for twins.
        rotors: (n,) kg m^2, `Dynamics.armature` of the training dynamics; None: rotors of `arm.robot`.
        adapter: adds torque to the policy's torque; None: no adaptation.
    """

    width = 1

    def __init__(
        self,
        arm: Arm,
        task: Task,
        friction: np.ndarray,
        *,
        soft_start_s: float = 0.0,
        rotors: np.ndarray | None = None,
        adapter: Adapter | None = None,
    ):
        self.robot, self._arm, self._substeps = arm.robot, arm, task.substeps
        self._kinematics = Kinematics(arm.robot)
        self._log: deque[tuple[ArmState, np.ndarray]] = deque(maxlen=round(LOGGED_S / SIM_DT))
        self._adapts, self._controller = adapter is not None, task.control(arm.robot)
        driver = episode_driver(arm.robot, task, soft_start_s, friction, rotors, speed_share(arm))
        self._loop = CommandLoop(arm, driver, self._log, adapter)
        self.stops: list[Stop] = []
        self.timing = Timing()
        self.done = 0
        self.speeds = np.zeros((1, task.steps, arm.robot.n))
        self.halted: str | None = None
        self.blocked: str | None = None

    def place(self, starts: np.ndarray, first: int) -> State:
        """Move the arm to starts (1, n) rad, and begin the episode with the index `first`.

        If an arm without operator stops on the way to the start, the episode ends. An `Operated` arm makes up to
        ATTEMPTS attempts to reach the start, if the operator agrees to each new attempt. If the operator refuses or
        all attempts fail, no further episode will run.
        """
        self._log.clear()
        self._angles: list[np.ndarray] = []
        self._hold = np.zeros(self.robot.n)
        self._episode, self._stopped, self._limited = first, False, 0
        self.timing.begin()
        if self.halted is None:
            self._approach(starts[0])
        self._stopped = self._stopped or self.halted is not None
        self.done += self.halted is None
        return self._observe()

    def step(self, command: np.ndarray) -> State:
        """Run one control period with the command (1, c) and return the state; end early if the arm stops."""
        self.timing.policy.append(time.perf_counter() - self._observed_at)
        self.run(chain([command[0]], repeat(None, self._substeps - 1)))
        return self._observe()

    def run(self, commands: Iterable[np.ndarray | None]) -> None:
        """Run one 1 kHz cycle for each command (c,) or None (no new command); end early if the arm stops."""
        for command in commands:
            self._cycle(command)
            if self._stopped:
                return

    def end(self) -> np.ndarray:
        """Stop the arm; return (1,) bool: whether arm, driver, a stop request or lost commands ended the episode."""
        reason = self._loop.end() or requested() or self.timing.refusal(self._arm)
        if not self._stopped and reason is not None:  # a stop that raised no exception before the episode ended
            self._record_stop(f"{self._loop.state.t:.2f} s", reason)
        self.halted = self.halted or requested()
        self.blocked = self._arm.blocked if isinstance(self._arm, Operated) else None
        speeds = smooth_speeds(self._angles, self._substeps)[: self.speeds.shape[1]]
        self.speeds[:] = 0.0  # a stopped arm is at rest
        self.speeds[0, : len(speeds)] = speeds
        return np.array([self._stopped])

    @property
    def cycles(self) -> int:
        """Number of cycles of the episode so far."""
        return len(self._angles)

    def read(self) -> tuple[ArmState, np.ndarray, bool, int]:
        """Return state, effort (n,) Nm, stop flag, and the number of cycles in which the safety filter acted."""
        driver = self._loop.driver
        return self._loop.state, driver.effort, self._stopped, driver.limited

    def _cycle(self, command: np.ndarray | None) -> None:
        if command is not None:
            self._hold = self._controller.holding_torque(self._loop.state.q)
        try:
            self._loop(command, self._hold)
        except ArmStopped as reason:
            self._record_stop(f"{self._loop.state.t:.2f} s", reason)
            if isinstance(reason, StopRequested):
                self.halted = str(reason)
        self._angles.append(self._loop.state.q)
        self.timing.cycle(self._loop.clock, self._loop.state, self._adapts)

    def _approach(self, start: np.ndarray) -> None:
        operated = isinstance(self._arm, Operated)
        for left in reversed(range(ATTEMPTS if operated else 1)):
            try:
                self._loop.place(start)
                return
            except (NotCleared, StopRequested) as reason:
                self.halted = str(reason)
                if isinstance(reason, StopRequested):
                    self._record_stop("on the way to its start", reason)
                return
            except ArmStopped as reason:
                if left:
                    continue
                if operated:
                    self.halted = str(reason)
                    return
                self._record_stop("on the way to its start", reason)

    def _record_stop(self, when: str, reason: object) -> None:
        rows = [np.concatenate([[s.t], s.q, s.dq, s.tau_J_d, command]) for s, command in self._log]
        log = np.array(rows).reshape(-1, 1 + 4 * self.robot.n)
        self.stops.append(Stop(self._episode, when, str(reason), log))
        self._stopped = True

    def _observe(self) -> State:
        s, effort, stopped, limited = self.read()
        share = (limited - self._limited) / self._substeps
        state, self._limited = as_state(self._kinematics, s, effort, stopped, share), limited
        self._observed_at = time.perf_counter()
        return state


def smooth_speeds(angles: Sequence[np.ndarray], every: int) -> np.ndarray:
    """Return smoothed joint speeds (k, n) rad/s of every `every`-th cycle, from the angles (n,) rad of all cycles.

    The speed in cycle i is the slope at i of a parabola fitted to the angles of the cycles i - SMOOTHING_CYCLES to
    i + SMOOTHING_CYCLES (Savitzky and Golay, Analytical Chemistry 36(8), 1964).
    """
    window = min(2 * SMOOTHING_CYCLES + 1, len(angles) - 1 + len(angles) % 2)
    if window < 3:
        return np.zeros((0, 1))
    speeds = savgol_filter(np.array(angles), window, 2, deriv=1, delta=SIM_DT, axis=0)
    return speeds[every - 1 :: every]


def as_state(kinematics: Kinematics, s: ArmState, effort: np.ndarray, stopped: bool, limited: float) -> State:
    """Convert an `ArmState`, effort (n,) Nm, stop flag and filter rate to a `State` of one arm."""
    ee, jacobian = kinematics(s.q)
    return State(
        t=np.array([s.t]), q=s.q[None], dq=s.dq[None], ee=ee[None], jacobian=np.ascontiguousarray(jacobian)[None],
        tau=s.tau_J_d[None], effort=effort[None], stopped=np.array([stopped]), limited=np.array([limited]),
        force=None if s.O_F_ext_hat_K is None else s.O_F_ext_hat_K[None, :3],
        box=None if s.box is None else s.box[None],
    )  # fmt: skip
