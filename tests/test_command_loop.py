"""Every command passes a driver; a held link meets a bounded force; a stop needs an operator's consent."""

import ast
import re
import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import ROOT, conf

from r2s.arm import driver as law
from r2s.arm.clients import fci
from r2s.arm.clients.collision_thresholds import CAUTIOUS
from r2s.arm.clients.consent import CONSENT, operator_agrees
from r2s.arm.clients.franka import ACCELERATION, TORQUE_SHARE, Franka
from r2s.arm.command_loop import SLIDING, CommandLoop
from r2s.arm.driver import ADDED, Driver
from r2s.arm.emulator.control import HOLD
from r2s.arm.interface import ArmStopped, NotCleared, StopRequested, signal_sizes
from r2s.arm.policy_runner import PolicyRunner
from r2s.arm.ramp import BRAKE_SHARE, MAX_SHARE, poses_about, ramp
from r2s.arm.recorder import record
from r2s.arm.simulated import SimulatedArm
from r2s.arm.stop_request import handled_signals, watched
from r2s.arm.tracking_controller import CORRECTION_SHARE, MAX_DEVIATION, TrackingController
from r2s.errors import UserError
from r2s.excitation.deviation import DeviationLimits
from r2s.excitation.minimum_jerk import minimum_jerk
from r2s.excitation.motion import Excitation
from r2s.excitation.motion_checks import Space
from r2s.excitation.paths import path_violation
from r2s.learning.evaluate import fixed_episodes
from r2s.learning.policy import make_policy
from r2s.physics.dynamics import nominal_dynamics
from r2s.physics.payload import LoadTorque, mass_and_moment, payload_of
from r2s.physics.rigid_body import InverseInertia
from r2s.physics.robot import SIM_DT, load_robot
from r2s.tasks.reach import ReachTask
from r2s.tasks.rollout import rollout

PANDA = load_robot(**conf("robot/panda"))
LEVEL = nominal_dynamics(PANDA, **conf("friction/paper")).level
LOW = np.array([0.0, 1.2, 0, -1.9, 0, 2.2, 0.8])  # hand at far reach, close to the table
TASK = ReachTask(**{k: tuple(v) if isinstance(v, list) else v for k, v in conf("task/reach").items()})


class LoggedArm(SimulatedArm):
    """An arm that keeps its commands; an obstacle may hold its first link from `hold_from` s on."""

    def __init__(self, hold_from=None):
        friction = nominal_dynamics(PANDA, **conf("friction/paper"))
        self.commands, self.pushes, self.held, self._hold_from = [], [], [], hold_from
        super().__init__(PANDA, replace(friction, delay=4e-3, lag=1e-3), position_noise=2e-5, velocity_noise=3e-3)

    def move_to(self, q):
        """Begin a motion."""
        self._at, self._since, self.over, self.external = None, 0, False, np.zeros(7)
        return super().move_to(q)

    def stop(self):
        """End it."""
        self.over = True
        super().stop()

    def command(self, tau):
        """Take a command, against what holds the link."""
        assert not self.over, "a command after a stop"
        q, dq = self._sim.q[0, 0], self._sim.dq[0, 0]
        if self._hold_from is not None and self.read().t >= self._hold_from:
            self._at = q if self._at is None else self._at
            self._since += 1
            self.external = (HOLD[0] * (self._at - q) - HOLD[1] * dq) * np.eye(7)[0]
        self.commands.append(np.array(tau))
        self.pushes.append(self.external[0])
        self.held.append(self._since)
        super().command(tau)


def motion(seconds=2.0, angle=0.5):
    """Return a minimum-jerk motion, largest in the first joint."""
    t = SIM_DT * np.arange(round(seconds / SIM_DT) + 1)
    end = PANDA.q_home + angle * np.array([1.0, 0.3, 0.2, 0.3, 0.2, 0.3, 0.4])
    return Excitation(t, *minimum_jerk(PANDA.q_home, end, seconds, t[:, None]))


def calls(name):
    """Return the calls of a method of this name in the modules that import r2s.arm, as file:receiver."""
    for path in sorted((ROOT / "r2s").rglob("*.py")):
        text = path.read_text()
        for node in ast.walk(ast.parse(text)) if f".{name}(" in text and "r2s.arm" in text else ():
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr == name:
                yield f"{path.relative_to(ROOT / 'r2s')}:{ast.unparse(node.func.value)}"


