"""A line that says how far, how fast and how long still."""

import sys
import time


class Progress:
    """A line that says how far, how fast, how long still; rewritten on a terminal, now and then elsewhere."""

    def __init__(self, label: str, every_s: float = 10.0):
        self._label, self._began, self._shown = label, time.perf_counter(), 0.0
        self._live = sys.stderr.isatty()
        self._every = 0.2 if self._live else every_s
        self._width = 0

    def __call__(self, share: float, text: str = "") -> None:
        """Show that `share` of the work is done, with a rate or result in `text`."""
        now = time.perf_counter()
        if now - self._shown < self._every:
            return
        self._shown = now
        elapsed = now - self._began
        left = f"{clock(elapsed * (1 - share) / share)} left" if share > 0.01 else ""
        line = f"{self._label} {100 * min(share, 1.0):3.0f} %  {clock(elapsed)}  {left}  {text}".rstrip()
        if self._live:
            self._width = max(self._width, len(line))
            print("\r" + line.ljust(self._width)[:180], end="", file=sys.stderr, flush=True)
        else:
            print(line, file=sys.stderr, flush=True)

    def close(self, text: str = "") -> None:
        """End the line with what came of it."""
        line = f"{self._label} done in {clock(time.perf_counter() - self._began)}  {text}".rstrip()
        print(("\r" + line.ljust(self._width)) if self._live else line, file=sys.stderr, flush=True)


def clock(seconds: float) -> str:
    """Return m:ss."""
    return f"{int(seconds) // 60}:{int(seconds) % 60:02d}"
