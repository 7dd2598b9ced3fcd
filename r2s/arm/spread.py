"""Episodes on a twin, spread over cores: chunks of goals, each on a twin of its own made from the same seed.

The chunks are the same whatever the number of cores, so the results are too. Each chunk's sensors have a stream of
noise of their own, and a twin that warms up is cold when a chunk begins.
"""

import multiprocessing
import signal
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import fields, replace
from typing import Any

import numpy as np

from r2s.arm.deploy import DrivenArm, Stop, Timing
from r2s.tasks.episode import Acts, rollout
from r2s.tasks.task import Episodes, Task

CHUNK = 25  # goals


def spread(
    opened: Callable[[int], AbstractContextManager[DrivenArm]],
    policy: Acts,
    task: Task,
    starts: np.ndarray,
    goals: np.ndarray,
    workers: int,
    progress: Callable[[int, int], None],
) -> tuple[Episodes, list[Stop], Timing]:
    """Return the episodes, why some ended early, and how long things took.

    Processes are forked, where the system can (else there is one): call this before threads are at work.

    Args:
        opened: gives the twin of a chunk, by its number.
        policy, task: what reaches, and what is asked.
        starts, goals: (E, n) rad, (E, ...).
        workers: processes at most.
        progress: called with goals done, and in all.
    """
    chunks = range(-(-len(goals) // CHUNK))
    done: dict[int, tuple[Episodes, list[Stop], Timing]] = {}
    job = opened, policy, task, starts, goals

    def take(chunk: int, result: tuple[Episodes, list[Stop], Timing]) -> None:
        done[chunk] = result
        progress(sum(len(episodes.goal) for episodes, _, _ in done.values()), len(goals))

    if min(workers, len(chunks)) < 2 or not sys.platform.startswith("linux"):
        for chunk in chunks:
            take(chunk, _reach(job, chunk))
    else:
        with multiprocessing.get_context("fork").Pool(min(workers, len(chunks)), _begin, (job,)) as pool:
            for chunk, result in pool.imap_unordered(_work, chunks):
                take(chunk, result)
    parts = [done[chunk] for chunk in chunks]
    each = [episodes for episodes, _, _ in parts]
    names = [f.name for f in fields(Episodes) if f.name != "t"]
    together = {name: np.concatenate([getattr(episodes, name) for episodes in each]) for name in names}
    timing = Timing()
    for _, _, took in parts:
        for field in fields(Timing):
            getattr(timing, field.name).extend(getattr(took, field.name))
    return replace(each[0], **together), [stop for _, stops, _ in parts for stop in stops], timing


_job: Any = None  # of a forked process


def _begin(job: Any) -> None:
    import torch

    global _job
    _job = job
    torch.set_num_threads(1)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the one that waits


def _work(chunk: int) -> tuple[int, tuple[Episodes, list[Stop], Timing]]:
    return chunk, _reach(_job, chunk)


def _reach(job: Any, chunk: int) -> tuple[Episodes, list[Stop], Timing]:
    opened, policy, task, starts, goals = job
    first, now = chunk * CHUNK, slice(chunk * CHUNK, (chunk + 1) * CHUNK)
    with opened(chunk) as driven:
        episodes = rollout(policy, driven, task, starts[now], goals[now])
        return episodes, [replace(stop, episode=first + stop.episode) for stop in driven.stops], driven.timing
