"""Arms other than the Panda: wall-mounted, one joint, no end stops, inertial frames equal to body frames, and those
shipped with r2s, one with recordings of a physical arm.
"""

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
import yaml
from conftest import ROOT, conf

from r2s.arm.twins.rigid_twin import RigidTwin
from r2s.engines.dart import DartEngine
from r2s.excitation.fourier import fourier
from r2s.excitation.motion_checks import check_limits, gravity_torque
from r2s.files import located
from r2s.identification.checks import check_motion, check_recording
from r2s.identification.parameters import parameter_space
from r2s.identification.residuals.torque_residual import TorqueResidual
from r2s.learning.env import TaskEnv
from r2s.physics.description import write_mjcf
from r2s.physics.dynamics import nominal_dynamics
from r2s.physics.robot import load_robot
from r2s.physics.safety_filter import filter_limits
from r2s.physics.simulator import Simulator, single_arm
from r2s.recordings.readers import read
from r2s.recordings.recording import Recording
from r2s.tasks.reach import ReachTask

UNIFORM = conf("friction/uniform")
FRICTIONLESS = {"phi1": 0.0, "phi2": 10.0, "phi3": 0.0}
SHIPPED = ("panda", "fr3", "kinova_gen3", "ur10e", "iiwa14", "xarm7")
ONE = """
<mujoco model="onejoint">
  <compiler angle="radian"/>
  <worldbody>
    <body name="arm" pos="0 0 0.5">
      <inertial pos="0 0 0" mass="2" diaginertia="0.03 0.03 0.03"/>
      <joint name="turn" axis="0 0 1" range="-2 2" actuatorfrcrange="-20 20"/>
      <site name="tip" pos="0.4 0 0"/>
    </body>
  </worldbody>
</mujoco>
"""
# Inertial frames equal to body frames or from a geom; a site on a body; endless first and last joints.
PLAIN = """
<mujoco model="plain">
  <compiler angle="radian"/>
  <default><joint axis="0 1 0" actuatorfrcrange="-40 40"/></default>
  <worldbody>
    <body name="a" pos="0 0 0.6"><inertial pos="0 0 0" mass="3" diaginertia="0.02 0.02 0.02"/>
      <joint name="ja" axis="0 0 1" limited="false"/>
      <body name="b" pos="0 0 0.1"><inertial pos="0 0 0.2" mass="2" diaginertia="0.02 0.02 0.005"/>
        <joint name="jb" range="-2 2"/>
        <body name="c" pos="0 0 0.4"><joint name="jc" limited="false"/>
          <geom type="sphere" size="0.05" pos="0 0 0.2" mass="1"/><site name="tip" pos="0 0 0.2"/>
        </body>
      </body>
    </body>
  </worldbody>
</mujoco>
"""


@pytest.fixture
def write(tmp_path):
    """Return a function: MJCF text -> robot."""

    def writer(text, **change):
        path = tmp_path / "arm.xml"
        path.write_text(text)
        return load_robot(str(path), **change)

    return writer


def shipped(name):
    """Return an arm of conf/robot, including the defaults of its yaml."""
    document = conf(f"robot/{name}")
    if name == "fr3":
        document = conf("robot/panda") | document
    return load_robot(**document)


# --- gravity


def test_gravity_comes_from_the_mjcf(write, tmp_path):
    """Both engines and written MJCF use the file's gravity; an explicit gravity overrides it."""
    leaning = [3.0, -4.0, 8.0]
    robot = write(PLAIN.replace("<default>", '<option gravity="3 -4 8"/><default>'))
    assert robot.gravity.tolist() == leaning
    assert robot.model(gravity=True).opt.gravity.tolist() == leaning
    q = np.random.default_rng(0).uniform(-1, 1, (5, robot.n))
    data = mujoco.MjData(robot.model(gravity=True))
    for posture, torque in zip(q, gravity_torque(robot, q), strict=True):
        # gradient of the potential energy, by central differences
        energy = []
        for step in 1e-6 * np.concatenate([np.eye(robot.n), -np.eye(robot.n)]):
            data.qpos[:] = posture + step
            mujoco.mj_kinematics(data.model, data)
            energy.append(-data.model.body_mass @ data.xipos @ leaning)
        np.testing.assert_allclose(torque, (np.array(energy[:3]) - energy[3:]) / 2e-6, atol=1e-6)
        np.testing.assert_allclose(DartEngine(robot, gravity=True).gravity_torque(posture), torque, atol=1e-11)
    write_mjcf(tmp_path / "again.xml", robot, nominal_dynamics(robot, **FRICTIONLESS))
    assert load_robot(str(tmp_path / "again.xml")).gravity.tolist() == leaning
    assert write(PLAIN, gravity=[0, 0, 9.81]).gravity.tolist() == [0, 0, 9.81]


