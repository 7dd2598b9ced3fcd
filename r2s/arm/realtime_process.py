"""Run a policy on an arm whose clock does not wait: a separate process runs the 1 kHz cycle.

The arm's process does not depend on the policy's process: if no new command arrives within the driver's deadline, the
driver damps and stops the arm. A thread would not suffice, because a policy that holds Python's global lock blocks
all threads. The processes share memory without a lock, because a killed process would not release a lock.

The arm's process runs in its own session, so signals from the terminal do not reach it. After a signal to either
process, or when the policy's process ends, the arm's process damps and ends every motion, also the motion to a start
(r2s/arm/stop_request.py).
"""

import multiprocessing
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from multiprocessing.connection import Connection
from multiprocessing.sharedctypes import RawArray
from typing import Any, NamedTuple

import numpy as np

from r2s.arm.interface import Arm, ArmState, ArmStopped, Operated, named_signals, signal_sizes
from r2s.arm.lifeline import Lifeline
from r2s.arm.policy_runner import PolicyRunner, Stop, as_state
from r2s.arm.realtime import Timing, realtime_section
from r2s.arm.stop_request import handled_signals, parent_ended, pipeline, requested, serve, watched
from r2s.arm.warm_up import warm_up
from r2s.errors import Stopped
from r2s.physics.rigid_body import Kinematics
from r2s.physics.robot import Robot
from r2s.tasks.task import State, Task

START_S = 240.0  # longest time for the arm's process to import, compile and connect to the arm
POLL_S = 2e-4  # s between two reads of shared memory, a fifth of a cycle
EXIT_S = 5.0  # s for the arm to come to rest; its process gets SIGTERM after 2 EXIT_S, SIGKILL after 4 EXIT_S
READ_ATTEMPTS = 10  # most attempts to read a slot that is being written; then `Slot.read` returns None


class Slot:
    """Numbers in shared memory with one writer; a write counter makes reads consistent (seqlock)."""

    def __init__(self, width: int):
        self._raw = RawArray("d", 1 + width)

    def write(self, values: np.ndarray) -> None:
        """Write values (width,)."""
        a = np.frombuffer(self._raw)
        a[0] += 1  # odd during a write
        a[1:] = values
        a[0] += 1

    def read(self) -> tuple[int, np.ndarray] | None:
        """Return the number of writes and the values (width,), or None if a write is unfinished or interrupted."""
        a = np.frombuffer(self._raw)
        for _ in range(READ_ATTEMPTS):
            before = a[0]
            values = a[1:].copy()
            if before == a[0] and before % 2 == 0:
                return int(before) // 2, values
        return None


class Channel(NamedTuple):
    """Memory that the policy's process and the arm's process share.

    Attributes:
        command: (c,), newest command of the policy's process. state: newest state of the arm (`_publish`).
        end: 1 after the policy's process has ended the episode, else 0.
        signal: number of a signal that the policy's process received. lifeline: mutex locked by the policy's process.
    """

    command: Slot
    state: Slot
    end: Slot
    signal: Slot
    lifeline: Lifeline

    @property
    def ended(self) -> bool:
        """Whether the policy's process has ended the episode."""
        end = self.end.read()
        return end is not None and end[1][0] > 0

    def signalled(self) -> str | None:
        """Return the name of the signal that the policy's process received, or None."""
        latest = self.signal.read()
        number = 0 if latest is None else int(latest[1][0])
        return signal.Signals(number).name if number else None


