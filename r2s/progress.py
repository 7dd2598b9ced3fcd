"""Show the progress of long computations: completed fraction, elapsed time and remaining time."""

import atexit
import time
from queue import SimpleQueue
from threading import Thread

from rich.console import Console
from rich.progress import BarColumn, TaskProgressColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.progress import Progress as Bar
from rich.table import Column


class Progress:
    """Show a progress bar on a terminal; without a terminal, print a line every `every_s` seconds.

    in_cycle: whether a control cycle calls this object; a thread then prints, so that no cycle waits for output.
    """

    def __init__(self, label: str, every_s: float = 10.0, in_cycle: bool = False):
        self._label, self._every, self._began, self._shown = label, every_s, time.perf_counter(), 0.0
        # time and share at the first call of the current part (in a resumed run, share > 0); share at the last call
        self._part, self._first, self._share = self._began, -1.0, 0.0
        self._console = Console(stderr=True, highlight=False, markup=False, soft_wrap=True)
        self._bar: Bar | None = None
        if self._console.is_terminal:
            columns = (
                TextColumn("{task.description}", markup=False),
                BarColumn(20),
                TaskProgressColumn(),
                TimeElapsedColumn(),
                TimeRemainingColumn(compact=True),
                TextColumn("left"),
                TextColumn("{task.fields[text]}", markup=False, table_column=Column(no_wrap=True, ratio=1)),
            )
            # Without automatic refresh the bar does not overwrite a prompt to the operator.
            options = {"auto_refresh": False, "redirect_stdout": False, "transient": True}
            self._bar = Bar(*columns, console=self._console, expand=True, **options)  # type: ignore[arg-type]
            self._task = self._bar.add_task(label, total=1.0, text="")
            self._bar.start()
            atexit.register(self._bar.stop)  # restores the cursor after an exception
        self._calls: SimpleQueue[tuple[float, str] | None] | None = SimpleQueue() if in_cycle else None
        if in_cycle:
            self._writer = Thread(target=self._write, daemon=True)
            self._writer.start()

    def __call__(self, share: float, text: str = "") -> None:
        """Show that the fraction `share` (0 to 1) of the work is done, and show `text`."""
        if self._calls is None:
            self._show(share, text)
        else:
            self._calls.put((share, text))

    def _write(self) -> None:
        assert self._calls is not None
        while (call := self._calls.get()) is not None:
            self._show(*call)

    def _show(self, share: float, text: str) -> None:
        now = time.perf_counter()
        if share < 0.5 * self._share or share < 1.0 <= self._share:  # the next part begins, such as another search
            self._first = -1.0
            if self._bar:  # rich treats a full bar as finished and hides its time
                began = self._bar.tasks[0].start_time
                self._bar.reset(self._task)
                self._bar.tasks[0].start_time = began
        if self._first < 0.0:
            self._part, self._first = now, share
        self._share = share
        if now - self._shown < (0.2 if self._bar else self._every):
            return
        self._shown = now
        if self._bar:
            self._bar.update(self._task, completed=share, text=text, refresh=True)
        else:
            done = share - self._first
            left = f"{clock((now - self._part) * (1 - share) / done)} left" if done > 0.01 else ""
            self._print(f"{self._label} {100 * min(share, 1.0):3.0f} %  {clock(now - self._began)}  {left}  {text}")

    def close(self, text: str = "") -> None:
        """Close the progress bar, and print the elapsed time and the result `text`."""
        if self._calls is not None:
            self._calls.put(None)
            self._writer.join()
        if self._bar:
            self._bar.stop()
            atexit.unregister(self._bar.stop)
        self._print(f"{self._label} done in {clock(time.perf_counter() - self._began)}  {text}")

    def _print(self, line: str) -> None:
        self._console.print(line.rstrip())


def clock(seconds: float) -> str:
    """Return a duration as text in minutes and seconds, m:ss."""
    return f"{int(seconds) // 60}:{int(seconds) % 60:02d}"