def test_a_wall_mounted_arm_is_identified_with_its_own_gravity(write):
    """The torque residual vanishes with the right gravity, and contains the links' weight with the wrong one."""
    upright = write(PLAIN)
    wall = replace(upright, gravity=np.array([9.81, 0.0, 0.0]))
    motion = fourier(wall, duration=3.0, seed=0, effort=0)
    model, tau = wall.model(gravity=True), np.empty_like(motion.q)
    data = mujoco.MjData(model)
    for k in range(len(tau)):
        data.qpos[:], data.qvel[:], data.qacc[:] = motion.q[k], motion.dq[k], motion.ddq[k]
        mujoco.mj_inverse(model, data)
        tau[k] = data.qfrc_inverse
    recording = Recording(t=motion.t, q=motion.q, dq=motion.dq, tau=tau, torque="measured")
    off = []
    for robot in (wall, upright):
        nominal = nominal_dynamics(robot, **FRICTIONLESS)
        space = parameter_space(robot, nominal, {"offset": [-2.0, 2.0]})
        off.append(np.abs(TorqueResidual(space, recording, cutoff_hz=50.0).error(nominal)).max())
    assert off[0] < 0.01 * np.abs(tau).max()  # error of the filters
    assert off[1] > 0.5 * np.abs(tau).max()


# --- one joint, endless joints, links in their own frame


@pytest.mark.parametrize("text", [ONE, PLAIN], ids=["one joint", "own frames"])
def test_links_with_own_inertial_frames_can_be_replaced(text, write):
    """Each of two simulations has the given masses, centres and tensors, checked by M and the hand's position."""
    robot, rng = write(text), np.random.default_rng(1)
    n = robot.n
    d = nominal_dynamics(robot, **FRICTIONLESS)
    second = 0.5 * np.trace(robot.inertia, axis1=1, axis2=2)[:, None, None] * np.eye(3) - robot.inertia
    bent = np.eye(3) + np.stack([np.zeros((n, 3, 3)), rng.uniform(-0.3, 0.3, (n, 3, 3))])
    second = bent @ second @ bent.transpose(0, 1, 3, 2)  # a linearly deformed body: its tensor stays physical
    tensor = np.trace(second, axis1=2, axis2=3)[..., None, None] * np.eye(3) - second
    com = robot.com + np.stack([np.zeros((n, 3)), rng.uniform(-0.05, 0.05, (n, 3))])
    d = replace(d, mass=robot.mass * np.array([[1.0], [1.2]]), com=com, inertia=tensor)
    sim, q = Simulator(robot, d, 2, 1), rng.uniform(-1, 1, (2, n))
    M = sim.batch.bind("M")
    sim.reset(q, np.zeros((2, n)))
    for k in range(2):
        # M from point masses: six masses along each body's principal axes, summed by Jacobians
        model = robot.model(gravity=False)
        data, full, jacobian = mujoco.MjData(model), np.zeros((n, n)), np.empty((3, n))
        data.qpos[:] = q[k]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        for i, body in enumerate(model.jnt_bodyid):
            m, c = d.mass[k, i], d.com[k, i]
            spreads, axes = np.linalg.eigh(second[k, i])
            for spread, axis in zip(spreads, axes.T, strict=True):
                for sign in (1.0, -1.0):
                    local = c + sign * np.sqrt(3 * max(spread, 0.0) / m) * axis
                    point = data.xpos[body] + data.xmat[body].reshape(3, 3) @ local
                    mujoco.mj_jac(model, data, jacobian, None, point, body)
                    full += m / 6 * jacobian.T @ jacobian
        rows = np.repeat(np.arange(n), model.M_rownnz)
        np.testing.assert_allclose(M[k], full[rows, model.M_colind], atol=1e-12)
        np.testing.assert_allclose(sim.ee[k], data.site(robot.ee_site).xpos, atol=1e-15)
        one = single_arm(robot, d.one(k))
        assert one.body_mass[one.jnt_bodyid].tolist() == d.mass[k].tolist()


