"""The clients that drive hardware, against our own FCI server; and what that server promises by itself.

The clients are the real packages (panda-python, pylibfranka): a test of one that is not installed is skipped.
"""

import os
import re
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from importlib.util import find_spec
from types import SimpleNamespace

import mujoco
import numpy as np
import psutil
import pytest
import torch
from conftest import ROOT, conf

from r2s.arm import fci, franka
from r2s.arm.deploy import DrivenArm
from r2s.arm.emulator.control import Control, Fault
from r2s.arm.emulator.process import Emulator, _yaml, main
from r2s.arm.emulator.server import listen
from r2s.arm.fr3 import FR3
from r2s.arm.franka import CAUTIOUS, TORQUE_SHARE, Collision
from r2s.arm.interface import ArmState, ArmStopped, NotCleared, Reflexes
from r2s.arm.panda import Panda
from r2s.arm.simulated import SimulatedArm
from r2s.arm.twin import Twin
from r2s.errors import UserError
from r2s.learning.evaluate import fixed_episodes
from r2s.learning.policy import make_policy
from r2s.physics.dynamics import nominal_dynamics
from r2s.physics.robot import SIM_DT, load_robot
from r2s.tasks.episode import rollout
from r2s.tasks.reach import ReachTask

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


class Bare:
    """The smallest `Arm`: the nominal model in MuJoCo, which starts in no time."""

    # ruff: noqa: D102

    def __init__(self, robot):
        self.robot, self._reflexes = robot, Reflexes(robot)
        self._model = robot.model(gravity=False)
        self._data = mujoco.MjData(self._model)
        self.commands = []
        self.move_to(robot.q_home)

    def move_to(self, q):
        mujoco.mj_resetData(self._model, self._data)
        self._data.qpos, self._last = q, np.zeros(7)
        return self.read()

    def read(self):
        return ArmState(0.0, self._data.qpos.copy(), self._data.qvel.copy(), self._last, self._last)

    def command(self, tau):
        self._reflexes.command(tau, self._last)
        self.commands.append(tau)
        self._last = self._data.qfrc_applied[:] = tau
        mujoco.mj_step(self._model, self._data)
        self._reflexes.state(self._data.qpos, self._data.qvel)

    def stop(self):
        pass


@pytest.fixture(scope="module")
def panda():
    return load_robot(**conf("robot/panda"))


@pytest.fixture(scope="module")
def servers(panda):
    """Two equal twins behind each client's version, all started at once: {client: (address, address)}."""
    with ExitStack() as stack, ThreadPoolExecutor() as pool:
        emulators = {
            (name, i): Emulator(partial(Twin, panda, SEED), version=version)
            for name, (package, _, version) in CLIENTS.items()
            for i in range(2 if find_spec(package.split(".")[0]) else 0)
        }
        started = {key: pool.submit(stack.enter_context, emulator) for key, emulator in emulators.items()}
        yield {name: tuple(x.result() for (other, _), x in started.items() if other == name) for name in CLIENTS}


@pytest.fixture(params=CLIENTS)
def client(request):
    """Each client that is installed: its name, its arm and its version."""
    package, arm, version = CLIENTS[request.param]
    pytest.importorskip(package)
    return request.param, arm, version


def drive(arm, cycles, share=0.02, pause=lambda k: None):
    """Command a slow wave, a share of tau_max; return t, q, dq, tau_J and tau_J_d after each cycle, (cycles, 29)."""
    rows = []
    for k in range(cycles):
        pause(k)
        arm.command(share * arm.robot.tau_max * np.sin(2 * np.pi * (k + 1) * SIM_DT))
        s = arm.read()
        rows.append(np.concatenate([[s.t], s.q, s.dq, s.tau_J, s.tau_J_d]))
    return np.array(rows)


def test_a_motion_is_bit_identical_and_the_arms_own(client, servers, panda):
    """0.3 s in lock-step twice, once with a client that dawdles, and a third time without any wire."""
    name, make, version = client
    motions = []
    for address, dawdle in zip(servers[name], (0.0, 0.03), strict=True):
        arm = make(panda, address)
        arm.move_to(panda.q_home)  # it is there
        motions.append(drive(arm, CYCLES, pause=lambda k, s=dawdle: time.sleep(s) if k % 50 == 0 else None))
        arm.stop()
        arm.close()
    assert np.array_equal(*motions)
    twin = Twin(panda, SEED)
    twin.move_to(panda.q_home)
    direct = drive(twin, CYCLES)
    if version == 10:  # its states have single precision
        direct[:, 1:] = direct[:, 1:].astype(np.float32)
    assert np.array_equal(motions[0], direct)


