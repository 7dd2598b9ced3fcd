"""Stops in contact: hold, release and retreat do what they say, within the bound of the force, on every arm."""

import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import ROOT, conf
from omegaconf import OmegaConf
from test_command_loop import Button
from test_press import PANDA, TASK_CONF, TRUE, N, make_task
from test_push_limit import LIMIT, POINT, UP

from r2s.arm.clients.collision_thresholds import CAUTIOUS, CollisionThresholds, thresholds_of
from r2s.arm.clients.franka import Franka
from r2s.arm.driver import DriverBatch
from r2s.arm.emulator.control import Control
from r2s.arm.policy_runner import PolicyRunner
from r2s.arm.presses import press_plan
from r2s.arm.twins.make_twin import make_twin
from r2s.arm.warm_up import warm_up
from r2s.errors import UserError
from r2s.physics.contact_stop import LEAVES_S, RELEASED, RETREAT_M, SLIDES
from r2s.physics.push_limit import LEAVE, STOPS, PushLimit
from r2s.physics.simulator import Simulator
from r2s.physics.surface import Surface
from r2s.physics.tip import Tip
from r2s.stages.build import _arm_settings
from r2s.tasks.press import PressTask

sys.path.insert(0, str(ROOT / "benchmarks"))
from push_limit import hostile

TIP, M = Tip(PANDA), 8
K = np.geomspace(2e3, 1e5, M)
PUSH = 25.0  # N
KINDS = pytest.mark.parametrize("stop", STOPS)


def heights(q):
    return np.array([UP @ (TIP(row)[0] - POINT) - PANDA.tool.radius for row in q])


def stopped(stop):
    """Press arms on surfaces of K, stop them after 1.2 s, and go on for as long as a driver may take, and 0.5 s.

    Return (k, M) forces N and heights m from the stop on, (M,) cycles until the driver was done, and the last driver.
    """
    surface = Surface(POINT + np.zeros((M, 1)), UP + np.zeros((M, 1)), K, 1.25, 0.5, 0.3, 1e-4)
    sim = Simulator(PANDA, replace(TRUE, surface=surface, delay=4e-3), M, 1)
    torque = 0.3 * PANDA.tau_max
    driver = DriverBatch(PANDA, torque, M, friction=TRUE.level, push_limit=replace(LIMIT, force_max=40.0, stop=stop))
    starts = PressTask(**TASK_CONF).goals(PANDA, np.random.default_rng(0), M)[:, 9:]
    sim.reset(starts, np.zeros((M, N)))
    inwards = -np.array([UP @ TIP(q)[1] for q in starts])
    rows, sent, going = [], np.zeros((M, N)), np.zeros(M)
    for cycle in range(2200):
        stiff = 400.0 * PANDA.tau_max / PANDA.tau_max.max()
        # across the normal the start posture holds; along it the push acts against viscosity
        away = starts - sim.q
        away -= (away * inwards).sum(1, keepdims=True) * inwards / (inwards**2).sum(1, keepdims=True)
        rate = (inwards * sim.dq).sum(1, keepdims=True)
        command = (min(1.0, cycle / 300) * PUSH - 150.0 * rate) * inwards + stiff * away
        if cycle == 1200:
            driver.stop("a test")
        sent = driver(sim.q.copy(), sim.dq.copy(), sent, None if cycle >= 1200 else command)
        sim.rollout(sent[:, None], record=())
        if cycle >= 1200:
            rows.append([sim.contact_force @ UP, heights(sim.q)])
            going += ~driver.done
    force, height = np.moveaxis(np.array(rows), 1, 0)
    return force, height, going, driver


@pytest.fixture(scope="module")
def results():
    return {stop: stopped(stop) for stop in STOPS}


