"""Signals and the death of a process while the real clients move an emulated arm, seen from the robot's side.

Each motion must begin to brake within 50 ms of the cause, end at rest, and be ended by the client instead of a reflex
of the arm; no command may follow, and the first cause is the one that is kept.
"""

import json
import multiprocessing
import os
import re
import signal
import subprocess
import sys
import time
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from conftest import ROOT, conf
from robot_side import (
    ABORTED,
    CYCLE,
    ENDED,
    MISSED,
    SIGNALLED,
    STRAY,
    TASK,
    Kill,
    Log,
    Motion,
    RobotSide,
    run_sides,
    swing,
)

from r2s.arm.command_loop import REST_S
from r2s.arm.drive_cycle import STILL
from r2s.arm.driver import ADDED, DAMP_S, Driver
from r2s.arm.emulator.control import MAX_MISSED, Fault
from r2s.arm.interface import ArmState, StopRequested
from r2s.arm.lifeline import Lifeline
from r2s.arm.policy_runner import PolicyRunner
from r2s.arm.recorder import record
from r2s.arm.stop_request import GRACE_S, PARENT, handled_signals, requested, watched
from r2s.arm.twins.rigid_twin import RigidTwin
from r2s.errors import Stopped
from r2s.excitation.motion import Excitation
from r2s.physics.rigid_body import Kinematics
from r2s.physics.robot import SIM_DT, load_robot

PANDA = load_robot(**conf("robot/panda"))
BRAKED_S = 0.05  # from the cause to the begin of braking
LAG = 12  # cycles in which a braked arm may still become faster: 2 to 5 of delay, 3 ms of lag and the speed filter
REST = 0.06  # rad/s at the last command: SLIDING of `CommandLoop.rest`, and noise
NAMES = ("SIGHUP", "SIGINT", "SIGQUIT", "SIGTERM", "SIGTSTP")
MIDST = {"approach": 800, "episode": 300, "record": 700, "ramp": 300}  # cycle of a motion at which the cause comes
LATE = 400  # missed answers that stop a robot in real time: a loaded machine stalls its client
LONGEST_S = 120.0


@pytest.fixture(scope="module")
def sides():
    """Return the line to a process from which robots and policies are forked, with everything compiled."""
    context = multiprocessing.get_context("spawn")
    line, remote = context.Pipe()
    process = context.Process(target=run_sides, args=(remote, LONGEST_S))
    process.start()
    remote.close()
    line.send(PANDA)
    yield line
    line.close()
    process.join()


def drives(k):
    """Return an action that keeps several joints in motion."""
    return 0.5 * np.array([1, 0.5, -1, 0.5, 0, 1, 0]) * np.cos(0.1 * k)


def falls_silent(k):
    """Drive, and give no action after 0.3 s."""
    if k == 15:
        time.sleep(1.0)
    return drives(k)


def rests(k):
    """Return no torque."""
    return np.zeros(7)


def diverges(k):
    """Drive, and return what is no number after 0.3 s."""
    return drives(k) * (np.nan if k >= 15 else 1.0)


def run(line, folder, kind, kills=(), *, realtime=False, motion=None, meanwhile=None, **more):
    """Run a motion against a robot; return its log, how it ended for the policy's process, and the questions asked.

    Args:
        line: `sides`. kind, motion: of `Motion`, with its other settings; by default in a process of the arm.
        kills, realtime, more: of `RobotSide`. meanwhile: called while the motion runs.
    """
    more = {
        "make_arm": partial(RigidTwin, PANDA, 3),
        "client": "panda",
        "max_missed": LATE if realtime else 20,
    } | more
    moves = Motion(**{"kind": kind, "live": True, "policy": drives, "settings": {}} | (motion or {}))
    line.send((RobotSide(realtime=realtime, kills=tuple(kills), **more), PANDA, moves, folder))
    if meanwhile is not None:
        meanwhile()
    assert line.recv() == []  # every process has ended by itself
    result = json.loads((folder / "result.json").read_text()) if (folder / "result.json").exists() else None
    asked = (folder / "asked").read_text().splitlines() if (folder / "asked").exists() else []
    return Log.read(folder), result, asked


