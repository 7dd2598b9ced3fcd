"""The emulated control box without a client: its wire, reflexes, limits, loads and thresholds."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from served_arms import Bare, holdable, loaded

from r2s.arm.clients import fci, fr3_limits
from r2s.arm.emulator.control import CUTOFF_HZ, Control, Fault
from r2s.arm.emulator.robot_model import urdf
from r2s.errors import UserError
from r2s.physics.payload import payload_of
from r2s.physics.robot import SIM_DT


def test_wire_layout():
    """Sizes and offsets equal those that both clients accept."""
    for version, size, command, q, tau, mode in ((5, 2373, 370, 1184, 1016, 2364), (10, 1377, 371, 596, 512, 1372)):
        state = fci.STATE[version]
        assert (state.itemsize, fci.COMMAND[version].itemsize) == (size, command)
        assert [state.fields[name][1] for name in ("q", "tau_J", "robot_mode")] == [q, tau, mode]
    assert [fci.REQUESTS[5].index(name) for name in ("SetLoad", "LoadModelLibrary")] == [10, 13]
    assert [fci.REQUESTS[10].index(name) for name in ("SetLoad", "GetRobotModel")] == [9, 11]


def test_the_served_urdf_is_the_arm(panda):
    """GetRobotModel's URDF has the arm's kinematics and inertia."""
    served = mujoco.MjModel.from_xml_string(urdf(panda))
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
    """Return a robot whose home is `room` rad below the upper limit of its last joint."""
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
def test_reflexes_set_libfrankas_error_flags(place, torque, panda):
    """Each violated limit sets libfranka's flag, and can be cleared."""
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
    """Near a position limit version 10 refuses a speed that version 5 allows."""
    wide = replace(panda, q_max=panda.q_max + 0.2)
    for version, goes_on in ((5, True), (10, False)):
        control, _ = begun(near_limit(wide, wide.q_max[6] - fr3_limits.Q_MAX[6] + 0.02), version)
        for _ in range(50):
            if control.running:
                control.cycle(0.05 * np.eye(7)[6])
        assert control.running == goes_on
    assert np.flatnonzero(control.state["errors"]).tolist() == [fci.JOINT_VELOCITY]


def test_an_fr3_has_limits_of_its_own(panda):
    """Version 10 stops at 0.2 rad of joint 6, which a Panda allows; recovery moves the arm back inside."""
    low = replace(panda, q_home=np.array([0, 0, 0, -2, 0, 0.2, 0]))
    for version, goes_on in ((5, True), (10, False)):
        control, arm = begun(low, version)
        control.cycle(np.zeros(7))
        assert control.running == goes_on
    assert np.flatnonzero(control.state["errors"]).tolist() == [fci.JOINT_POSITION_LIMITS]
    assert "an FR3 allows 0.4398 to 4.6216" in control.stopped_by
    assert control.recover()
    assert arm.read().q[5] > fr3_limits.Q_MIN[5]


def test_a_missed_answer_repeats_the_last_torque(panda):
    """19 consecutive misses repeat the last torque, the 20th ends the motion."""
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
    assert "20 consecutive cycles" in control.stopped_by


def field(control, name):
    """Return a field of RobotState in double precision."""
    return control.state[name].astype(float)


@pytest.mark.parametrize("version", [5, 10])
def test_an_undeclared_payload_is_an_external_force(version, panda):
    """The arm holds it up: a force along +z at its place, whose torque about the end effector is that of its lever.

    1e-4 N: single precision of the frames and of 12 N (1e-6), with a margin.
    """
    body = {"mass": 1.2, "centre": [0.03, 0.0, 0.05]}
    control = Control(loaded(panda, body), version)
    frame = field(control, "O_T_EE").reshape(4, 4).T
    up = np.array([0, 0, 1.2 * 9.81])
    lever = frame[:3, :3] @ body["centre"]
    wrench = np.concatenate([up, np.cross(lever, up)])
    np.testing.assert_allclose(field(control, "O_F_ext_hat_K"), wrench, atol=1e-4)
    own = np.concatenate([frame[:3, :3].T @ wrench[:3], frame[:3, :3].T @ wrench[3:]])
    np.testing.assert_allclose(field(control, "K_F_ext_hat_K"), own, atol=1e-4)
    assert np.abs(field(Control(loaded(panda, body, body), version), "tau_ext_hat_filtered")).max() < 1e-12
    less = Control(loaded(panda, None, body), version)
    np.testing.assert_allclose(field(less, "O_F_ext_hat_K"), -wrench, atol=1e-4)
    assert field(less, "m_load") == pytest.approx(1.2)


