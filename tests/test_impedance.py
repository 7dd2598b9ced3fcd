"""Impedance control: equilibrium, stiffness, damping, null space, orientation, and errors of the user."""

import copy
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from conftest import conf

from r2s.arm.driver import Driver
from r2s.arm.interface import ArmState
from r2s.control.impedance import cartesian_impedance, joint_impedance
from r2s.control.torque import torque
from r2s.errors import UserError
from r2s.physics import impedance as law
from r2s.physics.dynamics import Dynamics, nominal_dynamics
from r2s.physics.newton_euler import WORK, equations, links_of
from r2s.physics.robot import load_robot
from r2s.physics.surface import Tool
from r2s.tasks.reach import ReachTask

PANDA = load_robot(**conf("robot/panda"))
N = PANDA.n
FRICTIONLESS = Dynamics.of(PANDA, np.zeros((N, 3)))
REACH = ReachTask()
DT = 1e-3  # s, cycle
SUBSTEPS = 5  # of the simulation; semi-implicit Euler of 0.2 ms


class Pose(ReachTask):
    """Reaching with targets that have all nine numbers."""

    target_size = 9

    def target(self, t, goals):
        """Return (m, 9): no velocity, the orientation at home."""
        return np.concatenate([goals, np.zeros((len(goals), 6))], axis=1)


def place_of(control, q):
    """Return place (3,) m and Jacobian (6, n) of the controlled point."""
    frames, jacobian, place = np.empty((len(q), 12)), np.empty((6, len(q))), np.empty(3)
    law.arm_pose(q, control.parameters, frames, jacobian, place)
    return place, jacobian


def simulate(control, command: Any, q: np.ndarray, cycles: int, push: Callable | None = None) -> Iterator[tuple]:
    """Yield q, dq, memory and mass matrix in each cycle of the frictionless arm behind its gravity compensation.

    Args:
        control, command: the law and its command (c,), or a function of cycle, q and memory. q: (n,) rad, start at
            rest. push: force (3,) N on the controlled point at its place; None: none.
    """
    n = len(q)
    q, dq, out, memory = q.copy(), np.zeros(n), np.empty(n), np.zeros(control.memory_size)
    mass, bias, work = np.empty((n, n)), np.empty(n), np.empty((n, WORK))
    robot = control.model.robot
    links = links_of(robot, robot.mass, robot.com, robot.inertia)
    for k in range(cycles):
        now = command(k, q, memory) if callable(command) else command
        control.law(q, dq, now, control.parameters, memory, out)
        equations(links, np.zeros(3), q, dq, mass, bias, work)
        yield q, dq, memory, mass + np.diag(robot.armature)
        for _ in range(SUBSTEPS):
            equations(links, np.zeros(3), q, dq, mass, bias, work)
            tau = out - bias
            if push is not None:
                place, jacobian = place_of(control, q)
                tau = tau + jacobian[:3].T @ push(place)
            dq = dq + DT / SUBSTEPS * np.linalg.solve(mass + np.diag(robot.armature), tau)
            q = q + DT / SUBSTEPS * dq


def settled(*how: Any) -> np.ndarray:
    """Return q (n,) rad at the end of `simulate`."""
    return list(simulate(*how))[-1][0]


def target_at(control, place):
    """Return the command (c,) with this target (3,) m, and an action of zero."""
    rest = np.zeros(control.target_size - 3)
    return np.concatenate([control.action_offset, place, rest])


@pytest.mark.long
@pytest.mark.parametrize("turns", [0.0, 5.0])
@pytest.mark.parametrize("way", [(0.02, 0, 0), (0, 0.02, 0), (0, 0, 0.02), (0.1, 0.1, -0.1)])
def test_it_goes_to_the_target_without_overshoot(way, turns):
    """Every mode is critically damped: along the way to the target the error decays, and never changes its sign.

    The slowest mode w leaves (1 + w t) e^(-w t); half a second is for the way at the clipped force, a factor of 2 for
    how the start splits into modes. MOBILITY, 1e-3 / kg against 0.3 / kg, lets the null space move 1e-3 of the way.
    """
    control = cartesian_impedance(PANDA, REACH, FRICTIONLESS, rotational_stiffness=turns)
    start = place_of(control, PANDA.q_home)[0]
    command = target_at(control, start + way)
    left = np.array(
        [start + way - place_of(control, q)[0] for q, *_ in simulate(control, command, PANDA.q_home, 2500)]
    )
    mass, jacobian = (
        control.model.mass(PANDA.q_home[None])[0],
        place_of(control, PANDA.q_home)[1][: 6 if turns else 3],
    )
    K = control.parameters[law.K_DEFAULT + np.array([0, 1, 2, 3, 3, 3])][: len(jacobian)]
    wt = np.sqrt(np.linalg.eigvals(jacobian @ np.linalg.solve(mass, jacobian.T) * K).real.min()) * (2.5 - 0.5)
    along = left @ way / np.dot(way, way)
    assert along.min() > -1e-6
    assert np.linalg.norm(left[-1]) < (2 * (1 + wt) * np.exp(-wt) + 1e-3) * np.linalg.norm(way)