def test_one_module_commands_arms():
    """Only the emulator, which is the robot, commands its own arm too; others check reflexes or ask a controller."""
    others = "reflexes", ":control"
    found = {c for c in calls("command") if not c.endswith(others) and not c.startswith("arm/emulator/")}
    assert found == {"arm/command_loop.py:self.arm"}
    assert set(calls("exchange")) == {"arm/clients/franka.py:self._client"}  # called by `_send`, and that ...
    # ... by `Franka.command` only
    assert (ROOT / "r2s/arm/clients/franka.py").read_text().count("self._send(") == 1


def test_every_command_comes_from_a_driver(monkeypatch):
    """In recordings, ramps and episodes the arm receives exactly the drivers' torques, in their order."""
    computed = []
    compute = law.DriverBatch.__call__

    def noted(self, q, dq, tau_J_d, target, *more):
        out = compute(self, q, dq, tau_J_d, target, *more)
        computed.append(out[0].copy())
        return out

    monkeypatch.setattr(law.DriverBatch, "__call__", noted)
    task = replace(TASK, episode_s=0.1)
    episodes = fixed_episodes(PANDA, task, 1)

    def reach(arm):
        rollout(make_policy(PANDA, task, (8,)), PolicyRunner(arm, task, LEVEL), task, *episodes)

    for move in (
        lambda arm: record(arm, motion(0.4, 0.05)),
        lambda arm: ramp(arm, poses_about(PANDA, 1), rate=60.0, largest=0.5),
        reach,
    ):
        arm = LoggedArm()
        computed.clear()
        move(arm)
        mine = [tau for tau in computed if tau.any()]  # a new driver computes once to compile
        assert len(mine) > 50
        np.testing.assert_array_equal([tau for tau in arm.commands if tau.any()], mine)


def test_a_held_recording_is_bounded():
    """A recording pushes with at most its plan and CORRECTION_SHARE, plus what brakes the link; then it gives up."""
    plan, arm = motion(2.0, 0.8), LoggedArm(hold_from=0.7)
    allowed = DeviationLimits.along(Space(PANDA), plan, MAX_DEVIATION)
    with pytest.raises(ArmStopped, match=r"joint 1 is 0.\d+ rad off its path, allowed") as stopped:
        record(arm, plan)
    feedforward = TrackingController(PANDA, plan)._feedforward[:, 0]
    most = np.abs(feedforward).max() + CORRECTION_SHARE * PANDA.tau_max[0]
    assert np.abs(arm.commands).max(0)[0] <= most
    caught = round(0.7 / SIM_DT)
    settled = np.abs(arm.pushes[caught + 150 :])  # after the moving link has been caught
    assert settled.max() <= most
    assert np.abs(arm.commands[-1]).max() < 1.0
    assert len(stopped.value.recording.t) > caught  # the rows so far are kept
    end = len(stopped.value.recording.t)
    off = np.abs(plan.q[end] - arm.read().q) + 1e-3
    assert allowed.share(end, off).sum(1).max() >= 1


def test_a_requested_stop_keeps_its_reason():
    """An arm that brakes on request leaves its plan by more than is allowed; the request stays the reason."""
    plan, arm = motion(1.2, 0.8), LoggedArm()
    request = watched(lambda: "a request" if arm.read().t >= 0.6 else None)
    with handled_signals(), request, pytest.raises(StopRequested, match=r"^a request$"):
        record(arm, plan)
    assert np.abs(arm.read().q - plan.q[round(arm.read().t / SIM_DT)]).max() > MAX_DEVIATION
    assert np.abs(arm.read().dq).max() < SLIDING  # at rest, against what its friction and its load need
    assert (np.abs(arm.commands[-1]) < 0.05 * PANDA.tau_max).all()


def test_the_adaptive_estimate_is_bounded():
    """The estimate of a joint that is held off its plan stays within plausible friction and offset."""
    plan, arm = motion(4.0, 0.8), LoggedArm()
    tracker, state = TrackingController(PANDA, plan, DeviationLimits.uniform(7, np.inf)), arm.read()
    for k in range(len(plan.t)):
        target = tracker(k, state)
    assert (np.abs(tracker._theta) <= tracker._theta_max).all()
    assert tracker._theta[0, 0] == pytest.approx(8.7)
    assert (np.abs(target - tracker._feedforward[-1]) <= CORRECTION_SHARE * PANDA.tau_max + 1e-9).all()