@pytest.fixture
def faulty(client, panda):
    """The address of a server of its own, on which things go wrong."""
    with Emulator(partial(Twin, panda, SEED), version=client[2], faults=FAULTS) as address:
        yield address


def test_every_fault_is_a_stop_with_a_name(client, faulty, panda):
    """A few lost packets are borne; each fault ends the motion with libfranka's reason, and can be cleared."""
    _, make, _ = client
    asked = []
    arm = make(panda, faulty, operator=lambda reason: asked.append(reason) is None)
    here = arm.read().q
    arm.move_to(here)
    seen = drive(arm, 60)
    steps = np.diff(seen[:, 0])
    assert np.flatnonzero(steps > 1.5 * SIM_DT).tolist() == [18]  # row 18 has the state of cycle 19
    assert steps[18] == pytest.approx(7 * SIM_DT)  # six states were lost
    held = (seen[1:, 22:] == seen[:-1, 22:]).all(axis=1)
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
    assert [r for r in reasons if not any(r in line for line in asked)] == []
    with pytest.raises(ArmStopped, match=r"User Stop|user stop|emergency"):
        drive(arm, 60)
    with pytest.raises(ArmStopped, match="user stopped"):
        arm.move_to(here)
    assert len(asked) == len(reasons) + 1
    arm.close()


@pytest.mark.parametrize(
    ("fault", "reason"),
    [
        (Fault("late", 40, cycles=20), "communication_constraints_violation"),
        (Fault("drop", 40, cycles=20), "communication_constraints_violation"),
        (Fault("discontinuity", 40), "controller_torque_discontinuity"),
        (Fault("joint_limit", 40), "joint_position_limits_violation"),
    ],
    ids=lambda x: x.kind if isinstance(x, Fault) else "",
)
def test_a_fault_in_a_deployed_episode_is_kept(fault, reason, client, panda):
    """The episode ends with libfranka's reason and keeps what it saw; the next one, when it is cleared, runs."""
    _, make, version = client
    task = ReachTask(episode_s=0.2)
    torch.manual_seed(0)
    with Emulator(partial(Twin, panda, SEED), version=version, faults=[fault]) as address:
        arm = make(panda, address, operator=lambda reason: True)
        starts = np.stack([panda.q_home, panda.q_home])
        goals = fixed_episodes(panda, task, 2)[1]
        driven = DrivenArm(arm, task, nominal_dynamics(arm.robot, **conf("friction/paper")).level)
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


def test_a_stop_button_ends_a_deployment(client, panda):
    """A reflex can be cleared, a pressed button cannot: the episode ends, and no other one begins."""
    _, make, version = client
    task = ReachTask(episode_s=0.2)
    torch.manual_seed(0)
    with Emulator(partial(Twin, panda, SEED), version=version, faults=[Fault("estop", 40)]) as address:
        arm = make(panda, address, operator=lambda reason: True)
        starts, goals = np.stack([panda.q_home, panda.q_home]), fixed_episodes(panda, task, 2)[1]
        driven = DrivenArm(arm, task, nominal_dynamics(arm.robot, **conf("friction/paper")).level)
        episodes = rollout(make_policy(panda, task, (8,)), driven, task, starts, goals)
        stops = driven.stops
        arm.close()
    assert [stop.episode for stop in stops] == [0]
    assert driven.done == 1
    assert "the arm is not ready to move: it is user stopped" in driven.halted
    assert np.isinf(episodes.distance[:, -1]).all()


def test_a_reflex_is_cleared_by_an_operator_only(client, panda):
    """Without consent `move_to` refuses; what the arm would not take is refused before it is sent."""
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
        assert np.abs(arm.read().dq).max() < 0.05  # it was brought to rest
        with pytest.raises(ArmStopped, match="joint 2: position 3"):
            arm.move_to(np.array([0, 3, 0, -2, 0, 1, 0]))
        arm.close()


@pytest.mark.slow  # without a wire: test_driven.py
def test_pressed_and_released_counts_as_pressed(client, panda):
    """An idle arm whose button was released does not move before the operator agreed; then it does."""
    _, make, version = client
    with Emulator(partial(Bare, panda), version=version, faults=[Fault("press", 10, cycles=40)]) as address:
        answers, asked = iter((False, True)), []
        arm = make(panda, address, operator=lambda reason: asked.append(reason) or next(answers))
        arm.move_to(panda.q_home)
        with pytest.raises(ArmStopped, match=r"User Stop|user stop|emergency"):
            drive(arm, 60, BARE)
        time.sleep(0.3)  # an idle emulator passes 20 ms of the arm in as many of the clock
        assert int(arm._client.idle().robot_mode) == fci.IDLE  # it would move
        with pytest.raises(NotCleared, match="no operator agreed"):
            arm.move_to(panda.q_home)
        arm.move_to(panda.q_home)
        drive(arm, 20, BARE)
        assert len(asked) == 2
        arm.close()


