"""Handle requests to end every motion of this process: signals, or the end of the process that sends commands.

`CommandLoop` calls `requested` in every cycle. On a request the driver brings the arm to rest, and the motion ends
with `StopRequested`. No new motion begins after a request. A process has one request, as it has one set of signals.
"""

import os
import signal
import stat
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

from r2s.errors import Stopped

# a closed terminal, Ctrl-C, Ctrl-\, kill and systemd, Ctrl-Z; SIGKILL and SIGSTOP cannot be handled
SIGNALS = (signal.SIGHUP, signal.SIGINT, signal.SIGQUIT, signal.SIGTERM, signal.SIGTSTP)
PARENT = "R2S_PARENT"  # environment variable: pid of the parent, at whose end every motion of this process ends
FOLLOW_S = 0.1  # s between two checks that the parent still runs
GRACE_S = 2.0  # s for a motion to end (driver and `rest` need at most 0.5 s each) before a KeyboardInterrupt


class _Request:
    """The first stop request of this process: reason, whether a motion is ending for it, whether none runs now."""

    def __init__(self) -> None:
        self.sources: list[Callable[[], str | None]] = []
        self.reason: str | None = None
        self.ending = self.served = False


_request = _Request()


def requested() -> str | None:
    """Return the reason why every motion must end, or None; later reasons do not replace the first one."""
    if _request.reason is None:
        for source in _request.sources:
            if (reason := source()) is not None:
                _request.reason = reason
                break
    return _request.reason


def begin_ending() -> None:
    """Note that a motion is now ending because of the request."""
    _request.ending = True


def serve() -> None:
    """Note that no motion runs any more after the request; a further signal then raises KeyboardInterrupt at once."""
    _request.ending, _request.served = False, True


@contextmanager
def watched(source: Callable[[], str | None]) -> Iterator[None]:
    """Let `requested` also call `source` in this context; `source` returns a reason or None, within microseconds."""
    _request.sources.append(source)
    try:
        yield
    finally:
        _request.sources.remove(source)


def parent_ended(parent: int) -> Callable[[], str | None]:
    """Return a source for `watched` that reports the end of the process `parent`, which sends the commands."""
    return lambda: None if os.getppid() == parent else "the process of the policy has ended"


def pipeline() -> int | None:
    """Return the pid in PARENT, or None. In a grandchild, which inherits PARENT, it is not the pid of its parent."""
    return int(os.environ[PARENT]) if PARENT in os.environ else None


def _follow(parent: int, over: threading.Event) -> None:
    """Send SIGTERM to this process if its parent ends before `over` is set."""
    while not over.wait(FOLLOW_S):
        if os.getppid() != parent:
            os.kill(os.getpid(), signal.SIGTERM)
            return


def _leave_terminal() -> None:
    """Discard output to the terminal, which SIGHUP has closed: writing to it would end the run with an error."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for stream in (1, 2):
        if stat.S_ISCHR(os.fstat(stream).st_mode):
            os.dup2(nowhere, stream)
    os.close(nowhere)


@contextmanager
def handled_signals(
    forward: Callable[[int], None] = lambda number: None, parent: int | None = None
) -> Iterator[None]:
    """Convert SIGNALS to a stop request while an arm is open in this process.

    If no motion has responded to the request after GRACE_S, the main thread gets a KeyboardInterrupt; this context
    then raises `Stopped` with the name of the signal. It also raises `Stopped` if no motion has responded when the
    block ends: later code may move the arm. Outside the main thread it does nothing, as Python allows no handlers.

    Args:
        forward: called by the signal handler with the number of each signal.
        parent: pid of the parent process, whose end acts as a SIGTERM; None: no process is watched.

    Raises:
        Stopped: a signal came while no motion ran.
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
        threading.Thread(target=_follow, args=(parent, over), daemon=True, name="follow").start()
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