def test_a_held_ramp_is_bounded():
    """A ramp gives up at `largest`; the stop after it stays within its share of tau_max."""
    arm = LoggedArm(hold_from=0.0)
    ramps = ramp(arm, poses_about(PANDA, 1), rate=60.0)
    assert len(ramps.joint) == 14
    most = (MAX_SHARE + BRAKE_SHARE) * PANDA.tau_max + 1e-6
    assert (np.abs(arm.commands).max(0) <= most).all()


def test_no_command_follows_a_stop():
    """An ended motion sends nothing until the next one begins."""
    arm = LoggedArm()
    driven = CommandLoop(arm, Driver(PANDA, PANDA.tau_max, LEVEL))
    driven.place(PANDA.q_home)
    with pytest.raises(ArmStopped, match="no finite action"):
        without_commands(driven)
    count = len(arm.commands)
    for _ in range(3):
        with pytest.raises(ArmStopped, match="the motion is over"):
            driven(np.zeros(7))
    assert len(arm.commands) == count
    driven.place(PANDA.q_home)
    driven(np.zeros(7))
    assert len(arm.commands) == count + 1


def without_commands(driven):
    """Send no finite command for a second."""
    for _ in range(1000):
        driven(np.full(7, np.nan))


class OperatedArm(LoggedArm):
    """An arm with an operator that stops itself in the fifth cycle of a motion."""

    def __init__(self, answers):
        self.blocked, self.questions, self._answers = None, [], iter(answers)
        super().__init__()

    def operator(self, reason):
        """Return the next answer."""
        self.questions.append(reason)
        return next(self._answers)

    def move_to(self, q):
        """Ask the operator after a stop."""
        if self.blocked is not None and not self.operator(self.blocked):
            raise NotCleared(self.blocked)
        self.blocked, self._begun = None, len(self.commands)
        return super().move_to(q)

    def command(self, tau):
        """Stop in the fifth cycle."""
        if len(self.commands) == self._begun + 5:
            self.blocked = "the stop button was pressed"
            raise ArmStopped(self.blocked)
        super().command(tau)


class Button:
    """A client of an arm at home whose stop button is pressed during a motion and released."""

    def __init__(self):
        self.sent, self.cycle = [], 0

    def idle(self):
        """Return the state of an idle arm."""
        zeros, seconds = np.zeros(7), SIM_DT * self.cycle
        time = SimpleNamespace(to_sec=lambda: seconds)
        known = {name: np.zeros(size) for name, size in signal_sizes(7).items()}
        joints = {"q": PANDA.q_home, "dq": zeros, "tau_J": zeros, "tau_J_d": zeros}
        return SimpleNamespace(robot_mode=fci.IDLE, **joints, **known, time=time)

    start = idle

    def exchange(self, tau):
        """Accept ten commands."""
        self.cycle += 1
        if len(self.sent) == 10:
            raise ArmStopped("user stop")
        self.sent.append(tau)
        return self.idle()

    def set_collision_thresholds(self, collision):
        """Store the thresholds."""
        self.collision = collision

    def finish(self):
        """End a motion."""


@pytest.mark.parametrize("there", [True, False])
def test_a_released_stop_button_still_needs_consent(there):
    """The arm is idle again; without an operator's consent it receives no command."""
    client, questions = Button(), []
    arm = Franka(
        PANDA, client, operator=(lambda reason: questions.append(reason) or len(questions) > 1) if there else None
    )
    arm.move_to(PANDA.q_home)
    assert client.collision == CAUTIOUS
    with pytest.raises(ArmStopped, match="user stop"):
        record(arm, motion(0.4, 0.05))
    for _ in range(1 + (not there)):
        with pytest.raises(NotCleared, match="no operator agreed that it may move: user stop"):
            arm.move_to(PANDA.q_home)
    if there:
        arm.move_to(PANDA.q_home)
    assert len(questions) == 2 * there
    assert len(client.sent) == 10


def test_move_to_avoids_obstacles(monkeypatch):
    """If the straight path would collide, `move_to` moves joint by joint; without any path nothing moves."""
    client, places = Button(), []
    arm = Franka(PANDA, client)
    monkeypatch.setattr(Franka, "_follow", lambda self, q: places.append(q))
    folded = np.array([-1.1, 1.5, 1.1, -2.6, 0, 2.1, 0.8])
    arm.move_to(folded)
    assert len(places) == 6
    np.testing.assert_array_equal(places[-1], folded)
    assert path_violation(PANDA, np.array([PANDA.q_home, *places]), Space(PANDA)) == ""
    with pytest.raises(ArmStopped, match=r"the path of move_to: the end effector is 0.0.* guide the arm by hand"):
        arm.move_to(LOW)
    assert len(places) == 6
    assert client.sent == []


