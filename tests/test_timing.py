"""Real time is asked for where a motion computes, restored afterwards, and measured: lost cycles and success rate."""

import gc
import io
import os
import resource
import subprocess
import sys
import threading
from functools import partial

import numpy as np
import pytest
from conftest import ROOT, conf
from served_arms import Bare

from r2s.arm.clients.fr3 import FR3
from r2s.arm.clients.panda import Panda
from r2s.arm.emulator.control import Fault
from r2s.arm.emulator.process import Emulator
from r2s.arm.interface import ArmStopped
from r2s.arm.policy_runner import PolicyRunner
from r2s.arm.ramp import ramp
from r2s.arm.realtime import LEAST_SUCCESS, PRIORITY, Timing, realtime_section
from r2s.arm.recorder import record
from r2s.arm.simulated import SimulatedArm
from r2s.arm.twins.rigid_twin import RigidTwin
from r2s.excitation.minimum_jerk import minimum_jerk
from r2s.excitation.motion import Excitation
from r2s.physics.dynamics import nominal_dynamics
from r2s.physics.robot import SIM_DT, load_robot
from r2s.progress import Progress
from r2s.tasks.reach import ReachTask

PANDA = load_robot(**conf("robot/panda"))
TASK = ReachTask(episode_s=1.0)
ROWS = 1000
CLIENTS = {"panda": (Panda, 5), "fr3": (FR3, 10)}


def motion(distance=0.02):
    """Return a slow motion from home."""
    t = SIM_DT * np.arange(ROWS + 1)
    return Excitation(t, *minimum_jerk(PANDA.q_home, PANDA.q_home + distance, t[-1], t[:, None]))


def opened(name, *faults, served=Bare):
    """Return an emulator of a client's arm in lock-step, and what connects to its address."""
    make, version = CLIENTS[name]
    emulator = Emulator(partial(served, PANDA), version=version, faults=faults)
    return emulator, lambda address: make(PANDA, address, operator=lambda reason: False)


def computer():
    """Return what a realtime section changes."""
    scheduler = os.sched_getscheduler(0), os.sched_getparam(0).sched_priority
    return gc.isenabled(), sys.getswitchinterval(), scheduler


OFTEN = ["panda", pytest.param("fr3", marks=pytest.mark.slow)]


@pytest.mark.long
@pytest.mark.parametrize("client", OFTEN)
@pytest.mark.parametrize(("kind", "cycles"), [("drop", 7), ("late", 11)])
def test_lost_cycles_are_counted(client, kind, cycles):
    """Dropped states by the robot's clock, late commands by the success rate: a late one counts in 100 states."""
    emulator, connect = opened(client, Fault(kind, 300, cycles=cycles))
    timing = Timing()
    with emulator as address:
        arm = connect(address)
        record(arm, motion(), timing=timing)
        arm.close()
    row = timing.table()[-1]
    assert row["what"] == "robot"
    assert row["lost"] == (cycles if kind == "drop" else 0)
    assert row["max_ms"] == pytest.approx(1 + row["lost"])
    assert row["median_ms"] == pytest.approx(1)
    if kind == "late":
        assert np.sum(1 - np.array(timing.success)) == pytest.approx(cycles, abs=1e-3)  # the FR3 sends float32


@pytest.mark.long
@pytest.mark.parametrize("client", OFTEN)
def test_a_motion_with_too_few_commands_does_not_count(client):
    """In real time a recording and an episode are refused in one line with the value; in lock-step they count."""
    late = 15
    rate = 1 - late / (ROWS + 1 - 100)  # a motion's first 100 cycles are left out
    assert rate < LEAST_SUCCESS
    line = f"the arm got {100 * rate:.1f} % of its commands in time, at least 99 % are needed"
    emulator, connect = opened(client, *(Fault("late", 300, motion=k, cycles=late) for k in range(3)))
    with emulator as address:
        arm = connect(address)
        arm.realtime = True
        runner = PolicyRunner(arm, TASK, np.ones(7))
        runner.place(PANDA.q_home[None], 0)
        runner.run([np.zeros(7)] * ROWS)
        assert runner.end().all()
        assert [stop.reason for stop in runner.stops] == [line]
        with pytest.raises(ArmStopped) as stop:
            record(arm, motion(0.0))
        assert str(stop.value) == line
        assert len(stop.value.recording.t) == ROWS + 1
        arm.realtime = False
        record(arm, motion(0.0))
        arm.close()