def test_a_force_moves_it_by_force_over_stiffness():
    """At rest x = F / K in each direction; 1e-3 of it is left after 3 s and what MOBILITY lets through."""
    control = cartesian_impedance(PANDA, REACH, FRICTIONLESS)
    start, force = place_of(control, PANDA.q_home)[0], np.array([3.0, 2.0, -4.0])
    q = settled(control, target_at(control, start), PANDA.q_home, 3000, lambda place: force)
    np.testing.assert_allclose(
        (place_of(control, q)[0] - start) * control.parameters[law.K_DEFAULT], force, rtol=2e-3
    )


def test_the_force_of_the_spring_is_clipped():
    """Far from the target J^T F has a force of force_clip, towards it."""
    control = cartesian_impedance(PANDA, REACH, FRICTIONLESS, force_clip=20.0)
    start, jacobian = place_of(control, PANDA.q_home)
    tau = control.torque(
        PANDA.q_home[None], np.zeros((1, N)), target_at(control, start + np.array([0, 0.3, 0.4]))[None]
    )[0]
    np.testing.assert_allclose(tau, jacobian[:3].T @ [0, 12.0, 16.0], atol=1e-9)


def test_motion_in_the_null_space_does_not_move_the_end_effector():
    """The elbow swings back towards home by more than 0.1 rad; the end effector stays within 1 % of its way."""
    control = cartesian_impedance(PANDA, REACH, FRICTIONLESS)
    q = PANDA.q_home.copy()
    start = place_of(control, q)[0]
    for _ in range(400):  # along the null space of the Jacobian
        jacobian = place_of(control, q)[1][:3]
        own = np.eye(N) - np.linalg.pinv(jacobian) @ jacobian
        q += 1e-3 * own[:, 2] / np.linalg.norm(own[:, 2])
    start, begun = place_of(control, q)[0], q
    away = [
        np.linalg.norm(place_of(control, q)[0] - start)
        for q, *_ in simulate(control, target_at(control, start), q, 1500)
    ]
    last = [q for q, *_ in simulate(control, target_at(control, start), begun, 1500)][-1]
    assert np.linalg.norm(last - begun) > 0.1
    assert np.linalg.norm(last - PANDA.q_home) < 0.7 * np.linalg.norm(begun - PANDA.q_home)
    assert max(away) < 0.01 * 0.7 * np.linalg.norm(last - begun)  # 0.7 m: lever of the joints that move


def test_damping_is_the_geometric_mean_of_mass_and_stiffness():
    """D M^-1 D = K, which makes each mode critically damped with 2 D; to round-off of the condition."""
    rng = np.random.default_rng(0)
    K, M = (a @ a.T + 0.05 * np.eye(6) for a in rng.normal(size=(2, 6, 6)))
    D = np.empty((6, 6))
    law.geometric_mean(K, np.linalg.inv(M), D)
    np.testing.assert_allclose(D @ np.linalg.inv(M) @ D, K, atol=1e-9)
    np.testing.assert_allclose(D, D.T, atol=1e-12)


def test_the_controlled_point_is_the_tip_of_the_tool():
    robot = copy.copy(PANDA)
    object.__setattr__(robot, "tool", Tool(np.array([0.01, 0.02, 0.1]), 0.01))
    bare, held = (cartesian_impedance(r, REACH, FRICTIONLESS) for r in (PANDA, robot))
    np.testing.assert_allclose(
        np.linalg.norm(place_of(held, PANDA.q_home)[0] - place_of(bare, PANDA.q_home)[0]),
        np.linalg.norm([0.01, 0.02, 0.1]),
    )


