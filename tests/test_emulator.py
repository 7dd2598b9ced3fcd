"""The hardware clients against the emulated FCI server, and the server by itself.

The clients use the real packages (panda-python, pylibfranka); tests of a missing package are skipped.
"""

import os
import re
import signal
import socket
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from functools import partial
from importlib.util import find_spec
from types import SimpleNamespace

import numpy as np
import psutil
import pytest
import torch
from conftest import ROOT, conf
from served_arms import Bare, holdable, loaded

from r2s.arm.clients import fci, libfranka
from r2s.arm.clients.collision_thresholds import CAUTIOUS, CollisionThresholds
from r2s.arm.clients.fr3 import FR3
from r2s.arm.clients.franka import TORQUE_SHARE
from r2s.arm.clients.panda import Panda
from r2s.arm.emulator.control import Control, Fault
from r2s.arm.emulator.process import Emulator
from r2s.arm.emulator.server import Server, open_port
from r2s.arm.interface import ArmStopped, NotCleared, named_signals, signal_sizes
from r2s.arm.policy_runner import PolicyRunner
from r2s.arm.twins.rigid_twin import RigidTwin
from r2s.errors import UserError
from r2s.learning.evaluate import fixed_episodes
from r2s.learning.policy import make_policy
from r2s.physics.dynamics import nominal_dynamics
from r2s.physics.robot import SIM_DT, load_robot
from r2s.recordings.recording import SIGNALS
from r2s.tasks.reach import ReachTask
from r2s.tasks.rollout import rollout

CLIENTS = {"panda": ("panda_py.libfranka", Panda, 5), "fr3": ("pylibfranka", FR3, 10)}
CYCLES = 300
BARE = 1e-4  # of tau_max: what moves an arm without friction
SEED = 3
FAULTS = (  # in the order of motions
    Fault("late", 5, motion=0, cycles=6),
    Fault("drop", 20, motion=0, cycles=6),
    Fault("late", 10, motion=1, cycles=20),
    Fault("drop", 10, motion=2, cycles=20),
    Fault("discontinuity", 10, motion=3),
    Fault("joint_limit", 10, motion=4),
    Fault("estop", 10, motion=5),
)


@pytest.fixture(scope="module")
def panda():
    return load_robot(**conf("robot/panda"))


@pytest.fixture(scope="module")
def servers(panda):
    """Two servers with equal twins per FCI version, started in parallel: {client: (address, address)}."""
    with ExitStack() as stack, ThreadPoolExecutor() as pool:
        emulators = {
            (name, i): Emulator(partial(RigidTwin, panda, SEED), version=version)
            for name, (package, _, version) in CLIENTS.items()
            for i in range(2 if find_spec(package.split(".")[0]) else 0)
        }
        started = {key: pool.submit(stack.enter_context, emulator) for key, emulator in emulators.items()}
        yield {name: tuple(x.result() for (other, _), x in started.items() if other == name) for name in CLIENTS}


@pytest.fixture(params=CLIENTS)
def client(request):
    """Each installed client: name, class and FCI version."""
    package, arm, version = CLIENTS[request.param]
    pytest.importorskip(package)
    return request.param, arm, version


def drive(arm, cycles, share=0.02, pause=lambda k: None):
    """Command a slow sine, a share of tau_max; return t, q, dq, tau_J, tau_J_d of each cycle, (cycles, 29)."""
    rows = []
    for k in range(cycles):
        pause(k)
        arm.command(share * arm.robot.tau_max * np.sin(2 * np.pi * (k + 1) * SIM_DT))
        s = arm.read()
        rows.append(np.concatenate([[s.t], s.q, s.dq, s.tau_J, s.tau_J_d]))
    return np.array(rows)


@pytest.mark.long
def test_a_motion_is_bit_identical_with_and_without_a_client(client, servers, panda):
    """0.3 s in lock-step: twice with a client, one of them slow, and once without."""
    name, make, version = client
    motions = []
    for address, pause_s in zip(servers[name], (0.0, 0.03), strict=True):
        arm = make(panda, address)
        arm.move_to(panda.q_home)  # already there
        motions.append(drive(arm, CYCLES, pause=lambda k, s=pause_s: time.sleep(s) if k % 50 == 0 else None))
        arm.stop()
        arm.close()
    assert np.array_equal(*motions)
    twin = RigidTwin(panda, SEED)
    twin.move_to(panda.q_home)
    direct = drive(twin, CYCLES)
    if version == 10:  # single precision
        direct[:, 1:] = direct[:, 1:].astype(np.float32)
    assert np.array_equal(motions[0], direct)


