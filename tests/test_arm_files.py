"""Files of arms as people have them: scenes, grippers, switches of a simulator, placeholders, springs."""

from dataclasses import replace
from pathlib import Path

import dartpy
import mujoco
import numpy as np
import pytest

from r2s.errors import UserError
from r2s.physics.description import write_description, write_mjcf, write_sdf, write_urdf
from r2s.physics.dynamics import nominal_dynamics
from r2s.physics.rigid_body import LinkInertia, mujoco_inverse_dynamics, regressor
from r2s.physics.robot import load_robot
from r2s.physics.welds import Bodies

FRICTIONLESS = {"phi1": 0.0, "phi2": 10.0, "phi3": 0.0}
ARM = """
<mujoco model="four">
  <compiler angle="radian"/>OPTION
  <worldbody>SCENE
    <body name="turret" pos="0 0 0.2"><inertial pos="0 0 0.1" mass="4" diaginertia="0.03 0.03 0.02"/>
      <joint name="pan" axis="0 0 1" range="-3 3" actuatorfrcrange="-80 80"/>
      <body name="upper" pos="0 0 0.2"><inertial pos="0 0 0.15" mass="3" diaginertia="0.03 0.03 0.006"/>
        <joint name="lift" axis="0 1 0" range="-2 2" damping="0.3" SPRING/>TWO
        <body name="lower" pos="0 0 0.3"><inertial pos="0 0 0.12" mass="2" diaginertia="0.015 0.015 0.003"/>
          <joint name="elbow" axis="0 1 0" range="-2.5 2.5" actuatorfrcrange="-40 40"/>
          <body name="wrist" pos="0 0 0.25"><inertial pos="0 0.01 0.05" mass="1" diaginertia="0.002 0.002 0.001"/>
            <joint name="roll" axis="0 0 1" range="-3 3" actuatorfrcrange="-10 10"/>
            <site name="tip" pos="0 0 0.1"/>HAND
          </body>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="m" joint="lift" MOTOR/>EXTRA</actuator>
  REST
</mujoco>
"""
EMPTY = dict.fromkeys(("OPTION", "SCENE", "SPRING", "TWO", "HAND", "EXTRA", "REST"), "")
MOTOR = 'forcerange="-80 80"'
HAND = """
<frame euler="0 0 0.4"><body name="hand" pos="0 0 0.1" euler="0 0 0.3"><geom size="0.04" mass="0.6"/>
  <body name="left" pos="0.01 0 0.05"><joint name="f1" type="slide" axis="0 1 0" range="0 0.08"/>
    <geom size="0.01" pos="0 0.02 0" mass="0.05"/></body>
  <body name="right" pos="-0.01 0 0.05"><joint name="f2" type="slide" axis="0 -1 0" range="0 0.08"/>
    <geom size="0.01" pos="0 0.02 0" mass="0.05"/></body>
</body></frame>"""
MIRROR = '<equality><joint joint1="f2" joint2="f1"/></equality>'


@pytest.fixture
def write(tmp_path):
    """Return parts of ARM -> path of the file."""

    def writer(**parts):
        text = ARM
        for key, value in (EMPTY | {"MOTOR": MOTOR} | parts).items():
            text = text.replace(key, value)
        path = tmp_path / f"arm{len(list(tmp_path.iterdir()))}.xml"
        path.write_text(text)
        return str(path)

    return writer


def states(robot, count=1000):
    """Return q, dq, ddq (count, n) within the limits."""
    rng = np.random.default_rng(1)
    return rng.uniform(*robot.q_range, (count, robot.n)), *rng.normal(size=(2, count, robot.n))


def torque(robot, at=None):
    """Return inverse dynamics under gravity (T, n) Nm, without limits."""
    model = robot.model(gravity=True)
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_LIMIT)
    return mujoco_inverse_dynamics(model, *(at or states(robot)))