class RealtimeRunner:
    """Runs episodes on an arm; a separate process drives the arm. Implements `r2s.tasks.rollout.Arms`.

    `with RealtimeRunner(...) as arms`: the arm's process opens the arm, and stops and closes the arm at the end.

    Attributes:
        robot: the arm's model. stops, timing, done, speeds, halted, blocked: see `PolicyRunner`.

    Args:
        open_arm: picklable function that the arm's process calls; it returns the opened arm, or a context manager
            that opens the arm.
        robot: a model with the arm's number of joints. task, friction: see `PolicyRunner`.
        settings: further arguments of `PolicyRunner`; an adapter runs in the arm's process.

    Raises:
        UserError, ArmStopped: the arm cannot be opened.
    """

    width = 1

    def __init__(self, open_arm: Callable[[], Any], robot: Robot, task: Task, friction: np.ndarray, **settings: Any):
        self.robot, self._task, self._n = robot, task, robot.n
        self.stops: list[Stop] = []
        self.timing = Timing()
        self.done = 0
        self.speeds = np.zeros((1, task.steps, robot.n))
        self.halted: str | None = None
        self.blocked: str | None = None
        self._kinematics, self._section = Kinematics(robot), ExitStack()
        self._operator: Callable[[str], bool] | None = None
        command, state = task.control(robot).command_size, 4 + 5 * robot.n + sum(signal_sizes(robot.n).values())
        self._channel = Channel(Slot(command), Slot(state), Slot(1), Slot(1), Lifeline())
        self._arguments = open_arm, robot, task, {"friction": friction, **settings}, self._channel

    def __enter__(self) -> "RealtimeRunner":
        context = multiprocessing.get_context("spawn")  # fork would copy locks that other threads hold
        self._line, remote = context.Pipe()
        # not a daemon: a daemon would be killed while its arm moves, and could not start an emulator
        self._process = context.Process(target=_serve, args=(remote, os.getpid(), *self._arguments), name="arm")
        self._signals = ExitStack()
        signal = self._channel.signal
        self._signals.enter_context(handled_signals(lambda number: signal.write(np.array([number])), pipeline()))
        self._channel.lifeline.hold()
        self._process.start()
        remote.close()
        try:
            self.robot, self._operator = self._receive("ready", START_S)
        except BaseException:
            self.__exit__(*sys.exc_info())
            raise
        self._kinematics = Kinematics(self.robot)
        return self

    def __exit__(self, *error: Any) -> None:
        self._channel.end.write(np.ones(1))
        self._section.close()
        self._line.close()  # the arm's process ends when it reads the end of file
        for end in (lambda: None, self._process.terminate, self._process.kill):
            end()
            self._process.join(2 * EXIT_S)
            if not self._process.is_alive():
                break
        self._channel.lifeline.release()
        self._signals.__exit__(*error)  # type: ignore[arg-type]

    @property
    def cycle(self) -> int:
        """Number of the arm's cycles since the episode began."""
        return self._latest()[0]

    def place(self, starts: np.ndarray, first: int) -> State:
        """Begin episode `first` at starts (1, n) rad, see `PolicyRunner.place`; ask the operator in this process."""
        self._channel.end.write(np.zeros(1))
        self._line.send(("place", starts, first))
        self.done, self.halted = self._receive("placed")
        self._note_halt()
        self._due, self._last = 0, (0, 0)
        self._section.enter_context(realtime_section(priority=None))  # garbage collection would make the policy late
        return self._observe()

    def step(self, command: np.ndarray) -> State:
        """Pass the command (1, c) to the arm's process, and return the state when the next control period begins.

        A late command takes effect at once, and does not shift the times at which later control periods begin.
        """
        self.timing.policy.append(time.perf_counter() - self._observed_at)
        self._channel.command.write(command[0])
        substeps = self._task.substeps
        self._due = max(self._due + substeps, (self.cycle // substeps + 1) * substeps)
        polls = 0
        while True:
            cycle, _, _, stopped, _ = self._latest()
            if stopped or cycle >= self._due:
                return self._observe()
            polls += 1
            if polls % 100 == 0 and not self._process.is_alive():
                self._receive("ended")  # raises the exception that the process sent, or ArmStopped
            time.sleep(POLL_S)

    def end(self) -> np.ndarray:
        """Stop the arm; return (1,) bool: whether arm, driver, a stop request or lost commands ended the episode."""
        self._channel.end.write(np.ones(1))
        self._section.close()
        self.stops, stopped, timing, self.speeds, self.halted, self.blocked = self._receive("ended")
        self._note_halt()
        self.timing = replace(timing, policy=self.timing.policy)
        return np.array([stopped])

    def _note_halt(self) -> None:
        if self.halted is not None and requested() is not None:
            serve()

    def _latest(self) -> tuple[int, ArmState, np.ndarray, bool, int]:
        """Return cycle, state, effort (n,) Nm, stop flag, and in how many cycles the safety filter acted."""
        while (latest := self._channel.state.read()) is None:
            if not self._process.is_alive():
                raise ArmStopped("the process that drove the arm has ended")
        t, cycle, stopped, limited = latest[1][:4]
        moving, signals = np.split(latest[1][4:], [5 * self._n])
        q, dq, tau_J, tau_J_d, effort = moving.reshape(5, self._n)
        state = ArmState(t, q, dq, tau_J, tau_J_d, **named_signals(signals, self._n))
        return int(cycle), state, effort, bool(stopped), int(limited)

    def _observe(self) -> State:
        cycle, s, effort, stopped, limited = self._latest()
        share = (limited - self._last[1]) / max(cycle - self._last[0], 1)
        state, self._last = as_state(self._kinematics, s, effort, stopped, share), (cycle, limited)
        self._observed_at = time.perf_counter()
        return state

    def _receive(self, kind: str, timeout_s: float | None = None) -> Any:
        """Return the arm process's next message of the kind `kind`; pass the arm's questions on to the operator."""
        try:
            while True:
                if timeout_s is not None and not self._line.poll(timeout_s):
                    raise ArmStopped(f"the process that drives the arm sent no message for {timeout_s:g} s")
                received, content = self._line.recv()
                if received == kind:
                    return content
                if received == "failed":
                    raise content
                self._line.send(self._operator is not None and self._operator(content))
        except (EOFError, ConnectionError):
            raise ArmStopped("the process that drove the arm has ended") from None


def _serve(
    line: Connection,
    parent: int,
    open_arm: Callable[[], Any],
    robot: Robot,
    task: Task,
    settings: dict[str, Any],
    channel: Channel,
) -> None:
    """Open the arm, run the requested episodes, and end when the policy's process closes the connection `line`."""
    os.setsid()  # so that signals of the terminal reach only the policy's process

    def forward(reason: str) -> bool:
        line.send(("operator", reason))
        return line.recv()

    try:
        warm_up(robot, task, settings.get("adapter"))
        with ExitStack() as stack:
            stack.enter_context(handled_signals())
            stack.enter_context(watched(channel.lifeline.lost))
            stack.enter_context(watched(parent_ended(parent)))
            stack.enter_context(watched(channel.signalled))
            opened = open_arm()
            arm: Arm = stack.enter_context(opened) if hasattr(opened, "__enter__") else opened
            stack.callback(arm.stop)
            operator = None
            if isinstance(arm, Operated):
                operator, arm.operator = arm.operator, forward  # only the policy's process can ask at the terminal
            runner = PolicyRunner(arm, task, **settings)
            line.send(("ready", (arm.robot, operator)))
            while True:
                _, starts, first = line.recv()
                _run_episode(runner, starts, first, line, channel)
    except (EOFError, ConnectionError):
        return  # the policy's process has ended
    except Stopped as error:
        line.send(("failed", ArmStopped(f"the process that drives the arm received {error}")))
    except Exception as error:
        line.send(("failed", error))


def _run_episode(runner: PolicyRunner, starts: np.ndarray, first: int, line: Connection, channel: Channel) -> None:
    commands = _newest_commands(runner, channel, last=(channel.command.read() or (0,))[0])
    runner.place(starts, first)
    _publish(runner, channel)
    line.send(("placed", (runner.done, runner.halted)))
    with realtime_section(priority=None):  # an arm sets its own priority
        try:
            if runner.halted is None:
                runner.run(commands)
                _publish(runner, channel)
            while not channel.ended and requested() is None:
                time.sleep(POLL_S)
        finally:
            stopped = bool(runner.end()[0])
    line.send(("ended", (runner.stops, stopped, runner.timing, runner.speeds, runner.halted, runner.blocked)))


def _newest_commands(runner: PolicyRunner, channel: Channel, last: int) -> Iterator[np.ndarray | None]:
    """Wait for an episode's first command; then yield, in each cycle, the new command, or None if no command is new.

    Args:
        last: number of commands that the policy wrote in earlier episodes.
    """
    while not channel.ended:
        latest = channel.command.read()
        if latest is not None and latest[0] > last:
            last = latest[0]
            yield latest[1]
        elif runner.cycles:
            yield None
        elif requested() is None:
            time.sleep(POLL_S)
            continue
        else:
            return
        _publish(runner, channel)


def _publish(runner: PolicyRunner, channel: Channel) -> None:
    s, effort, stopped, limited = runner.read()
    head = [s.t, runner.cycles, stopped, limited]
    channel.state.write(np.concatenate([head, s.q, s.dq, s.tau_J, s.tau_J_d, effort, s.signals]))
