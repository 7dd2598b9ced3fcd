"""Robot descriptions: an identified arm is the same in MJCF, URDF and SDF, for every reader."""

from dataclasses import replace
from xml.etree import ElementTree

import dartpy
import mujoco
import numpy as np
import pytest
from conftest import conf
from test_engines import ODD_ARM

from r2s.errors import UserError
from r2s.physics.description import coulomb_viscous, write_mjcf, write_sdf, write_urdf
from r2s.physics.dynamics import nominal_dynamics
from r2s.physics.robot import load_robot
from r2s.physics.simulator import single_arm


def identified(robot):
    """Return dynamics with slightly different links than the file's."""
    rng = np.random.default_rng(3)
    n = robot.n
    friction = conf("friction/paper") if n == 7 else {"family": "sigmoid", **UNIFORM}
    plain = nominal_dynamics(robot, **friction)
    tensor = robot.inertia * rng.uniform(0.8, 1.2, n)[:, None, None]
    return replace(
        plain,
        inertia=tensor,
        mass=robot.mass * rng.uniform(0.8, 1.2, n),
        com=robot.com + rng.normal(0, 0.01, (n, 3)),
    )


UNIFORM = {k: v for k, v in conf("friction/uniform").items() if k != "family"}


@pytest.fixture(params=["panda", "odd"])
def arm(request, tmp_path):
    """Return a robot and its dynamics; the second arm has anchors, references and welds that a Panda has not."""
    if request.param == "panda":
        robot = load_robot(**conf("robot/panda"))
    else:
        path = tmp_path / "odd.xml"
        path.write_text(ODD_ARM.replace(' armature="0.05"', "").replace(' armature="0.01"', ""))
        robot = load_robot(str(path))
    return robot, identified(robot)


def reference(robot, dynamics):
    """Return q -> mass matrix, gravity torque, end effector: MuJoCo with the arrays themselves."""
    model = single_arm(robot, dynamics)
    model.jnt_user[:] = 0
    model.opt.gravity[:] = 0, 0, -9.81
    return statics(robot, model, robot.ee_site)


def statics(robot, model, site=None):
    """Return q -> mass matrix, gravity torque, end effector of a MuJoCo model."""
    data, full = mujoco.MjData(model), np.empty((robot.n, robot.n))

    def at(q):
        data.qpos[:] = q
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, full)
        place = data.site(site).xpos if site else data.body("ee").xpos
        return full.copy(), data.qfrc_bias.copy(), place.copy()

    return at


def dart_statics(skeleton, hand):
    """Return the same of a DART skeleton."""
    world = dartpy.simulation.World()
    world.setGravity([0, 0, -9.81])
    world.addSkeleton(skeleton)

    def at(q):
        skeleton.setPositions(q)
        skeleton.setVelocities(np.zeros(len(q)))
        return skeleton.getMassMatrix(), skeleton.getGravityForces(), hand(skeleton)

    at.world = world  # it holds the skeleton's gravity
    return at


def check(robot, ours, theirs):
    """Compare at random postures, within 1e-6."""
    for q in np.random.default_rng(0).uniform(robot.q_min, robot.q_max, (30, robot.n)):
        for a, b in zip(ours(q), theirs(q), strict=True):
            if b is not None:
                np.testing.assert_allclose(a, b, atol=1e-6)


def test_mjcf_comes_back(arm, tmp_path):
    robot, dynamics = arm
    write_mjcf(tmp_path / "arm.xml", robot, dynamics)
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "arm.xml"))
    check(robot, reference(robot, dynamics), statics(robot, model, "ee"))
    coulomb, viscous = coulomb_viscous(robot, dynamics)
    np.testing.assert_allclose(model.dof_frictionloss, coulomb, atol=1e-9)
    np.testing.assert_allclose(model.dof_damping, viscous, atol=1e-9)
    np.testing.assert_allclose(model.jnt_range, np.stack([robot.q_min, robot.q_max], -1), atol=1e-6)
    again = load_robot(str(tmp_path / "arm.xml"))
    np.testing.assert_allclose(again.tau_max, robot.tau_max)


def test_urdf_in_mujoco_and_dart(arm, tmp_path):
    robot, dynamics = arm
    path = tmp_path / "arm.urdf"
    write_urdf(path, robot, dynamics)
    spec = mujoco.MjSpec.from_file(str(path))
    spec.compiler.fusestatic = False  # keeps the link `ee`
    model = spec.compile()
    check(robot, reference(robot, dynamics), statics(robot, model))
    loader, options = dartpy.utils.DartLoader(), dartpy.utils.DartLoaderOptions()
    options.mDefaultRootJointType = dartpy.utils.DartLoaderRootJointType.FIXED
    loader.setOptions(options)
    skeleton = loader.parseSkeleton(str(path))
    hand = lambda s: s.getBodyNode("ee").getWorldTransform().translation()  # noqa: E731
    check(robot, reference(robot, dynamics), dart_statics(skeleton, hand))
    limits(robot, dynamics, skeleton)
    joints = [j for j in skeleton.getJoints() if j.getNumDofs()]
    np.testing.assert_allclose([j.getForceUpperLimit(0) for j in joints], robot.tau_max)
    np.testing.assert_allclose([j.getVelocityUpperLimit(0) for j in joints], robot.dq_max)


def test_sdf_in_dart(arm, tmp_path):
    robot, dynamics = arm
    path = tmp_path / "arm.sdf"
    write_sdf(path, robot, dynamics)
    path.write_text(path.read_text().replace('version="1.9"', 'version="1.6"'))  # what dartpy reads
    skeleton = dartpy.utils.SdfParser.readSkeleton(str(path))
    check(robot, reference(robot, dynamics), dart_statics(skeleton, lambda s: None))
    limits(robot, dynamics, skeleton)
    root = ElementTree.parse(path).getroot()  # dartpy does not read these two
    for name, value in (("effort", robot.tau_max), ("velocity", robot.dq_max)):
        np.testing.assert_allclose([float(x.text) for x in root.iter(name)], value)


def limits(robot, dynamics, skeleton):
    """Check limits and friction as DART read them."""
    joints = [j for j in skeleton.getJoints() if j.getNumDofs()]
    coulomb, viscous = coulomb_viscous(robot, dynamics)
    np.testing.assert_allclose([j.getPositionLowerLimit(0) for j in joints], robot.q_min)
    np.testing.assert_allclose([j.getPositionUpperLimit(0) for j in joints], robot.q_max)
    np.testing.assert_allclose([j.getDampingCoefficient(0) for j in joints], viscous, atol=1e-12)
    np.testing.assert_allclose([j.getCoulombFriction(0) for j in joints], coulomb, atol=1e-12)


def test_the_line_meets_the_friction():
    """Coulomb and viscous terms give the identified friction at 0.3 and 1 times the largest velocity."""
    robot = load_robot(**conf("robot/panda"))
    dynamics = identified(robot)
    coulomb, viscous = coulomb_viscous(robot, dynamics)
    for share in (0.3, 1.0):
        level = dynamics.family.level(dynamics.phi, share * robot.dq_max)
        np.testing.assert_allclose(coulomb + viscous * share * robot.dq_max, level, rtol=1e-9)


def test_armature_in_sdf_is_an_error(tmp_path):
    path = tmp_path / "odd.xml"
    path.write_text(ODD_ARM)
    robot = load_robot(str(path))
    with pytest.raises(UserError, match="armature"):
        write_sdf(tmp_path / "odd.sdf", robot, identified(robot))