@pytest.mark.parametrize(
    "parts",
    [
        {"OPTION": '<option density="1000" viscosity="1"/>'},
        {"OPTION": '<option><flag gravity="disable"/></option>'},
        {"OPTION": '<option><flag spring="disable" damper="disable"/></option>'},
        {"OPTION": '<default><joint/></default><option integrator="RK4"/>'},
        {"SCENE": '<body name="cube" pos="1 0 0"><freejoint/><geom size="0.1"/></body>'},
        {
            "SCENE": '<body name="cube"><freejoint name="c"/><geom size="0.1"/><site name="s"/></body>',
            "REST": '<equality><weld body1="cube" body2="wrist"/></equality><sensor><framepos objtype="site" '
            'objname="s"/></sensor><keyframe><key qpos="0 0 0 1 0 0 0 1 1 1 1"/></keyframe>',
        },
        {
            "SCENE": '<body name="mocap" mocap="true"/>',
            "REST": '<equality><weld body1="mocap" body2="wrist"/></equality>',
        },
        {"REST": '<equality><joint joint1="lift" joint2="elbow" active="false"/></equality>'},
        {"REST": '<tendon><fixed name="both"><joint joint="lift" coef="1"/></fixed></tendon>'},
    ],
)
def test_switches_and_objects_of_a_scene_change_nothing(write, parts):
    np.testing.assert_allclose(torque(load_robot(write(**parts))), torque(load_robot(write())), atol=1e-12)


def test_gravity_compensation_of_the_simulator_is_left_out(write):
    """`gravcomp` and a compensated actuator hold no link of the real arm."""
    text = ARM.replace("<body ", '<body gravcomp="1" ').replace(
        "actuatorfrcrange", 'actuatorgravcomp="true" actuatorfrcrange'
    )
    path = write()
    with open(path, "w") as file:
        for key, value in (EMPTY | {"MOTOR": MOTOR}).items():
            text = text.replace(key, value)
        file.write(text)
    np.testing.assert_allclose(torque(load_robot(path)), torque(load_robot(write())), atol=1e-12)


def test_a_motors_rotor_and_damping_are_its_joints(write):
    """MuJoCo reflects both by the square of the gear."""
    robot = load_robot(write(MOTOR='ctrlrange="-8 8" gear="10" armature="0.002" damping="0.001"'))
    assert robot.tau_max[1] == 80
    np.testing.assert_allclose(robot.armature, [0, 0.2, 0, 0])
    np.testing.assert_allclose(robot.damping, [0, 0.4, 0, 0])


def test_the_keyframe_home_is_home(write):
    keys = '<keyframe><key name="zero" qpos="0 0 0 0"/><key name="home" qpos="0.1 -0.4 0.9 0.2"/></keyframe>'
    path = write(REST=keys)
    np.testing.assert_array_equal(load_robot(path).q_home, [0.1, -0.4, 0.9, 0.2])
    np.testing.assert_array_equal(load_robot(path, q_home=[0, 0, 0, 0]).q_home, 0)
    with pytest.raises(UserError, match=r"robot\.q_home: expected -2.000 to 2.000 rad, got 2.500"):
        load_robot(write(REST='<keyframe><key name="home" qpos="0 2.5 0 0"/></keyframe>'))