def held(robot):
    """Return an arm of known truth whose links can be held."""
    return SimulatedArm(robot, nominal_dynamics(robot, **conf("friction/paper")), position_noise=0, velocity_noise=0)


@pytest.mark.slow
@pytest.mark.parametrize("cautious", [True, False])
def test_who_holds_a_link_on_the_way(cautious, client, panda):
    """The arm stops itself at its threshold; without thresholds the way is given up, and presses no harder than its
    share of the torque on the way.
    """
    _, make, version = client
    collision = Collision([5.0] * 7, CAUTIOUS.force) if cautious else Collision([1e3] * 7, [1e3] * 6)
    with Emulator(partial(held, panda), version=version, faults=[Fault("hold", 300, cycles=10_000)]) as address:
        arm = make(panda, address, operator=lambda reason: False, collision=collision)
        told, send = [], arm._client.exchange
        arm._client.exchange = lambda tau: told.append(tau) or send(tau)
        reason = "joint_reflex" if cautious else r"joint 1 is 0.10\d rad off its way"
        with pytest.raises(ArmStopped, match=reason):
            arm.move_to(arm.read().q + np.array([0.5, 0, 0, 0, 0, 0, 0]))
        assert np.abs(told).max(0)[0] <= (5.0 + 2.5 if cautious else TORQUE_SHARE * 87) + 1e-6  # friction, and 15 Hz
        with pytest.raises(NotCleared, match="no operator agreed"):
            arm.move_to(arm.read().q)
        arm.close()


def test_what_cannot_be_held(panda):
    """A fault that the arm behind the emulator cannot have is one line."""
    with pytest.raises(UserError, match="fault 'hold': Bare has nothing that could push it"):
        Control(Bare(panda), 5, [Fault("hold", 3)])
    with pytest.raises(UserError, match="collision_torque: 3 numbers, allowed are 7"):
        Collision([1.0] * 3, CAUTIOUS.force)
    with pytest.raises(UserError, match=r"collision_force: 0.0 is not allowed"):
        Collision(CAUTIOUS.torque, [0.0] * 6)


@pytest.mark.slow  # on a loaded machine the clients give up, and say so
def test_real_time_does_not_wait(client, panda):
    """At 1 kHz a client that stalls loses its motion; a machine that stalls a little does not."""
    _, make, version = client
    with Emulator(partial(Bare, panda), version=version, realtime=True, patience=400) as address:
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


@pytest.mark.slow  # in real time: on a machine with nothing else to do
@pytest.mark.parametrize("realtime", [False, True])
def test_twenty_episodes_complete(realtime, client, panda):
    """With the collision reflex at its cautious thresholds and nobody who would let the arm go on after a stop."""
    _, make, version = client
    task = ReachTask(episode_s=1.0)
    torch.manual_seed(0)
    with Emulator(partial(Twin, panda, SEED), version=version, realtime=realtime) as address:
        arm = make(panda, address, operator=lambda reason: False)
        driven = DrivenArm(arm, task, nominal_dynamics(arm.robot, **conf("friction/paper")).level)
        episodes = rollout(make_policy(panda, task, (8,)), driven, task, *fixed_episodes(panda, task, 20))
        arm.close()
    assert [str(stop) for stop in driven.stops] == []
    assert (driven.done, driven.halted) == (20, None)
    assert np.isfinite(episodes.distance).all()


def test_the_other_robot_and_nobody(client, servers, panda):
    """A wrong version, and an address where nothing answers, give one line with libfranka's reason."""
    name, make, version = client
    other = 15 - version
    for address in servers["fr3" if name == "panda" else "panda"]:
        with pytest.raises(UserError, match=rf"arm={name}: .*version:? {other}") as wrong:
            make(panda, address)
        assert "\n" not in str(wrong.value)
    with pytest.raises(UserError, match=f"arm={name}: no connection to 127.1.2.3: libfranka") as nobody:
        make(panda, "127.1.2.3")
    assert "\n" not in str(nobody.value)