@KINDS
def test_a_stop_in_contact_does_what_it_says(stop, results):
    """Hold keeps the force but for what friction hides; the others end without force, that close to the surface."""
    force, height, going, driver = results[stop]
    hidden = LIMIT.at(PANDA, TRUE.level, PANDA.q_home)[1]
    assert (force[0] > 0.5 * PUSH).all()
    assert (force <= force[0] + 1.0).all()  # the tip was at rest: nothing adds to the force
    assert (going < 500).all()
    if stop == "hold":
        assert (np.abs(force - force[0]) < hidden).all()
        pressing = (driver.held * -np.array([UP @ TIP(PANDA.q_home)[1]])).sum(1)
        assert (pressing > 0).all()  # what the arm keeps when the driver hands it over
        return
    assert (force[-1] <= RELEASED).all()
    above, farthest = height[-1], LEAVE * LEAVES_S
    assert (above > (0.5 * RETREAT_M if stop == "retreat" else -1e-3)).all()
    assert (above < (RETREAT_M if stop == "retreat" else 0.0) + farthest).all()


def test_they_are_over_in_this_order(results):
    """A stop that holds moves nothing, one that retreats farther than one that releases."""
    travel = [(results[stop][1][-1] - results[stop][1][0]).mean() for stop in ("hold", "release", "retreat")]
    assert abs(travel[0]) < 1e-3
    assert travel[0] < travel[1] < travel[2] - 0.5 * RETREAT_M


@pytest.mark.slow
@KINDS
def test_no_stop_amid_hostile_torques_exceeds_the_bound(stop):
    """Silence at random times of hostile presses, 4 ms late, during the stop and after it."""
    limit = replace(LIMIT, stop=stop)
    force, bound, _, touched = hostile(PANDA, TRUE, limit, 1, 64, delay=4, cycles=3000, stops=True).T
    assert (force < bound).all()
    assert (touched > 100).mean() > 0.1


@pytest.mark.long
@pytest.mark.parametrize("variant", ["rigid", pytest.param("elastic", marks=pytest.mark.slow)])
@KINDS
def test_on_a_twin_an_episode_that_stops_or_ends_leaves_as_decided(stop, variant):
    """First an episode whose policy falls silent in contact, then one that ends there."""
    task = replace(make_task(), episode_s=4.5, stop=stop).pushing_within(PANDA, TRUE.level, 45.0, 0.03)
    twin = make_twin(PANDA, variant=variant, seed=0, surface=True)
    runner, rest = PolicyRunner(twin, task, TRUE.level), np.zeros((1, task.control(PANDA).action_dim))
    goals = task.goals(PANDA, np.random.default_rng(1), 1)
    for silent in (True, False):
        state = runner.place(task.begin(PANDA.q_home[None], goals), 0)
        before = 0.0
        for k in range(300):
            command = task.control(PANDA).command(rest, task, state.t, goals)
            state = runner.step(np.full_like(command, np.nan) if silent and k > 250 else command)
            before = np.linalg.norm(state.force) if k <= 250 or not silent else before
            if state.stopped.all():
                break
        assert runner.end()[0] == silent
        after = np.linalg.norm(runner.read()[0].O_F_ext_hat_K[:3])
        hidden = task.push_limit.at(PANDA, TRUE.level, runner.read()[0].q)[1]
        assert before > 2.0
        if stop == "hold":
            assert abs(after - before) < hidden
        else:
            assert after <= (0.0 if stop == "retreat" else RELEASED + (1.0 - SLIDES) * hidden)


def test_a_wrong_decision_is_one_line():
    with pytest.raises(UserError, match=r"^task.stop: 'relese'; allowed: hold, release, retreat; did you mean 'rel"):
        replace(make_task(), stop="relese").pushing_within(PANDA, TRUE.level, 45.0, 0.03)


