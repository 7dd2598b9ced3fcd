"""The limit of pushes: its kinematics, equal in training and driver, and no hostile torque presses harder."""

import sys
from dataclasses import replace

import mujoco
import numpy as np
import pytest
from conftest import ROOT
from test_press import FRICTIONLESS, PANDA, TRUE, N, make_draw, make_task, pressed

from r2s.arm.driver import DriverBatch
from r2s.errors import UserError
from r2s.physics.push_limit import OVERSHOOT, SPEED_NEAR, PushLimit, push_limit, tip_motion
from r2s.physics.safety_filter import filter_limits
from r2s.physics.simulator import Simulator
from r2s.physics.surface import Surface
from r2s.physics.tip import Tip

sys.path.insert(0, str(ROOT / "benchmarks"))
from push_limit import hostile

TASK = make_task()
POINT, UP = TASK.plane(PANDA)
TORQUE = 0.3 * PANDA.tau_max
LIMIT = PushLimit(30.0, 0.03, POINT, UP, place=5e-3, tilt=np.radians(5.0))


def kinematics(q):
    """Return position and rotation of the last link, and anchors and axes of the joints."""
    model = PANDA.model(gravity=False)
    data = mujoco.MjData(model)
    data.qpos = q
    mujoco.mj_kinematics(model, data)
    last = model.jnt_bodyid[-1]
    return data.xpos[last], data.xmat[last], data.xanchor, data.xaxis


def test_the_motion_of_the_tip_is_that_of_its_jacobian():
    """Height, speeds and dJ/dt dq against differences along q + dq t, from postures and speeds at random."""
    rng, tip, h = np.random.default_rng(0), Tip(PANDA), 1e-5
    columns = replace(LIMIT, place=0.0, tilt=0.0).columns(PANDA)
    for _ in range(20):
        q, dq, row = rng.uniform(PANDA.q_min, PANDA.q_max), rng.normal(size=N), np.empty(N)
        height, speed, along, convective = tip_motion(columns, kinematics(q), dq, row)
        place, J = tip(q)
        after, before = (tip(q + s * h * dq)[1] @ dq for s in (1, -1))
        assert height == pytest.approx(UP @ (place - POINT) - PANDA.tool.radius, abs=1e-12)
        np.testing.assert_allclose(row, -UP @ J, atol=1e-12)
        assert speed == pytest.approx(-UP @ J @ dq, abs=1e-12)
        assert np.hypot(speed, along) == pytest.approx(np.linalg.norm(J @ dq), abs=1e-12)
        assert convective == pytest.approx(-UP @ (after - before) / (2 * h), abs=1e-6)


@pytest.mark.long
@pytest.mark.parametrize("delay", [0, 8])
def test_no_torque_presses_harder_than_the_limit(delay):
    """At the driver, immediately and 8 ms late; without a limit nearly all of these arms do."""
    force, bound, _, touched = hostile(PANDA, TRUE, LIMIT, 1, 32, delay=delay).T
    assert (force < bound).all()
    assert (touched > 100).mean() > 0.1
    free, bound, *_ = hostile(PANDA, TRUE, LIMIT, 1, 32, delay=delay, cycles=500, limited=False).T
    assert (free > bound).mean() > 0.8