def test_a_load_that_is_set_is_no_external_force(panda):
    """After SetLoad with the payload's values the estimate is zero; a tilted O_ddP_O is felt as a force."""
    body = {"mass": 1.2, "centre": [0.03, 0.0, 0.05]}
    control = Control(loaded(panda, body), 5)
    before = field(control, "tau_ext_hat_filtered")
    assert np.abs(before).max() > 3
    load = payload_of(body, (3.0, 0.15))
    control.set("SetLoad", np.array((1.2, load.centre, load.inertia.ravel()), fci.LOAD))
    assert np.abs(field(control, "tau_ext_hat_filtered")).max() < 1e-9
    assert field(control, "m_load") == 1.2
    tilted = Control(Bare(panda), 5, desk={"O_ddP_O": [9.81 * np.sin(0.2), 0, -9.81 * np.cos(0.2)]})
    assert np.abs(field(tilted, "tau_ext_hat_filtered")).max() > 3
    with pytest.raises(UserError, match="desk setting 'm_hand'; allowed: F_T_EE, m_ee"):
        Control(Bare(panda), 5, desk={"m_hand": 0.7})


def test_frames_that_are_set_move_the_end_effector(panda):
    """SetNEToEE moves O_T_EE; SetEEToK moves the point of the wrench."""
    control = Control(loaded(panda, 1.0), 5)
    flange = field(control, "O_T_EE").reshape(4, 4).T
    up = field(control, "O_F_ext_hat_K")
    tool = np.eye(4)
    tool[:3, 3] = 0.02, 0.0, 0.1
    control.set("SetNEToEE", np.array((tool.T.ravel(),), fci.SETTINGS["SetNEToEE"]))
    np.testing.assert_allclose(field(control, "O_T_EE").reshape(4, 4).T, flange @ tool, atol=1e-12)
    np.testing.assert_allclose(field(control, "F_T_EE").reshape(4, 4).T, tool, atol=1e-12)
    lever = -flange[:3, :3] @ tool[:3, 3]
    np.testing.assert_allclose(field(control, "O_F_ext_hat_K")[3:], up[3:] + np.cross(lever, up[:3]), atol=1e-6)
    control.set("SetEEToK", np.array((np.linalg.inv(tool).T.ravel(),), fci.SETTINGS["SetEEToK"]))
    np.testing.assert_allclose(field(control, "O_F_ext_hat_K"), up, atol=1e-6)


def test_contact_and_collision_follow_the_thresholds(panda):
    """A held link raises the contact flag at the lower threshold, the collision flag and the reflex at the upper."""
    thresholds = np.full((), 100.0, fci.COLLISION)
    thresholds["lower_torque"], thresholds["upper_torque"] = 2.0, 6.0
    control = Control(holdable(panda), 5, [Fault("hold", 40, cycles=10_000)])
    control.set("SetCollisionBehavior", thresholds)
    control.begin()
    control.first_answer()
    contact = []
    for k in range(2000):
        if not control.running:
            break
        control.cycle(np.minimum(0.5 * (k + 1), 12.0) * np.eye(7)[0])
        contact.append((control.state["joint_contact"][0], np.abs(field(control, "tau_ext_hat_filtered")).max()))
    flags, torque = np.array(contact).T
    np.testing.assert_array_equal(flags > 0, torque > 2)
    assert 0 < flags.sum() < len(flags)
    assert np.flatnonzero(control.state["reflex_reason"]).tolist() == [fci.JOINT_REFLEX]
    assert control.state["joint_collision"][0] == 1
    assert "joint 1: external torque" in control.stopped_by
    assert control.recover()
    assert not control.state["joint_contact"].any()  # nothing holds the link any more


def test_the_external_torque_is_low_passed(panda):
    """After a step it follows 1 - exp(-2 pi 15 Hz t), the first-order filter of the emulator."""
    arm = holdable(panda)
    control = Control(arm, 5)
    control.begin()
    arm.external = -np.eye(7)[6]  # what the surroundings do to the arm; the estimate has the other sign
    arm.move_to(panda.q_home)
    seen = []
    for _ in range(30):
        control._feel()
        seen.append(field(control, "tau_ext_hat_filtered")[6])
    np.testing.assert_allclose(seen, 1 - np.exp(-2 * np.pi * CUTOFF_HZ * SIM_DT * (1 + np.arange(30))), atol=1e-12)


@pytest.mark.parametrize("version", [5, 10])
def test_the_box_forgives_no_step(version, panda):
    """A step of 1.0005 Nm per ms stops the motion; r2s's own arms tolerate 1e-3 Nm of round-off."""
    for step, goes_on in ((0.9999, True), (1.0005, False)):
        control, arm = begun(panda, version)
        control.cycle(np.full(7, step))
        assert control.running == goes_on
        assert len(arm.commands) == goes_on
    assert np.flatnonzero(control.state["errors"]).tolist() == [fci.TORQUE_DISCONTINUITY]