@pytest.mark.long
@pytest.mark.parametrize("client", OFTEN)
def test_every_motion_asks_for_real_time(client):
    """Recording, approach, ramps and episode; afterwards all is as before."""
    before, seen, counts = computer(), [], []
    with realtime_section():
        inside = computer()
    emulator, connect = opened(client, served=partial(RigidTwin, seed=3))  # its friction lets a ramp end
    with emulator as address:
        arm = connect(address)
        arm.realtime, exchange = True, arm._client.exchange

        def watched(tau):
            seen.append(computer())
            return exchange(tau)

        arm._client.exchange = watched
        runner = PolicyRunner(arm, TASK, np.ones(7))
        for move in (
            lambda: record(arm, motion(), loaded=True),
            lambda: arm.move_to(PANDA.q_home + 0.05),
            lambda: ramp(arm, PANDA.q_home[None], largest=0.1),
            lambda: (runner.place(PANDA.q_home[None], 0), runner.step(np.zeros((1, 7))), runner.end()),
        ):
            move()
            counts.append(len(seen))
            assert computer() == before
        arm.close()
    assert (np.diff([0, *counts]) > 0).all()
    assert set(seen) == {inside}
    assert not inside[0]


@pytest.mark.long
@pytest.mark.parametrize("client", CLIENTS)
def test_connecting_keeps_the_scheduler(client):
    """And so does a motion in lock-step: whatever the process does next is not for real time."""
    before, (emulator, connect) = computer(), opened(client)
    with emulator as address:
        arm = connect(address)
        assert computer() == before
        arm.move_to(PANDA.q_home)
        arm.command(np.zeros(7))
        assert computer() == before
        arm.close()


@pytest.mark.long
@pytest.mark.parametrize("client", OFTEN)
def test_a_reflex_restores_everything(client):
    """The arm ends the motion, not r2s."""
    before = computer()
    emulator, connect = opened(client, Fault("joint_limit", 30))
    with emulator as address:
        arm = connect(address)
        arm.realtime = True
        with pytest.raises(ArmStopped):
            record(arm, motion())
        assert computer() == before
        arm.close()


def fails():
    """Raise within a section."""
    with realtime_section(priority=None), realtime_section():
        assert not gc.isenabled()
        assert gc.get_freeze_count()
        raise ZeroDivisionError


def test_an_exception_restores_everything():
    """Also in a section within a section, as an arm's motion within an episode."""
    before = computer()
    with pytest.raises(ZeroDivisionError):
        fails()
    assert computer() == before
    assert not gc.get_freeze_count()


RIGHTS = """
import os, resource, sys
from r2s.arm.realtime import realtime_section
os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
if sys.argv[1] == "none":
    resource.setrlimit(resource.RLIMIT_RTPRIO, (0, 0))
    resource.setrlimit(resource.RLIMIT_MEMLOCK, (4096, 4096))
    if os.geteuid() == 0:
        os.setuid(65534)
for _ in range(2):
    with realtime_section():
        print(os.sched_getscheduler(0), os.sched_getparam(0).sched_priority)
    print(os.sched_getscheduler(0))
"""


def may_schedule():
    """Return whether this process has the right to real-time priorities."""
    return os.geteuid() == 0 or resource.getrlimit(resource.RLIMIT_RTPRIO)[1] >= PRIORITY


@pytest.mark.long
@pytest.mark.parametrize("rights", ["all", "none"])
def test_the_scheduler_is_set_where_it_may_be(rights):
    """Otherwise one warning in a process for each missing right, and the motion runs."""
    if rights == "all" and not may_schedule():
        pytest.skip("this user has no right to real-time priorities")
    env = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", RIGHTS, rights], capture_output=True, text=True, env=env, check=True
    )
    fifo, other = f"{os.SCHED_FIFO} {PRIORITY}", f"{os.SCHED_OTHER}"
    assert done.stdout.splitlines() == [fifo if rights == "all" else f"{other} 0", other] * 2
    warned = [line for line in done.stderr.splitlines() if line.startswith("warning: ")]
    if rights == "none":
        assert len(warned) == 2
        assert "memlock" in warned[0]
        assert "rtprio to at least 80" in warned[1]


class Terminal(io.StringIO):
    """Keeps which threads write to it; a terminal that does not take the text until `free`."""

    def __init__(self):
        super().__init__()
        self.threads, self.free = set(), threading.Event()

    def write(self, text):
        """Wait, except for the main thread."""
        self.threads.add(threading.get_ident())
        if threading.current_thread() is not threading.main_thread():
            assert self.free.wait(60)
        return super().write(text)


def test_a_cycle_does_not_write(monkeypatch):
    """A recording runs to its end while the terminal takes nothing, and then the terminal shows its progress."""
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    arm = SimulatedArm(
        PANDA, nominal_dynamics(PANDA, **conf("friction/paper")), position_noise=0.0, velocity_noise=0.0
    )
    progress = Progress("record", every_s=0.0, in_cycle=True)
    record(arm, motion(), progress=lambda k, n: progress(k / n, f"{k} cycles"))
    assert threading.get_ident() not in terminal.threads
    assert terminal.getvalue() == ""
    terminal.free.set()
    progress.close("ok")
    assert f"{ROWS + 1} cycles" in terminal.getvalue()
    assert "record done" in terminal.getvalue()