class Compensates:
    """An adapter that knows the payload: a point mass of `mass` kg at the end effector."""

    def __init__(self, mass):
        self._mass, self._kinematics = mass, Kinematics(PANDA)

    def begin(self):
        """Begin a motion."""

    def __call__(self, q, dq, tau):
        """Return what holds the payload at q (7,) rad."""
        return self._mass * 9.81 * self._kinematics(q)[1][2]


def wait_for(folder, name):
    """Wait until a process has written a file."""
    deadline = time.monotonic() + 60
    while not (folder / name).exists():
        assert time.monotonic() < deadline, f"no file {name}"
        time.sleep(0.02)


def check_stop(log, cause):
    """Check the motion after the row `cause` of a robot's log: braking in time, rest, an orderly end, no command."""
    after = log.after(cause)
    assert (after.motion == after.motion[0]).all()  # no other motion begins
    assert ABORTED not in after.kind
    (end,) = np.flatnonzero(after.kind == ENDED)
    assert not np.isin(after.kind[end:], (CYCLE, MISSED, STRAY)).any()  # no command after the end
    moving = after.between(0, int(end))
    moving = moving.between(1, len(moving.kind))  # after the row of the signal, if it is one
    stalled = int((moving.kind == MISSED).sum())  # cycles of a loaded machine in which no process of the arm ran
    assert len(moving.kind) <= (BRAKED_S + DAMP_S) / SIM_DT + LAG + stalled
    speed = np.abs(moving.dq / PANDA.dq_max).max(1)
    if np.abs(moving.dq).max() > 2 * REST:
        assert speed.argmax() <= BRAKED_S / SIM_DT + LAG + stalled
    assert np.abs(moving.dq[-1]).max() < REST


def cause_of(log, realtime=False):
    """Return the row of the first signal."""
    return first(log.kind == SIGNALLED, realtime)


def first(rows, realtime):
    """Return the number of the first of `rows` (k,) that is true; skip in real time if a motion ended before it."""
    if realtime and not rows.any():
        pytest.skip("this machine is too busy for real time: the motion ended before its fault")
    return int(np.flatnonzero(rows)[0])


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "target", "kind", "realtime"),
    [
        ("SIGINT", "policy", "approach", False),
        ("SIGHUP", "arm", "episode", False),
        *(
            pytest.param(name, target, kind, realtime, marks=pytest.mark.slow)
            for realtime in (False, True)
            for kind in ("approach", "episode")
            for target in ("policy", "arm")
            for name in NAMES
        ),
    ],
)
def test_a_signal_ends_a_live_motion(name, target, kind, realtime, sides, tmp_path):
    """Approach and episode end at rest; the name of the signal is the reason, and no operator is asked.

    After SIGINT with a process of the arm that is spawned, as in every run.
    """
    kills = [Kill(0, MIDST[kind], target, getattr(signal, name))]
    log, result, asked = run(sides, tmp_path, kind, kills, realtime=realtime, motion={"forks": name != "SIGINT"})
    check_stop(log, cause_of(log, realtime))
    assert asked == []
    assert result["halted"] == name
    assert len(result["stops"]) == 1
    assert result["stops"][0].endswith(f": {name}")


@pytest.mark.long
@pytest.mark.parametrize(
    ("kind", "target", "realtime"),
    [
        ("approach", "policy", True),
        ("episode", "policy", False),
        pytest.param("approach", "policy", False, marks=pytest.mark.slow),
        pytest.param("episode", "policy", True, marks=pytest.mark.slow),
        *(
            pytest.param(kind, "arm", realtime, marks=pytest.mark.slow)
            for kind in ("approach", "episode")
            for realtime in (False, True)
        ),
    ],
)
def test_a_killed_process_leaves_no_motion(kind, target, realtime, sides, tmp_path):
    """The death of the policy's process ends the motion at rest; that of the arm's own within 20 lost cycles."""
    own = {"max_missed": MAX_MISSED} if target == "arm" else {}
    log, result, _ = run(
        sides, tmp_path, kind, [Kill(0, MIDST[kind], target, signal.SIGKILL)], realtime=realtime, **own
    )
    if target == "policy":
        check_stop(log, cause_of(log, realtime))
        assert result is None
        return
    after = log.after(cause_of(log, realtime))
    assert (after.kind != CYCLE).all()  # the emulator ends a motion whose connection ends
    assert (after.kind == MISSED).sum() <= MAX_MISSED
    assert "the process that drove the arm has ended" in result["error"]


