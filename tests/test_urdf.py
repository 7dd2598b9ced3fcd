"""URDF reader: the arm equals that of an equivalent MJCF, and errors name link or joint."""

from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
from conftest import conf

from r2s.errors import UserError
from r2s.physics.description import write_urdf
from r2s.physics.dynamics import nominal_dynamics
from r2s.physics.robot import load_robot

FRICTIONLESS = {"phi1": 0.0, "phi2": 10.0, "phi3": 0.0}

# What people's files hold: a world, a base with inertia, meshes that are not there, a tool fixed to the last link at
# an angle, a camera without inertia, a continuous joint, one that lost its range, and gaps for defaults.
URDF = """<?xml version="1.0"?>
<robot name="lamp">
  <link name="world"/>
  <joint name="mount" type="fixed"><parent link="world"/><child link="base"/><origin xyz="0 0 0.2"/></joint>
  <link name="base">
    <inertial><mass value="40"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><geometry><cylinder radius="0.1" length="0.2"/></geometry></collision>
  </link>
  <joint name="yaw" type="continuous">
    <origin xyz="0 0 0.1" rpy="0.1 0 0"/><parent link="base"/><child link="upper"/><axis xyz="0 0 2"/>
    <limit effort="30" velocity="1.5"/><dynamics damping="0.2"/>
  </joint>
  <link name="upper">
    <inertial>
      <origin xyz="0.01 0 0.1" rpy="0.2 -0.4 0.7"/><mass value=" 2.0 "/>
      <inertia ixx="0.03" iyy="0.02" izz="0.015" ixy="0.001" ixz="0.002" iyz="-0.003"/>
    </inertial>
    <visual><geometry><mesh filename="package://lamp/meshes/nowhere.dae"/></geometry></visual>
    <collision><origin xyz="0 0 0.1"/><geometry><box size="0.1 0.1 0.2"/></geometry></collision>
  </link>
  <joint name="pitch" type="revolute">
    <origin xyz="0 0.05 0.2" rpy="1.5708 -0.3 0.2"/><parent link="upper"/><child link="lower"/>
    <limit lower="-1.5" upper="2" effort="20"/>
  </joint>
  <link name="lower">
    <inertial><origin xyz="0 0 0.15"/><mass value="1.5"/><inertia ixx="0.02" iyy="0.02" izz="0.005"/></inertial>
  </link>
  <joint name="roll" type="revolute">
    <origin xyz="0 0 0.3"/><parent link="lower"/><child link="hand"/><axis xyz="0 0 1"/>
    <limit effort="5" velocity="3"/>
  </joint>
  <link name="hand">
    <inertial><origin xyz="0 0 0.02"/><mass value="0.5"/><inertia ixx="0.001" iyy="0.001" izz="0.0008"/></inertial>
  </link>
  <joint name="flange" type="fixed">
    <origin xyz="0.02 0 0.05" rpy="0.3 0.5 -0.2"/><parent link="hand"/><child link="tool"/>
  </joint>
  <link name="tool">
    <inertial>
      <origin xyz="0 0.01 0.03" rpy="0.4 0 0"/><mass value="0.25"/>
      <inertia ixx="0.0004" iyy="0.0003" izz="0.0002" iyz="0.00002"/>
    </inertial>
  </link>
  <joint name="tip_fixed" type="fixed"><origin xyz="0 0 0.1"/><parent link="tool"/><child link="tip"/></joint>
  <link name="tip"/>
  <joint name="camera_fixed" type="fixed"><parent link="hand"/><child link="camera"/></joint>
  <link name="camera"/>
</robot>
"""
# The same as MJCF: what is fixed to a link is welded to it; eulerseq XYZ are URDF's angles about fixed axes.
MJCF = """
<mujoco model="lamp">
  <compiler angle="radian" eulerseq="XYZ"/>
  <worldbody>
    <body name="upper" pos="0 0 0.3" euler="0.1 0 0">
      <inertial pos="0.01 0 0.1" mass="2" fullinertia="TENSOR"/>
      <joint name="yaw" axis="0 0 1" limited="false" actuatorfrcrange="-30 30" damping="0.2"/>
      <body name="lower" pos="0 0.05 0.2" euler="1.5708 -0.3 0.2">
        <inertial pos="0 0 0.15" mass="1.5" diaginertia="0.02 0.02 0.005"/>
        <joint name="pitch" axis="1 0 0" range="-1.5 2" actuatorfrcrange="-20 20"/>
        <body name="hand" pos="0 0 0.3">
          <inertial pos="0 0 0.02" mass="0.5" diaginertia="0.001 0.001 0.0008"/>
          <joint name="roll" axis="0 0 1" limited="false" actuatorfrcrange="-5 5"/>
          <body name="tool" pos="0.02 0 0.05" euler="0.3 0.5 -0.2">
            <body pos="0 0.01 0.03" euler="0.4 0 0">
              <inertial pos="0 0 0" mass="0.25" fullinertia="0.0004 0.0003 0.0002 0 0 0.00002"/>
            </body>
            <site name="tip" pos="0 0 0.1"/>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
</mujoco>
"""


