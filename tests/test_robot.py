"""Robot files: the embedded Panda, other serial arms, and one-line errors."""

import mujoco
import numpy as np
import pytest
from conftest import conf

from r2s.errors import UserError
from r2s.excitation.fourier import fourier
from r2s.excitation.motion_checks import check_limits
from r2s.identification.link_inertia import LINK
from r2s.identification.parameters import parameter_space
from r2s.identification.residuals.torque_residual import TorqueResidual
from r2s.learning.env import TaskEnv
from r2s.physics.dynamics import nominal_dynamics
from r2s.physics.robot import load_robot
from r2s.recordings.recording import Recording
from r2s.tasks.reach import ReachTask
from r2s.tasks.rollout import REST

ARM = """
<mujoco model="threelink">
  <worldbody>
    <body name="base" pos="0 0 0.2">
      <body name="upper"><inertial pos="0 0 0.1" mass="2" diaginertia="0.02 0.02 0.01"/>
        <joint name="yaw" axis="0 0 1" range="-150 150"/>
        <body name="lower" pos="0 0 0.2"><inertial pos="0 0 0.15" mass="1.5" diaginertia="0.02 0.02 0.005"/>
          <joint name="pitch" axis="0 1 0" range="-90 90" armature="0.01"/>
          <body name="hand" pos="0 0 0.3"><inertial pos="0 0 0.1" mass="0.8" diaginertia="0.006 0.006 0.002"/>
            <joint name="elbow" axis="0 1 0" range="-120 60" damping="0.05"/>
            <site name="tool" pos="0 0 0.25"/><site name="wrist" pos="0 0 0.05"/>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor joint="yaw" forcerange="-30 30" forcelimited="true"/>
    <motor joint="pitch" ctrlrange="-2 2" ctrllimited="true" gear="10"/>
    <motor joint="elbow" forcerange="-12 15" forcelimited="true"/>
  </actuator>
</mujoco>
"""


@pytest.fixture
def write(tmp_path):
    """Return text -> path of a file that holds it."""

    def writer(text, name="arm.xml"):
        path = tmp_path / name
        path.write_text(text)
        return str(path)

    return writer


@pytest.fixture
def arm(write):
    return load_robot(write(ARM), ee="tool")


def test_the_hand_of_the_panda_is_where_franka_says(panda):
    """At the usual start posture the flange is at (0.3069, 0, 0.5903) m, within 1 mm."""
    model = panda.model(gravity=False)
    data = mujoco.MjData(model)
    data.qpos[:] = panda.q_home
    mujoco.mj_kinematics(model, data)
    np.testing.assert_allclose(data.site(panda.ee_site).xpos, [0.3069, 0.0, 0.5903], atol=1e-3)


def test_the_panda_is_built_of_the_published_figures(panda):
    """Seven links of the published masses, Table III's OLD moments, no stock damping, armature or contact."""
    model = panda.model(gravity=True)
    assert (model.nq, model.nv, model.nu) == (7, 7, 0)
    masses = [4.970684, 0.646926, 3.228604, 3.587895, 1.225946, 1.666555, 0.735522]
    np.testing.assert_allclose(model.body_mass[model.jnt_bodyid], masses, atol=1e-9)
    np.testing.assert_allclose(panda.mass, masses, atol=1e-9)
    np.testing.assert_allclose(panda.com[[0, 6]], [[0.003875, 0.002081, -0.175], [0.010517, -0.004252, 0.061597]])
    izz = [0.009117, 0.025995, 0.01083, 0.02832, 0.008627, 0.005433, 0.004815]
    ixy = [-0.000139, -0.003925, -0.004761, 0.007796, -0.002117, 0.000109, -0.000428]
    np.testing.assert_allclose(panda.inertia[:, 2, 2], izz, atol=1e-8)
    np.testing.assert_allclose(panda.inertia[:, 0, 1], ixy, atol=1e-8)
    np.testing.assert_allclose(panda.inertia, panda.inertia.transpose(0, 2, 1), atol=1e-12)
    assert not model.dof_damping.any()
    assert not model.dof_armature.any()
    assert model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CONTACT


