"""A policy on an arm that waits for it: observe, ask the policy at its own rate, let the driver command at 1 kHz.

Here time passes only while nobody thinks: right for twins and in lock-step, and the same bit for bit. An arm whose
clock does not wait is driven from a process of its own, r2s/arm/live.py.
"""

import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.signal import savgol_filter

from r2s.adaptation.adapter import Adapter
from r2s.arm.driven import Driven
from r2s.arm.driver import Driver
from r2s.arm.interface import Arm, ArmState, ArmStopped, NotCleared, Operated
from r2s.physics.rigid_body import Kinematics
from r2s.physics.robot import SIM_DT, Robot
from r2s.tasks.task import State, Task

LOGGED_S = 1.0  # before a stop, of every cycle
SMOOTH = 20  # cycles to either side, from whose angles a speed is told: an encoder's noise leaves 2e-4 rad/s
ATTEMPTS = 3  # to bring an arm to its start, each with the operator's consent


@dataclass
class Timing:
    """How long things took on the clock of this computer, s; in lock-step only what we do ourselves has a meaning.

    Attributes:
        policy: from a state to the policy's target, once per control step. driver: working out one command.
        adapter: hearing one cycle, where there is an adapter. period: from one command to the next.
    """

    policy: list[float] = field(default_factory=list)
    driver: list[float] = field(default_factory=list)
    adapter: list[float] = field(default_factory=list)
    period: list[float] = field(default_factory=list)

    def table(self) -> list[dict[str, float | str]]:
        """Return one row each: count, median, 99 % and largest, ms."""
        rows: list[dict[str, float | str]] = []
        names = ["policy", "driver", *(["adapter"] if self.adapter else []), "period"]
        for name in names:
            x = 1e3 * np.array(getattr(self, name) or [np.nan])
            row = {"median_ms": np.median(x), "p99_ms": np.percentile(x, 99), "max_ms": x.max()}
            rows.append({"what": name, "count": len(x), **{k: float(v) for k, v in row.items()}})
        return rows


@dataclass(frozen=True)
class Stop:
    """Why an episode ended early.

    Attributes:
        episode: from 0. when: in it. reason: in the words of the arm or of the driver.
        log: (k, 1 + 4 n), the last second at 1 kHz: t s, q rad, dq rad/s, tau_J_d Nm, and the command Nm thereupon.
    """

    episode: int
    when: str
    reason: str
    log: np.ndarray

    def __str__(self) -> str:
        return f"episode {self.episode + 1}, {self.when}: {self.reason}"


def episode_driver(
    robot: Robot, task: Task, soft_start_s: float, friction: np.ndarray, rotors: np.ndarray | None = None
) -> Driver:
    """Return the driver of an episode of `task`; friction (n,) Nm and rotors as of `Drivers`."""
    period = {"period_s": 1 / task.ctrl_hz, "cutoff_hz": task.cutoff_hz}
    return Driver(robot, task.torque(robot), friction, **period, soft_start_s=soft_start_s, rotors=rotors)