@pytest.fixture
def write(tmp_path):
    """Return text -> path of a file that holds it."""

    def writer(text, name="lamp.urdf"):
        path = tmp_path / name
        path.write_text(text)
        return str(path)

    return writer


def turned_tensor():
    """Return the tensor of link `upper` in link axes, as MJCF's fullinertia."""
    tensor = np.array([[0.03, 0.001, 0.002], [0.001, 0.02, -0.003], [0.002, -0.003, 0.015]])
    (a, b, c), (i, j, k) = np.cos([0.2, -0.4, 0.7]), np.sin([0.2, -0.4, 0.7])
    about_x, about_y = np.array([[1, 0, 0], [0, a, -i], [0, i, a]]), np.array([[b, 0, j], [0, 1, 0], [-j, 0, b]])
    axes = np.array([[c, -k, 0], [k, c, 0], [0, 0, 1]]) @ about_y @ about_x
    x = axes @ tensor @ axes.T
    return " ".join(repr(float(v)) for v in (x[0, 0], x[1, 1], x[2, 2], x[0, 1], x[0, 2], x[1, 2]))


def behaviour(robot, seed=0, samples=20):
    """Return inverse dynamics under gravity (T, n) Nm, end-effector position (T, 3) m and rotation (T, 9)."""
    model, rng = robot.model(gravity=True), np.random.default_rng(seed)
    data, site = mujoco.MjData(model), model.site(robot.ee_site).id
    torque, hand, axes = np.empty((samples, robot.n)), np.empty((samples, 3)), np.empty((samples, 9))
    for k in range(samples):
        data.qpos[:] = rng.uniform(*robot.q_range)
        data.qvel[:], data.qacc[:] = rng.normal(size=(2, robot.n))
        mujoco.mj_inverse(model, data)
        torque[k], hand[k], axes[k] = data.qfrc_inverse, data.site_xpos[site], data.site_xmat[site]
    return torque, hand, axes


def assert_same(a, b):
    """Check that two arms are the same: limits, and how they move."""
    for name in ("q_min", "q_max", "dq_max", "tau_max"):
        np.testing.assert_allclose(getattr(a, name), getattr(b, name), rtol=1e-9, err_msg=name)
    b = replace(b, q_home=a.q_home)
    for ours, theirs in zip(behaviour(a), behaviour(b), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-9)


def test_a_urdf_is_the_mjcf_of_the_same_arm(write):
    """Links with what is fixed to them, limits and damping; neither the base's inertia nor missing meshes count."""
    urdf = load_robot(write(URDF), ee="tip")
    mjcf = load_robot(write(MJCF.replace("TENSOR", turned_tensor()), "lamp.xml"), dq_max=[1.5, 2.0, 3.0])
    assert (urdf.name, urdf.n) == ("lamp", 3)
    assert_same(urdf, mjcf)
    assert urdf.q_max.tolist() == [np.inf, 2.0, np.inf]
    np.testing.assert_allclose(urdf.mass, [2.0, 1.5, 0.75])
    np.testing.assert_allclose(urdf.mass[:2], mjcf.mass[:2], atol=1e-9)
    np.testing.assert_allclose(urdf.com[:2], mjcf.com[:2], atol=1e-9)
    np.testing.assert_allclose(urdf.inertia[:2], mjcf.inertia[:2], atol=1e-9)
    np.testing.assert_array_equal(urdf.damping, [0.2, 0, 0])
    names = [urdf.model(gravity=True).joint(i).name for i in range(3)]
    assert names == ["yaw", "pitch", "roll"]


def test_shapes_of_a_urdf_become_geoms(write):
    """A cylinder of the base and a box of the upper arm, both for contacts; a mesh is left out."""
    model = load_robot(write(URDF), ee="tip").model(gravity=False)
    assert model.ngeom == 2
    np.testing.assert_allclose(model.geom_size, [[0.1, 0.1, 0], [0.05, 0.05, 0.1]])
    assert (model.geom_contype == 1).all()
    assert model.body(model.geom_bodyid[1]).name == "upper"


@pytest.mark.parametrize("name", ["panda", "kinova_gen3", "ur10e", "iiwa14", "xarm7"])
def test_a_written_urdf_is_restored(name, tmp_path):
    """Written without friction and read again: masses, centres, tensors, rotors and how it moves, to 1e-9."""
    robot = load_robot(**conf(f"robot/{name}"))
    write_urdf(tmp_path / "arm.urdf", robot, nominal_dynamics(robot, **FRICTIONLESS))
    again = load_robot(str(tmp_path / "arm.urdf"), q_home=robot.q_home.tolist())
    assert again.ee_site == "ee"
    assert_same(robot, again)
    for field in ("mass", "com", "inertia", "armature"):
        np.testing.assert_allclose(getattr(robot, field), getattr(again, field), rtol=0, atol=1e-9)