@pytest.mark.parametrize(
    ("kind", "name", "realtime", "client"),
    [
        ("record", "SIGINT", False, "panda"),
        *(
            pytest.param(kind, name, realtime, client, marks=pytest.mark.slow)
            for client, realtime in (("panda", False), ("fr3", True))
            for kind in ("record", "ramp", "approach", "episode")
            for name in NAMES
        ),
    ],
)
def test_a_signal_ends_a_motion_of_the_main_process(kind, name, realtime, client, sides, tmp_path):
    """Recordings, ramps and lock-step episodes run beside no other process; a recording keeps its rows."""
    kills = [Kill(0, MIDST[kind], "policy", getattr(signal, name))]
    log, result, asked = run(sides, tmp_path, kind, kills, realtime=realtime, motion={"live": False}, client=client)
    check_stop(log, cause_of(log, realtime))
    assert asked == []
    if kind in ("record", "ramp"):
        assert (result["kind"], result["error"]) == ("StopRequested", name)
        assert result["rows"] >= (MIDST[kind] if kind == "record" else 0)
    else:
        assert result["halted"] == name
        assert [stop.split(": ")[-1] for stop in result["stops"]] == [name]


@pytest.mark.long
@pytest.mark.parametrize("gap", [3, pytest.param(90, marks=pytest.mark.slow)])
@pytest.mark.parametrize("live", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_a_second_ctrl_c_changes_nothing(live, gap, sides, tmp_path):
    """Two signals within 100 ms: the arm still comes to rest, and the first one is the reason."""
    first, second = (Kill(0, 800 + k, "policy", n) for k, n in ((0, signal.SIGTERM), (gap, signal.SIGINT)))
    log, result, _ = run(sides, tmp_path, "approach", [first, second], motion={"live": live})
    check_stop(log, cause_of(log))
    assert result["halted"] == "SIGTERM"


@pytest.mark.long
@pytest.mark.parametrize("live", [True, pytest.param(False, marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    "name", ["SIGTERM", *(pytest.param(n, marks=pytest.mark.slow) for n in ("SIGINT", "SIGTSTP"))]
)
def test_a_signal_without_a_motion_ends_the_process(live, name, sides, tmp_path):
    """Within GRACE_S, with the signal's name; the arm has not moved."""
    began = []

    def send():
        wait_for(tmp_path, "idle")
        began.append(time.monotonic())
        os.kill(int((tmp_path / "policy.pid").read_text()), getattr(signal, name))
        wait_for(tmp_path, "result.json")
        began.append(time.monotonic())

    log, result, _ = run(sides, tmp_path, "idle", motion={"live": live}, meanwhile=send)
    assert (result["kind"], result["error"]) == ("Stopped", f"{name}; no motion was running")
    assert began[1] - began[0] < GRACE_S + 4.0  # the rest is the end of the processes on a loaded machine
    assert not len(log.kind)


@pytest.mark.slow
@pytest.mark.parametrize("live", [True, False])
def test_a_signal_while_the_operator_is_asked(live, sides, tmp_path):
    """The question ends, nothing moves, and the processes end."""

    def send():
        wait_for(tmp_path, "asked")
        time.sleep(0.2)
        os.kill(int((tmp_path / "policy.pid").read_text()), signal.SIGINT)

    faults = (Fault("joint_limit", 300),)
    motion = {"live": live, "thinks_s": 60.0}
    log, result, asked = run(sides, tmp_path, "approach", motion=motion, meanwhile=send, faults=faults)
    assert len(asked) == 1
    assert "joint_position_limits_violation" in asked[0]
    assert "SIGINT" in f"{result['halted']} {result['error']}"
    assert log.motion.max() == 0


@pytest.mark.long
@pytest.mark.parametrize(
    ("policy", "realtime"),
    [(falls_silent, False), *(pytest.param(p, r, marks=pytest.mark.slow)
     for p, r in ((falls_silent, True), (diverges, False), (diverges, True)))],
)  # fmt: skip
def test_a_drivers_stop_ends_the_motion_of_the_arm(policy, realtime, sides, tmp_path):
    """A policy that gives no action is the reason that is kept and asked about, not a reflex of the open motion."""
    log, result, asked = run(sides, tmp_path, "episode", realtime=realtime, motion={"policy": policy})
    silent = first((log.kind == CYCLE) & (log.cycle >= 15 * TASK.substeps), realtime)
    check_stop(log, silent)
    assert asked == ["no finite action for 50 ms"]
    assert "no finite action for 50 ms" in result["stops"][0]
    assert "no finite action for 50 ms" in result["halted"]


@pytest.mark.parametrize("realtime", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_a_stop_holds_what_an_adapter_compensates(realtime, sides, tmp_path):
    """An arm at rest that carries 1.5 kg, which only its adapter knows, does not sink while a signal ends its motion.

    Without the adapter's torque friction does not hold it: it sank at up to 0.15 rad/s. STILL of the driver is the
    bound on what rests.
    """
    make, adapts = partial(RigidTwin, PANDA, 3, payload=1.5), {"settings": {"adapter": Compensates(1.5)}}
    kills = [Kill(0, 300, "policy", signal.SIGTERM)]
    log, _, _ = run(
        sides, tmp_path, "episode", kills, realtime=realtime, motion=adapts | {"policy": rests}, make_arm=make
    )
    check_stop(log, cause_of(log, realtime))
    assert np.abs(log.after(cause_of(log, realtime)).dq).max() < STILL


@pytest.mark.long
@pytest.mark.parametrize(("load", "declared"), [(0.24, 1.3), pytest.param(1.3, 0.0, marks=pytest.mark.slow)])
def test_a_stop_finds_what_holds_a_wrong_load(load, declared, sides, tmp_path):
    """An arm whose gravity compensation is wrong by 1 kg, which nothing knows yet, comes to rest within REST_S.

    With the compensation of the moment of the stop alone, its wrist rose at 1.3 rad/s and got faster.
    """
    make = partial(RigidTwin, PANDA, 9, payload=load, declared_payload=declared)
    own = {"live": False, "loaded": True, "declared": declared, "far": 0.5}
    log, result, _ = run(sides, tmp_path, "record", [Kill(0, 461, "arm", signal.SIGTERM)], motion=own, make_arm=make)
    assert result["error"] == "SIGTERM"
    after = log.after(cause_of(log))
    (end,) = np.flatnonzero(after.kind == ENDED)
    stopping = after.between(1, int(end))
    assert len(stopping.kind) <= (DAMP_S + REST_S) / SIM_DT + LAG
    assert np.abs(stopping.dq[-1]).max() < REST


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="robust mutexes of Linux")
@pytest.mark.parametrize("end", ["killed", "released"])
def test_a_lifeline_reports_a_death_and_nothing_else(end):
    """The process that holds it is killed, or releases it and ends."""
    context, lifeline = multiprocessing.get_context("fork"), Lifeline()
    line, remote = context.Pipe()

    def holds():
        lifeline.hold()
        remote.send("held")
        remote.recv()
        lifeline.release()

    process = context.Process(target=holds)
    process.start()
    assert line.poll(60)
    assert lifeline.lost() is None
    if end == "killed":
        process.kill()
    else:
        line.send("release")
    process.join(60)
    assert lifeline.lost() == ("the process of the policy has ended" if end == "killed" else None)


def test_a_request_in_the_last_cycle_of_a_recording_counts():
    """The plan is over before the driver has brought the arm to rest; the recording still ends as stopped."""
    whole = swing(PANDA, 0.5)
    plan = Excitation(*(column[: len(whole.t) // 2] for column in (whole.t, whole.q, whole.dq, whole.ddq)))

    def late():
        return "a test" if arm.read().t >= plan.t[-2] else None

    arm = RigidTwin(PANDA, 3)
    with watched(late), handled_signals(), pytest.raises(StopRequested, match="a test") as stop:
        record(arm, plan)
    assert len(stop.value.recording.t) == len(plan.t)
    assert (np.abs(arm.read().dq) < REST).all()


def test_a_contact_releases_the_compensation():
    """The bound on a held link: at most ADDED of tau_max is kept, and after a contact nothing."""
    still, much = np.zeros(7), 0.5 * PANDA.tau_max
    for contact, held in ((np.zeros(7), ADDED * PANDA.tau_max), (np.eye(7)[1], still)):
        driver = Driver(PANDA, 0.2 * PANDA.tau_max, np.ones(7))
        state = ArmState(0.0, PANDA.q_home, still, still, still, joint_contact=np.zeros(7))
        for _ in range(200):
            state = replace(state, tau_J_d=driver(state, still, much))
        driver.stop("a test")
        state = replace(state, joint_contact=contact)
        for _ in range(200):
            state = replace(state, tau_J_d=driver(state, None, much))
        np.testing.assert_allclose(driver.held, held)
        assert (np.abs(state.tau_J_d) <= ADDED * PANDA.tau_max + 1e-9).all()
        assert contact.any() == (np.abs(state.tau_J_d) < 1e-6).all()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["SIGINT", "SIGTSTP"])
def test_a_signal_ends_a_run_as_stopped(name, tmp_path):
    """`run.py stage=identify` on an emulated arm: exit status 3, one line, and the rows so far are kept."""
    words = ["stage=identify", "data=arm", "arm=panda_emulated", "name=a"]
    words += [f"root={tmp_path}", "data.seconds=20"]
    command = [sys.executable, "run.py", *words]
    with subprocess.Popen(command, cwd=ROOT, stderr=subprocess.PIPE, text=True) as process:
        folder, printed = tmp_path / "identify" / "a", []
        assert process.stderr is not None
        for line in process.stderr:
            printed.append(line)
            if re.search(r"record train motion.* [1-9]", line):
                process.send_signal(getattr(signal, name))
                break
        printed += process.stderr.readlines()
    assert process.returncode == 3, "".join(printed)
    assert re.fullmatch(rf"stopped: while the arm was recorded: {name}; .*", printed[-1].strip())
    assert json.loads((folder / "meta.json").read_text())["status"] == "stopped"
    with np.load(folder / "train_until_stop.npz") as rows:
        assert len(rows["t"]) >= 500


@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP"])
def test_a_signal_after_the_last_motion_ends_the_run(name):
    """What follows would open the arm again, so the request is not lost."""
    with pytest.raises(Stopped, match=rf"^{name}; no motion was running$"), handled_signals():
        os.kill(os.getpid(), getattr(signal, name))
    with handled_signals():  # a later arm starts without a request
        assert requested() is None


def test_a_request_before_the_first_episode_halts_the_runner():
    """The runner has a state to show, the arm has not moved, and the reason stays."""
    arm = RigidTwin(PANDA, 3)
    with watched(lambda: "the parent has ended"), handled_signals():
        runner = PolicyRunner(arm, TASK, np.ones(7))
        runner.place(PANDA.q_home[None], 0)
    assert (runner.halted, runner.done) == ("the parent has ended", 0)


@pytest.mark.slow
def test_the_end_of_a_parent_ends_the_motion_of_its_step(tmp_path):
    """A killed process, such as stage=pipeline, leaves no recording behind that moves an arm."""
    words = ["stage=identify", "data=arm", "arm=panda_emulated", "name=a", f"root={tmp_path}", "data.seconds=20"]
    start = f"""import os, subprocess, sys
env = os.environ | {{{PARENT!r}: str(os.getpid())}}
with open({str(tmp_path / "log")!r}, "w") as log:
    step = subprocess.Popen([sys.executable, "run.py", *{words!r}], stderr=log, env=env)
print(step.pid, flush=True)
step.wait()"""
    with subprocess.Popen([sys.executable, "-c", start], cwd=ROOT, stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        step, log = int(parent.stdout.readline()), tmp_path / "log"
        while not re.search(r"record train motion.* [1-9]", log.read_text()):
            time.sleep(0.1)
        parent.kill()
    until = time.monotonic() + 60.0
    meta = tmp_path / "identify" / "a" / "meta.json"
    while json.loads(meta.read_text())["status"] == "running" and time.monotonic() < until:
        time.sleep(0.1)
    assert json.loads(meta.read_text())["status"] == "stopped", (step, log.read_text())
    assert "SIGTERM" in log.read_text()