def test_an_endless_joint_has_no_limits(write):
    """Without range and soft limit, excitations stay within half a revolution of home; recordings need not."""
    robot = write(PLAIN, q_home=[2.0, 0.0, 1.0])
    assert robot.q_min.tolist() == [-np.inf, -2.0, -np.inf]
    assert robot.model(gravity=False).jnt_limited.tolist() == [False, True, False]
    np.testing.assert_allclose(robot.q_range, [[2 - np.pi, -2, 1 - np.pi], [2 + np.pi, 2, 1 + np.pi]])
    motion = fourier(robot, duration=3.0, seed=0, effort=0)
    check_limits(robot, motion)
    assert np.abs(motion.q - np.mean(robot.q_range, 0)).max() < np.pi
    nominal = nominal_dynamics(robot, **UNIFORM)
    env = TaskEnv(robot, ReachTask(reach=None), lambda rng, m: nominal, 3, nthread=1)
    state = env.reset()
    state["action"] = env.action_spec.rand()
    assert np.isfinite(env.step(state)["next"]["observation"].numpy()).all()
    sim = Simulator(robot, nominal_dynamics(robot, **FRICTIONLESS), 1, 1)
    sim.drive(filter_limits(robot, robot.tau_max))
    sim.reset(np.array([[100.0, 0.0, -100.0]]), np.zeros((1, 3)))
    sim.rollout(np.zeros((1, 50, 3)))
    np.testing.assert_allclose(sim.q, [[100.0, 0.0, -100.0]], atol=1e-12)
    twin = RigidTwin(robot, 0)
    twin.move_to(np.array([20.0, 0.0, 1.0]))
    twin.command(np.zeros(3))
    away = np.array([40.0, 0.0, -40.0])
    turns = Recording(t=motion.t, q=motion.q + away, dq=motion.dq, tau=motion.q, torque="measured")
    check_motion(robot, turns)


def test_goals_lie_within_reach(write):
    """Without a configured region every arm has goals; with one joint they lie on the hand's circle."""
    one = write(ONE)
    goals = ReachTask(reach=None).goals(one, np.random.default_rng(0), 20)
    np.testing.assert_allclose(np.linalg.norm(goals - [0, 0, 0.5], axis=1), 0.4, atol=1e-9)
    three = write(PLAIN)
    low, high = ReachTask(reach=None).region(three)
    assert 0.1 < low < high < 0.6 + 1e-6


# --- shipped arms


@pytest.mark.long
@pytest.mark.parametrize("name", SHIPPED)
def test_a_shipped_arm_is_ready_for_every_stage(name):
    """Home is inside the limits, not singular and above the table; goals and safe excitations exist."""
    robot = shipped(name)
    document = yaml.safe_load((ROOT / "conf" / "robot" / f"{name}.yaml").read_text())
    low, high = robot.q_range
    assert np.all((robot.q_home - low > 0.3) & (high - robot.q_home > 0.3))
    model = robot.model(gravity=True)
    data, jacobian = mujoco.MjData(model), np.empty((3, robot.n))
    data.qpos[:] = robot.q_home
    mujoco.mj_forward(model, data)
    mujoco.mj_jacSite(model, data, jacobian, None, model.site(robot.ee_site).id)
    assert np.linalg.svd(jacobian)[1][-1] > 0.15
    assert data.site(robot.ee_site).xpos[2] > 0.2
    assert np.all(np.abs(data.qfrc_bias) < 0.5 * robot.tau_max)
    if "reach" in document:
        low, high = document["reach"]
        goals = ReachTask(reach=(low, high)).goals(robot, np.random.default_rng(0), 30)
        assert len(goals) == 30
        # an action of 1 overcomes a twin's friction in every joint that moves the hand
        moves = levers(robot) > 0.12
        assert moves.sum() >= 3
        assert np.all((np.array(document["torque_fraction"]) * robot.tau_max)[moves] > 0.6)
        follows = np.array(document.get("tracking_fraction", document["torque_fraction"]))
        assert np.all(follows * robot.tau_max > 0.6)
    check_limits(robot, fourier(robot, duration=3.0, seed=0, effort=0))