def test_gravity_is_a_choice_of_the_model(panda):
    """With gravity, holding still takes the slope of the potential energy of seven masses; without, nothing."""
    q, h, n = panda.q_home + 0.3, 1e-6, panda.n
    torque = []
    for gravity in (True, False):
        model = panda.model(gravity=gravity)
        data = mujoco.MjData(model)
        data.qpos[:] = q
        mujoco.mj_inverse(model, data)
        torque.append(data.qfrc_inverse.copy())
    height = []
    for step in np.concatenate([np.eye(n), -np.eye(n)]):
        data.qpos[:] = q + h * step
        mujoco.mj_kinematics(model, data)
        height.append(9.81 * model.body_mass @ data.xipos[:, 2])
    slope = (np.array(height[:n]) - height[n:]) / (2 * h)
    np.testing.assert_allclose(torque[0], slope, atol=1e-6)
    assert np.abs(slope).max() > 5
    assert np.abs(torque[1]).max() < 1e-9


def test_the_files_limits_are_read(arm):
    """Ranges in degrees become rad; the weaker side of a motor's force or control range, times gear, is the limit."""
    assert (arm.name, arm.n, arm.ee_site) == ("threelink", 3, "tool")
    np.testing.assert_allclose(arm.q_min, np.radians([-150, -90, -120]))
    np.testing.assert_allclose(arm.q_max, np.radians([150, 90, 60]))
    np.testing.assert_allclose(arm.tau_max, [30, 20, 12])
    assert np.all((arm.q_home > arm.q_min) & (arm.q_home < arm.q_max))
    np.testing.assert_allclose(arm.inertia[1], np.diag([0.02, 0.02, 0.005]))
    np.testing.assert_allclose(arm.mass, [2, 1.5, 0.8])
    np.testing.assert_allclose(arm.com, [[0, 0, 0.1], [0, 0, 0.15], [0, 0, 0.1]])


def test_the_compiled_arm_keeps_the_limits_and_drops_the_motors(arm):
    """In `model` ranges are those of the Robot in rad, actuators are gone, armature stays, damping is of the law."""
    model = arm.model(gravity=False)
    np.testing.assert_allclose(model.jnt_range, np.stack([arm.q_min, arm.q_max], -1))
    assert model.nu == 0
    assert not model.dof_damping.any()
    np.testing.assert_allclose(arm.damping, [0, 0, 0.05])
    np.testing.assert_allclose(model.dof_armature, [0, 0.01, 0])


def test_what_is_given_goes_over_the_file(write):
    """Limits and start given to load_robot win over the file's, one number serves all joints."""
    robot = load_robot(
        write(ARM), ee="wrist", q_min=[-1, -1, -1], tau_max=[5, 5, 5], q_home=[0.1, 0.2, 0.3], dq_max=1.5
    )
    assert robot.ee_site == "wrist"
    assert robot.q_min.tolist() == [-1, -1, -1]
    assert robot.tau_max.tolist() == [5, 5, 5]
    assert robot.q_home.tolist() == [0.1, 0.2, 0.3]
    assert robot.dq_max.tolist() == [1.5] * 3
    np.testing.assert_allclose(robot.model(gravity=False).jnt_range[:, 0], -1)


@pytest.mark.long
def test_another_arm_goes_through_environment_and_identification(arm):
    """Three joints: an episode starts and steps, an excitation keeps its limits, a residual is computed."""
    nominal = nominal_dynamics(arm, **conf("friction/uniform") | {"family": "sigmoid"})
    env = TaskEnv(arm, ReachTask(reach=(0.1, 0.5)), lambda rng, m: nominal, 4, nthread=1)
    state = env.reset()
    state["action"] = env.action_spec.rand()
    after = env.step(state)["next"]
    assert after["observation"].shape == (4, 6 * 3 + 12)
    assert not np.array_equal(after["observation"], state["observation"])

    motion = fourier(arm, duration=3.0, seed=0)
    check_limits(arm, motion)
    recording = Recording(t=motion.t, q=motion.q, dq=motion.dq, tau=np.zeros_like(motion.q), torque="measured")
    bounds = conf("identify/default")["bounds"]
    space = parameter_space(arm, nominal, {k: bounds[k] for k in ("phi1", "phi2", "offset", *LINK, "delay")})
    assert len(space.names) == 13 * 3 + 1
    residual = TorqueResidual(space, recording)
    assert np.isfinite(residual(np.stack([space.start, space.lower, space.upper]))).all()


SLIDE = ARM.replace('name="elbow" axis', 'name="elbow" type="slide" axis')
TREE = """
<mujoco model="tree">
  <worldbody>
    <body name="trunk"><joint name="a" axis="0 0 1"/><geom size="0.1"/>
      <body name="left"><joint name="b" axis="0 0 1"/><geom size="0.1"/><site name="tip"/></body>
      <body name="right"><joint name="c" axis="0 0 1"/><geom size="0.1"/></body>
    </body>
  </worldbody>
</mujoco>
"""
WEAK = ARM.replace('<motor joint="elbow" forcerange="-12 15" forcelimited="true"/>', "")
EMPTY = '<mujoco model="rock"><worldbody><body name="b"><geom size="1"/></body></worldbody></mujoco>'