@pytest.fixture
def faulty(client, panda):
    """Address of a server with injected faults."""
    with Emulator(partial(RigidTwin, panda, SEED), version=client[2], faults=FAULTS) as address:
        yield address


@pytest.mark.long
def test_every_fault_stops_with_libfrankas_reason(client, faulty, panda):
    """A few lost packets have no effect; each fault ends the motion with libfranka's reason and can be cleared."""
    _, make, _ = client
    questions = []
    arm = make(panda, faulty, operator=lambda reason: questions.append(reason) is None)
    here = arm.read().q
    arm.move_to(here)
    rows = drive(arm, 60)
    steps = np.diff(rows[:, 0])
    assert np.flatnonzero(steps > 1.5 * SIM_DT).tolist() == [18]  # row 18 has the state of cycle 19
    assert steps[18] == pytest.approx(7 * SIM_DT)  # six states were lost
    held = (rows[1:, 22:] == rows[:-1, 22:]).all(axis=1)
    assert np.flatnonzero(held).tolist() == [4, 5, 6, 7, 8, 9]  # six answers came too late
    reasons = [
        "communication_constraints_violation", "communication_constraints_violation",
        "controller_torque_discontinuity", "joint_position_limits_violation",
    ]  # fmt: skip
    for reason in reasons:
        arm.move_to(arm.read().q)
        with pytest.raises(ArmStopped, match=f"reflex.*{reason}"):
            drive(arm, 60)
        assert arm.read().t <= 31 * SIM_DT
        with pytest.raises(ArmStopped, match=f"the arm is stopped: .*{reason}"):
            arm.command(np.zeros(7))
    arm.move_to(arm.read().q)
    assert [r for r in reasons if not any(r in line for line in questions)] == []
    with pytest.raises(ArmStopped, match=r"User Stop|user stop|emergency"):
        drive(arm, 60)
    with pytest.raises(ArmStopped, match="user stopped"):
        arm.move_to(here)
    assert len(questions) == len(reasons) + 1
    arm.close()


@pytest.mark.long
@pytest.mark.parametrize(
    ("fault", "reason"),
    [
        (Fault("late", 40, cycles=20), "communication_constraints_violation"),
        *(
            pytest.param(*row, marks=pytest.mark.slow)  # that each stops with its reason: above
            for row in (
                (Fault("drop", 40, cycles=20), "communication_constraints_violation"),
                (Fault("discontinuity", 40), "controller_torque_discontinuity"),
                (Fault("joint_limit", 40), "joint_position_limits_violation"),
            )
        ),
    ],
    ids=lambda x: x.kind if isinstance(x, Fault) else "",
)
def test_a_fault_in_an_episode_is_logged(fault, reason, client, panda):
    """The episode ends with libfranka's reason and a log; after clearing, the next one runs."""
    _, make, version = client
    task = ReachTask(episode_s=0.2)
    torch.manual_seed(0)
    with Emulator(partial(RigidTwin, panda, SEED), version=version, faults=[fault]) as address:
        arm = make(panda, address, operator=lambda reason: True)
        starts = np.stack([panda.q_home, panda.q_home])
        goals = fixed_episodes(panda, task, 2)[1]
        driven = PolicyRunner(arm, task, nominal_dynamics(arm.robot, **conf("friction/paper")).level)
        episodes = rollout(make_policy(panda, task, (8,)), driven, task, starts, goals)
        stops = driven.stops
        arm.close()
    assert len(stops) == 1, stops
    assert re.match(rf"episode 1, 0\.0[4-6]\d* s: .*{reason}", str(stops[0]))
    np.testing.assert_allclose(np.diff(stops[0].log[:, 0]), 1e-3, atol=1e-9)  # every cycle up to it
    np.testing.assert_allclose(stops[0].log[0, 1:8], panda.q_home, atol=1e-2)
    assert np.isinf(episodes.distance[0, -1])
    assert np.isfinite(episodes.distance[1]).all()
    assert np.isfinite(episodes.q).all()