@pytest.mark.parametrize(
    ("desk", "control", "there"),
    [("silent", "silent", False), ("refused", "silent", True), ("open", "silent", True), ("silent", "refused", True)],
)
def test_an_address_that_is_silent_is_said_within_seconds(desk, control, there, monkeypatch):
    """It would take libfranka a minute. Who refuses is there, also who answers at one port alone."""
    answers, waited = {franka.DESK: desk, fci.PORT: control}, []

    def create_connection(place, timeout):
        waited.append(timeout)
        if answers[place[1]] == "open":
            return SimpleNamespace(close=lambda: None)
        raise TimeoutError if answers[place[1]] == "silent" else ConnectionRefusedError

    monkeypatch.setattr(franka.socket, "create_connection", create_connection)
    if there:
        assert franka.connect(lambda: "a robot", "panda", "172.16.0.2") == "a robot"
    else:
        with pytest.raises(UserError, match=r"arm=panda: no connection to 172.16.0.2: nothing there answers"):
            franka.connect(pytest.fail, "panda", "172.16.0.2")
    assert sum(waited) < 10


@pytest.mark.parametrize("name", CLIENTS)
def test_a_missing_package_is_named(name, panda, monkeypatch):
    """Without its client package an adapter says which extra to install."""
    package, make, _ = CLIENTS[name]
    for module in (package, package.split(".")[0]):
        monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(UserError, match=rf"arm={name} needs the package .*r2s\[{name}\]"):
        make(panda, "127.0.0.1")


def alive(process):
    """Return whether a process runs; one that nobody has buried does not."""
    return process.is_running() and process.status() != psutil.STATUS_ZOMBIE


def test_the_process_dies_with_its_parent(tmp_path):
    """Even a parent that is killed leaves no server behind."""
    script = tmp_path / "parent.py"
    script.write_text(
        "import os, sys, time\n"
        "from functools import partial\n"
        "from test_emulator import Bare, Emulator, conf, load_robot\n"
        "if __name__ == '__main__':\n"
        "    emulator = Emulator(partial(Bare, load_robot(**conf('robot/panda'))), version=5)\n"
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


def test_what_the_emulator_does_not_speak(panda):
    """A wrong version, address or fault is one line; a free address is found, a taken one is said."""
    with pytest.raises(UserError, match="version 5, 10, not 7"):
        Emulator(partial(Bare, panda), version=7)
    with pytest.raises(UserError, match=r"'192.168.0.1' must be a loopback one"):
        Emulator(partial(Bare, panda), version=5, address="192.168.0.1")
    with pytest.raises(UserError, match=r"fault 'e-stop': allowed are .*; did you mean 'estop'"):
        Fault("e-stop", 3)
    with pytest.raises(UserError, match="cycle=-1"):
        Fault("late", -1)
    with listen() as one, listen() as other:
        assert one.getsockname()[0] != other.getsockname()[0]
        taken = one.getsockname()[0]
        emulator = Emulator(partial(Bare, panda), version=5, address=taken)
        with pytest.raises(UserError, match=f"port 1337 is not free on {taken}"):
            emulator.__enter__()


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (["--address", "10.0.0.1"], "emulator: address '10.0.0.1' must be a loopback one"),
        (["--fault", "drop", "soon"], "--fault drop soon: it is KIND CYCLE"),
        (["--fault", "late"], "--fault late: it is KIND CYCLE"),
        (["--robot", "no.yaml"], "--robot no.yaml: No such file"),
        (
            ["--robot", f"{ROOT}/conf/robot/fr3.yaml"],
            f"--robot {ROOT}/conf/robot/fr3.yaml: it goes on from another file",
        ),
    ],
)
def test_by_hand_a_mistake_is_one_line(arguments, line, capsys):
    """`python -m r2s.arm.emulator` says what is wrong and exits with 2."""
    with pytest.raises(SystemExit) as end:
        main(arguments)
    assert end.value.code == 2
    said = capsys.readouterr().err
    assert said.startswith(line)
    assert said.count("\n") == 1


def test_the_robots_file_of_a_config_is_one_for_an_emulator(panda):
    """What it says of tasks is left out."""
    found = load_robot(**_yaml(ROOT / "conf" / "robot" / "panda.yaml"))
    assert found.name == panda.name
    assert np.array_equal(found.q_max, panda.q_max)


def test_layout_of_the_wire():
    """Sizes and places are those that both clients were seen to accept."""
    for version, size, command, q, tau, mode in ((5, 2373, 370, 1184, 1016, 2364), (10, 1377, 371, 596, 512, 1372)):
        state = fci.STATE[version]
        assert (state.itemsize, fci.COMMAND[version].itemsize) == (size, command)
        assert [state.fields[name][1] for name in ("q", "tau_J", "robot_mode")] == [q, tau, mode]
    assert [fci.REQUESTS[5].index(name) for name in ("SetLoad", "LoadModelLibrary")] == [10, 13]
    assert [fci.REQUESTS[10].index(name) for name in ("SetLoad", "GetRobotModel")] == [9, 11]