class DrivenArm:
    """An arm behind the driver, one control period at a time; the `Arms` of `r2s.tasks.episode.rollout`.

    Attributes:
        stops: why episodes ended early, where they did. timing: see there.
        done: episodes that the arm was brought to the start of, or tried to: all, unless it was `halted`.
        speeds: (1, T, n) rad/s after each control step of the last episode, from the angles of all its cycles.
        halted: why there are no further episodes, or None: the operator was asked after a stop, and did not agree.

    Args:
        arm: at 1 kHz; one that waits for its commands.
        task: rates and torques.
        friction: (n,) Nm, how much is believed to hold each joint: `Dynamics.level` of what the policy learned on.
        soft_start_s: s, over which the torque of an episode fades in; hardware deserves some, the twin needs none.
        rotors: (n,) kg m^2, `Dynamics.armature` of the same; None: the robot's.
        adapter: what adds to the policy's torque; None: nothing.
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
        self._adapts = adapter is not None
        driver = episode_driver(arm.robot, task, soft_start_s, friction, rotors)
        self._driven = Driven(arm, driver, self._log, adapter)
        self.stops: list[Stop] = []
        self.timing = Timing()
        self.done = 0
        self.speeds = np.zeros((1, task.steps, arm.robot.n))
        self.halted: str | None = None

    def place(self, starts: np.ndarray, first: int) -> State:
        """Move to starts (1, n) rad and begin episode `first` there.

        A stop on the way is the episode's stop. Beside an arm with an operator he is asked whether to try again;
        where he does not agree, neither this nor any later episode begins.
        """
        self._log.clear()
        self._angles: list[np.ndarray] = []
        self._episode, self._stopped, self._sent, self._limited = first, False, 0.0, 0
        if self.halted is None:
            self._approach(starts[0])
        self._stopped = self._stopped or self.halted is not None
        self.done += self.halted is None
        return self._read()

    @property
    def told(self) -> np.ndarray | None:
        """(c,), what the adapter tells a policy, None: nothing."""
        return self._driven.told

    def read(self) -> tuple[ArmState, np.ndarray, bool, int]:
        """Return the arm's state, what the low-pass let through (n,) Nm, whether the episode was stopped, and in how
        many cycles of it the driver's law changed what was asked for.
        """
        driver = self._driven.driver
        return self._driven.state, driver.effort, self._stopped, driver.limited

    def step(self, target: np.ndarray) -> State:
        """Go on for one control period with the target torque (1, n) Nm, or until the arm stops."""
        self.timing.policy.append(time.perf_counter() - self._told)
        for ms in range(self._substeps):
            if not self.cycle(target[0] if ms == 0 else None):
                break
        return self._read()

    def end(self) -> np.ndarray:
        """Stop the arm; return (1,), whether it had stopped, or was being stopped, before."""
        reason = self._driven.end()
        if not self._stopped and reason is not None:  # the end came before the arm was at rest
            self._stop(f"{self._driven.state.t:.2f} s", reason)
        told = smooth_speeds(self._angles, self._substeps)[: self.speeds.shape[1]]
        self.speeds[:] = 0.0  # an arm that was stopped rests
        self.speeds[0, : len(told)] = told
        return np.array([self._stopped])

    def cycle(self, target: np.ndarray | None) -> bool:
        """Go on for 1 ms with the target (n,) Nm, None where nothing new was said; return whether the arm goes on."""
        try:
            self._driven(target)
        except ArmStopped as reason:
            self._stop(f"{self._driven.state.t:.2f} s", reason)
        self._angles.append(self._driven.state.q)
        began, now, heard = self._driven.clock
        self.timing.driver.append(now - began)
        if self._adapts:
            self.timing.adapter.append(heard - now)
        if self._sent:
            self.timing.period.append(now - self._sent)
        self._sent = now
        return not self._stopped

    def _approach(self, start: np.ndarray) -> None:
        for left in reversed(range(ATTEMPTS if isinstance(self._arm, Operated) else 1)):
            try:
                self._driven.place(start)
                return
            except NotCleared as reason:
                self.halted = str(reason)
                return
            except ArmStopped as reason:
                if left:
                    continue
                if isinstance(self._arm, Operated):
                    self.halted = str(reason)
                    return
                self._stop("on the way to its start", reason)

    def _stop(self, when: str, reason: object) -> None:
        rows = [np.concatenate([[s.t], s.q, s.dq, s.tau_J_d, command]) for s, command in self._log]
        log = np.array(rows).reshape(-1, 1 + 4 * self.robot.n)
        self.stops.append(Stop(self._episode, when, str(reason), log))
        self._stopped = True

    def _read(self) -> State:
        s, effort, stopped, limited = self.read()
        share = (limited - self._limited) / self._substeps
        state, self._limited = as_state(self._kinematics, s, effort, stopped, share, self.told), limited
        self._told = time.perf_counter()
        return state


def smooth_speeds(angles: Sequence[np.ndarray], every: int) -> np.ndarray:
    """Return speeds (., n) rad/s in each `every`-th of the cycles that angles (n,) rad are of.

    A parabola through SMOOTH cycles to either side (Savitzky and Golay, Analytical Chemistry 36(8), 1964).
    """
    window = min(2 * SMOOTH + 1, len(angles) - 1 + len(angles) % 2)
    if window < 3:
        return np.zeros((0, 1))
    speeds = savgol_filter(np.array(angles), window, 2, deriv=1, delta=SIM_DT, axis=0)
    return speeds[every - 1 :: every]


def as_state(
    kinematics: Kinematics,
    s: ArmState,
    effort: np.ndarray,
    stopped: bool,
    limited: float,
    told: np.ndarray | None = None,
) -> State:
    """Return what a task is told of one arm; effort (n,) Nm, told (c,), stopped and limited as of `State`."""
    ee, jacobian = kinematics(s.q)
    return State(
        t=np.array([s.t]), q=s.q[None], dq=s.dq[None], ee=ee[None], jacobian=np.ascontiguousarray(jacobian)[None],
        tau=s.tau_J_d[None], effort=effort[None], stopped=np.array([stopped]), limited=np.array([limited]),
        told=None if told is None else told[None],
    )  # fmt: skip
