"""Nothing compiles, loads or imports in a cycle: `warm_up` runs it before the arm opens, and changes no result."""

import gc
import os
import pickle
import random
import subprocess
import sys
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from conftest import ROOT
from numba.core import event
from numba.core.dispatcher import Dispatcher
from served_arms import Paced
from test_adapters import MAKES, PANDA, PAYLOAD, context, swing, truth

from r2s.arm.clients.fr3 import FR3
from r2s.arm.clients.panda import Panda
from r2s.arm.emulator.process import Emulator
from r2s.arm.policy_runner import PolicyRunner
from r2s.arm.ramp import ramp
from r2s.arm.realtime_process import RealtimeRunner
from r2s.arm.recorder import record
from r2s.arm.twins.rigid_twin import RigidTwin
from r2s.arm.warm_up import warm_up
from r2s.excitation.minimum_jerk import minimum_jerk
from r2s.excitation.motion import Excitation
from r2s.physics.robot import SIM_DT
from r2s.tasks.reach import ReachTask

TASK = ReachTask(episode_s=0.2)
RAMPS = {"largest": 0.5, "rate": 50.0}
CLIENTS = {"panda": (Panda, 5), "fr3": (FR3, 10)}


class Loads(event.Listener):
    """Counts what numba compiled or read from its cache, and what was imported, since it was made."""

    def __init__(self):
        self.compiled = 0
        event.register("numba:compile", self)
        self._before = self.now()

    def on_start(self, _):  # noqa: D102
        self.compiled += 1

    def on_end(self, _):  # noqa: D102
        pass

    @staticmethod
    def now():
        """Return functions with the signatures that are loaded, and modules."""
        functions = {(d.py_func.__qualname__, str(s)) for d in gc.get_objects() if isinstance(d, Dispatcher)
                     for s in d.signatures}  # fmt: skip
        return functions | set(sys.modules)

    @property
    def found(self):
        """What is new."""
        return self.now() - self._before


def moves(client, warm):
    """Return what was loaded while a real client recorded, ramped and ran episodes with each adapter."""
    make, version = CLIENTS[client]
    t = SIM_DT * np.arange(501)
    motion = Excitation(t, *minimum_jerk(PANDA.q_home, PANDA.q_home + 0.05, t[-1], t[:, None]))
    adapters = [None, *(make(context()) for make in MAKES)]
    with Emulator(partial(RigidTwin, PANDA, 3), version=version) as address:
        arm = make(PANDA, address, operator=lambda reason: True)
        if warm:
            for adapter in adapters:
                warm_up(PANDA, TASK, adapter)
        loads = Loads()
        record(arm, motion)
        ramp(arm, PANDA.q_home[None], **RAMPS)
        for adapter in adapters:
            runner = PolicyRunner(arm, TASK, truth().level, adapter=adapter)
            runner.place(PANDA.q_home[None], 0)
            runner.step(np.ones((1, 7)))
            runner.run([None] * 300)
            runner.end()
            assert runner.stops
        arm.close()
    return loads


def jumps(warm):
    """Return what was loaded while an adapter detected a payload."""
    swing(None, payload=PAYLOAD, seconds=0.1)  # of the simulated arm
    adapter = MAKES[1](context())
    if warm:
        warm_up(PANDA, TASK, adapter)
    loads = Loads()
    swing(adapter, payload=replace(PAYLOAD, on_s=0.7), seconds=1.2, rate=3.0)
    assert adapter.estimator.changes
    return loads


SCRIPT = """
import sys
from test_warm_up import *

if __name__ == "__main__":
    what, warm = sys.argv[1], sys.argv[2] == "warm"
    loads = jumps(warm) if what == "jump" else moves(what, warm)
    print(loads.compiled, sorted(map(str, loads.found)))
"""


def run(tmp_path, what, how, **env):
    """Return what a fresh process printed."""
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    env = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "tests")])} | env
    done = subprocess.run([sys.executable, script, what, how], capture_output=True, text=True, env=env, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()[-1]


@pytest.mark.long
@pytest.mark.parametrize("what", [*(pytest.param(x, marks=pytest.mark.slow) for x in ("panda", "fr3")), "jump"])
def test_a_cycle_loads_nothing(what, tmp_path):
    """In a fresh process, recordings, ramps, approaches, episodes and jumps."""
    assert run(tmp_path, what, "warm") == "0 []"


@pytest.mark.slow
def test_without_warm_up_a_cycle_loads(tmp_path):
    assert "update" in run(tmp_path, "jump", "cold")


@pytest.mark.slow  # compiles everything
@pytest.mark.parametrize("what", ["panda", "fr3", "jump"])
def test_a_cycle_compiles_nothing(what, tmp_path):
    """With an empty cache of compiled functions."""
    assert run(tmp_path, what, "warm", NUMBA_CACHE_DIR=str(tmp_path / "cache")) == "0 []"


@pytest.mark.long
@pytest.mark.parametrize("make", MAKES)
def test_warm_up_changes_no_bit(make):
    """Neither of an adapter, of its motions, nor of a random generator."""
    adapter = make(context())
    before, numbers = pickle.dumps(adapter), (random.getstate(), np.random.get_state()[1].copy())
    warm_up(PANDA, TASK, adapter)
    assert pickle.dumps(adapter) == before
    assert random.getstate() == numbers[0]
    assert np.array_equal(np.random.get_state()[1], numbers[1])
    for one, other in zip(*(swing(a, payload=PAYLOAD, seconds=0.3) for a in (adapter, make(context()))), strict=True):
        assert np.array_equal(one, other)


class Watched(Paced):
    """An arm that writes what its process loads after it is open."""

    def __init__(self, robot, path):
        super().__init__(robot, path.with_suffix(".commands"))
        self.path = path
        super().command(np.zeros(7))  # compiles the simulated arm
        self.loads = Loads()

    def stop(self):
        """Write."""
        self.path.write_text(str(sorted(map(str, self.loads.found))))
        super().stop()


@pytest.mark.long
def test_the_process_of_an_arm_loads_everything_before_it_opens_the_arm(tmp_path):
    """With an adapter, for twelve control periods."""
    path = tmp_path / "loads"
    task = ReachTask(episode_s=0.24)
    with RealtimeRunner(
        partial(Watched, PANDA, path), PANDA, task, truth().level, adapter=MAKES[1](context())
    ) as arms:
        arms.place(PANDA.q_home[None], 0)
        for _ in range(task.steps):
            arms.step(np.zeros((1, 7)))
        arms.end()
    assert path.read_text() == "[]"
