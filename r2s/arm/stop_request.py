"""Stop every motion of this process on a signal, or when the process that sends the commands ends.

`CommandLoop` calls `requested` in every cycle. After a stop request the driver brings the arm to rest, the motion
ends with `StopRequested`, and no new motion begins. All motions of a process share one stop request.
"""

import os
import signal
import stat
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

from r2s.errors import Stopped

# signals of a closed terminal, Ctrl-C, Ctrl-\, kill and systemd, Ctrl-Z; no process can handle SIGKILL or SIGSTOP
SIGNALS = (signal.SIGHUP, signal.SIGINT, signal.SIGQUIT, signal.SIGTERM, signal.SIGTSTP)
PARENT = "R2S_PARENT"  # environment variable: pid of the process whose end stops every motion of this process
FOLLOW_S = 0.1  # s between two checks whether the parent process still runs
GRACE_S = 2.0  # s for a motion to end (driver and `rest` need at most 0.5 s each) before a KeyboardInterrupt


class _Request:
    """The stop request of this process; `ending`: a motion is stopping; `served`: all motions have ended."""

    def __init__(self) -> None:
        self.sources: list[Callable[[], str | None]] = []
        self.reason: str | None = None
        self.ending = self.served = False


_request = _Request()


def requested() -> str | None:
    """Return the reason of the first stop request in this process, or None if no stop was requested."""
    if _request.reason is None:
        for source in _request.sources:
            if (reason := source()) is not None:
                _request.reason = reason
                break
    return _request.reason


def begin_ending() -> None:
    """Record that a motion is stopping because of the stop request."""
    _request.ending = True


def serve() -> None:
    """Record that all motions have ended after the stop request; the next signal raises KeyboardInterrupt at once."""
    _request.ending, _request.served = False, True


@contextmanager
def watched(source: Callable[[], str | None]) -> Iterator[None]:
    """In this context, `requested` also calls `source`, which must return a reason or None within microseconds."""
    _request.sources.append(source)
    try:
        yield
    finally:
        _request.sources.remove(source)


def parent_ended(parent: int) -> Callable[[], str | None]:
    """Return a `source` for `watched` that requests a stop when the policy's process (pid `parent`) has ended."""
    return lambda: None if os.getppid() == parent else "the process of the policy has ended"


def pipeline() -> int | None:
    """Return the pid of the pipeline that started this process (environment variable PARENT), or None if unset."""
    return int(os.environ[PARENT]) if PARENT in os.environ else None


def follow(parent: int, over: threading.Event) -> None:
    """Send SIGTERM to this process when its parent is no longer `parent`; check until the event `over` is set."""
    while not over.wait(FOLLOW_S):
        if os.getppid() != parent:
            os.kill(os.getpid(), signal.SIGTERM)
            return


def _leave_terminal() -> None:
    """Discard output to a terminal that has closed, because a write to a closed terminal raises an error."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for stream in (1, 2):
        if stat.S_ISCHR(os.fstat(stream).st_mode):
            os.dup2(nowhere, stream)
    os.close(nowhere)


@contextmanager
def handled_signals(
    forward: Callable[[int], None] = lambda number: None, parent: int | None = None
) -> Iterator[None]:
    """Convert each signal of SIGNALS to a stop request while an arm is open in this process.

    If no motion has responded GRACE_S after the request, the main thread gets a KeyboardInterrupt, and this context
    raises `Stopped` with the signal's name. The context also raises `Stopped` if its block ends before a motion has
    responded, because code after the block may move the arm. Outside the main thread, the context has no effect,
    because Python handles signals only in the main thread.

    Args:
        forward: function that the signal handler calls with each signal's number.
        parent: pid of the parent process, whose end acts like SIGTERM; None: no process is watched.

    Raises:
        Stopped: a signal arrived while no motion ran.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def request(number: int, _: FrameType | None) -> None:
        forward(number)
        if number == signal.SIGHUP:
            _leave_terminal()
        if _request.served and not _request.ending:
            raise KeyboardInterrupt
        _request.reason = _request.reason or signal.Signals(number).name
        signal.setitimer(signal.ITIMER_REAL, GRACE_S)

    def insist(number: int, _: FrameType | None) -> None:
        if _request.ending:
            signal.setitimer(signal.ITIMER_REAL, GRACE_S)
        elif not _request.served:
            raise KeyboardInterrupt

    before = {number: signal.signal(number, request) for number in SIGNALS}
    before[signal.SIGALRM] = signal.signal(signal.SIGALRM, insist)
    over = threading.Event()
    if parent is not None:
        threading.Thread(target=follow, args=(parent, over), daemon=True, name="follow").start()
    try:
        yield
    except KeyboardInterrupt:
        raise Stopped(f"{_request.reason or 'interrupted'}; no motion was running") from None
    else:
        if _request.reason is not None and not _request.served:
            raise Stopped(f"{_request.reason}; no motion was running")
    finally:
        over.set()
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        for number, handler in before.items():
            signal.signal(number, handler)
        _request.reason, _request.ending, _request.served = None, False, False