MISTAKES = {
    "zero gravity": ({"OPTION": '<option gravity="0 0 0"/>'}, "set robot.gravity=[0, 0, -9.81] for an upright base"),
    "coupled": (
        {"REST": '<equality><joint joint1="elbow" joint2="lift"/></equality>'},
        "the equality constraint of 'elbow' and 'lift' ties joints together",
    ),
    "a loop": (
        {"REST": '<equality><connect body1="turret" body2="lower" anchor="0 0 0"/></equality>'},
        "the equality constraint of 'turret' and 'lower' ties joints together",
    ),
    "a tendon": (
        {"REST": '<tendon><fixed name="b" stiffness="50"><joint joint="lift" coef="1"/></fixed></tendon>'},
        "tendon 'b' acts between the joints",
    ),
    "one side": ({"MOTOR": 'forcerange="0 80"'}, "lift in arm0.xml; its motor has force in one direction only"),
    "no range": ({}, "robot.q_min: arm0.xml limits roll to 0 to 0 rad"),
    "degrees": ({}, "has limits of -170 to 170 rad (joint 4): are they in degrees?"),
    "two hinges": (
        {"TWO": '<joint name="twist" axis="0 0 1"/>'},
        "joints 'lift' and 'twist' are both in body 'upper'; give each a body of its own",
    ),
    "a gripper": ({"HAND": HAND, "REST": MIRROR}, "a gripper's or a rail's is welded by robot.lock={f1: 0}"),
    "a floating base": (
        {
            "SCENE": '<body name="cart"><freejoint/><geom size="1"/><body><joint axis="1 0 0"/><geom size="1"/>'
            "</body></body>"
        },
        "got mjJNT_FREE (joint ''); it carries the arm: delete it",
    ),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_file_that_is_no_serial_arm_gets_one_line(write, mistake):
    parts, words = MISTAKES[mistake]
    path = Path(write(**parts))
    ranges = {"no range": "0 0", "degrees": "-170 170"}
    if mistake in ranges:
        path.write_text(
            path.read_text().replace(
                'axis="0 0 1" range="-3 3" actuatorfrcrange="-10 10"',
                f'axis="0 0 1" range="{ranges[mistake]}" actuatorfrcrange="-10 10"',
            )
        )
    with pytest.raises(UserError) as caught:
        load_robot(str(path))
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def scaled(path, mass, by, moments=1.0):
    """Change the mass of a link, and its moments, in a file."""
    with open(path) as file:
        text = file.read()
    (before,) = [part for part in text.split("<inertial")[1:] if f'mass="{mass}"' in part]
    triple = before.split('diaginertia="')[1].split('"')[0]
    after = before.replace(f'mass="{mass}"', f'mass="{mass * by:g}"')
    after = after.replace(triple, " ".join(repr(moments * float(x)) for x in triple.split()))
    with open(path, "w") as file:
        file.write(text.replace(before, after))
    return path


@pytest.mark.parametrize(
    ("mass", "by", "moments", "words"),
    [
        (3, 6.0, 6.0, "link 'upper' has 18 kg, all other links together have 7 kg"),  # 42.9 kg for 7.2
        (1, 0.001, 0.001, "link 'wrist' has 0.001 kg of the arm's 9 kg: a placeholder?"),
        (2, 0.0005, 1.0, "link 'lower' has 0.001 kg of the arm's 8 kg: a placeholder?"),
        (2, 1.0, 1e-6, "less than a ball of tungsten"),  # kg m^2 written as kg mm^2 the wrong way
        (2, 6.0, 1.0, "link 'lower' has 12 kg with moments 0.015 0.015 0.003 kg m^2, less than a ball of tungsten"),
        (2, 4.0, 9.0, "joint 2 would need"),
    ],
)
def test_a_mass_that_no_arm_has_is_named(write, mass, by, moments, words):
    with pytest.raises(UserError) as caught:
        load_robot(scaled(write(), mass, by, moments), tau_max=[80, 20, 20, 10])
    assert words in str(caught.value)


def test_a_locked_gripper_is_a_part_of_the_last_link(write):
    """Its mirrored finger follows; torque and the lumped link are those of the file with the fingers held."""
    path = write(HAND=HAND, REST=MIRROR + '<keyframe><key name="home" qpos="0 -0.4 0.9 0.2 0.03 0.03"/></keyframe>')
    robot = load_robot(path, lock={"f1": 0.04})
    assert robot.n == 4
    np.testing.assert_array_equal(robot.q_home, [0, -0.4, 0.9, 0.2])
    assert robot.mass[-1] == pytest.approx(1.7)
    free = mujoco.MjModel.from_xml_path(path)
    free.dof_damping[:] = 0.0  # nominal friction, not part of the rigid model
    free.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_LIMIT | mujoco.mjtDisableBit.mjDSBL_EQUALITY)
    q, dq, ddq = states(robot, 100)
    held = np.full((100, 2), 0.04)
    whole = mujoco_inverse_dynamics(free, np.hstack([q, held]), np.hstack([dq, 0 * held]), np.hstack([ddq, 0 * held]))
    np.testing.assert_allclose(torque(robot, (q, dq, ddq)), whole[:, :4], atol=1e-9)
    model = robot.model(gravity=True)
    assert Bodies(model).lumped(model.jnt_bodyid[-1])[0] == pytest.approx(1.7)
    with pytest.raises(UserError, match=r"robot.lock: no hinge or slide 'f3' in .*did you mean 'f[12]'"):
        load_robot(path, lock={"f3": 0.04})


