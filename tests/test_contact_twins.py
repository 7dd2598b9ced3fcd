"""The surface of a twin: drawn from its seed, held against by friction, and seen in what the arm reports."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from conftest import conf
from test_contact_physics import pressing

from r2s.arm.emulator.control import Control
from r2s.arm.interface import ArmStopped
from r2s.arm.simulated import SimulatedArm
from r2s.arm.twins.make_twin import make_twin
from r2s.errors import UserError
from r2s.physics.contact_layout import DEPTH, FORCE, NORMAL, POINT, K
from r2s.physics.rigid_body import Kinematics
from r2s.physics.robot import load_robot
from r2s.physics.surface import Tool

VARIANTS = ("rigid", "elastic")
BOTH = pytest.mark.parametrize("variant", VARIANTS)
TABLE = {"point": [0.307, 0.0, 0.528], "normal": [0.0, 0.0, 1.0]}  # 2 mm below the tip at home


@cache
def armed():
    """Return the Panda with a tip of 10 mm, 50 mm before its flange."""
    return replace(load_robot(**conf("robot/panda")), tool=Tool(np.array([0.0, 0.0, 0.05]), 0.01))


@cache
def kinematics():
    return Kinematics(armed())


def press(arm, read, command, downs, height):
    """Press with impedance, J^T (K (x_d - x) - D v), at each of the commanded depths `downs` m below `height` m.

    Return the contact forces (len(downs), 3) N at the end of 0.5 s each, of which the command changes for 0.4 s.
    """
    x0, last, out = None, np.zeros(7), []
    for before, down in zip((0.0, *downs), downs, strict=False):
        for k in range(500):
            q, dq = read()
            place, jacobian = kinematics()(q)
            place, jacobian = place.reshape(3), jacobian.reshape(3, 7)
            x0 = place.copy() if x0 is None else x0
            target = np.array([x0[0], x0[1], height - before - min(1.0, k / 400) * (down - before)])
            wanted = jacobian.T @ (800 * (target - place) - 60 * jacobian @ dq) - 0.5 * dq
            last = last + np.clip(wanted - last, -0.9, 0.9)
            command(last)
        out.append(arm._touch.contact[FORCE : FORCE + 3].copy())
    return np.array(out)


def pressed(twin, downs=(0.005, 0.02)):
    """Return the forces (k, 3) N of a twin that starts at home above TABLE."""
    twin.move_to(twin.robot.q_home)
    return press(twin, lambda: (twin.read().q, twin.read().dq), twin.command, downs, 0.59)


@BOTH
def test_a_seed_draws_a_surface_near_the_expected_place(variant):
    """Within 5 mm and 5 degrees of it, the same for the same seed, in the range of the tasks."""
    drawn = [make_twin(armed(), variant=variant, seed=s, surface=TABLE)._touch.contact for s in (0, 1, 2, 1)]
    for c in drawn:
        assert abs(c[POINT + 2] - TABLE["point"][2]) <= 5e-3
        assert np.degrees(np.arccos(c[NORMAL + 2])) <= 5.0
        assert 2e3 <= c[K] * (1e-3) ** (c[1] - 1.0) <= 1e5
    assert np.array_equal(drawn[1], drawn[3])
    assert not np.array_equal(drawn[0][:14], drawn[1][:14])


@BOTH
def test_a_surface_out_of_reach_changes_no_bit(variant):
    """A twin above its table moves as one without a table."""
    twins = [make_twin(armed(), variant=variant, seed=3, surface=surface) for surface in (False, True)]
    rng, tau = np.random.default_rng(0), np.zeros(7)
    for twin in twins:
        twin.move_to(armed().q_home)
    for _ in range(60):
        tau = np.clip(tau + 0.2 * rng.normal(size=7), -1, 1)
        for twin in twins:
            twin.command(tau)
        a, b = (twin.read() for twin in twins)
        assert np.array_equal([a.q, a.dq, a.tau_J], [b.q, b.dq, b.tau_J])
    assert a.O_F_ext_hat_K is None
    assert not b.O_F_ext_hat_K.any()


@pytest.mark.long
@BOTH
@pytest.mark.parametrize("stiffness", [3e3, 1e5])
def test_a_twin_presses_and_keeps_its_force(variant, stiffness):
    """At one command the force is higher after unloading than after loading; at 1e5 N/m it is stable.

    Exact rest of the elastic twin keeps it within 0.3 N when the command falls by 1.2 N. The bristles of the rigid
    one yield more than a surface of 1e5 N/m.

    At rest the sensors' torque minus gravity is the external torque, within the noise of a mean of 100 cycles.
    """
    twin = make_twin(armed(), variant=variant, seed=2, surface=TABLE)
    twin._touch.contact[K] = stiffness * 1e3 ** (twin._touch.contact[1] - 1.0)
    forces = pressed(twin, (0.02, 0.0185, 0.04, 0.02))[:, 2]
    assert forces[0] > 8
    assert forces[3] > forces[0] + (2.0 if variant == "elastic" or stiffness < 1e4 else 0.1)
    assert variant == "rigid" or abs(forces[1] - forces[0]) < 0.3
    seen = []
    for _ in range(100):
        twin.command(twin._tau_J_d)
        seen.append(twin.read().tau_J)
    state, q = twin.read(), twin._link_q
    gravity = twin._engine.gravity_torque(q) if variant == "rigid" else twin._gravity(twin._links, q)
    pull = np.mean(seen, axis=0) - gravity
    assert np.abs(state.dq).max() < 0.02
    np.testing.assert_allclose(pull, state.tau_ext_hat_filtered, atol=4 * 0.3 / np.sqrt(100) + 0.3)
    _, jacobian = kinematics()(q)
    force = state.O_F_ext_hat_K
    assert np.array_equal(force[:3], -twin._touch.contact[FORCE : FORCE + 3])
    assert twin._touch.contact[DEPTH] > 0
    turning = np.array([twin._touch.axes[j] @ force[3:] for j in range(7)])
    np.testing.assert_allclose(state.tau_ext_hat_filtered, jacobian.reshape(3, 7).T @ force[:3] + turning, atol=1e-9)


def test_the_emulated_box_reports_the_press():
    """O_F_ext_hat_K is the force on the surface, behind the box's filter and its nominal model of the arm."""
    box = Control(make_twin(armed(), seed=2, surface=TABLE), 5)
    box.begin()
    twin, state = box._arm, box.state
    forces = press(twin, lambda: (state["q"].copy(), state["dq"].copy()), box.cycle, (0.02,), 0.59)
    assert box.stopped_by is None
    assert forces[0, 2] > 8
    np.testing.assert_allclose(state["O_F_ext_hat_K"][:3], -forces[0], atol=0.5)