def test_orientation_returns_to_its_target():
    """A rotation vector of the task turns the hand by that much: R R_home^T is its rotation."""
    control = cartesian_impedance(PANDA, Pose(), FRICTIONLESS, rotational_stiffness=5.0)
    home = control.parameters[law.HOME_AXES : law.HOME_AXES + 9].reshape(3, 3)
    command = np.concatenate([np.zeros(6), place_of(control, PANDA.q_home)[0], np.zeros(3), [0.0, 0.0, 0.2]])
    q = settled(control, command, PANDA.q_home, 2500)
    frames = np.empty((N, 12))
    law.arm_pose(q, control.parameters, frames, np.empty((6, N)), np.empty(3))
    turned = np.array([[np.cos(0.2), -np.sin(0.2), 0], [np.sin(0.2), np.cos(0.2), 0], [0, 0, 1]])
    np.testing.assert_allclose(frames[-1, 3:].reshape(3, 3) @ home.T, turned, atol=2e-3)


def test_an_arm_of_six_joints_has_it_too():
    from conftest import ROOT

    robot = load_robot(str(ROOT / "tests" / "models" / "six_joints.xml"))
    own = Dynamics.of(robot, np.zeros((6, 3)))
    control = cartesian_impedance(robot, ReachTask(reach=None), own)
    start = place_of(control, robot.q_home)[0]
    q = settled(control, target_at(control, start + np.array([0.01, 0, 0])), robot.q_home, 2000)
    np.testing.assert_allclose(place_of(control, q)[0], start + np.array([0.01, 0, 0]), atol=2e-4)


def test_the_safety_filter_is_the_same_behind_it():
    """The driver with the law sends what a driver sends that gets the law's torque in each cycle."""
    control = cartesian_impedance(PANDA, REACH, FRICTIONLESS)
    level = nominal_dynamics(PANDA, **conf("friction/paper")).level
    own = Driver(PANDA, control.torque_limit, level, control=control)
    plain = Driver(PANDA, control.torque_limit, level, control=torque(PANDA, REACH))
    memory, tau, sent = np.zeros(control.memory_size), np.empty(N), np.zeros(N)
    for k, (q, dq, *_) in enumerate(
        simulate(control, target_at(control, np.array([0.3, 0.5, 0.3])), PANDA.q_home, 600)
    ):
        state = ArmState(DT * k, q, dq, np.zeros(N), sent)
        control.law(q, dq, target_at(control, np.array([0.3, 0.5, 0.3])), control.parameters, memory, tau)
        sent = own(state, target_at(control, np.array([0.3, 0.5, 0.3])))
        np.testing.assert_array_equal(sent, plain(state, tau))


@pytest.mark.parametrize(
    ("settings", "line"),
    [
        ({"action": "targte"}, r"action: 'targte'; allowed: target, stiffness, both; did you mean 'target'\?"),
        ({"stiffness": 0.0}, r"stiffness: expected a number in \(0, inf\), got 0.0"),
        ({"stiffness": -3.0}, r"stiffness: expected a number in \(0, inf\), got -3.0"),
        ({"force_clip": 500.0}, r"force_clip: expected at most 43.3 N, which the torque limit allows, got 500"),
        ({"tank": [2.0, 1.0]}, r"tank: expected first level and size in J"),
        ({"torque_fraction": 1.5}, r"torque_fraction: expected numbers in \(0, 1\]"),
        ({"hybrid": True}, r"normal: ReachTask has no contact; hybrid needs control.normal and control.force"),
        ({"hybrid": True, "normal": [0, 0, 0], "force": 1.0}, r"normal: expected three numbers, not all 0"),
        (
            {"hybrid": True, "normal": [0, 0, 1], "force": 99.0},
            r"force: expected a number in \[0, 30.3164\], got 99.0",
        ),
    ],
)
def test_a_wrong_setting_gets_one_line(settings, line):
    with pytest.raises(UserError, match=line):
        cartesian_impedance(PANDA, REACH, FRICTIONLESS, **settings)


def test_a_wrong_setting_of_joints_gets_one_line():
    for stiffness in (0.0, [1.0] * 6 + [-1.0]):
        with pytest.raises(UserError, match="stiffness: expected numbers above 0 Nm/rad, got"):
            joint_impedance(PANDA, REACH, FRICTIONLESS, stiffness=stiffness)
    with pytest.raises(
        UserError, match="action: the target of ReachTask is home at all times; allowed: target, both"
    ):
        joint_impedance(PANDA, REACH, FRICTIONLESS, action="stiffness")