URDF_HAND = """
  <link name="hand"><inertial><mass value="0.5"/><inertia ixx="1e-3" iyy="1e-3" izz="1e-3"/></inertial></link>
  <joint name="hand_fixed" type="fixed"><parent link="wrist"/><child link="hand"/><origin xyz="0 0 0.1"/></joint>
  <link name="left"><inertial><mass value="0.1"/><inertia ixx="1e-4" iyy="1e-4" izz="1e-4"/></inertial></link>
  <joint name="f1" type="prismatic"><parent link="hand"/><child link="left"/><axis xyz="0 2 0"/><limit effort="9"/>
  </joint>
  <link name="right"><inertial><mass value="0.1"/><inertia ixx="1e-4" iyy="1e-4" izz="1e-4"/></inertial></link>
  <joint name="f2" type="prismatic"><parent link="hand"/><child link="right"/><axis xyz="0 -1 0"/>
    <mimic joint="f1" multiplier="0.5" offset="0.01"/></joint>
</robot>"""


def test_a_locked_gripper_of_a_urdf_is_a_part_of_the_last_link(write, tmp_path):
    """The mimic joint follows by its multiplier and offset."""
    robot = load_robot(write())
    path = tmp_path / "arm.urdf"
    write_urdf(path, robot, nominal_dynamics(robot, **FRICTIONLESS))
    path.write_text(path.read_text().replace("</robot>", URDF_HAND))
    with pytest.raises(UserError, match=r"joint 'f1': .*got prismatic; robot.lock=\{f1: 0\} welds it there"):
        load_robot(str(path), ee="ee")
    held = load_robot(str(path), ee="ee", lock={"f1": 0.04})
    assert held.n == 4
    masses, centres = np.array([1, 0.5, 0.1, 0.1]), [[0.01, 0.05], [0, 0.1], [0.04, 0.1], [-0.03, 0.1]]
    np.testing.assert_allclose(held.mass[-1], masses.sum(), rtol=1e-9)
    np.testing.assert_allclose(held.com[-1][1:], masses @ centres / masses.sum(), atol=1e-9)


def test_limits_of_zero_to_zero_are_a_mistake(write, tmp_path):
    """An endless joint is declared so; given limits count."""
    robot = load_robot(write())
    path = tmp_path / "arm.urdf"
    write_urdf(path, robot, nominal_dynamics(robot, **FRICTIONLESS))
    path.write_text(path.read_text().replace('lower="-2.0" upper="2.0"', 'lower="0" upper="0"'))
    with pytest.raises(UserError, match=r"robot\.q_min: arm\.urdf limits lift to 0 to 0 rad: set robot.q_min"):
        load_robot(str(path), ee="ee")
    given = load_robot(str(path), ee="ee", q_min=[-1] * 4, q_max=[1] * 4)
    np.testing.assert_allclose(given.model(gravity=False).jnt_range, [[-1, 1]] * 4)