def test_a_simulated_arm_reports_its_contact(panda):
    """The external torque of the arm of known truth is J^T of what it exerts on the surface."""
    robot, d, jacobian = pressing(panda, 2e4)
    arm = SimulatedArm(robot, d, position_noise=0.0, velocity_noise=0.0)
    tau = np.zeros(7)
    for _ in range(100):
        tau = tau + np.clip(jacobian.T @ np.array([0.0, 0.0, -20.0]) - tau, -0.9, 0.9)
        arm.command(tau)
    force = arm._sim.contact_force[0]
    assert force[2] > 10
    expected = -jacobian.T @ force  # but for the lever of the tangential force, 60 mm, and the motion since home
    np.testing.assert_allclose(arm.read().tau_ext_hat_filtered, expected, atol=0.07 * np.hypot(*force[:2]) + 0.05)


@pytest.mark.parametrize(
    ("surface", "message"),
    [
        ("table", r"^arm\.surface: expected false, true, box or \{point: \[3\], normal: \[3\]\}, got 'table'$"),
        (
            {"point": [0, 0, 0], "normall": [0, 0, 1]},
            r"^arm\.surface: unknown key 'normall'; allowed: point, normal; did you mean 'normal'\?$",
        ),
        ({"point": [0, 0, 0], "normal": [0, 0, 0]}, r"^arm\.surface: expected \{point: 3 numbers in m, normal: 3"),
        ({"point": [0, 0], "normal": [0, 0, 1]}, r"^arm\.surface: expected \{point: 3 numbers in m, normal: 3"),
    ],
)
def test_a_wrong_surface_gets_one_line(surface, message):
    with pytest.raises(UserError, match=message):
        make_twin(armed(), surface=surface)


def test_a_surface_needs_a_tool_and_room(panda):
    with pytest.raises(
        UserError, match=r"^arm\.surface: panda has no tool that could touch it; give robot\.tool=FILE$"
    ):
        make_twin(panda, surface=True)
    inside = {"point": [0.307, 0.0, 0.56], "normal": [0.0, 0.0, 1.0]}
    with pytest.raises(
        UserError, match=r"^arm\.surface: the tip at home would be \d+\.\d mm inside it; choose a point"
    ):
        make_twin(armed(), surface=inside)
    below = armed().q_home + 0.2 * (np.arange(7) == 1)
    with pytest.raises(ArmStopped, match=r"^move_to: the tool's tip would be \d+\.\d mm inside the surface$"):
        make_twin(armed(), surface=TABLE).move_to(below)
