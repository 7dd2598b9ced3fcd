"""A policy on an arm whose clock does not wait: the 1 kHz cycle runs in a process of its own and asks for the newest
target.

Whatever becomes of the policy's process, the arm's goes on: where nothing new is said for the driver's deadline, it
damps the arm and stops it. A thread would not do: a policy that keeps Python's lock keeps it from every thread
(benchmarks/watchdog.py). What the two share is memory without a lock, which a process that is killed would keep.
"""

import gc
import multiprocessing
import signal
import time
from collections.abc import Callable
from contextlib import ExitStack
from multiprocessing.connection import Connection
from multiprocessing.sharedctypes import RawArray
from typing import Any

import numpy as np

from r2s.adaptation.adapter import Adapter, Tells
from r2s.arm.deploy import DrivenArm, Stop, Timing, as_state
from r2s.arm.interface import Arm, ArmState, ArmStopped, Operated
from r2s.physics.rigid_body import Kinematics
from r2s.physics.robot import Robot
from r2s.tasks.task import State, Task

START_S = 240.0  # for the process to import, compile and reach its arm
POLL_S = 2e-4
PATIENCE_S = 5.0  # for an arm to be brought to rest at the end
TRIES = 10  # to read what is being written; then it is not new


class Slot:
    """Numbers that one process writes and others read whole; how often it was written says whether they are new."""

    def __init__(self, width: int):
        self._raw = RawArray("d", 1 + width)

    def write(self, values: np.ndarray) -> None:
        """Put values (width,) there."""
        a = np.frombuffer(self._raw)
        a[0] += 1  # odd: being written
        a[1:] = values
        a[0] += 1

    def read(self) -> tuple[int, np.ndarray] | None:
        """Return how often it was written, and values (width,); None while it is being written, for good or not."""
        a = np.frombuffer(self._raw)
        for _ in range(TRIES):
            before = a[0]
            values = a[1:].copy()
            if before == a[0] and before % 2 == 0:
                return int(before) // 2, values
        return None