SPRING = 'stiffness="12" springref="0.4"'


@pytest.mark.parametrize("parts", [{}, {"SPRING": SPRING}, {"SPRING": 'stiffness="12 3 1" springref="0.4"'}])
def test_what_is_written_moves_like_the_arm(write, tmp_path, parts):
    """MJCF, URDF and SDF, read again by r2s, MuJoCo and Pinocchio: torque at 1,000 states to 1e-9 of the largest."""
    robot = load_robot(write(**parts))
    dynamics = nominal_dynamics(robot, **FRICTIONLESS)
    at, left_out = states(robot), write_description(tmp_path / "model", robot, dynamics)
    exact = torque(robot, at)
    tolerance = 1e-9 * np.abs(exact).max()
    mjcf = tmp_path / "model" / "arm.xml"
    np.testing.assert_allclose(torque(load_robot(str(mjcf)), at), exact, atol=tolerance)
    raw = mujoco.MjModel.from_xml_path(str(mjcf))
    raw.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_LIMIT)
    np.testing.assert_allclose(mujoco_inverse_dynamics(raw, *at), exact, atol=tolerance)
    if not parts:
        urdf = load_robot(str(tmp_path / "model" / "arm.urdf"), ee="ee")
        np.testing.assert_allclose(torque(urdf, at), exact, atol=tolerance)
        assert left_out == []
        return
    with pytest.raises(UserError, match=r"joint 'lift' has a .*spring.*, which URDF cannot represent; use the MJCF"):
        write_urdf(tmp_path / "arm.urdf", robot, dynamics)
    assert left_out[0].startswith("not written: arm.urdf: robot.mjcf: joint 'lift' has a")
    if parts["SPRING"] == SPRING:
        write_sdf(tmp_path / "arm.sdf", robot, dynamics)
        assert "<spring_stiffness>12.0<" in (tmp_path / "arm.sdf").read_text()
        assert "<spring_reference>0.4<" in (tmp_path / "arm.sdf").read_text()
    else:
        assert left_out[1].startswith(
            "not written: arm.sdf: robot.mjcf: joint 'lift' has a nonlinear damping or spring"
        )


def dart_urdf(path):
    """Return the skeleton of a URDF, fixed to the world."""
    loader, options = dartpy.utils.DartLoader(), dartpy.utils.DartLoaderOptions()
    options.mDefaultRootJointType = dartpy.utils.DartLoaderRootJointType.FIXED
    loader.setOptions(options)
    return loader.parseSkeleton(str(path))


def dart_torque(skeleton, gravity, at):
    """Return DART's inverse dynamics (T, n) Nm, without damping and springs."""
    skeleton.setGravity(gravity)
    out = []
    for q, dq, ddq in zip(*at, strict=True):
        skeleton.setPositions(q)
        skeleton.setVelocities(dq)
        skeleton.setAccelerations(ddq)
        skeleton.computeInverseDynamics(False, False, False)
        out.append(skeleton.getForces())
    return np.array(out)


@pytest.mark.parametrize(("form", "parts"), [("urdf", {}), ("sdf", {}), ("sdf", {"SPRING": SPRING})])
def test_what_is_written_moves_alike_in_dart(write, tmp_path, form, parts):
    """Inverse dynamics at 1,000 states to 1e-9 of the largest; DART leaves damping and springs to the caller."""
    robot = load_robot(write(**parts))
    path = tmp_path / f"arm.{form}"
    {"urdf": write_urdf, "sdf": write_sdf}[form](path, robot, nominal_dynamics(robot, **FRICTIONLESS))
    if form == "sdf":
        path.write_text(path.read_text().replace('version="1.9"', 'version="1.6"'))  # what dartpy reads
        skeleton = dartpy.utils.SdfParser.readSkeleton(str(path))
    else:
        skeleton = dart_urdf(path)
    at = states(robot)
    theirs = dart_torque(skeleton, robot.gravity, at)
    joints = [j for j in skeleton.getJoints() if j.getNumDofs()]
    rest, stiffness = (
        np.array([getattr(j, f"get{x}")(0) for j in joints]) for x in ("RestPosition", "SpringStiffness")
    )
    damping = np.array([j.getDampingCoefficient(0) for j in joints])
    theirs = theirs + stiffness * (at[0] - rest) + damping * at[1]
    exact = torque(robot, at)
    np.testing.assert_allclose(theirs, exact, atol=1e-9 * np.abs(exact).max())


