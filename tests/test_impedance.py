"""Impedance and hybrid control: equilibrium, stiffness, damping, null space, passivity, and errors of the user."""

import copy
import subprocess
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from conftest import conf
from test_export import COMPILER, LAW_NM, LIBFRANKA, POLICY, compare, drawn, hostile, loaded

from r2s import commands
from r2s.arm.driver import Driver
from r2s.arm.interface import ArmState
from r2s.control.impedance import cartesian_impedance, joint_impedance
from r2s.control.torque import torque
from r2s.errors import UserError
from r2s.export.bundle import law_source
from r2s.export.contract import check_exportable
from r2s.physics import impedance as law
from r2s.physics.dynamics import Dynamics, nominal_dynamics
from r2s.physics.friction import BRISTLE, presliding
from r2s.physics.inverse_dynamics import InverseDynamics
from r2s.physics.newton_euler import WORK, equations, links_of
from r2s.physics.robot import load_robot
from r2s.physics.surface import Tool
from r2s.tasks.reach import ReachTask
from r2s.tasks.track import TrackTask
from r2s.tasks.wipe import WipeTask

PANDA = load_robot(**conf("robot/panda"))
N = PANDA.n
FRICTIONLESS = Dynamics.of(PANDA, np.zeros((N, 3)))
REACH = ReachTask()
DT = 1e-3  # s, cycle
SUBSTEPS = 5  # of the simulation; semi-implicit Euler of 0.2 ms


def random_model():
    """Return dynamics with every error that the feedforward knows."""
    rng, d = np.random.default_rng(5), nominal_dynamics(PANDA, **conf("friction/paper"))
    errors = {"offset": rng.normal(size=N), "drag": rng.normal(size=(N, 2)), "com": d.com + 0.01}
    return replace(d, mass=1.1 * d.mass, **errors)


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


def energy(control, K, error):
    """Return the energy, J, of clipped springs with stiffness K; see `spring`."""
    p = control.parameters
    if control.name == "joint_impedance":
        limit, s = p[law.HEAD :].reshape(-1, law.ROW)[:, law.JOINT_LIMIT], 0.5 * K * error**2
    else:
        limit, s = p[law.FORCE_LIMIT], 0.5 * (K[:3] * error**2).sum()
    return np.where(s <= limit, s, 2 * np.sqrt(np.maximum(s * limit, 0)) - limit).sum()


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


def test_joints_rest_where_the_command_says():
    """With a wrong model of the compensation, the feedforward holds the arm: the law gives the model's torque."""
    control = joint_impedance(PANDA, REACH, random_model())
    q = PANDA.q_home + np.linspace(-0.3, 0.4, N)
    tau = control.torque(q[None], np.zeros((1, N)), (q - PANDA.q_home)[None])[0]
    np.testing.assert_allclose(
        tau, InverseDynamics(PANDA, random_model())(q[None], *np.zeros((3, 1, N)))[0], atol=1e-9
    )
    np.testing.assert_allclose(tau, control.holding_torque(q), atol=1e-9)


@pytest.mark.parametrize("speed", [0.32, -0.08, 0.02])
def test_friction_of_the_reference_is_fed_forward(speed):
    """At the speeds of its table the torque is the model's friction, or the breakaway torque of a joint at rest."""
    model = replace(nominal_dynamics(PANDA, **conf("friction/paper")), offset=np.zeros(N))
    q, dq = PANDA.q_home, np.full(N, speed)
    command = np.concatenate([np.zeros(N), q, dq])
    edges, friction = model.breakaway[:, int(speed > 0)], model.friction(dq)
    farther = np.where(np.abs(edges) > np.abs(friction), edges, friction)
    for rest, wanted in ((True, farther), (False, friction)):
        control = joint_impedance(PANDA, TrackTask(pool=2), model)
        memory, tau = np.zeros(control.memory_size), np.empty(N)
        for k in range(60):  # the low-pass of the speed settles; a joint that moves is at q and dq in the last cycle
            there = q if rest else q + (k - 59) * DT * dq
            control.law(there, dq, command, control.parameters, memory, tau)
        np.testing.assert_allclose(tau, wanted, rtol=1e-4)


def bristle_model(**changes):
    """Return dynamics whose friction has bristles, with nothing else that the feedforward knows."""
    rows = np.tile([1.0, 0.1, 0.3, 0.2, 0.1, 6e-4, 0.0, 0.0], (N, 1)) * np.linspace(0.5, 1.5, N)[:, None]
    rows[:, 5] = np.linspace(4e-4, 1e-3, N)
    return replace(Dynamics.of(PANDA, rows, BRISTLE), **changes)


