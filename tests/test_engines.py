"""DART is the same arm as MuJoCo, for the Panda and for a file with everything the Panda's lacks."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
import torch
from conftest import conf

from r2s.engines.dart import DartEngine
from r2s.engines.episodes import EngineArms
from r2s.errors import UserError
from r2s.learning.evaluate import fixed_episodes, make_evaluation
from r2s.learning.policy import make_policy
from r2s.learning.randomization import UniformRandomization
from r2s.physics.dynamics import STICTION_MODELS, nominal_dynamics
from r2s.physics.robot import load_robot
from r2s.physics.simulator import single_arm
from r2s.tasks.reach import ReachTask
from r2s.tasks.rollout import rollout

ODD_ARM = """
<mujoco model="odd">
  <compiler angle="radian"/>
  <worldbody>
    <body pos="0 0 0.3" euler="0.2 0 0.1">
      <body name="a" pos="0.1 0 0">
        <inertial pos="0.01 0.02 0.1" mass="2" fullinertia="0.03 0.03 0.02 0.001 0.002 0.003"/>
        <joint name="ja" axis="0 0 1" pos="0.02 0.01 0" range="-2 2" armature="0.05"
               actuatorfrcrange="-20 20"/>
        <body name="welded" pos="0.1 0 0.1" euler="0.3 0.4 0.5">
          <inertial pos="0 0.02 0" mass="0.5" fullinertia="0.003 0.002 0.002 0 0 0"/>
          <body name="b" pos="0 0 0.2" euler="1.2 0 0">
            <inertial pos="0 0 0.15" mass="1" fullinertia="0.01 0.01 0.002 0 0 0"/>
            <joint name="jb" axis="0.6 0 0.8" range="-1 2.5" ref="0.3" damping="0.4" armature="0.01"
                   actuatorfrcrange="-10 10"/>
            <body pos="0 0 0.2" euler="0 0.3 0">
              <inertial pos="0 0 0.05" mass="0.3" fullinertia="0.001 0.001 0.0005 0 0 0"/>
              <site name="tip" pos="0 0.01 0.1"/>
            </body>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
</mujoco>
"""


class _MujocoEngine:
    """MuJoCo without r2s's friction."""

    def __init__(self, robot, dynamics):
        self.model = single_arm(robot, dynamics)
        self.model.jnt_user[:] = 0.0  # no friction from r2s
        self.data = mujoco.MjData(self.model)

    def reset(self, q, dq):
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:], self.data.qvel[:] = q, dq

    def step(self, tau):
        self.data.qfrc_applied[:] = tau
        mujoco.mj_step(self.model, self.data)
        return self.data.qpos.copy(), self.data.qvel.copy()


def panda(**change):
    return load_robot(
        **{
            "q_home": [0, -0.785, 0, -2.356, 0, 1.571, 0.785],
            "dq_max": [2.175] * 4 + [2.61] * 3,
            "ddq_max": [15, 7.5, 10, 12.5, 15, 20, 20],
            "tau_max": [87] * 4 + [12] * 3,
            **change,
        }
    )


@pytest.fixture(params=["panda", "odd"])
def robot(request, tmp_path):
    if request.param == "panda":
        return panda()
    path = tmp_path / "odd.xml"
    path.write_text(ODD_ARM)
    return load_robot(str(path))


def test_statics_and_mass_matrix_agree_with_mujoco(robot):
    """Mass matrix, gravity torque and end effector are those of MuJoCo at random postures."""
    engine, model = DartEngine(robot, gravity=True), robot.model(gravity=True)
    data = mujoco.MjData(model)
    full = np.empty((robot.n, robot.n))
    for q in np.random.default_rng(0).uniform(robot.q_min, robot.q_max, (30, robot.n)):
        data.qpos[:] = q
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, full)
        engine.reset(q, np.zeros(robot.n))
        np.testing.assert_allclose(engine.mass_matrix(q), full, atol=1e-12)
        np.testing.assert_allclose(engine.gravity_torque(q), data.qfrc_bias, atol=1e-11)
        np.testing.assert_allclose(engine.ee(), data.site(robot.ee_site).xpos, atol=1e-12)


@pytest.mark.parametrize("gravity", [False, True])
def test_open_loop_motion_agrees_with_mujoco(robot, gravity):
    """The same torques from the same state give the same motion: 1e-9 rad after 0.1 s."""
    rng = np.random.default_rng(1)
    model = robot.model(gravity=gravity)
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_EULER
    data, engine = mujoco.MjData(model), DartEngine(robot, gravity=gravity)
    data.qpos[:] = robot.q_home
    data.qvel[:] = rng.uniform(-0.3, 0.3, robot.n)
    engine.reset(data.qpos, data.qvel)
    for tau in rng.uniform(-0.05, 0.05, (100, robot.n)) * robot.tau_max:
        data.qfrc_applied[:] = tau
        mujoco.mj_step(model, data)
        q, dq = engine.step(tau)
    np.testing.assert_allclose(q, data.qpos, atol=1e-9)
    np.testing.assert_allclose(dq, data.qvel, atol=1e-8)