def changed(robot):
    """Return dynamics with other masses, centres, tensors and rotors than the file's, without friction."""
    rng, n = np.random.default_rng(5), robot.n
    factor = rng.uniform(0.8, 1.2, n)
    plain = nominal_dynamics(robot, **FRICTIONLESS)
    own = {"mass": factor * robot.mass, "com": robot.com + rng.normal(0, 0.01, (n, 3))}
    tilt = np.linalg.qr(rng.normal(size=(n, 3, 3)))[0]  # other principal axes, the same moments
    return replace(
        plain, **own, inertia=tilt @ robot.inertia @ tilt.swapaxes(1, 2), armature=rng.uniform(0.05, 0.2, n)
    )


def test_an_identified_arm_comes_back_in_every_reader(panda, tmp_path):
    """Of a Panda with other links and rotors: torque at 1,000 states to 1e-9 of the largest.

    r2s reads rotors from MJCF and URDF, MuJoCo from MJCF; no other reader of the URDF knows them.
    """
    d, at = changed(panda), states(panda)
    write_mjcf(tmp_path / "arm.xml", panda, d)
    write_urdf(tmp_path / "arm.urdf", panda, d)
    xml, urdf = str(tmp_path / "arm.xml"), str(tmp_path / "arm.urdf")
    y = regressor(panda, *at, panda.gravity).reshape(len(at[0]), panda.n, -1)
    links = y @ LinkInertia(d.mass, d.com, d.inertia).standard().ravel()
    exact = links + d.armature * at[2]
    found = {
        "r2s, MJCF": (exact, torque(load_robot(xml), at)),
        "r2s, URDF": (exact, torque(load_robot(urdf, ee="ee"), at)),
    }
    for name, path, expected in (("MJCF", xml, exact), ("URDF", urdf, links)):
        model = mujoco.MjModel.from_xml_path(path)
        model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_LIMIT)
        found[f"MuJoCo, {name}"] = expected, mujoco_inverse_dynamics(model, *at)
    found["DART, URDF"] = links, dart_torque(dart_urdf(urdf), panda.gravity, at)
    for name, (expected, theirs) in found.items():
        np.testing.assert_allclose(theirs, expected, atol=1e-9 * np.abs(exact).max(), rtol=0, err_msg=name)


def test_an_identified_arm_comes_back_in_pinocchio(panda, tmp_path):
    """From MJCF with its rotors, from URDF without, at 1,000 states."""
    pinocchio = pytest.importorskip("pinocchio", reason="pip install pin")
    d, at = changed(panda), states(panda)
    write_mjcf(tmp_path / "arm.xml", panda, d)
    write_urdf(tmp_path / "arm.urdf", panda, d)
    y = regressor(panda, *at, panda.gravity).reshape(len(at[0]), panda.n, -1)
    links = y @ LinkInertia(d.mass, d.com, d.inertia).standard().ravel()
    for name, build, rotors in (
        ("arm.xml", "buildModelFromMJCF", d.armature),
        ("arm.urdf", "buildModelFromUrdf", 0.0),
    ):
        model = getattr(pinocchio, build)(str(tmp_path / name))
        data = model.createData()
        theirs = [pinocchio.rnea(model, data, *x) for x in zip(*at, strict=True)]
        np.testing.assert_allclose(theirs, links + rotors * at[2], atol=1e-9 * np.abs(links).max(), err_msg=name)
