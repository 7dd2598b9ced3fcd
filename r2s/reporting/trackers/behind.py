"""Trackers behind a run: each on a thread of its own, so that none can hold a run up or end it.

A tracker that fails says so once, and is silent from then on.
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

WAITING = 10_000  # rows that may wait for a slow tracker
LAST_S = 60.0  # at the end of a run, for what still waits
FILES = ("recording.rrd", "report.html", "report.md", "parameters.yaml", "policy.onnx")


class Behind:
    """One tracker on its thread: `send` returns at once."""

    def __init__(self, name: str, tracker: Tracker):
        self._name, self._tracker, self._well = name, tracker, True
        self._queue: Queue[Callable[[Tracker], None] | None] = Queue(WAITING)
        self._thread = Thread(target=self._work, name=f"tracker {name}", daemon=True)
        self._thread.start()

    def send(self, call: Callable[[Tracker], None] | None) -> None:
        """Let the thread call it with the tracker; None ends the thread."""
        try:
            self._queue.put_nowait(call)
        except Full:
            self._give_up(f"{WAITING} rows wait for it")

    def join(self, seconds: float) -> None:
        """Wait for what was sent."""
        self._thread.join(seconds)
        if self._thread.is_alive():
            self._give_up(f"it is not done {seconds:.0f} s after the run")

    def _work(self) -> None:
        while (call := self._queue.get()) is not None:
            if not self._well:
                continue
            try:
                call(self._tracker)
            except (Exception, SystemExit) as error:  # of a library that talks to the outside: anything
                self._give_up(f"{type(error).__name__}: {' '.join(str(error).split())[:200]}")

    def _give_up(self, why: str) -> None:
        if self._well:
            self._well = False
            print(f"warning: tracker={self._name}: {why}; the run goes on without it", file=sys.stderr, flush=True)


class Trackers:
    """All trackers of a run, as r2s/runs.py calls them."""

    def __init__(self, trackers: Mapping[str, Tracker], run: Tracked):
        self._run, self._rows = run, Counter[str]()
        self._behind = [Behind(name, tracker) for name, tracker in trackers.items()]
        self._send(lambda tracker: tracker.start(run))

    def _send(self, call: Callable[[Tracker], None]) -> None:
        for one in self._behind:
            one.send(call)

    def log(self, table: str, row: Mapping[str, Any]) -> None:
        """Send a row of a table."""
        step = int(row.get("env_steps", self._rows[table]))
        self._rows[table] += 1
        numbers = {k: v for k, v in finite(row).items() if k != "env_steps"}
        self._send(lambda tracker: tracker.log(table, numbers, step))

    def summary(self, document: Mapping[str, Any]) -> None:
        """Send the numbers of summary.json."""
        numbers = finite(dict(flat(document, between="/")))
        self._send(lambda tracker: tracker.summary(numbers))

    def finish(self, status: str) -> None:
        """Send figures and files, and wait a minute at most."""
        pictures = sorted((self._run.folder / "figures").glob("*.png"))
        files = [path for name in FILES if (path := Path(self._run.folder / name)).is_file()]
        self._send(lambda tracker: tracker.finish(status, pictures, files))
        for one in self._behind:
            one.send(None)
        for one in self._behind:
            one.join(LAST_S)


def finite(row: Mapping[str, Any]) -> dict[str, float]:
    """Return the finite numbers of a row; words and gaps are left out."""
    numbers = {k: float(v) for k, v in row.items() if not isinstance(v, str) and hasattr(v, "__float__")}
    return {k: v for k, v in numbers.items() if math.isfinite(v)}