def test_the_reflexes_of_an_arm_follow_the_force_of_its_task():
    """What the client sets: above what the limit allows, at tip and joints, cautious without one, or as typed."""
    limit = PushLimit(45.0, 0.03, POINT, UP)
    given = {"arm": conf("arm/panda") | {"address": "arm"}}
    settings = _arm_settings(OmegaConf.create(given), PANDA, SimpleNamespace(push_limit=limit))
    client = Button()
    thresholds = CollisionThresholds(settings["collision_torque"], settings["collision_force"])
    Franka(PANDA, client, operator=None, collision=thresholds).move_to(PANDA.q_home)  # type: ignore[arg-type]
    q = TIP.posture(POINT + PANDA.tool.radius * UP)
    most = limit.bound(PANDA, q, 1e5)
    assert most > limit.force_max
    assert (np.array(client.collision.force[:3]) > most).all()
    assert (np.array(client.collision.torque) > most * np.abs(UP @ TIP(q)[1])).all()
    for x, low in ((client.collision.torque, CAUTIOUS.torque), (client.collision.force, CAUTIOUS.force)):
        assert (np.array(x) >= low).all()
        assert (np.array(x) < 100.0).all()  # where libfranka's examples switch the reflexes off
    for task in (None, SimpleNamespace(push_limit=None)):
        free = _arm_settings(OmegaConf.create(given), PANDA, task)
        assert (free["collision_torque"], free["collision_force"]) == (CAUTIOUS.torque, CAUTIOUS.force)
    given["arm"]["collision_force"] = [30.0] * 6
    typed = _arm_settings(OmegaConf.create(given), PANDA, SimpleNamespace(push_limit=limit))
    assert typed["collision_force"] == [30.0] * 6
    assert typed["collision_torque"] == thresholds.torque
    with pytest.raises(
        UserError, match=r"^safety.force_max: 80 N, with safety.speed_near of 0.05 m/s, allows 1\d\d N"
    ):
        thresholds_of(PANDA, PushLimit(80.0, 0.05, POINT, UP))


def test_the_reflexes_allow_the_force_that_a_task_on_a_surface_requests():
    """Without safety.force_max too: pressing, wiping and data.presses stay below the thresholds, with what errs."""
    arm = conf("arm/panda") | {"address": "arm"}
    for task in (make_task(), press_plan(PANDA, TRUE)):
        own = _arm_settings(OmegaConf.create({"arm": arm}), PANDA, task)
        limit = PushLimit(task.force[1], 0.02, *task.plane(PANDA))
        most = task.force[1] + 2 * limit.at(PANDA, TRUE.level, PANDA.q_home)[1]
        assert (np.array(own["collision_force"][:3]) > most).all()
        lever = np.abs([UP @ TIP(goal[9 : 9 + N])[1] for goal in task.goals(PANDA, np.random.default_rng(0), 3)])
        assert (np.array(own["collision_torque"]) > task.force[1] * lever).all()
        assert max(*own["collision_torque"], *own["collision_force"]) < 100.0
        typed = _arm_settings(OmegaConf.create({"arm": arm | {"collision_force": [30.0] * 6}}), PANDA, task)
        assert typed["collision_force"] == [30.0] * 6
    with pytest.raises(UserError, match=r"^task.force: 20 N, at a task.approach_speed of 0.3 m/s, allows 2\d\d N"):
        _arm_settings(OmegaConf.create({"arm": arm}), PANDA, make_task(approach_speed=0.3))


@pytest.mark.long
def test_the_emulated_box_holds_an_arm_that_presses():
    """Where it presses it stays, and elsewhere inside the surface nothing can be placed."""
    task = make_task()
    start = task.goals(PANDA, np.random.default_rng(1), 1)[0]
    surface = {"point": POINT.tolist(), "normal": UP.tolist()}
    box = Control(make_twin(replace(PANDA, q_home=start[9:]), seed=0, surface=surface), 5)
    box.begin()
    box.first_answer()
    inwards, tau = -UP @ TIP(start[9:])[1], np.zeros(N)
    for _ in range(1500):
        state = box._arm.read()
        wanted = 15.0 * inwards - 2.0 * state.dq
        tau = tau + np.clip(wanted - tau, -0.9, 0.9)
        box.cycle(tau)
    assert box.running
    force = np.linalg.norm(box._arm.read().O_F_ext_hat_K[:3])
    assert force > 5.0
    box.end()
    assert not box.running
    box.begin()
    box.first_answer()
    box.cycle(np.zeros(N))
    assert box.running


def test_a_task_that_presses_is_warmed_up():
    """Its controller takes more numbers than an arm has joints, and no torques."""
    task = make_task().pushing_within(PANDA, TRUE.level, 45.0, 0.03)
    assert task.control(PANDA).command_size > N
    warm_up(PANDA, task)