@pytest.mark.long
def test_a_pressed_stop_button_ends_the_run(client, panda):
    """A pressed button cannot be cleared: the episode ends, and no other one begins."""
    _, make, version = client
    task = ReachTask(episode_s=0.2)
    torch.manual_seed(0)
    with Emulator(partial(RigidTwin, panda, SEED), version=version, faults=[Fault("estop", 40)]) as address:
        arm = make(panda, address, operator=lambda reason: True)
        starts, goals = np.stack([panda.q_home, panda.q_home]), fixed_episodes(panda, task, 2)[1]
        driven = PolicyRunner(arm, task, nominal_dynamics(arm.robot, **conf("friction/paper")).level)
        episodes = rollout(make_policy(panda, task, (8,)), driven, task, starts, goals)
        stops = driven.stops
        arm.close()
    assert [stop.episode for stop in stops] == [0]
    assert driven.done == 1
    assert "the arm is not ready to move: it is user stopped" in driven.halted
    assert np.isinf(episodes.distance[:, -1]).all()


@pytest.mark.long
def test_only_an_operator_clears_a_reflex(client, panda):
    """Without consent `move_to` refuses; a command beyond the limits is not sent."""
    _, make, version = client
    with Emulator(partial(Bare, panda), version=version, faults=[Fault("joint_limit", 3)]) as address:
        arm = make(panda, address)
        arm.move_to(panda.q_home)
        with pytest.raises(ArmStopped, match="joint_position_limits_violation"):
            drive(arm, 10, BARE)
        with pytest.raises(ArmStopped, match=r"no operator agreed .*joint_position_limits_violation"):
            arm.move_to(panda.q_home)
        arm.close()
        arm = make(panda, address, operator=lambda reason: True)  # the reflex outlives the connection
        target = panda.q_home + np.array([0, 0, 0, 0, 0, 0, 0.05])
        assert np.abs(arm.move_to(target).q - target).max() < 2e-3
        for bad, reason in ((np.full(7, np.nan), "nan, must be finite"), (np.full(7, 2.0), r"steps by \+2.000 Nm")):
            arm.move_to(arm.read().q)
            drive(arm, 2, BARE)
            with pytest.raises(ArmStopped, match=reason):
                arm.command(bad)
        assert np.abs(arm.read().dq).max() < 0.05  # at rest
        with pytest.raises(ArmStopped, match="joint 2: position 3"):
            arm.move_to(np.array([0, 3, 0, -2, 0, 1, 0]))
        arm.close()


@pytest.mark.slow  # without a wire: test_command_loop.py
def test_a_released_stop_button_still_needs_consent(client, panda):
    """After the button's release the arm moves only with the operator's consent."""
    _, make, version = client
    with Emulator(partial(Bare, panda), version=version, faults=[Fault("press", 10, cycles=40)]) as address:
        answers, questions = iter((False, True)), []
        arm = make(panda, address, operator=lambda reason: questions.append(reason) or next(answers))
        arm.move_to(panda.q_home)
        with pytest.raises(ArmStopped, match=r"User Stop|user stop|emergency"):
            drive(arm, 60, BARE)
        time.sleep(0.3)  # an idle emulator passes 20 ms of the arm in as many of the clock
        assert int(arm._client.idle().robot_mode) == fci.IDLE  # ready to move
        with pytest.raises(NotCleared, match="no operator agreed"):
            arm.move_to(panda.q_home)
        arm.move_to(panda.q_home)
        drive(arm, 20, BARE)
        assert len(questions) == 2
        arm.close()


@pytest.mark.slow
@pytest.mark.parametrize("cautious", [True, False])
def test_a_held_link_meets_a_bounded_force(cautious, client, panda):
    """The arm stops itself at its threshold; with high thresholds `move_to` gives up within its torque share."""
    _, make, version = client
    torque, force = ([5.0] * 7, CAUTIOUS.force) if cautious else ([1e3] * 7, [1e3] * 6)
    with Emulator(partial(holdable, panda), version=version, faults=[Fault("hold", 300, cycles=10_000)]) as address:
        arm = make(panda, address, operator=lambda _: False, collision_torque=torque, collision_force=force)
        sent, send = [], arm._client.exchange
        arm._client.exchange = lambda tau: sent.append(tau) or send(tau)
        reason = "joint_reflex" if cautious else r"joint 1 is 0.10\d rad off its path"
        with pytest.raises(ArmStopped, match=reason):
            arm.move_to(arm.read().q + np.array([0.5, 0, 0, 0, 0, 0, 0]))
        most = 5.0 + 2.5 if cautious else TORQUE_SHARE * 87  # the threshold, plus friction and the filter's lag
        assert np.abs(sent).max(0)[0] <= most + 1e-6
        with pytest.raises(NotCleared, match="no operator agreed"):
            arm.move_to(arm.read().q)
        arm.close()


