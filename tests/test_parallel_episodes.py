"""Episodes on copies of a twin in parallel processes."""

import multiprocessing
import os
import signal
import sys
import time
from contextlib import contextmanager

import numpy as np
import psutil
import pytest
import torch
from conftest import conf

from r2s.arm import parallel_episodes
from r2s.arm.policy_runner import PolicyRunner
from r2s.arm.twins.rigid_twin import RigidTwin
from r2s.errors import UserError
from r2s.learning.evaluate import fixed_episodes
from r2s.learning.policy import make_policy
from r2s.physics.dynamics import nominal_dynamics
from r2s.tasks.reach import ReachTask

GOALS = 5


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="several processes only on Linux")
def test_two_processes_do_what_one_does_and_report_every_goal(panda, monkeypatch):
    """One process reports each goal; two report a count that never falls and ends at all goals."""
    monkeypatch.setattr(parallel_episodes, "CHUNK", 2)
    monkeypatch.setattr(parallel_episodes, "REPORT_S", 0.01)
    torch.manual_seed(0)
    task = ReachTask(episode_s=0.2)
    policy, friction = make_policy(panda, task, (8,)), nominal_dynamics(panda, **conf("friction/paper")).level
    starts, goals = fixed_episodes(panda, task, GOALS)

    @contextmanager
    def open_twin(chunk):
        yield PolicyRunner(RigidTwin(panda, 0, noise=chunk), task, friction)

    done, reports = {}, {1: [], 2: []}
    for workers, calls in reports.items():
        parts = (
            open_twin,
            policy,
            task,
            starts,
            goals,
            workers,
            lambda k, total, calls=calls: calls.append((k, total)),
        )
        done[workers], stops, timing = parallel_episodes.run_parallel_episodes(*parts)
        assert not stops
        assert timing.table()
    assert reports[1] == [(k, GOALS) for k in range(1, GOALS + 1)]
    counts = [k for k, _ in reports[2]]
    assert counts == sorted(counts)
    assert counts[-1] == GOALS
    np.testing.assert_array_equal(done[1].q, done[2].q)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="several processes only on Linux")
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_no_process_outlives_a_parent_that_is_killed(panda, monkeypatch, number, tmp_path):
    """Two processes run episodes of a minute; both end within a second of the process that started them."""
    monkeypatch.setattr(parallel_episodes, "CHUNK", 1)
    task = ReachTask(episode_s=0.2)
    starts, goals = fixed_episodes(panda, task, 2)

    @contextmanager
    def open_twin(chunk):
        (tmp_path / str(os.getpid())).touch()
        time.sleep(60)
        yield

    job = open_twin, None, task, starts, goals, 2, lambda k, total: None
    parent = multiprocessing.get_context("fork").Process(target=parallel_episodes.run_parallel_episodes, args=job)
    parent.start()
    while len(workers := list(tmp_path.iterdir())) < 2:
        time.sleep(0.01)
    processes = [psutil.Process(int(worker.name)) for worker in workers]
    os.kill(parent.pid, number)
    parent.join()
    left = psutil.wait_procs(processes, 1.0)[1]
    for process in left:
        process.kill()
    assert not [process for process in left if process.status() != psutil.STATUS_ZOMBIE]


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="several processes only on Linux")
@pytest.mark.parametrize(
    ("end", "error", "words"),
    [
        (lambda: os.kill(os.getpid(), signal.SIGKILL), UserError, "a process that ran episodes was killed"),
        (lambda: np.zeros(2)[3], IndexError, "out of bounds"),
    ],
    ids=["killed", "raised"],
)
def test_a_process_that_ends_early_ends_the_run(panda, monkeypatch, end, error, words):
    """Out of memory, a process is killed: one line, and no wait for episodes that do not come."""
    monkeypatch.setattr(parallel_episodes, "CHUNK", 1)
    task = ReachTask(episode_s=0.2)
    starts, goals = fixed_episodes(panda, task, 2)

    @contextmanager
    def open_twin(chunk):
        end()
        yield

    with pytest.raises(error, match=words):
        parallel_episodes.run_parallel_episodes(open_twin, None, task, starts, goals, 2, lambda k, total: None)