class LiveArm:
    """An arm behind the driver in a process of its own; the `Arms` of `r2s.tasks.episode.rollout`.

    `with LiveArm(...) as arms`: the arm is opened in the process, stopped and closed at the end whatever happens.

    Attributes:
        robot: the arm's. stops, timing, done, speeds, halted: as of `DrivenArm`.

    Args:
        open_arm: returns the arm, or a context manager that gives it; runs in the process, so it must be picklable.
        robot: whose number of joints the arm has.
        task, friction, soft_start_s, rotors, adapter: as of `DrivenArm`; the adapter works in the process.

    Raises:
        UserError, ArmStopped: what opening the arm says.
    """

    width = 1

    def __init__(
        self,
        open_arm: Callable[[], Any],
        robot: Robot,
        task: Task,
        friction: np.ndarray,
        *,
        soft_start_s: float = 0.0,
        rotors: np.ndarray | None = None,
        adapter: Adapter | None = None,
    ):
        self.robot, self._task, self._n = robot, task, robot.n
        self.stops: list[Stop] = []
        self.timing = Timing()
        self.done = 0
        self.speeds = np.zeros((1, task.steps, robot.n))
        self.halted: str | None = None
        self._kinematics = Kinematics(robot)
        self._operator: Callable[[str], bool] | None = None
        words = len(adapter.told) if isinstance(adapter, Tells) else 0
        self._target, self._state, self._over = Slot(robot.n), Slot(5 * robot.n + 4 + words), Slot(1)
        driver = {"friction": friction, "soft_start_s": soft_start_s, "rotors": rotors, "adapter": adapter}
        self._given = open_arm, task, driver, self._target, self._state, self._over

    def __enter__(self) -> "LiveArm":
        context = multiprocessing.get_context("spawn")  # a fork would copy threads in any state
        self._line, its = context.Pipe()
        # no daemon, which would be killed with its arm in motion, and could not start an emulator
        self._process = context.Process(target=_serve, args=(its, *self._given), name="arm")
        self._process.start()
        its.close()
        try:
            self.robot, self._operator = self._hear("ready", START_S)
        except BaseException:
            self.__exit__()
            raise
        self._kinematics = Kinematics(self.robot)
        return self

    def __exit__(self, *_: object) -> None:
        self._over.write(np.ones(1))
        self._line.close()  # its end of file
        self._process.join(2 * PATIENCE_S)
        if self._process.is_alive():
            self._process.terminate()
            self._process.join()

    @property
    def cycle(self) -> int:
        """Cycles of the arm since the episode began."""
        return self._look()[0]

    @property
    def stopped(self) -> bool:
        """Whether the episode was stopped."""
        return self._look()[3]

    def place(self, starts: np.ndarray, first: int) -> State:
        """Begin episode `first` at starts (1, n) rad, as `DrivenArm.place`; the operator is asked in this process."""
        self._over.write(np.zeros(1))
        self._line.send(("place", starts, first))
        self.done, self.halted = self._hear("placed")
        self._due, self._limited = 0, (0, 0)
        return self._read()

    def step(self, target: np.ndarray) -> State:
        """Say the target torque (1, n) Nm, and return the state at the next control period.

        A policy that needed longer than its period is heard when it speaks, and asked again at the next one.
        """
        self.timing.policy.append(time.perf_counter() - self._told)
        self._target.write(target[0])
        substeps = self._task.substeps
        self._due = max(self._due + substeps, (self.cycle // substeps + 1) * substeps)
        looked = 0
        while True:
            cycle, _, _, stopped, *_ = self._look()
            if stopped or cycle >= self._due:
                return self._read()
            looked += 1
            if looked % 100 == 0 and not self._process.is_alive():
                self._hear("ended")  # raises: what it said last, or that it has ended
            time.sleep(POLL_S)

    def end(self) -> np.ndarray:
        """Stop the arm; return (1,), whether it had stopped, or was being stopped, before."""
        self._over.write(np.ones(1))
        self.stops, stopped, timing, self.speeds = self._hear("ended")
        self.timing.driver, self.timing.adapter, self.timing.period = timing.driver, timing.adapter, timing.period
        return np.array([stopped])

    def _look(self) -> tuple[int, ArmState, np.ndarray, bool, int, np.ndarray | None]:
        """Return cycle, state, effort, whether it has stopped, in how many cycles the law acted, and what is told."""
        while (seen := self._state.read()) is None:
            if not self._process.is_alive():
                raise ArmStopped("the process that drove the arm has ended")
        t, cycle, stopped, limited = seen[1][:4]
        rows, told = np.split(seen[1][4:], [5 * self._n])
        q, dq, tau_J, tau_J_d, effort = rows.reshape(5, self._n)
        state = ArmState(t, q, dq, tau_J, tau_J_d)
        return int(cycle), state, effort, bool(stopped), int(limited), told if len(told) else None

    def _read(self) -> State:
        cycle, s, effort, stopped, limited, told = self._look()
        share = (limited - self._limited[1]) / max(cycle - self._limited[0], 1)
        state, self._limited = as_state(self._kinematics, s, effort, stopped, share, told), (cycle, limited)
        self._told = time.perf_counter()
        return state

    def _hear(self, word: str, patience: float | None = None) -> Any:
        """Wait for the process to say `word`, and return what; in between it may want the operator."""
        try:
            while True:
                if patience is not None and not self._line.poll(patience):
                    raise ArmStopped(f"the process that drives the arm said nothing for {patience:g} s")
                said, what = self._line.recv()
                if said == word:
                    return what
                if said == "failed":
                    raise what
                agreed = self._operator is not None and self._operator(what)
                self._line.send(agreed)
        except (EOFError, ConnectionError):
            raise ArmStopped("the process that drove the arm has ended") from None


def _serve(
    line: Connection,
    open_arm: Callable[[], Any],
    task: Task,
    driver: dict[str, Any],
    target: Slot,
    state: Slot,
    over: Slot,
) -> None:
    """Open the arm, run episodes as they are asked for, and end with the process that asks."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the one that asks, which stops the arm first

    def ask(reason: str) -> bool:
        line.send(("ask", reason))
        return line.recv()

    try:
        with ExitStack() as stack:
            opened = open_arm()
            arm: Arm = stack.enter_context(opened) if hasattr(opened, "__enter__") else opened
            stack.callback(arm.stop)
            operator = None
            if isinstance(arm, Operated):
                operator, arm.operator = arm.operator, ask  # whose terminal is that of the other process
            driven = DrivenArm(arm, task, **driver)
            line.send(("ready", (arm.robot, operator)))
            while True:
                _, starts, first = line.recv()
                _episode(driven, starts, first, line, target, state, over)
    except (EOFError, ConnectionError):
        return  # nobody is there any more
    except Exception as error:
        line.send(("failed", error))


def _episode(
    driven: DrivenArm, starts: np.ndarray, first: int, line: Connection, target: Slot, state: Slot, over: Slot
) -> None:
    heard = (target.read() or (0,))[0]
    driven.place(starts, first)
    cycle = 0
    _publish(driven, cycle, state)
    line.send(("placed", (driven.done, driven.halted)))
    parent = multiprocessing.parent_process()
    assert parent is not None
    goes_on = driven.halted is None
    gc.collect()
    gc.disable()  # which would take its time in some cycle
    try:
        while not _said(over):
            new = target.read()
            fresh = new is not None and new[0] > heard
            if goes_on and (fresh or cycle):
                heard = new[0] if new is not None else heard
                goes_on = driven.cycle(new[1] if fresh and new is not None else None)
                cycle += 1
                _publish(driven, cycle, state)
            elif parent.is_alive():
                time.sleep(POLL_S)  # for a first target, or for the end
            else:
                break
    finally:
        gc.enable()
        stopped = bool(driven.end()[0])
    line.send(("ended", (driven.stops, stopped, driven.timing, driven.speeds)))


def _said(over: Slot) -> bool:
    seen = over.read()
    return seen is not None and seen[1][0] > 0


def _publish(driven: DrivenArm, cycle: int, state: Slot) -> None:
    s, effort, stopped, limited = driven.read()
    told = np.zeros(0) if driven.told is None else driven.told
    state.write(np.concatenate([[s.t, cycle, stopped, limited], s.q, s.dq, s.tau_J, s.tau_J_d, effort, told]))