def ahead(control, angles):
    """Return the torque (m, n) Nm along angles (m, n) rad of a joint impedance that holds each of them at rest."""
    memory, out = np.zeros(control.memory_size), np.empty(angles.shape)
    for k, q in enumerate(angles):
        control.law(q, np.zeros(N), q - PANDA.q_home, control.parameters, memory, out[k])
    return out


def test_bristles_are_fed_forward_as_they_deflect():
    """Forth by 2 mrad and back by a part of the presliding distance: their friction is the family's, to a step."""
    model = bristle_model()
    control = joint_impedance(PANDA, REACH, model, action="target", displacement=3.0)
    path = np.concatenate([np.linspace(0, 2e-3, 400), np.linspace(2e-3, 1.7e-3, 400), np.full(100, 1.7e-3)])
    got = ahead(control, PANDA.q_home + path[:, None])[-1]
    moves = np.gradient(path, DT)[:, None] * np.ones(N)
    z = presliding(moves, DT, model.phi[:, 5])[-1]
    level = np.abs(model.friction(law.FIRST_DQ * np.sign(z), np.sign(z)))
    # a step of the law: STEP of the distance behind, and as much of the deflection that is left to go
    assert (np.abs(got - level * z) <= 2.0 * law.STEP * level * (1.0 + np.abs(z))).all()
    assert (np.abs(z) < 0.9).all()


@pytest.mark.parametrize("distance", [1e-4, 3e-4, 1e-3])
def test_noise_of_the_encoders_does_not_move_the_bristles(distance):
    """While joints rest for ten seconds under a Panda's noise, they deflect at most by a step that a motion began."""
    model = bristle_model()
    model.phi[:, 5] = distance
    control = joint_impedance(PANDA, REACH, model, action="target", displacement=3.0)
    noise = np.random.default_rng(0).normal(size=(10_000, N))
    rest = 2e-5 * np.round((2 * distance + 1.5e-5 * noise) / 2e-5)
    moves = np.linspace(0, 2 * distance, 400)[:, None] * np.ones(N)
    tau = ahead(control, PANDA.q_home + np.concatenate([moves, rest]))
    step = 1.1 * max(law.STEP, law.ENCODER / distance)  # of the distance; what noise adds to it, a tenth
    left = np.exp(step - 2)  # of the deflection when the motion ends, a step behind
    np.testing.assert_allclose(tau[-1], tau[500], rtol=left * -np.expm1(-step) / (1 - left))


def test_bristles_are_not_fed_forward_above_their_friction():
    """At speed the falling friction of the measured speed counts, and load-dependent friction that of the posture."""
    model, q = bristle_model(load=np.full(N, 0.05)), PANDA.q_home + np.linspace(-0.3, 0.4, N)
    control = joint_impedance(PANDA, REACH, model, action="target", displacement=3.0)
    for speed in (0.02, 0.08, 0.32, -0.32):
        dq = np.full(N, speed)
        got = ahead(control, q + DT * np.arange(-300, 1)[:, None] * dq)[-1]
        level = InverseDynamics(PANDA, model).load_friction(q[None])[0]
        wanted = model.friction(dq, np.sign(dq)) + np.sign(dq) * level
        slow = model.friction(law.FIRST_DQ * np.sign(dq), np.sign(dq)) + np.sign(dq) * level
        assert (np.abs(got) <= np.abs(wanted) * (1 + 1e-6)).all()
        np.testing.assert_allclose(np.abs(got), np.minimum(np.abs(wanted), np.abs(slow)), rtol=0.01)