def test_the_model_that_is_served_is_the_arm(panda):
    """The URDF that a client of version 10 gets has the arm's kinematics and inertia."""
    served = mujoco.MjModel.from_xml_string(fci.urdf(panda))
    ours = panda.model(gravity=True)
    rng = np.random.default_rng(0)
    for _ in range(5):
        q = rng.uniform(panda.q_min, panda.q_max)
        mass, gravity = [], []
        for model in (served, ours):
            data = mujoco.MjData(model)
            data.qpos[:] = q
            mujoco.mj_forward(model, data)
            full = np.empty((7, 7))
            mujoco.mj_fullM(model, data, full)
            mass.append(full - np.diag(model.dof_armature))
            gravity.append(data.qfrc_bias.copy())
        assert np.abs(mass[0] - mass[1]).max() < 1e-9
        assert np.abs(gravity[0] - gravity[1]).max() < 1e-9


def begun(robot, version=5):
    """Return a Control in its first motion, and its arm."""
    arm = Bare(robot)
    control = Control(arm, version)
    control.begin()
    control.first_answer()
    return control, arm


def near_limit(robot, room):
    """Return a robot that starts `room` rad before the upper limit of its last joint."""
    return replace(robot, q_home=np.array([0, 0, 0, -2, 0, 1, robot.q_max[6] - room]))


@pytest.mark.parametrize(
    ("place", "torque"),
    [
        (fci.TORQUE_DISCONTINUITY, lambda k: 1.4),
        (fci.TORQUE_RANGE, lambda k: 0.9 * k),
        (fci.JOINT_VELOCITY, lambda k: -0.5),
        (fci.JOINT_POSITION_LIMITS, lambda k: 0.02),
    ],
)
def test_reflexes_have_libfrankas_names(place, torque, panda):
    """Whichever of its limits an arm names, the error has the place that libfranka gives it; and can be cleared."""
    control, _ = begun(replace(near_limit(panda, 0.005), tau_max=np.full(7, 1.5)))
    for k in range(200):
        if control.running:
            control.cycle(torque(k) * np.eye(7)[6])
    assert np.flatnonzero(control.state["errors"]).tolist() == [place]
    assert np.flatnonzero(control.state["reflex_reason"]).tolist() == [place]
    assert control.state["robot_mode"] == fci.REFLEX
    assert not control.can_move
    assert control.recover()
    assert control.can_move
    assert not control.state["errors"].any()


def test_an_fr3_brakes_before_its_limits(panda):
    """Version 10 refuses a speed near a position limit of an FR3 that version 5 takes."""
    wide = replace(panda, q_max=panda.q_max + 0.2)
    for version, goes_on in ((5, True), (10, False)):
        control, _ = begun(near_limit(wide, wide.q_max[6] - fci.FR3_Q_MAX[6] + 0.02), version)
        for _ in range(50):
            if control.running:
                control.cycle(0.05 * np.eye(7)[6])
        assert control.running == goes_on
    assert np.flatnonzero(control.state["errors"]).tolist() == [fci.JOINT_VELOCITY]


def test_an_fr3_has_limits_of_its_own(panda):
    """Where a Panda's sixth joint may go, at 0.2 rad, version 10 stops; cleared, the arm is back inside."""
    low = replace(panda, q_home=np.array([0, 0, 0, -2, 0, 0.2, 0]))
    for version, goes_on in ((5, True), (10, False)):
        control, arm = begun(low, version)
        control.cycle(np.zeros(7))
        assert control.running == goes_on
    assert np.flatnonzero(control.state["errors"]).tolist() == [fci.JOINT_POSITION_LIMITS]
    assert "an FR3 allows 0.4398 to 4.6216" in control.stopped_by
    assert control.recover()
    assert arm.read().q[5] > fci.FR3_Q_MIN[5]


def test_a_missed_answer_repeats_the_last_torque(panda):
    """19 in a row are borne with the last torque, the 20th ends the motion."""
    control, arm = begun(panda)
    control.cycle(np.full(7, 0.5))
    for _ in range(19):
        control.cycle(None)
    assert control.running
    assert np.array_equal(arm.commands, np.full((20, 7), 0.5))
    control.cycle(np.full(7, 0.6))
    for _ in range(20):
        control.cycle(None)
    assert not control.running
    assert "20 cycles in a row" in control.stopped_by