def test_wrong_faults_and_thresholds_are_refused(panda):
    """Each error is one line."""
    with pytest.raises(UserError, match="fault 'hold': Bare has no attribute 'external'"):
        Control(Bare(panda), 5, [Fault("hold", 3)])
    with pytest.raises(UserError, match="collision_torque: expected 7 numbers, got 3"):
        CollisionThresholds([1.0] * 3, CAUTIOUS.force)
    with pytest.raises(UserError, match=r"collision_force: expected .*, got 0.0"):
        CollisionThresholds(CAUTIOUS.torque, [0.0] * 6)
    with pytest.raises(UserError, match=r"collision_torque: expected .*100.*, got 100"):
        CollisionThresholds([100.0] * 7, CAUTIOUS.force)  # the arm's reflexes would be off


def test_a_box_that_wakes_late_does_not_shorten_the_clients_time(panda, monkeypatch):
    """An answer counts however late the emulator's own process wakes up, and the next state leaves it time."""
    clock = SimpleNamespace(monotonic=lambda: now)
    monkeypatch.setattr("r2s.arm.emulator.server.time", clock)
    control, now = Control(Bare(panda), 5), 0.0
    with open_port() as port, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
        server = Server(port, control, "", 5, realtime=True)
        client.bind((server.address, 0))
        server._udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        server._udp.bind((server.address, 0))
        server._udp.setblocking(False)
        server._client, server._move, server._due = client.getsockname(), 1, now
        control.begin()

        def answer():
            command = np.zeros((), fci.COMMAND[5])
            command["message_id"] = np.frombuffer(client.recv(4096), fci.STATE[5])[0]["message_id"]
            client.sendto(command.tobytes(), server._udp.getsockname())
            server._commands()

        for late in (0.0, 0.2e-3, 0.7e-3, 5e-3, 0.0, 0.4e-3):  # s
            now = server._due + late
            server._tick()
            assert server._due - now >= 0.9 * SIM_DT - 1e-12  # the time from this state to the next one
            answer()
            if not server._ahead:  # the first answer starts the motion, with a state of its own
                answer()
        assert control.state["control_command_success_rate"] == 1.0
        server._udp.close()


@pytest.mark.slow  # a loaded machine makes the clients time out
def test_real_time_does_not_wait(client, panda):
    """At 1 kHz a stalling client loses its motion; a short stall of the computer does not matter."""
    _, make, version = client
    with Emulator(partial(Bare, panda), version=version, realtime=True, max_missed=400) as address:
        arm = make(panda, address, operator=lambda reason: True)
        arm.move_to(panda.q_home)
        drive(arm, 200, BARE)
        arm.stop()
        assert arm.read().q == pytest.approx(panda.q_home, abs=0.1)
        arm.move_to(arm.read().q)
        drive(arm, 10, BARE)
        time.sleep(0.6)
        with pytest.raises(ArmStopped, match="communication_constraints_violation"):
            drive(arm, 500, BARE)
        arm.close()


@pytest.mark.slow  # in real time it needs an idle machine
@pytest.mark.parametrize("realtime", [False, True])
def test_twenty_episodes_complete(realtime, client, panda):
    """With cautious collision thresholds and an operator who never consents."""
    _, make, version = client
    task = ReachTask(episode_s=1.0)
    torch.manual_seed(0)
    with Emulator(partial(RigidTwin, panda, SEED), version=version, realtime=realtime) as address:
        arm = make(panda, address, operator=lambda reason: False)
        driven = PolicyRunner(arm, task, nominal_dynamics(arm.robot, **conf("friction/paper")).level)
        episodes = rollout(make_policy(panda, task, (8,)), driven, task, *fixed_episodes(panda, task, 20))
        arm.close()
    assert [str(stop) for stop in driven.stops] == []
    assert (driven.done, driven.halted) == (20, None)
    assert np.isfinite(episodes.distance).all()


def test_wrong_versions_and_addresses_are_one_line(client, servers, panda):
    """A wrong version or an address without server gives one line with libfranka's reason."""
    name, make, version = client
    other = 15 - version
    for address in servers["fr3" if name == "panda" else "panda"]:
        with pytest.raises(UserError, match=rf"arm={name}: .*version:? {other}") as wrong:
            make(panda, address)
        assert "\n" not in str(wrong.value)
    with pytest.raises(UserError, match=f"arm={name}: no connection to 127.1.2.3: libfranka") as missing:
        make(panda, "127.1.2.3")
    assert "\n" not in str(missing.value)