def test_replaced_inertia_moves_as_if_it_were_the_files(robot):
    """Twice all masses and tensors at the same centres: twice the mass matrix, where nothing is welded on."""
    if robot.name == "odd":
        pytest.skip("its welded bodies keep their own mass")
    model = robot.model(gravity=True)
    masses, inertias = 2 * model.body_mass[model.jnt_bodyid], 2 * robot.inertia
    coms = model.body_ipos[model.jnt_bodyid]
    heavy = DartEngine(robot, gravity=True, masses=masses, coms=coms, inertias=inertias)
    plain = DartEngine(robot, gravity=True)
    q = robot.q_home
    np.testing.assert_allclose(heavy.mass_matrix(q), 2 * plain.mass_matrix(q), atol=1e-6)
    np.testing.assert_allclose(heavy.gravity_torque(q), 2 * plain.gravity_torque(q), atol=1e-11)


def test_queries_leave_the_state_alone():
    robot = panda()
    engine, other = (DartEngine(robot, gravity=False) for _ in range(2))
    for e in (engine, other):
        e.reset(robot.q_home, np.full(7, 0.1))
    engine.mass_matrix(robot.q_min)
    engine.gravity_torque(robot.q_max)
    for a, b in zip(engine.step(np.ones(7)), other.step(np.ones(7)), strict=True):
        assert np.array_equal(a, b)


def test_limits():
    """Commands are clipped, last one step, and a joint stays at its position limit."""
    robot = panda()
    engine, clipped = (DartEngine(robot, gravity=False) for _ in range(2))
    for e in (engine, clipped):
        e.reset(robot.q_home, np.zeros(7))
    assert np.array_equal(engine.step(10 * robot.tau_max)[0], clipped.step(robot.tau_max)[0])
    _, before = engine.step(np.zeros(7))
    _, after = engine.step(np.zeros(7))
    assert np.abs(after - before).max() < 0.05  # Coriolis only
    engine.reset(robot.q_max - 1e-3, np.zeros(7))
    for _ in range(300):
        q, _ = engine.step(0.05 * robot.tau_max)
    assert np.all(q <= robot.q_max + 1e-3)


def test_implicit_damping_of_one_step():
    """`damping` acts implicitly: stable at any size, and gone in the next step."""
    robot = panda()
    engine = DartEngine(robot, gravity=False)
    engine.reset(robot.q_home, np.full(7, 0.5))
    _, dq = engine.step(np.zeros(7), None, np.full(7, 1e6))
    assert np.abs(dq).max() < 1e-3
    _, dq = engine.step(np.ones(7), None, np.zeros(7))
    assert np.abs(dq).max() > 1e-2


def test_wrong_shapes_are_named():
    with pytest.raises(UserError, match="masses"):
        DartEngine(panda(), gravity=True, masses=np.ones(3))


@pytest.mark.long
@pytest.mark.parametrize("hold", STICTION_MODELS)
def test_a_policy_meets_the_same_arm_in_every_engine(hold):
    """Friction, breakaway, offsets, the driver's law, delay: an episode in DART is the batch's, within 1e-3 mm."""
    robot, task = load_robot(**conf("robot/panda")), ReachTask(episode_s=0.88, torque_fraction=0.15)
    truth = nominal_dynamics(robot, **conf("friction/paper"), inertia_scale=conf("inertia/paper")["scale"])
    truth = replace(truth, delay=2e-3, lag=1e-3, mass=1.1 * robot.mass, stiction_model=hold)
    draw = UniformRandomization(robot, truth, phi_relative=0.1, inertia_relative=0.05)
    torch.manual_seed(0)
    policy = make_policy(robot, task, (16,))
    starts, goals = fixed_episodes(robot, task, 4)
    home = make_evaluation(robot, task, draw, episodes=4, nthread=1)(policy)
    assert np.abs(home.dq).max() > 0.3  # it moves

    def dart(d):
        return DartEngine(robot, gravity=False, masses=d.mass, coms=d.com, inertias=d.inertia)

    for make in (dart, lambda d: _MujocoEngine(robot, d)):
        away = rollout(policy, EngineArms(make, robot, task, draw, 4), task, starts, goals)
        assert np.linalg.norm(away.ee - home.ee, axis=-1).max() < 1e-6  # no joint gets to a hard stop
        np.testing.assert_allclose(away.reward, home.reward, atol=1e-3)
