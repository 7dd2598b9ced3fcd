"""Measure the lateness of a 1 kHz cycle in a thread and in a process beside a busy policy.

`python benchmarks/watchdog.py` prints the table of benchmarks/results/watchdog.md. The cycle sleeps until its next
millisecond; the delay of its wake-up is its lateness. It does no work, so the cycle of an arm is rather later. The
lateness in a process comes from the machine; in a thread, Python's interpreter lock adds to it.
"""

import multiprocessing
import threading
import time

import numpy as np

SECONDS = 3.0


def cycle(end: float, out) -> None:
    """Wake up every millisecond until `end`; append the lateness, s, to out or send it."""
    due, late = time.perf_counter(), []
    while due < end:
        due = max(due, time.perf_counter() - 1e-3) + 1e-3
        time.sleep(max(0.0, due - time.perf_counter()))
        late.append(time.perf_counter() - due)
    out.append(late) if isinstance(out, list) else out.send(late)


def rest(end: float) -> None:
    """Sleep."""
    time.sleep(max(0.0, end - time.perf_counter()))


def spin(end: float) -> None:
    """Compute in Python, which releases the lock every 5 ms."""
    while time.perf_counter() < end:
        pass


def compiled(end: float) -> None:
    """Compute in C calls of about 0.3 s that hold the lock."""
    size = 2**18
    while time.perf_counter() < end:
        began = time.perf_counter()
        pow(7, size)
        if time.perf_counter() - began < 0.3:
            size *= 2


def main() -> None:
    """Print the table."""
    print("| policy | 1 kHz in | median late, ms | 99 %, ms | most, ms |")
    print("|---|---|---|---|---|")
    for policy in (rest, spin, compiled):
        for where in ("thread", "process"):
            end = time.perf_counter() + SECONDS
            if where == "thread":
                out: list = []
                worker = threading.Thread(target=cycle, args=(end, out))
                worker.start()
                policy(end)
                worker.join()
                late = out[0]
            else:
                mine, its = multiprocessing.get_context("fork").Pipe()
                child = multiprocessing.get_context("fork").Process(target=cycle, args=(end, its))
                child.start()
                policy(end)
                late = mine.recv()
                child.join()
            ms = 1e3 * np.array(late)
            figures = f"{np.median(ms):.2f} | {np.percentile(ms, 99):.1f} | {ms.max():.0f}"
            print(f"| {policy.__name__} | {where} | {figures} |")


if __name__ == "__main__":
    main()
