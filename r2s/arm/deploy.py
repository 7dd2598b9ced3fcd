"""A policy on an arm: observe, ask the policy at its own rate, let the driver command at 1 kHz.

The policy is asked within the cycle. One that hangs leaves the arm without commands, and the arm stops itself.
"""

import time
from collections import deque
from dataclasses import dataclass, field

import numpy as np

from r2s.arm.driver import Driver
from r2s.arm.interface import Arm, ArmState, ArmStopped
from r2s.physics.rigid_body import Kinematics
from r2s.physics.robot import SIM_DT
from r2s.tasks.task import State, Task

LOGGED_S = 1.0  # before a stop, of every cycle


@dataclass
class Timing:
    """How long things took on the clock of this computer, s; in lock-step only what we do ourselves has a meaning.

    Attributes:
        policy: from a state to the policy's target, once per control step. driver: working out one command.
        period: from one command to the next.
    """

    policy: list[float] = field(default_factory=list)
    driver: list[float] = field(default_factory=list)
    period: list[float] = field(default_factory=list)

    def table(self) -> list[dict[str, float | str]]:
        """Return one row each: count, median, 99 % and largest, ms."""
        rows: list[dict[str, float | str]] = []
        for name in ("policy", "driver", "period"):
            x = 1e3 * np.array(getattr(self, name) or [np.nan])
            row = {"median_ms": np.median(x), "p99_ms": np.percentile(x, 99), "max_ms": x.max()}
            rows.append({"what": name, "count": len(x)} | {k: float(v) for k, v in row.items()})
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


class DrivenArm:
    """An arm behind the driver, one control period at a time; the `Arms` of `r2s.tasks.episode.rollout`.

    Attributes:
        stops: why episodes ended early, where they did. timing: see there.

    Args:
        arm: at 1 kHz.
        task: rates and torques.
        soft_start_s: s, over which the torque of an episode fades in; hardware deserves some, the twin needs none.
    """

    width = 1

    def __init__(self, arm: Arm, task: Task, *, soft_start_s: float = 0.0):
        self.robot, self._arm, self._substeps = arm.robot, arm, task.substeps
        self._kinematics = Kinematics(arm.robot)
        period = {"period_s": 1 / task.ctrl_hz, "cutoff_hz": task.cutoff_hz}
        self._driver = Driver(arm.robot, task.torque(arm.robot), **period, soft_start_s=soft_start_s)
        self.stops: list[Stop] = []
        self.timing = Timing()
        self._log: deque[tuple[ArmState, np.ndarray]] = deque(maxlen=round(LOGGED_S / SIM_DT))

    def place(self, starts: np.ndarray, first: int) -> State:
        """Move to starts (1, n) rad and begin episode `first` there; a stop on the way is its stop."""
        self._driver.reset()
        self._log.clear()
        self._episode, self._stopped, self._sent = first, False, 0.0
        try:
            self._state = self._arm.move_to(starts[0])
        except ArmStopped as reason:
            self._state = self._arm.read()
            self._stop("on the way to its start", reason)
        return self._read()

    def step(self, target: np.ndarray) -> State:
        """Go on for one control period with the target torque (1, n) Nm, or until the arm stops."""
        self.timing.policy.append(time.perf_counter() - self._told)
        try:
            for ms in range(self._substeps):
                self._cycle(target[0] if ms == 0 else None)
        except ArmStopped as reason:
            self._stop(f"{self._state.t:.2f} s", reason)
        return self._read()

    def end(self) -> np.ndarray:
        """Stop the arm; return (1,), whether it had stopped, or was being stopped, before."""
        if not self._stopped and self._driver.stopping is not None:  # the end came before the arm was at rest
            self._stop(f"{self._state.t:.2f} s", self._driver.stopping)
        self._arm.stop()
        return np.array([self._stopped])

    def _cycle(self, target: np.ndarray | None) -> None:
        began = time.perf_counter()
        wanted = self._driver(self._state, target)
        now = time.perf_counter()
        self.timing.driver.append(now - began)
        if self._sent:
            self.timing.period.append(now - self._sent)
        self._sent = now
        self._log.append((self._state, wanted))
        self._arm.command(wanted)
        self._state = self._arm.read()
        if self._driver.done:
            raise ArmStopped(self._driver.stopping)

    def _stop(self, when: str, reason: object) -> None:
        rows = [np.concatenate([[s.t], s.q, s.dq, s.tau_J_d, command]) for s, command in self._log]
        log = np.array(rows).reshape(-1, 1 + 4 * self.robot.n)
        self.stops.append(Stop(self._episode, when, str(reason), log))
        self._stopped = True

    def _read(self) -> State:
        s, (ee, jacobian) = self._state, self._kinematics(self._state.q)
        state = State(
            t=np.array([s.t]), q=s.q[None], dq=s.dq[None], ee=ee[None], jacobian=np.ascontiguousarray(jacobian)[None],
            tau=s.tau_J_d[None], effort=self._driver.effort[None], stopped=np.array([self._stopped]),
            limited=np.array([self._driver.limited]),
        )  # fmt: skip
        self._told = time.perf_counter()
        return state