def hostile_stiffness(control, rng, cycles):
    """Return stiffnesses (cycles, s) between their bounds that jump in every fifth cycle."""
    low, high = control.action_offset - control.action_scale, control.action_offset + control.action_scale
    rows = np.where(rng.random((cycles // 5, len(low))) < 0.5, low, high)
    return np.repeat(rows, 5, axis=0)


@pytest.mark.parametrize("kind", ["cartesian", "joint"])
def test_the_tank_pays_for_what_stiffness_adds(kind):
    """Over random postures at rest, where damping refills nothing: net energy out of the tank is at most its fill.

    1e-9 J: sums of thousands of terms of 10 J, each to 1e-16.
    """
    rng, fill = np.random.default_rng(1), 1.5
    if kind == "joint":
        control = joint_impedance(PANDA, TrackTask(pool=2), FRICTIONLESS, action="stiffness", tank=[fill, fill])
    else:
        control = cartesian_impedance(PANDA, REACH, FRICTIONLESS, action="stiffness", tank=[fill, fill])
    memory, out, s = np.zeros(control.memory_size), np.empty(N), N if kind == "joint" else law.SPRINGS
    net, worst, before, asked = 0.0, -np.inf, None, 0.0
    for K in hostile_stiffness(control, rng, 4000):
        q, target = PANDA.q_home + rng.uniform(-0.4, 0.4, N), np.array([0.4, 0.1, 0.5])
        command = np.concatenate([K, PANDA.q_home, np.zeros(N)] if kind == "joint" else [K, target])
        control.law(q, np.zeros(N), command, control.parameters, memory, out)
        error = PANDA.q_home - q if kind == "joint" else target - place_of(control, q)[0]
        K_now = memory[law.STIFFNESS : law.STIFFNESS + s].copy()
        if before is not None:
            change = energy(control, K_now, error) - energy(control, before, error)
            net, asked = net + change, asked + max(energy(control, K, error) - energy(control, before, error), 0.0)
        before, worst = K_now, max(worst, net)
        assert 0.0 <= memory[law.LEVEL] <= fill
    assert worst <= fill + 1e-9
    assert asked > 10 * fill  # what was asked for would have been much more


@pytest.mark.parametrize(("fill", "grows"), [(0.5, False), (1e3, True)])
def test_hostile_switching_cannot_pump_energy(fill, grows):
    """Stiff while the joints approach their targets, soft while they leave: energy and tank together never rise.

    With an endless tank the same switching makes the arm's own energy grow. Damping is a hundredth of critical. A
    torque that is held for 1 ms adds up to K dq^2 dt / 2 per s and joint: 5 % of the energy at 60 Nm/rad and 1 rad/s.
    """
    control = joint_impedance(
        PANDA, TrackTask(pool=2), FRICTIONLESS, action="stiffness", damping=0.01, tank=[fill, fill], softest=0.3
    )
    low, high = control.action_offset - control.action_scale, control.action_offset + control.action_scale
    goal, last = PANDA.q_home, [PANDA.q_home]

    def switch(k, q, memory):
        nearer = np.abs(goal - q) < np.abs(goal - last[0])
        last[0] = q
        return np.concatenate([np.where(nearer, high, low), goal, np.zeros(N)])

    own, tank = [], []
    for q, dq, memory, mass in simulate(control, switch, goal + np.array([0, 0.2, 0, 0.2, 0, 0.2, 0]), 1500):
        own.append(0.5 * dq @ mass @ dq + energy(control, memory[law.STIFFNESS : law.STIFFNESS + N], goal - q))
        tank.append(memory[law.LEVEL])
    total = np.array(own) + tank
    assert min(tank) >= 0.0
    if grows:
        assert max(own) > 2 * own[0]
    else:
        assert total.max() <= 1.05 * total[0]
        assert max(own) <= own[0] + fill + 0.05 * total[0]


def test_an_empty_tank_lets_the_stiffness_fall_but_not_rise():
    control = cartesian_impedance(PANDA, REACH, FRICTIONLESS, action="stiffness", tank=[0.0, 1.0])
    K_low, K_high = (control.action_offset + side * control.action_scale for side in (-1, 1))
    memory, out, start = np.zeros(control.memory_size), np.empty(N), place_of(control, PANDA.q_home)[0]
    seen = []
    for K, off in ((K_high, 0.02), (K_low, 0.02), (K_high, 0.02), (K_high, 0.0)):
        memory[law.LEVEL] = 0.0
        command = np.concatenate([K, start + np.array([off, 0, 0])])
        control.law(PANDA.q_home, np.zeros(N), command, control.parameters, memory, out)
        seen.append(memory[law.STIFFNESS])
    np.testing.assert_allclose(seen, [K_high[0], K_low[0], K_low[0], K_high[0]])  # without error a rise is free


def wall(stiffness, height):
    """Return the force (3,) N of an elastic floor."""
    return lambda place: np.array([0.0, 0.0, stiffness * max(height - place[2], 0.0)])


@pytest.mark.parametrize("measured", [False, True])
def test_hybrid_control_pushes_with_its_force(measured):
    """On an elastic floor the force is the reference, and across it the tip moves to its target.

    With a measured force the integral removes a load of 2 N that the model does not know; without one it stays.
    """
    control = cartesian_impedance(
        PANDA, REACH, FRICTIONLESS, hybrid=True, normal=[0, 0, 2], force=8.0, integral_rate=5.0
    )
    start = place_of(control, PANDA.q_home)[0]
    floor, goal = wall(5e3, start[2] + 0.001), start + np.array([0.03, 0.0, 0.2])
    command = control.command(np.zeros((1, 3)), REACH, np.zeros(1), goal[None])
    load = np.array([0.0, 0.0, -2.0])

    def now(k, q, memory):
        force = floor(place_of(control, q)[0])[2]
        return control.with_force(command, np.array([force]))[0] if measured else command[0]

    q = settled(control, now, PANDA.q_home, 2500, lambda place: floor(place) + load)
    place = place_of(control, q)[0]
    assert floor(place)[2] == pytest.approx(8.0 if measured else 10.0, abs=0.05)
    np.testing.assert_allclose(place[:2], goal[:2], atol=5e-4)


def test_the_integral_does_not_wind_up():
    """A force that never arrives fills the integral to its clamp; the force stays below force_clip."""
    control = cartesian_impedance(
        PANDA, REACH, FRICTIONLESS, hybrid=True, normal=[0, 0, 1], force=25.0, force_clip=26.0
    )
    start, jacobian = place_of(control, PANDA.q_home)
    command = control.command(np.zeros((1, 3)), REACH, np.zeros(1), start[None])
    memory, out = np.zeros(control.memory_size), np.empty(N)
    for _ in range(5000):
        control.law(
            PANDA.q_home, np.zeros(N), control.with_force(command, np.zeros(1))[0], control.parameters, memory, out
        )
    np.testing.assert_allclose(out, jacobian[:3].T @ [0, 0, -26.0], atol=1e-9)
    assert memory[law.INTEGRAL] <= 1.0 + 25.0 * 5.0 * DT  # it stops where the force saturates


def test_a_displacement_against_the_normal_adds_force():
    control = cartesian_impedance(
        PANDA, REACH, FRICTIONLESS, hybrid=True, normal=[0, 0, 1], force=5.0, displacement=0.02
    )
    start, jacobian = place_of(control, PANDA.q_home)
    command = control.command(np.array([[0, 0, -0.5]]), REACH, np.zeros(1), start[None])
    tau = control.torque(PANDA.q_home[None], np.zeros((1, N)), command)[0]
    force = 5.0 + 0.01 * control.parameters[law.K_DEFAULT]
    np.testing.assert_allclose(tau, jacobian[:3].T @ [0, 0, -force], atol=1e-9)


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


CONTROLS = {
    "cartesian": lambda model: cartesian_impedance(PANDA, REACH, model),
    "pose": lambda model: cartesian_impedance(PANDA, Pose(), model, action="both", rotational_stiffness=5.0),
    "hybrid": lambda model: cartesian_impedance(
        PANDA, Pose(), model, action="both", hybrid=True, normal=[0, 0, 1], force=5.0
    ),
    "sliding": lambda model: cartesian_impedance(PANDA, WipeTask(), model, hybrid=True, integral_rate=8.0),
    "joint": lambda model: joint_impedance(PANDA, REACH, model, action="both"),
    "joint path": lambda model: joint_impedance(PANDA, TrackTask(pool=2), model, action="stiffness"),
    "bristles": lambda model: cartesian_impedance(PANDA, WipeTask(), bristle_model(mass=model.mass), hybrid=True),
}


def stream(control, cycles=1000):
    """Return q, dq, command (cycles, ...), new commands each 20 cycles, and where motions begin."""
    rng, rows = np.random.default_rng(3), cycles // 20
    action = control.action_offset + control.action_scale * rng.uniform(-1.2, 1.2, (rows, control.action_dim))
    given = rng.normal(0, 0.4, (rows, control.setpoint_size))
    if control.hybrid:
        contact = slice(control.target_size, control.target_size + 6)
        given[:, contact] = [0.0, 0.6, 0.8, 5.0, 3.0, 1.0] + np.array([0, 0, 0, 1, 3, 0]) * rng.normal(size=(rows, 1))
    command = np.repeat(np.concatenate([action, given], axis=1), 20, axis=0)
    q = PANDA.q_home + rng.uniform(-0.1, 0.1, (cycles, N)) + np.repeat(rng.uniform(-0.5, 0.5, (rows, N)), 20, axis=0)
    return q, 0.3 * rng.normal(size=(cycles, N)), command, np.arange(cycles) % 400 == 0


def by_law(run, control, motion):
    """Return torque and level of the tank (cycles, n + 1) of a law over a stream."""
    memory, rows = np.zeros(control.memory_size), np.empty((len(motion[0]), N + 1))
    for k, (q, dq, command, begin) in enumerate(zip(*motion, strict=True)):
        memory[:] = 0.0 if begin else memory
        run(q, dq, command, control.parameters, memory, rows[k, :N])
        rows[k, N] = memory[law.LEVEL]
    return rows


MAIN = """
}} }}
int main() {{
  double x[2 * contract::n + {c} + 1], memory[{k}] = {{}}, out[contract::n];
  while (std::fread(x, sizeof *x, 2 * contract::n + {c} + 1, stdin) == 2 * contract::n + {c} + 1) {{
    if (x[2 * contract::n + {c}] > 0) for (double& m : memory) m = 0.0;
    contract::control_law(x, x + contract::n, x + 2 * contract::n, memory, out);
    std::fwrite(out, sizeof *out, contract::n, stdout);
    std::fwrite(memory + {level}, sizeof *out, 1, stdout);
  }}
}}
"""


@pytest.mark.skipif(COMPILER is None, reason="no C++ compiler here")
@pytest.mark.parametrize("name", CONTROLS)
def test_the_law_in_cpp_is_that_of_python(name, tmp_path):
    """Torque and tank over a random stream, to round-off."""
    control = CONTROLS[name](random_model())
    motion = stream(control)
    parameters = ", ".join(repr(float(x)) for x in control.parameters)
    head = f"#include <cmath>\n#include <cstdio>\nnamespace contract {{\nconstexpr int n = {N};\n"
    head += f"constexpr double parameters[] = {{{parameters}}};\ninline void control_law("
    head += "const double* q, const double* dq, const double* command, double* memory, double* out) {\n"
    end = MAIN.format(c=control.command_size, k=control.memory_size, level=law.LEVEL)
    (tmp_path / "check.cpp").write_text(head + control.cpp + end)
    words = [
        str(COMPILER),
        "-std=c++17",
        "-O1",
        "-Wall",
        "-Wextra",
        "-Wpedantic",
        "-Werror",
        "check.cpp",
        "-o",
        "check",
    ]
    subprocess.run(words, cwd=tmp_path, check=True)
    rows = np.ascontiguousarray(np.column_stack(motion), dtype=float)
    done = subprocess.run([tmp_path / "check"], input=rows.tobytes(), capture_output=True, check=True)
    got, wanted = np.frombuffer(done.stdout).reshape(len(rows), -1), by_law(control.law, control, motion)
    assert np.ptp(wanted[:, N]) > 0.1 or control.action == "target"
    assert np.abs(got - wanted).max() < LAW_NM


@pytest.mark.parametrize("name", CONTROLS)
def test_the_law_of_a_bundle_is_that_of_r2s(name):
    """Its source needs NumPy alone."""
    control = CONTROLS[name](random_model())
    motion, names = stream(control, 60), {"np": np}
    call, source = law_source(control.law)
    exec(source, names)
    assert np.abs(by_law(eval(call, names), control, motion) - by_law(control.law, control, motion)).max() < LAW_NM


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """The bundle of a policy that sets target and stiffness of reaching."""
    run = tmp_path_factory.mktemp("runs") / "train" / "impedance"
    made = drawn(run, "control=cartesian_impedance", "control.action=both")
    commands.run_command(["export", str(run)])
    return made


def test_a_bundle_does_what_r2s_does(exported):
    assert compare(exported, loaded(exported.folder), hostile(exported.robot, exported.task, 300)) < POLICY


@pytest.mark.slow
def test_it_does_so_for_ten_thousand_cycles(exported):
    assert compare(exported, loaded(exported.folder), hostile(exported.robot, exported.task, 10_000)) < POLICY


@pytest.mark.skipif(COMPILER is None, reason="no C++ compiler here")
def test_the_header_of_a_bundle_compiles(exported, tmp_path):
    (tmp_path / "check.cpp").write_text(
        '#include "law.hpp"\nstatic_assert(contract::setpoints == 3);\nint main() { law::Driver driver; }\n'
    )
    words = [str(COMPILER), "-std=c++17", "-fsyntax-only", "-Wall", "-Wextra", "-Wpedantic", "-Werror"]
    subprocess.run([*words, "-I", str(LIBFRANKA), "-I", str(exported.folder), "check.cpp"], cwd=tmp_path, check=True)


def test_hybrid_control_is_not_exported():
    task = REACH.controlled_by(
        cartesian_impedance(PANDA, REACH, FRICTIONLESS, hybrid=True, normal=[0, 0, 1], force=5.0)
    )
    with pytest.raises(UserError, match="export: control=hybrid takes setpoints"):
        check_exportable(PANDA, task)


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