@pytest.mark.parametrize(
    ("text", "change", "words"),
    [
        (ARM[:-20], {}, ["robot.mjcf", "arm.xml", "not a valid MJCF"]),
        (ARM.replace('mass="2"', 'mass="two"'), {}, ["robot.mjcf", "mass"]),
        (SLIDE, {}, ["elbow", "mjJNT_SLIDE", "expected hinges"]),
        (TREE, {"ee": "tip"}, ["not a serial arm", "'right'", "'left'"]),
        (EMPTY, {}, ["arm.xml", "no joints"]),
        (ARM, {"ee": "toool"}, ["robot.ee", "toool", "tool, wrist", "did you mean 'tool'?"]),
        (ARM, {"ee": None}, ["robot.ee", "tool, wrist"]),
        (WEAK, {}, ["robot.tau_max", "elbow"]),
        (ARM, {"q_min": [0.0, 0.0]}, ["robot.q_min", "got 2", "3 joints"]),
        (ARM, {"dq_max": [1.0] * 4}, ["robot.dq_max", "got 4", "3 joints"]),
        (ARM, {"q_home": [0.0, 1.6, 0.0]}, ["robot.q_home", "joint 2", "1.600", "-1.571 to 1.571"]),
        (ARM, {"tau_max": [1.0, 0.0, 1.0]}, ["robot.tau_max", "pitch"]),
    ],
)
def test_a_wrong_file_gets_one_line(write, text, change, words):
    """Every mistake raises a UserError of one line that names it."""
    with pytest.raises(UserError) as caught:
        load_robot(write(text), **({"ee": "tool"} | change))
    message = str(caught.value)
    assert "\n" not in message
    for word in words:
        assert word in message


def test_a_missing_file_names_the_nearest(write, tmp_path):
    """A misspelt file name gets the one that is there; a missing folder still gets one line."""
    write(ARM, "my_arm.xml")
    with pytest.raises(UserError, match=r"no such file: .*my_arn\.xml; did you mean 'my_arm\.xml'\?$"):
        load_robot(str(tmp_path / "my_arn.xml"))
    with pytest.raises(UserError, match=r"^robot\.mjcf: no such file: .*nowhere/arm\.xml$"):
        load_robot(str(tmp_path / "nowhere" / "arm.xml"))


def test_a_tool_is_read_with_the_robot(tmp_path):
    """`tool` gives the robot its tip; a wrong file gets one line that names robot.tool."""
    file = tmp_path / "tool.json"
    file.write_text('{"tip_in_flange_m": [0.0, 0.01, 0.09], "radius_m": 0.01, "mass_kg": 0.2}')
    tool = load_robot(tool=str(file)).tool
    assert tool is not None
    assert load_robot().tool is None
    np.testing.assert_array_equal([*tool.tip, tool.radius, tool.mass], [0.0, 0.01, 0.09, 0.01, 0.2])
    file.write_text('{"tip_in_flange_m": [0.0, 0.01], "radius_m": 0.01}')
    with pytest.raises(UserError, match=r"^robot\.tool: tool\.json: tip_in_flange_m: expected 3 numbers"):
        load_robot(tool=str(file))
    file.write_text('{"tip": [0.0, 0.0, 0.06], "radius_m": 0.01}')
    with pytest.raises(UserError, match=r"^robot\.tool: tool\.json: unknown key 'tip'; allowed: tip_in_flange_m, "):
        load_robot(tool=str(file))
    with pytest.raises(UserError, match=r"^robot\.tool: no such file: .*tol\.json; did you mean 'tool\.json'"):
        load_robot(tool=str(tmp_path / "tol.json"))
    with pytest.raises(UserError, match=r"^robot\.tool: .*directory"):
        load_robot(tool=str(tmp_path))


def test_a_wrist_that_reaching_turns_comes_to_rest():
    """Friction at the speed that counts as rest exceeds the torque of an action of 1 in joints 5 and 7."""
    robot = load_robot(**conf("robot/panda"))
    dynamics = nominal_dynamics(robot, **conf("friction/paper"), inertia_scale=conf("inertia/paper")["scale"])
    task = ReachTask(torque_fraction=tuple(conf("task/reach")["torque_fraction"]))
    for speed in (-REST, REST):
        holds = task.torque_limit(robot) < np.abs(dynamics.friction(np.full(robot.n, speed)))
        assert holds[[4, 6]].all()
