"""Run each tracker in a separate thread, so that no tracker can delay or end a run.

If a tracker fails, r2s prints one warning and does not call the tracker again.
"""

import math
import sys
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path
from queue import Full, Queue
from threading import Thread
from typing import Any

from r2s.reporting.trackers.tracker import Tracked, Tracker, flat

MOST_WAITING = 10_000  # largest number of rows that wait for a slow tracker, some megabytes in all
LAST_S = 60.0  # s, longest wait for each tracker at the end of a run
FILES = ("recording.rrd", "report.html", "report.md", "parameters.yaml", "policy.onnx", "measures.json")


class AsyncTracker:
    """A tracker with its own thread, which executes the calls queued by `send`."""

    def __init__(self, name: str, tracker: Tracker):
        self._name, self._tracker, self._works = name, tracker, True
        self._queue: Queue[Callable[[Tracker], None] | None] = Queue(MOST_WAITING)
        self._thread = Thread(target=self._work, name=f"tracker {name}", daemon=True)
        self._thread.start()

    def send(self, call: Callable[[Tracker], None] | None) -> None:
        """Queue a call, which the thread executes; None ends the thread."""
        try:
            self._queue.put_nowait(call)
        except Full:
            self._give_up(f"{MOST_WAITING} rows are waiting")

    def join(self, seconds: float) -> None:
        """Wait at most `seconds` s for the queued calls; if calls remain, warn and drop them."""
        self._thread.join(seconds)
        if self._thread.is_alive():
            self._give_up(f"not finished {seconds:.0f} s after the run")

    def _work(self) -> None:
        while (call := self._queue.get()) is not None:
            if not self._works:
                continue
            try:
                call(self._tracker)
            except (Exception, SystemExit) as error:  # a network library may raise any exception
                self._give_up(f"{type(error).__name__}: {' '.join(str(error).split())[:200]}")

    def _give_up(self, why: str) -> None:
        if self._works:
            self._works = False
            print(f"warning: tracker={self._name}: {why}; the run continues without it", file=sys.stderr, flush=True)


class Trackers:
    """All trackers of a run, with the methods that r2s/runs.py calls."""

    def __init__(self, trackers: Mapping[str, Tracker], run: Tracked):
        self._run, self._rows = run, Counter[str]()
        self._trackers = [AsyncTracker(name, tracker) for name, tracker in trackers.items()]
        self._send(lambda tracker: tracker.start(run))

    def _send(self, call: Callable[[Tracker], None]) -> None:
        for one in self._trackers:
            one.send(call)

    def log(self, table: str, row: Mapping[str, Any]) -> None:
        """Send a row of a table to all trackers."""
        step = int(row.get("env_steps", self._rows[table]))
        self._rows[table] += 1
        numbers = {k: v for k, v in finite(row).items() if k != "env_steps"}
        self._send(lambda tracker: tracker.log(table, numbers, step))

    def summary(self, document: Mapping[str, Any]) -> None:
        """Send the finite numbers in summary.json to all trackers."""
        numbers = finite(dict(flat(document, between="/")))
        self._send(lambda tracker: tracker.summary(numbers))

    def finish(self, status: str) -> None:
        """Send figures and files, and wait at most `LAST_S` for each tracker."""
        pictures = sorted((self._run.folder / "figures").glob("*.png"))
        files = [path for name in FILES if (path := Path(self._run.folder / name)).is_file()]
        self._send(lambda tracker: tracker.finish(status, pictures, files))
        for one in self._trackers:
            one.send(None)
        for one in self._trackers:
            one.join(LAST_S)


def finite(row: Mapping[str, Any]) -> dict[str, float]:
    """Return the finite numbers of a row."""
    numbers = {k: float(v) for k, v in row.items() if not isinstance(v, str) and hasattr(v, "__float__")}
    return {k: v for k, v in numbers.items() if math.isfinite(v)}