@pytest.mark.parametrize(
    ("desk", "control", "there"),
    [("silent", "silent", False), ("refused", "silent", True), ("open", "silent", True), ("silent", "refused", True)],
)
def test_an_unreachable_address_is_found_within_seconds(desk, control, there, monkeypatch):
    """A refusal or one open port counts as reachable; libfranka itself would wait a minute."""
    answers, waited = {libfranka.DESK_PORT: desk, fci.PORT: control}, []

    def create_connection(place, timeout):
        waited.append(timeout)
        if answers[place[1]] == "open":
            return SimpleNamespace(close=lambda: None)
        raise TimeoutError if answers[place[1]] == "silent" else ConnectionRefusedError

    monkeypatch.setattr(libfranka.socket, "create_connection", create_connection)
    if there:
        assert libfranka.connect(lambda: "a robot", "panda", "172.16.0.2") == "a robot"
    else:
        with pytest.raises(UserError, match=r"arm=panda: no connection to 172.16.0.2: no answer"):
            libfranka.connect(pytest.fail, "panda", "172.16.0.2")
    assert sum(waited) < 10


@pytest.mark.parametrize("name", CLIENTS)
def test_a_missing_package_is_named(name, panda, monkeypatch):
    """The error names the extra to install."""
    package, make, _ = CLIENTS[name]
    for module in (package, package.split(".")[0]):
        monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(UserError, match=rf"arm={name} needs .*r2s\[{name}\]"):
        make(panda, "127.0.0.1")


def alive(process):
    """Return whether a process runs; a zombie does not."""
    return process.is_running() and process.status() != psutil.STATUS_ZOMBIE


@pytest.mark.long
def test_the_process_dies_with_its_parent(tmp_path):
    """A killed parent leaves no server behind."""
    script = tmp_path / "parent.py"
    script.write_text(
        "import time\n"
        "from functools import partial\n"
        "from served_arms import Bare\n"
        "from r2s.arm.emulator.process import Emulator\n"
        "from r2s.physics.robot import load_robot\n"
        "if __name__ == '__main__':\n"
        "    emulator = Emulator(partial(Bare, load_robot()), version=5)\n"
        "    emulator.__enter__()\n"
        "    print(emulator._process.pid, flush=True)\n"
        "    time.sleep(60)\n"
    )
    env = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "tests")])}
    with subprocess.Popen([sys.executable, script], stdout=subprocess.PIPE, text=True, env=env) as parent:
        assert parent.stdout is not None
        child = psutil.Process(int(parent.stdout.readline()))
        assert alive(child)
        parent.send_signal(signal.SIGKILL)
    deadline = time.monotonic() + 5
    while alive(child) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not alive(child)


def test_wrong_emulator_settings_are_one_line(panda):
    """A wrong version or fault is one line; a free address is found."""
    with pytest.raises(UserError, match="version 7; allowed: 5, 10"):
        Emulator(partial(Bare, panda), version=7)
    with pytest.raises(UserError, match=r"fault: 'e-stop'; allowed: .*; did you mean 'estop'"):
        Fault("e-stop", 3)
    with pytest.raises(UserError, match="cycle=-1"):
        Fault("late", -1)
    with open_port() as one, open_port() as other:
        assert one.getsockname()[0] != other.getsockname()[0]


@pytest.mark.long
def test_clients_read_what_the_arm_knows(client, panda):
    """Every signal arrives, at rest and in motion; a load that is set reaches the state."""
    _, make, version = client
    with Emulator(partial(loaded, panda, 1.0), version=version) as address:
        arm = make(panda, address)
        arm.move_to(panda.q_home)
        drive(arm, 20, BARE)
        s = arm.read()
        sizes = {name: np.size(getattr(s, name)) for name in SIGNALS}
        assert sizes == signal_sizes(7)
        assert s.O_F_ext_hat_K[2] == pytest.approx(9.81, abs=0.05)  # it moves by 0.1 mrad
        assert s.control_command_success_rate == pytest.approx(1.0)
        assert not s.in_contact
        again = named_signals(s.signals, 7)
        assert all(np.array_equal(again[name], getattr(s, name)) for name in SIGNALS)
        arm.stop()
        assert arm.read().control_command_success_rate == 0
        arm._client._robot.set_load(0.4, [0.0, 0.0, 0.02], [1e-3, 0, 0, 0, 1e-3, 0, 0, 0, 1e-3])
        arm.move_to(arm.read().q)
        assert arm.read().m_load == pytest.approx(0.4)
        assert arm.read().O_F_ext_hat_K[2] == pytest.approx(0.6 * 9.81, abs=0.05)
        arm.close()
