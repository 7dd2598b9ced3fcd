"""Run a motion with real-time priority, and measure whether commands reach the arm in time."""

import ctypes
import gc
import os
import sys
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field

import numpy as np

from r2s.arm.interface import Arm, ArmState, ArmStopped
from r2s.physics.robot import SIM_DT

PRIORITY = 80  # SCHED_FIFO priority; libfranka's own thread has the highest, 99
SWITCH_S = 1e-4  # longest wait for Python's global lock while another thread computes; the default is 5 ms
LOCK_ALL = 1 | 2 | 4  # MCL_CURRENT | MCL_FUTURE | MCL_ONFAULT of mlockall(2): pages stay in memory after first use
LEAST_SUCCESS = 0.99  # share of the commands that must reach the arm in time
SUCCESS_CYCLES = 100  # cycles over which the arm averages its success rate; earlier averages are incomplete
_warned: set[str] = set()


@contextmanager
def realtime_section(priority: int | None = PRIORITY) -> Iterator[None]:
    """Run a motion without garbage collection, with this thread under SCHED_FIFO and with locked memory.

    Each missing permission causes one warning per process. At the end all settings are restored.

    Args:
        priority: SCHED_FIFO priority of this thread; None: do not change scheduler and memory.
    """
    with ExitStack() as stack:
        if gc.isenabled():  # a full collection takes up to 0.3 s
            gc.collect()
            gc.freeze()
            gc.disable()
            stack.callback(gc.enable)
            stack.callback(gc.unfreeze)
        stack.callback(sys.setswitchinterval, sys.getswitchinterval())
        sys.setswitchinterval(SWITCH_S)
        if priority is not None and sys.platform == "linux":
            _lock_memory(stack)
            _schedule(stack, priority)
        yield


@contextmanager
def kept_scheduler() -> Iterator[None]:
    """Restore this thread's scheduler at the end: on connection, libfranka 0.21 sets SCHED_FIFO 99 permanently."""
    thread = threading.get_native_id()  # the code after `yield` may run in another thread
    before = os.sched_getscheduler(thread), os.sched_getparam(thread)
    try:
        yield
    finally:
        with suppress(ProcessLookupError):  # the thread has ended
            os.sched_setscheduler(thread, *before)


def _schedule(stack: ExitStack, priority: int) -> None:
    stack.enter_context(kept_scheduler())
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except OSError as error:
        _warn(f"no real-time priority ({error.strerror}): set rtprio to at least {priority}")


def _lock_memory(stack: ExitStack) -> None:
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.mlockall(LOCK_ALL) == 0:
        stack.callback(libc.munlockall)
    else:
        _warn(f"memory is not locked ({os.strerror(ctypes.get_errno())}): set memlock to unlimited")


def _warn(message: str) -> None:
    if message not in _warned:
        _warned.add(message)
        print(f"warning: {message} in /etc/security/limits.conf", file=sys.stderr)


@dataclass
class Timing:
    """Measured durations, s. In lock-step only the durations of r2s's own computations are meaningful.

    Attributes:
        policy: time from a state to the policy's command, once per control step.
        driver, adapter: computing time of driver and adapter in one cycle; without an adapter, `adapter` is empty.
        period: time between two commands.
        robot: time from one state of the arm to the next by the arm's clock; more than 1 ms means lost cycles.
        success: control_command_success_rate of each cycle, without the first 100 cycles of a motion.
    """

    policy: list[float] = field(default_factory=list)
    driver: list[float] = field(default_factory=list)
    adapter: list[float] = field(default_factory=list)
    period: list[float] = field(default_factory=list)
    robot: list[float] = field(default_factory=list)
    success: list[float] = field(default_factory=list)

    def begin(self) -> None:
        """Begin a new motion: forget the last cycle's times, and store the motion's first index in `success`."""
        self._begun, self._last = len(self.success), (0.0, 0.0)

    def cycle(self, clock: tuple[float, float, float], state: ArmState, adapts: bool = False) -> None:
        """Add the durations of one cycle, given `CommandLoop.clock` and the state after this cycle."""
        began, driven, adapted = clock
        (sent_at, t), self._last = self._last, (driven, state.t)
        if not t:  # the first command starts the motion; this start takes longer than a cycle
            self._last = 0.0, state.t
        self.driver.append(driven - began)
        if adapts:
            self.adapter.append(adapted - driven)
        if state.t > t:  # false in the first cycle of a new motion, and in a cycle in which the arm stopped
            self.robot.append(state.t - t)
            if sent_at:
                self.period.append(driven - sent_at)
        rate = state.control_command_success_rate
        if rate is not None and state.t > SUCCESS_CYCLES * SIM_DT:
            self.success.append(float(rate))

    def refusal(self, arm: Arm) -> str | None:
        """Return a reason to reject a real-time motion if under 99 % of its commands came in time, else None."""
        rates = self.success[self._begun :]
        if not getattr(arm, "realtime", False) or not rates or (rate := float(np.mean(rates))) >= LEAST_SUCCESS:
            return None
        least = f"{100 * LEAST_SUCCESS:g} %"
        return f"the arm got {100 * rate:.1f} % of its commands in time, at least {least} are needed"

    def check(self, arm: Arm) -> None:
        """Raise ArmStopped if too few commands of a real-time motion came in time, see `refusal`."""
        if (reason := self.refusal(arm)) is not None:
            raise ArmStopped(reason)

    def table(self) -> list[dict[str, float | str]]:
        """Return one row per kind of duration: count, quantiles in ms; for `robot` also lost cycles, success rate."""
        rows: list[dict[str, float | str]] = []
        for name in ("policy", "driver", "adapter", "period", "robot"):
            values = getattr(self, name)
            if not values:
                continue
            x = 1e3 * np.array(values)
            names = ("median_ms", "p99_ms", "p999_ms", "max_ms")
            quantiles = zip(names, np.percentile(x, (50, 99, 99.9, 100)), strict=True)
            row: dict[str, float | str] = {"what": name, "count": len(x)} | {k: float(v) for k, v in quantiles}
            row |= {"lost": np.nan, "success_rate": np.nan}
            if name == "robot":
                row["lost"] = float(np.round(x).sum() - len(x))
                row["success_rate"] = float(np.mean(self.success or [np.nan]))
            rows.append(row)
        return rows