def test_a_colliding_motion_does_not_begin():
    """A recording or a ramp pose too close to the table is refused before anything moves."""
    t = SIM_DT * np.arange(2001)
    down = Excitation(t, *minimum_jerk(PANDA.q_home, LOW, 2.0, t[:, None]))
    for move in (lambda arm: record(arm, down), lambda arm: ramp(arm, [PANDA.q_home, LOW])):
        arm = LoggedArm()
        with pytest.raises(UserError, match=r"(excitation|pose 2): the end effector is 0\.0\d+ m above the base"):
            move(arm)
        assert arm.commands == []


@pytest.mark.parametrize(("answers", "done"), [([False], 1), ([True, False], 2), ([True, True], 3)])
def test_episodes_need_the_operators_consent(answers, done):
    """Each stop needs one consent; episodes after a refusal are not counted."""
    task, arm = replace(TASK, episode_s=0.1), OperatedArm(answers)
    driven = PolicyRunner(arm, task, LEVEL)
    rollout(make_policy(PANDA, task, (8,)), driven, task, *fixed_episodes(PANDA, task, 3))
    assert driven.done == done
    assert len(driven.stops) == done
    assert len(arm.questions) == len(answers)
    assert len(arm.commands) == 5 * done
    assert (driven.halted is None) == answers[-1]


def test_consent_needs_a_terminal(monkeypatch):
    """Only the exact words count, typed at a terminal after the question."""
    assert not operator_agrees("a test")

    class Terminal:
        def isatty(self):
            return True

    monkeypatch.setattr(sys, "stdin", Terminal())
    monkeypatch.setattr("r2s.arm.clients.consent.termios.tcflush", lambda *_: None)
    for typed, agrees in (("", False), ("y", False), ("yes", False), (CONSENT, True), (f" {CONSENT} ", True)):
        monkeypatch.setattr("builtins.input", lambda *_, typed=typed: typed)
        assert operator_agrees("a test") == agrees


class Wire:
    """A client of a `LoggedArm` without a network: the part of libfranka that `Franka` needs."""

    def __init__(self, arm):
        self._arm, self._zero = arm, 0
        self.set_collision_thresholds = self.recover = lambda *_: None

    def idle(self):
        """Return the arm's state."""
        s = self._arm.read()
        time = SimpleNamespace(to_sec=lambda: s.t)
        return SimpleNamespace(
            robot_mode=fci.IDLE, q=s.q, dq=s.dq, tau_J=s.tau_J, tau_J_d=s.tau_J_d, time=time, last_motion_errors="",
            **{name: np.zeros(size) for name, size in signal_sizes(7).items()},
        )  # fmt: skip

    def start(self):
        """Begin a motion where the arm is."""
        self._arm.over = False
        return self.idle()

    def exchange(self, tau):
        """Take a command."""
        self._arm.command(tau)
        return self.idle()

    def finish(self):
        """End the motion."""
        self._arm.stop()


def test_a_stop_keeps_a_heavy_compensated_load():
    """An adapter compensates an undeclared payload of 3 kg in slow motion: the stop ends near where it began."""
    q = np.array([0.0, 0.9, 0, -0.9, 0, 1.8, 0.785])
    payload = payload_of(3.0, PANDA.payload_max)
    dynamics = nominal_dynamics(PANDA, **conf("friction/paper"))
    twin = SimulatedArm(PANDA, dynamics, position_noise=0.0, velocity_noise=0.0, payload=payload)
    twin.move_to(q)
    wire, ends = Wire(twin), []
    finish, wire.finish = wire.finish, lambda: (ends.append(twin.read()), finish())
    arm = Franka(PANDA, wire)
    arm.move_to(q)
    load = LoadTorque(PANDA)(q, mass_and_moment(PANDA, payload))
    hold = np.clip(load, -ADDED * PANDA.tau_max, ADDED * PANDA.tau_max)
    assert np.abs(hold / PANDA.tau_max).max() > TORQUE_SHARE
    falling = hold - 1.2 * np.eye(7)[1]  # Nm
    for k in range(1, 61):  # the rest of the load is supported until the command has reached `falling`
        twin.external = (k / 60 - 1) * falling
        arm.command(k / 60 * falling)
    twin.external = np.zeros(7)
    for _ in range(20):
        arm.command(falling)
    before = arm.read()
    assert np.abs(before.dq).max() > 0.05
    arm.hold, speeds, send = hold, [], twin.command
    twin.command = lambda tau: (send(tau), speeds.append(twin.read().dq))
    arm.stop()
    assert np.abs(speeds)[:, 1].max() < 1.2 * np.abs(before.dq[1])  # the load does not drop when the stop begins
    assert np.abs(ends[0].dq).max() < SLIDING
    assert np.abs(ends[0].q - before.q).max() < 0.03


