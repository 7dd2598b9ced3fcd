"""An arm in real time whose policy stalls, raises or is killed."""

import os
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import ROOT, conf
from served_arms import Paced

from r2s.arm.command_loop import REST_S
from r2s.arm.driver import DAMP_S, DEADLINE_S
from r2s.arm.realtime_process import RealtimeRunner, Slot
from r2s.learning.evaluate import fixed_episodes
from r2s.learning.policy import make_policy
from r2s.physics.robot import SIM_DT, load_robot
from r2s.tasks.reach import ReachTask
from r2s.tasks.rollout import rollout

DEADLINE = round(DEADLINE_S / SIM_DT)
TASK = ReachTask(episode_s=0.2)
LEVEL = np.ones(7)  # Nm


def commands(path):
    """Return the rows of a `Paced` arm's file, one array per motion."""
    rows = np.fromfile(path).reshape(-1, 22)
    return np.split(rows, np.flatnonzero(rows[1:, 0] < rows[:-1, 0]) + 1)


class Stalls:
    """A policy that stalls for the given number of the arm's cycles, once per episode."""

    def __init__(self, robot, arms, stalls):
        torch.manual_seed(0)
        self._policy, self._arms, self._stalls = make_policy(robot, TASK, (8,)), arms, iter(stalls)
        self._calls = 0

    def action(self, observation):
        """Return an action, late in the fourth step of an episode."""
        began = self._arms.cycle
        if began == 0:
            self._calls = 0
        self._calls += 1
        if self._calls == 4:
            stall = next(self._stalls)
            while self._arms.cycle < began + stall and not self._arms._latest()[3]:
                time.sleep(1e-4)
        return 0.3 * self._policy.action(observation)


@pytest.fixture(scope="module")
def panda():
    return load_robot(**conf("robot/panda"))


@pytest.mark.long
def test_a_policy_that_stalls(panda, tmp_path):
    """30 ms have no effect; 60 and 500 ms lead to damping after 50 ms, to rest, and to no further command."""
    path, stalls = tmp_path / "commands", (30, 60, 500)
    with RealtimeRunner(partial(Paced, panda, path), panda, TASK, LEVEL) as arms:
        starts, goals = fixed_episodes(panda, TASK, len(stalls))
        episodes = rollout(Stalls(panda, arms, stalls), arms, TASK, starts, goals)
        state = arms._latest()[1]  # of another process
    assert state.tau_ext_hat_filtered.shape == (7,)
    assert (state.m_ee, state.m_load, state.O_T_EE) == (0, 0, None)
    assert [stop.episode for stop in arms.stops] == [1, 2]
    assert all("no finite action for 50 ms" in stop.reason for stop in arms.stops)
    assert np.isfinite(episodes.distance[0]).all()
    assert np.isinf(episodes.distance[1:, -1]).all()
    assert arms.done == 3
    for stop, motion in zip(arms.stops, commands(path)[1:], strict=True):
        assert len(motion) == round(motion[-1, 0] / SIM_DT) + 1  # every cycle, and none after the stop
        assert np.array_equal(stop.log[:, -7:], motion[:, -7:])
        assert len(motion) <= 4 * TASK.substeps + DEADLINE + (DAMP_S / SIM_DT) + 2
        assert np.abs(motion[-1, 8:15]).max() < 0.05  # at rest


@pytest.mark.slow
def test_a_policy_that_raises_leaves_the_arm_at_rest(panda, tmp_path):
    """The caller gets the error, the arm's process ends, and its last commands bring the arm to rest."""

    class Raises(Stalls):
        def action(self, observation):
            if self._arms.cycle > 60:
                raise ZeroDivisionError("a policy's own mistake")
            return super().action(observation)

    path = tmp_path / "commands"
    with pytest.raises(ZeroDivisionError), RealtimeRunner(partial(Paced, panda, path), panda, TASK, LEVEL) as arms:
        rollout(Raises(panda, arms, (0,)), arms, TASK, *fixed_episodes(panda, TASK, 1))
    assert not arms._process.is_alive()
    assert len(commands(path)) == 1
    assert len(commands(path)[0]) < 100 + DEADLINE + (REST_S / SIM_DT)


KILLED = """
import os, signal, sys
from functools import partial
from test_realtime import *

if __name__ == "__main__":
    panda = load_robot(**conf("robot/panda"))
    with RealtimeRunner(partial(Paced, panda, sys.argv[1]), panda, TASK, LEVEL) as arms:
        class Dies(Stalls):
            def action(self, observation):
                if self._arms.cycle >= 80:
                    print(self._arms._process.pid, self._arms.cycle, flush=True)
                    os.kill(os.getpid(), signal.SIGKILL)
                return super().action(observation)
        rollout(Dies(panda, arms, (0,)), arms, TASK, *fixed_episodes(panda, TASK, 1))
"""


@pytest.mark.slow
def test_a_policy_that_is_killed(panda, tmp_path):
    """The arm's process damps the arm within 50 ms of the last command, brings it to rest and ends."""
    script, path = tmp_path / "killed.py", tmp_path / "commands"
    script.write_text(KILLED)
    env = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "tests")])}
    done = subprocess.run(
        [sys.executable, script, path], stdout=subprocess.PIPE, text=True, env=env, timeout=120, check=False
    )
    assert done.returncode == -signal.SIGKILL
    process, cycle = map(int, done.stdout.split())
    for _ in range(600):
        if not Path(f"/proc/{process}").exists():
            break
        time.sleep(0.05)
    assert not Path(f"/proc/{process}").exists()
    (motion,) = commands(path)
    speed = np.abs(motion[:, 8:15]).max(1)
    assert cycle < len(motion) <= cycle + DEADLINE + DAMP_S / SIM_DT + 1
    assert speed[-1] < 0.05 < speed[cycle]


def test_an_incomplete_write_is_not_read():
    """A process killed during a write does not block the reader."""
    slot = Slot(3)
    slot.write(np.arange(3.0))
    count, values = slot.read()
    assert count == 1
    assert values.tolist() == [0, 1, 2]
    np.frombuffer(slot._raw)[0] += 1
    assert slot.read() is None