@pytest.mark.long
def test_the_tip_meets_the_surface_at_the_speed_allowed():
    """From 15 mm above it, pressed with all that the arm has, without friction that would hold it back."""
    surface = Surface(POINT, UP, 1e5, 1.0, 0.0, 0.0)
    sim = Simulator(PANDA, replace(FRICTIONLESS, surface=surface, delay=4e-3), 1, 1)
    limit = replace(LIMIT, place=0.0, tilt=0.0)
    sim.drive(filter_limits(PANDA, TORQUE), TORQUE, push_limit=limit)
    q = TASK.goals(PANDA, np.random.default_rng(0), 1)[:, 9:]
    sim.reset(q, np.zeros((1, N)))
    inwards, fastest, force = -UP @ Tip(PANDA)(q[0])[1], 0.0, 0.0
    for _ in range(3000):
        sim.rollout(np.clip(150 * inwards, -TORQUE, TORQUE)[None, None])
        place, J = Tip(PANDA)(sim.q[0])
        if UP @ (place - POINT) - PANDA.tool.radius < 0:
            fastest = max(fastest, -UP @ J @ sim.dq[0])
            force = max(force, float(sim.contact_force[0] @ UP))
    assert 0.5 * limit.speed_near < fastest <= limit.speed_near
    assert force > 0.5 * limit.force_max  # it presses, and no harder than a push of force_max on a spring
    assert force < limit.force_max + limit.speed_near * np.sqrt(1e5 * limit.at(PANDA, np.zeros(N), q[0])[0])


def test_driver_and_simulator_limit_alike():
    """The same torque to round-off, over a press with all torque."""
    free = replace(FRICTIONLESS, surface=Surface(POINT, UP, 2e4, 1.0, 0.5, 0.3, 1e-4))
    sim = Simulator(PANDA, free, 1, 1)
    sim.drive(filter_limits(PANDA, TORQUE), TORQUE, push_limit=LIMIT)
    driver = DriverBatch(PANDA, TORQUE, 1, friction=free.level, cutoff_hz=np.inf, push_limit=LIMIT)
    q = TASK.goals(PANDA, np.random.default_rng(0), 1)[:, 9:]
    sim.reset(q, np.zeros((1, N)))
    tau = np.clip(-150 * UP @ Tip(PANDA)(q[0])[1], -TORQUE, TORQUE)[None]
    effort = np.zeros((1, N))
    for _ in range(1500):
        effort += np.clip(tau - effort, -PANDA.step_max, PANDA.step_max)
        sent = driver(sim.q.copy(), sim.dq.copy(), sim.tau.copy(), tau)
        np.testing.assert_allclose(driver.effort, effort, atol=1e-12)
        sim.rollout(effort[:, None])
        np.testing.assert_allclose(sent, sim.tau, atol=1e-9)
    assert driver.limited[0] > 500
    assert float(sim.contact_force[0] @ UP) > 5.0


@pytest.mark.long
def test_the_reference_presses_as_well_within_a_limit():
    """The task's forces and its approach stay below the limit, so that it changes little."""
    draw = make_draw(stiffness=[1e5, 1e5])
    plain, limited = (
        t.measures(pressed(t, draw)) for t in (TASK, TASK.pushing_within(PANDA, TRUE.level, 40.0, 0.03))
    )
    assert limited["success"] == plain["success"] == 1.0
    assert limited["force_rmse_last_N"] == pytest.approx(plain["force_rmse_last_N"], abs=0.1)
    assert limited["limited"] < 0.1


def test_a_wrong_limit_is_one_line():
    within = TASK.pushing_within
    with pytest.raises(UserError, match=r"^safety.force_max: 20 N is not allowed; 33\.\d N or more is: the task"):
        within(PANDA, TRUE.level, 20.0, None)
    with pytest.raises(UserError, match=r"^safety.speed_near: it needs safety.force_max, got null; set a force"):
        within(PANDA, TRUE.level, None, 0.02)
    with pytest.raises(UserError, match=r"^safety.speed_near: expected a number in \(0, inf\), got -1$"):
        within(PANDA, TRUE.level, 40.0, -1)
    with pytest.raises(UserError, match=r"^robot.tool: panda has no tool"):
        push_limit(replace(PANDA, tool=None), TRUE.level, 40.0, 0.02)
    speed = within(PANDA, TRUE.level, 40.0, None).push_limit.speed_near  # lets a rigid surface add force_max
    mass = LIMIT.at(PANDA, TRUE.level, PANDA.q_home)[0]
    assert speed == pytest.approx(40.0 / np.sqrt(1e5 * mass))
    assert LIMIT.columns(PANDA)[SPEED_NEAR] == LIMIT.speed_near / OVERSHOOT