def hostile(cycles, seed):
    """Run recordings, ramps, `move_to` and episodes with held links and stalling policies.

    Return cycles and largest push of each kind over its bound in docs/explanation/safety.md, and the stops' reasons.
    """
    rng, reasons = np.random.default_rng(seed), []
    counted = dict.fromkeys(("record", "ramp", "move_to", "episode"), 0)
    share = dict.fromkeys(counted, 0.0)
    while sum(counted.values()) < cycles:
        arm = LoggedArm(hold_from=rng.choice([None, rng.uniform(0, 1.5)], p=[0.4, 0.6]))
        kind, most = min(counted, key=counted.__getitem__), (MAX_SHARE + BRAKE_SHARE) * PANDA.tau_max[0]
        try:
            if kind == "record":
                plan = motion(rng.uniform(0.6, 2.0), rng.uniform(-0.5, 0.5))
                tracker = TrackingController(PANDA, plan)
                most = np.abs(tracker._feedforward[:, 0]).max() + CORRECTION_SHARE * PANDA.tau_max[0]
                added = CORRECTION_SHARE * PANDA.tau_max * np.diagonal(np.linalg.inv(tracker._mass), 0, 1, 2).max(0)
                most += swung(tracker._mass, np.abs(plan.ddq).max(0) + added)  # which tracking may accelerate, too
                record(arm, plan)
            elif kind == "ramp":
                ramp(arm, poses_about(PANDA, 1), rate=rng.uniform(2, 60))
            elif kind == "move_to":
                end = PANDA.q_home + rng.uniform(-0.4, 0.4, 7)
                mass = np.linalg.inv(InverseInertia(PANDA, 2)(np.array([PANDA.q_home, end])))
                most = TORQUE_SHARE * PANDA.tau_max[0] + swung(mass, ACCELERATION * PANDA.ddq_max)
                Franka(PANDA, Wire(arm)).move_to(end)
            else:
                most = TASK.torque_limit(PANDA)[0]
                spoiled(arm, rng)
        except ArmStopped as stop:
            reasons.append(str(stop))
        counted[kind] += len(arm.commands)
        caught = np.array(arm.held) > 150  # the link that moved has been stopped
        share[kind] = max(share[kind], np.abs(np.array(arm.pushes)[caught]).max(initial=0.0) / most)
    return counted, share, reasons


def swung(mass, ddq):
    """Return the largest torque, Nm, of the other joints' ddq (7,) on the first one; mass (k, 7, 7) kg m^2."""
    return (np.abs(mass[:, 0, 1:]) @ ddq[1:]).max()


def spoiled(arm, rng):
    """Run a policy that sends no command for up to 500 ms, and excessive or non-finite ones."""
    driven, until = CommandLoop(arm, Driver(PANDA, TASK.torque_limit(PANDA), LEVEL)), 0
    driven.place(PANDA.q_home)
    try:
        for k in range(1500):
            if k == until:
                kind = rng.choice(5)
                until += rng.choice([30, 60, 500]) if kind == 0 else 40
            noise = rng.normal(size=7) * PANDA.tau_max
            driven([None, noise, np.full(7, np.nan), 1e9 * noise, 0.1 * noise][kind] if k % 20 == 0 else None)
    finally:
        driven.end()


@pytest.mark.slow
def test_hostile_motions_stay_within_all_bounds():
    """200,000 cycles: no reflex, no command after a stop, bounded force on a held link."""
    counted, share, reasons = hostile(200_000, seed=1)
    print(counted, share, len(reasons), "stops")
    assert sum(counted.values()) >= 200_000
    assert min(counted.values()) > 10_000
    assert len(reasons) > 10
    assert [r for r in reasons if re.search(r"commanded torque|: position|: velocity|after a stop", r)] == []
    assert max(share[kind] for kind in ("record", "ramp", "move_to")) <= 1.0