def levers(robot):
    """Return each joint's lever arm (n,) m/rad: RMS over random postures."""
    model, rng = robot.model(gravity=False), np.random.default_rng(0)
    data, jacobian, total = mujoco.MjData(model), np.empty((3, robot.n)), np.zeros(robot.n)
    for _ in range(200):
        data.qpos[:] = rng.uniform(*robot.q_range)
        mujoco.mj_forward(model, data)
        mujoco.mj_jacSite(model, data, jacobian, None, model.site(robot.ee_site).id)
        total += (jacobian**2).sum(0) / 200
    return np.sqrt(total)


def test_shipped_files_are_found_from_anywhere():
    assert located("r2s:models/ur10e.xml") == ROOT / "r2s" / "models" / "ur10e.xml"
    assert located("models/ur10e.xml") == Path("models/ur10e.xml")


def test_the_shipped_recordings_fit_the_shipped_arm():
    """Two motions at 1 kHz with both torques; joints 2 and 4 measure mostly gravity."""
    robot, data = shipped("kinova_gen3"), conf("data/kinova_gen3")
    for key in ("path", "validation"):
        recording = read(located(data[key]), torque=data["torque"], n_joints=7)
        check_recording(robot, recording)
        assert recording.torque == "measured"
        assert recording.t[1] - recording.t[0] == pytest.approx(1e-3)
        with np.load(located(data[key])) as file:
            assert set(file.files) == {"t", "q", "dq", "tau_J", "tau_motor"}
            np.testing.assert_array_equal(recording.tau, file["tau_J"])
        explained = gravity_torque(robot, recording.q[::20])[:, [1, 3]]
        measured = recording.tau[::20, [1, 3]]
        assert np.corrcoef(explained.T, measured.T)[[0, 1], [2, 3]].min() > 0.9


def run(overrides, folder):
    """Return the output of `python run.py OVERRIDES` with its own root folder."""
    command = [sys.executable, str(ROOT / "run.py"), *overrides, f"root={folder}"]
    done = subprocess.run(command, cwd=ROOT, env=os.environ | {"COLUMNS": "110"}, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.mark.slow
def test_the_real_kinova_is_predicted_better_than_by_its_description(tmp_path):
    """The README's command: on validation data no joint is worse, and the mean is better by a third."""
    run(["stage=identify", "data=kinova_gen3", "name=real"], tmp_path)
    folder = tmp_path / "identify" / "real"
    validation = json.loads((folder / "summary.json").read_text())["validation"]
    identified, nominal = (np.array(validation[f"{k}torque_rmse_Nm"]) for k in ("", "nominal_"))
    assert np.mean(identified) < 0.67 * np.mean(nominal)
    assert np.all(identified < 1.02 * nominal)
    assert yaml.safe_load((folder / "config.yaml").read_text())["robot"]["mjcf"] == "r2s:models/kinova_gen3.xml"


@pytest.mark.slow
@pytest.mark.parametrize("name", [*SHIPPED, "one joint"])
def test_the_pipeline_ends_for_every_arm(name, tmp_path):
    """Identification, two trainings and transfer to a twin, with only the arm's name given."""
    overrides = [f"robot={name}"]
    if name == "one joint":
        (tmp_path / "one.xml").write_text(ONE)
        overrides = ["robot=other", f"robot.mjcf={tmp_path / 'one.xml'}"]
    overrides += ["stage=pipeline", "pipeline.train_minutes=null", "name=arm", "+experiment=toy"]
    out = run(overrides, tmp_path / "runs")
    assert all(
        f"{model} model, {where}" in out for model in ("identified", "nominal") for where in ("mujoco", "twin")
    )