def change(old, new):
    assert old in URDF
    return URDF.replace(old, new)


def beside_the_world(elements):
    return change('<link name="world"/>', '<link name="world"/>' + elements)


def beside_the_camera(elements):
    return change('<link name="camera"/>', '<link name="camera"/>' + elements)


def fixed(name, parent, child):
    return f'<joint name="{name}" type="fixed"><parent link="{parent}"/><child link="{child}"/></joint>'


LOWER = '<inertial><origin xyz="0 0 0.15"/><mass value="1.5"/><inertia ixx="0.02" iyy="0.02" izz="0.005"/></inertial>'
FORK = """
  <link name="other"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1"/></inertial></link>
  <joint name="fork" type="revolute"><parent link="upper"/><child link="other"/></joint>
"""
MISTAKES = {
    "cut off": (URDF[:-30], ["expected XML", "line"]),
    "another format": ("<sdf/>", ["<sdf>", "<robot>"]),
    "xacro": (beside_the_world('<arm xmlns="http://ros.org/wiki/xacro"/>'), ["xacro FILE > arm.urdf"]),
    "a slide": (change('"pitch" type="revolute"', '"pitch" type="prismatic"'), ["'pitch'", "prismatic", "revolute"]),
    "free": (change('name="mount" type="fixed"', 'name="mount" type="floating"'), ["'mount'", "floating"]),
    "mimic": (change('<axis xyz="0 0 1"/>', '<mimic joint="yaw"/>'), ["'roll'", "mimic"]),
    "no mass": (change(LOWER, ""), ["link 'lower'", "expected an <inertial>"]),
    "a word": (change('mass value="1.5"', 'mass value="heavy"'), ["link 'lower'", "value", "'heavy'"]),
    "two numbers": (change('xyz="0 0 0.3"', 'xyz="0 0.3"'), ["joint 'roll'", "3 numbers", "'0 0.3'"]),
    "no body": (change('izz="0.015"', 'izz="0.15"'), ["link 'upper'", "none above the sum of the others"]),
    "no axis": (change('xyz="0 0 2"', 'xyz="0 0 0"'), ["joint 'yaw'", "axis"]),
    "limits": (change('lower="-1.5"', 'lower="3"'), ["joint 'pitch'", "3", "2 rad"]),
    "a link": (change('child link="lower"', 'child link="lover"'), ["'pitch'", "'lover'", "did you mean 'lower'"]),
    "twice": (change('<link name="tip"/>', '<link name="hand"/>'), ["two elements link 'hand'"]),
    "two roots": (beside_the_world('<link name="moon"/>'), ["world, moon"]),
    "two parents": (beside_the_camera(fixed("j", "tool", "camera")), ["'camera'", "'camera_fixed'", "'j'"]),
    "a loop": (
        beside_the_camera('<link name="a"/><link name="b"/>' + fixed("j", "a", "b") + fixed("k", "b", "a")),
        ["link 'a'", "loop"],
    ),
    "two branches": (change("</robot>", FORK + "</robot>"), ["not a serial arm", "'other'", "'hand'"]),
    "no torque": (change('effort="20"', ""), ["robot.tau_max", "pitch"]),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_wrong_urdf_gets_one_line(mistake, write):
    """The file, the element by its name, and what is allowed."""
    text, words = MISTAKES[mistake]
    with pytest.raises(UserError) as caught:
        load_robot(write(text), ee="tip")
    message = str(caught.value)
    assert "\n" not in message
    for word in ["lamp.urdf", *words]:
        assert word in message


def test_an_end_effector_is_a_site_a_body_or_a_link(write):
    """Its place is that body's frame; of several candidates none is taken, and an unknown one gets the nearest."""
    path = write(URDF)
    urdf = load_robot(path, ee="camera")
    model = urdf.model(gravity=False)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    np.testing.assert_allclose(data.site(urdf.ee_site).xpos, data.body("camera").xpos, atol=1e-12)
    xml = write(MJCF.replace("TENSOR", turned_tensor()), "lamp.xml")
    assert load_robot(xml, ee="tool").ee_site == "tool"
    assert load_robot(xml).ee_site == "tip"
    with pytest.raises(UserError, match=r"^robot\.ee: choose the end effector of lamp\.urdf: .*tip.*camera"):
        load_robot(path)
    with pytest.raises(UserError, match=r"expected one of .* in lamp\.urdf, got 'camra'; did you mean 'camera'\?$"):
        load_robot(path, ee="camra")


def test_a_file_is_urdf_by_its_name_or_by_its_first_element(write):
    assert load_robot(write(URDF, "lamp.xml"), ee="tip").n == 3
    assert Path(write("no XML", "lamp.txt")).read_text() == "no XML"
    with pytest.raises(UserError, match="not a valid MJCF"):
        load_robot(write("no XML", "lamp.txt"))
