"""Run episodes on a twin in parallel: each chunk of goals runs on a new twin with the same seed.

On any computer, every chunk except the last has CHUNK goals, so the results do not depend on the number of cores.
Each chunk has its own stream of sensor noise. A twin with temperature-dependent friction is cold at the start of a
chunk.
"""

import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import AbstractContextManager
from dataclasses import fields, replace
from typing import Any

import numpy as np

from r2s.arm.policy_runner import PolicyRunner, Stop
from r2s.arm.realtime import Timing
from r2s.arm.stop_request import follow
from r2s.errors import UserError
from r2s.tasks.rollout import PolicyLike, rollout
from r2s.tasks.task import Episodes, Task

Progress = Callable[[int, int], None]
Result = tuple[Episodes, list[Stop], Timing]
CHUNK = 25  # goals
REPORT_S = 1.0  # s, longest time between two calls of `progress`


def run_parallel_episodes(
    open_twin: Callable[[int], AbstractContextManager[PolicyRunner]],
    policy: PolicyLike,
    task: Task,
    starts: np.ndarray,
    goals: np.ndarray,
    workers: int,
    progress: Progress,
) -> tuple[Episodes, list[Stop], Timing]:
    """Return the episodes, their early stops, and the measured durations.

    On Linux, this function forks, so call the function before any thread starts. On other systems, one process runs
    all chunks.

    Args:
        open_twin: function that opens the twin for a chunk; the function's argument is the number of the chunk.
        policy, task: see `rollout`.
        starts: (E, n) rad, first postures of the episodes. goals: (E, ...), see `Task`.
        workers: largest number of processes.
        progress: called with (goals done, total) after every goal; with several processes, at least once per
            REPORT_S.

    Raises:
        UserError: a process was killed.
    """
    chunks = range(-(-len(goals) // CHUNK))
    done: dict[int, Result] = {}
    job = open_twin, policy, task, starts, goals

    def after(earlier: int) -> Progress:
        return lambda k, _: progress(earlier + k, len(goals))

    if min(workers, len(chunks)) < 2 or not sys.platform.startswith("linux"):
        for chunk in chunks:
            done[chunk] = _run_chunk(job, chunk, after(chunk * CHUNK))
    else:
        context = multiprocessing.get_context("fork")
        finished = context.Value("l", 0)  # number of goals finished by all processes together
        given = job, finished, os.getpid()
        with ProcessPoolExecutor(min(workers, len(chunks)), context, _initialize, given) as pool:
            waiting = {pool.submit(_run_as_process, chunk): chunk for chunk in chunks}
            try:
                while waiting:
                    for ended in wait(waiting, REPORT_S, FIRST_COMPLETED).done:
                        done[waiting.pop(ended)] = ended.result()
                    progress(finished.value, len(goals))
            except BrokenProcessPool:
                raise UserError(
                    "a process that ran episodes was killed, as for lack of memory; threads=1 runs all in one process"
                ) from None
            except BaseException:  # on Ctrl-C, do not wait for running episodes
                for process in multiprocessing.active_children():
                    process.terminate()
                raise
    parts = [done[chunk] for chunk in chunks]
    each = [episodes for episodes, _, _ in parts]
    names = [f.name for f in fields(Episodes) if f.name != "t" and getattr(each[0], f.name) is not None]
    together = {name: np.concatenate([getattr(episodes, name) for episodes in each]) for name in names}
    timing = Timing()
    for _, _, durations in parts:
        for field in fields(Timing):
            getattr(timing, field.name).extend(getattr(durations, field.name))
    return replace(each[0], **together), [stop for _, stops, _ in parts for stop in stops], timing


_job: Any = None  # arguments that a forked process received from `_initialize`
_finished: Any = None  # shared number of finished goals


def _initialize(job: Any, finished: Any, parent: int) -> None:
    global _job, _finished
    signal.signal(signal.SIGTERM, signal.SIG_DFL)  # not a handler inherited from the parent process
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C goes to the parent process
    import torch

    _job, _finished = job, finished
    torch.set_num_threads(1)
    # a thread watches the parent: a killed parent cannot end this process, and the pool's queue reports no end
    threading.Thread(target=follow, args=(parent, threading.Event()), daemon=True, name="follow").start()


def _run_as_process(chunk: int) -> Result:
    counted = 0

    def count(k: int, total: int) -> None:
        nonlocal counted
        with _finished.get_lock():
            _finished.value += k - counted
        counted = k

    return _run_chunk(_job, chunk, count)


def _run_chunk(job: Any, chunk: int, progress: Progress) -> Result:
    open_twin, policy, task, starts, goals = job
    first, now = chunk * CHUNK, slice(chunk * CHUNK, (chunk + 1) * CHUNK)
    with open_twin(chunk) as runner:
        episodes = rollout(policy, runner, task, starts[now], goals[now], progress)
        return episodes, [replace(stop, episode=first + stop.episode) for stop in runner.stops], runner.timing
