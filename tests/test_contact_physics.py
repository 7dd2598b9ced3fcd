"""Contact in a physics step: held by friction, exact in energy, stable, and as in an independent simulator."""

import sys
from dataclasses import replace

import mujoco
import numpy as np
import pytest
from conftest import ROOT
from scipy.integrate import solve_ivp
from test_physics import light, mass_matrix

from r2s.engines.dart import dart
from r2s.engines.interface import FrictionTorque
from r2s.errors import UserError
from r2s.physics.contact_layout import COLUMNS, DEPTH, FORCE
from r2s.physics.dynamics import Dynamics
from r2s.physics.friction import COULOMB
from r2s.physics.robot import SIM_DT
from r2s.physics.simulator import Simulator
from r2s.physics.surface import Surface, Tool

__all__ = ["light"]  # a fixture
LEVER, RADIUS = 0.1, 0.01  # m, of the light arm's tip
SHARED = ROOT.parent / "shared" / "data" / "contact_arms"
UP = np.array([0.0, 0.0, 1.0])


def pusher(light, surface: Surface, level: float = 0.0, mass: float = 0.5):
    """Return the one-joint arm with a tool; dynamics with `mass` kg at its tip and Coulomb friction `level` Nm."""
    d = Dynamics.of(light, np.array([[level, 0.0, 0.0]]), COULOMB, dq_min=0.0)
    d = replace(d, breakaway=level * np.array([[-1.0, 1.0]]), stiction_model="net" if level else "command")
    d = replace(d, inertia=mass * LEVER**2 * np.eye(3)[None], surface=surface)
    return replace(light, tool=Tool(np.zeros(3), RADIUS)), d


def ahead(stiffness, exponent=1.0, damping=0.0) -> Surface:
    """Return a surface without friction that the light arm's tip meets at q = 0, moving towards y."""
    return Surface(np.array([LEVER, RADIUS, 0.0]), np.array([0.0, -1.0, 0.0]), stiffness, exponent, damping, 0.0)


def contacts(out: dict) -> np.ndarray:
    """Return the contacts (m, T, COLUMNS) of a rollout that recorded userdata; nothing else follows them there."""
    return out["userdata"][..., -COLUMNS:]


@pytest.mark.parametrize("stiffness", [1e3, 1e5])
def test_a_force_remains_until_friction_has_reversed(light, stiffness):
    """F = (tau - tau_c) / lever when loading, held to the bit, then (tau + tau_c) / lever when unloading.

    A ramp of r Nm/s excites an oscillation of r / omega Nm about it.
    """
    level, rate, most = 0.3, 1.0, 1.5
    robot, d = pusher(light, ahead(stiffness), level)
    up = np.arange(0.0, most, rate * SIM_DT)
    tau = np.concatenate([up, up[::-1]])
    sim = Simulator(robot, d, 1, 1)
    sim.reset(np.zeros((1, 1)), np.zeros((1, 1)))
    out = sim.rollout(tau[None, :, None], record=("qpos", "qvel", "userdata"))
    q, force = out["qpos"][0, :, 0], -contacts(out)[0, :, FORCE + 1]
    torque = force * LEVER * np.cos(q)
    near = 2 * rate / np.sqrt(stiffness / 0.5) + rate * SIM_DT
    top, back = len(up), len(up) + int(2 * level / rate / SIM_DT)  # from `back` on friction has reversed
    np.testing.assert_allclose(torque[:top], np.maximum(up - level, 0.0), atol=near)
    held = slice(top + 5 + int(np.pi * np.sqrt(0.5 / stiffness) / SIM_DT), back - 60)  # after half an oscillation
    assert np.ptp(force[held]) < 1e-9 * force[top]
    assert np.abs(out["qvel"][0, held]).max() < 1e-12
    np.testing.assert_allclose(torque[back + 20 : -20], tau[back + 20 : -20] + level, atol=near)
    assert force[-1] > 0.9 * level / LEVER  # without a command


def bounce(light, surface, mass, speed=0.3, steps=150):
    """Return forces (8, T) N and speeds (8, T) m/s of tips that meet a surface at 8 phases of a step."""
    robot, d = pusher(light, surface, mass=mass)
    sim = Simulator(robot, d, 8, 1)
    start = -speed * SIM_DT * (1 + np.arange(8)[:, None] / 8) / LEVER
    sim.reset(start, np.full((8, 1), speed / LEVER))
    out = sim.rollout(np.zeros((8, steps, 1)), record=("qvel", "userdata"))
    return -contacts(out)[..., FORCE + 1], LEVER * out["qvel"][..., 0]


@pytest.mark.parametrize(("stiffness", "mass"), [(1e3, 0.5), (1e4, 0.5), (1e5, 2.0)])
def test_peak_force_of_an_elastic_impact(light, stiffness, mass):
    """V sqrt(k m) within 2 %, for a Hertzian surface K d^1.5 with m v^2 / 2 = K d^2.5 / 2.5."""
    for surface in (ahead(stiffness), ahead(stiffness, 1.5)):
        force, after = bounce(light, surface, mass)
        if surface.exponent == 1.0:
            peak = 0.3 * np.sqrt(stiffness * mass)
        else:
            peak = surface.coefficient * (1.25 * mass * 0.3**2 / surface.coefficient) ** 0.6
        np.testing.assert_allclose(force.max(1), peak, rtol=0.02)
        np.testing.assert_allclose(after[:, -1], -0.3, rtol=2e-3)  # the lever turns by up to 0.07 rad


@pytest.mark.parametrize("stiffness", [1e5, 1e6, 1e8])
def test_no_stiffness_gives_energy(light, stiffness):
    """A tip of 0.5 kg at 1e8 N/m would need steps of 0.14 ms; it leaves with the speed with which it came."""
    for surface in (ahead(stiffness), ahead(stiffness, 1.5)):
        force, after = bounce(light, surface, 0.5, steps=60)
        assert (force >= 0).all()
        np.testing.assert_allclose(after[:, -1], -0.3, rtol=2e-3)


@pytest.mark.parametrize("exponent", [1.0, 1.5])
def test_a_damped_impact_is_that_of_hunt_and_crossley(light, exponent):
    """Peak force and speed of the rebound of their equation in one dimension, integrated to 1e-9."""
    surface = ahead(2e4, exponent, 1.0)
    force, after = bounce(light, surface, 2.0)

    def motion(t, x):
        return x[1], -max(surface.coefficient * max(x[0], 0.0) ** exponent * (1 + surface.damping * x[1]), 0.0) / 2.0

    path = solve_ivp(motion, (0, 0.15), (0.0, 0.3), rtol=1e-9, atol=1e-12, max_step=1e-4)
    peak = max(-2.0 * motion(0, x)[1] for x in path.y.T)
    np.testing.assert_allclose(force.max(1), peak, rtol=0.02)
    np.testing.assert_allclose(after[:, -1], path.y[1, -1], rtol=0.01)


def pressing(panda, stiffness=1e5, friction=0.3, exponent=1.5, level=0.3, **change):
    """Return a Panda whose tip is on a table, its dynamics, and J^T (3, 7) at home."""
    robot = replace(panda, tool=Tool(np.array([0.0, 0.0, 0.05]), RADIUS))
    d = Dynamics.of(robot, np.tile([level, 0.1, 0.1], (7, 1)), COULOMB, dq_min=1e-3)
    d = replace(d, breakaway=1.2 * level * np.tile([-1.0, 1.0], (7, 1)), stiction_model="net")
    sim = Simulator(robot, d, 1, 1)
    sim.reset(panda.q_home[None], np.zeros((1, 7)))
    point = sim.ee[0] - (0.05 + RADIUS) * UP
    surface = Surface(point, UP, stiffness, exponent, 1.0, friction, 2e-4)
    return robot, replace(d, surface=replace(surface, **change)), sim.jacobian[0].copy()


@pytest.mark.parametrize(("down", "yaw"), [(0.0, 0.0), (20.0, 0.0), (20.0, 6.0)], ids=["rest", "press", "slide"])
def test_a_stiff_surface_is_stable(panda, down, yaw):
    """At 1e5 N/m and 1 ms: a resting and a pressing arm come to rest exactly, a sliding one is pressed evenly."""
    for exponent in (1.0, 1.5):
        robot, d, jacobian = pressing(panda, exponent=exponent)
        tau = jacobian.T @ np.array([0.0, 0.0, -down]) + yaw * np.eye(7)[0]
        if yaw:  # about the base only: the others hold the tip at a depth
            d = replace(d, breakaway=np.where(np.arange(7)[:, None] == 0, d.breakaway, [-80.0, 80.0]))
            d = replace(d, surface=replace(d.surface, point=d.surface.point + 3e-4 * UP))
        sim = Simulator(robot, d, 1, 1)
        sim.reset(panda.q_home[None], np.zeros((1, 7)))
        out = sim.rollout(np.tile(tau, (1, 400, 1)), record=("qvel", "userdata"))
        seen, dq = contacts(out)[0, :, FORCE : FORCE + 3], out["qvel"][0]
        if yaw:
            assert dq[100, 0] > 0.5
            assert seen[:, 2].min() > 4
            assert np.ptp(seen[100:200, 2]) < 0.05 * down
            np.testing.assert_allclose(np.hypot(*seen[100:200, :2].T), 0.3 * seen[100:200, 2], rtol=0.01)
        else:
            assert np.ptp(seen[300:], axis=0).max() <= 1e-9 * down
            assert np.abs(dq[-1]).max() < 1e-12
            assert seen[-1, 2] <= down


def test_contact_gives_a_moving_arm_no_energy(panda):
    """An arm without joint friction leaves a surface with less kinetic energy than it came with, or the same.

    The step's own error, 1 % of the energy, is that of the same motion without a surface.
    """
    _, d, _ = pressing(panda, 1e4, damping=0.0)
    robot = replace(panda, tool=Tool(np.array([0.0, 0.0, 0.05]), RADIUS))
    d = replace(d, phi=0 * d.phi, breakaway=0 * d.breakaway, stiction_model="command")
    model = panda.model(gravity=False)
    data = mujoco.MjData(model)
    left = {}
    for friction in (0.0, 0.5, None):
        surface = (
            None if friction is None else replace(d.surface, friction=friction, point=d.surface.point - 0.02 * UP)
        )
        sim = Simulator(robot, replace(d, surface=surface), 1, 1)
        sim.reset(panda.q_home[None], np.array([[0.3, 0.5, 0.0, -0.3, 0.2, 0.0, 0.5]]))
        out = sim.rollout(np.zeros((1, 300, 7)), record=("qpos", "qvel", "userdata"))
        energy = []
        for q, dq in zip(out["qpos"][0], out["qvel"][0], strict=True):
            data.qpos[:] = q
            mujoco.mj_forward(model, data)
            energy.append(0.5 * dq @ mass_matrix(model, data) @ dq)
        left[friction] = energy[-1] / energy[0]
        if friction is not None:
            touched = contacts(out)[0, :, FORCE + 2] > 0
            assert touched.any()
            assert not touched[-1]
    assert abs(left[None] - 1) < 0.01
    assert abs(left[0.0] - 1) < 0.01
    assert left[0.5] < 0.98


def test_half_the_step_gives_the_same_force(panda):
    """Touch, press, slide and stop: against steps of 0.25 ms, half a step has at most 0.7 of a step's difference."""
    robot, d, jacobian = pressing(panda, 2e4)
    d = replace(d, surface=replace(d.surface, point=d.surface.point - 2e-3 * UP))
    t = SIM_DT * np.arange(600)[:, None]
    force = np.array([0.0, 0.0, -25.0]) * np.minimum(1.0, 4 * t) + np.array([0.0, 14.0, 0.0]) * np.sin(9.0 * t)
    tau, seen = force @ jacobian, {}
    for parts in (1, 2, 4):
        sim = Simulator(robot, d, 1, 1, dt=SIM_DT / parts)
        sim.reset(panda.q_home[None], np.zeros((1, 7)))
        out = sim.rollout(np.repeat(tau, parts, axis=0)[None], record=("userdata",))
        seen[parts] = contacts(out)[0, :, FORCE : FORCE + 3].reshape(600, parts, 3).mean(1)
    whole, half = (np.sqrt(((seen[k] - seen[4]) ** 2).sum(1).mean()) for k in (1, 2))
    assert half < 0.7 * whole
    assert whole < 0.3


def test_what_does_not_touch_changes_no_bit(panda):
    """An arm with a tool, and one above a surface, move as one without either."""
    robot, d, _ = pressing(panda)
    above = replace(d, surface=replace(d.surface, point=d.surface.point - 0.4 * UP))
    tau = np.random.default_rng(0).normal(size=(1, 200, 7))
    for stiction in ("net", "command"):
        paths = []
        for arm, one in ((panda, replace(d, surface=None)), (robot, replace(d, surface=None)), (robot, above)):
            sim = Simulator(arm, replace(one, stiction_model=stiction), 1, 1)
            sim.reset(panda.q_home[None], np.zeros((1, 7)))
            paths.append(sim.rollout(tau, record=("qvel",))["qvel"])
        assert np.array_equal(paths[0], paths[1])
        assert np.array_equal(paths[0], paths[2])


def test_each_arm_has_its_own_surface(panda):
    """Three arms at once, on any thread, from a stored state, touch as each does alone."""
    robot, d, jacobian = pressing(panda)
    batch = {"stiffness": np.array([1e3, 1e4, 1e5]), "friction": np.array([0.0, 0.3, 0.6])}
    many = replace(d, surface=replace(d.surface, **batch))
    tau = np.tile(jacobian.T @ np.array([5.0, 3.0, -20.0]), (3, 100, 1))
    seen = []
    for threads in (1, 2):
        sim = Simulator(robot, many, 3, threads)
        sim.reset(np.tile(panda.q_home, (3, 1)), np.zeros((3, 7)))
        sim.rollout(tau[:, :40])
        state = sim.state()
        seen.append(contacts(sim.rollout(tau[:, 40:], record=("userdata",))))
        assert np.array_equal(sim.contact_force, seen[-1][:, -1, FORCE : FORCE + 3])
        assert np.array_equal(sim.depth, seen[-1][:, -1, DEPTH])
        sim.set_state(state)
        seen.append(contacts(sim.rollout(tau[:, 40:], record=("userdata",))))
    for k in range(3):
        sim = Simulator(robot, many.one(k), 1, 1)
        sim.reset(panda.q_home[None], np.zeros((1, 7)))
        alone = contacts(sim.rollout(tau[:1], record=("userdata",)))[0, 40:]
        assert all(np.array_equal(alone, one[k]) for one in seen)


def test_a_box_is_a_plane_at_its_face_and_round_at_its_edge(panda):
    """A press on its face gives a plane's force; at an edge the force points from the edge to the tip's centre."""
    robot, d, jacobian = pressing(panda, 2e4)
    tau = np.tile(jacobian.T @ np.array([0.0, 2.0, -20.0]), (1, 150, 1))
    half, plane, seen = np.array([0.1, 0.2, 0.05]), d.surface, []
    aside = np.array([0.0, -0.5, 0.8660254037844386])  # from the edge to the centre
    edge = plane.point + RADIUS * (UP - aside) - 1e-4 * aside
    for surface in (
        plane,
        replace(plane, point=plane.point - 0.05 * UP, half=half, axes=np.eye(3)),
        replace(plane, point=edge - np.array([0.0, -0.2, 0.05]), half=half, axes=np.eye(3)),
    ):
        sim = Simulator(robot, replace(d, surface=surface), 1, 1)
        sim.reset(panda.q_home[None], np.zeros((1, 7)))
        seen.append(contacts(sim.rollout(tau, record=("userdata",)))[0])
        sim.reset(panda.q_home[None], np.zeros((1, 7)))
        depth = surface.depth(sim.ee[0] - 0.05 * UP, RADIUS)
        sim.rollout(tau[:, :1])
        np.testing.assert_allclose(sim.depth[0], depth, atol=1e-12)
    assert seen[0][-1, FORCE + 2] > 10
    np.testing.assert_allclose(seen[1][:, FORCE : FORCE + 3], seen[0][:, FORCE : FORCE + 3], atol=1e-6)
    force = seen[2][:, FORCE : FORCE + 3]
    first = force[np.argmax(np.linalg.norm(force, axis=1) > 0.5)]
    assert np.linalg.norm(first) > 0.5
    away = first @ aside / np.linalg.norm(first)
    assert away > np.cos(np.arctan(plane.friction))  # within the cone of friction


def test_dart_and_mujoco_touch_alike(panda):
    """A press with a slide in DART has the forces of MuJoCo, within 0.3 N in the mean."""
    robot, d, jacobian = pressing(panda, 2e4)
    tau = jacobian.T @ np.array([3.0, 9.0, -20.0])
    sim = Simulator(robot, d, 1, 1)
    sim.reset(panda.q_home[None], np.zeros((1, 7)))
    force = contacts(sim.rollout(np.tile(tau, (1, 300, 1)), record=("userdata",)))[0, :, FORCE : FORCE + 3]
    engine, law = dart(robot)(d), FrictionTorque(robot, d)
    now, seen = (panda.q_home, np.zeros(7)), []
    engine.reset(*now)
    for _ in range(300):
        now = engine.step(tau + law(*now, tau))
        seen.append(law.contact[FORCE : FORCE + 3].copy())
    assert np.abs(force[-1, 2]) > 10
    assert np.abs(np.array(seen) - force).mean() < 0.3


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"stiffness": 0.0}, r"^surface\.stiffness: expected a value above 0 N/m, got 0 to 0$"),
        ({"exponent": 0.5}, r"^surface\.exponent: expected a value from 1 to 2, got 0\.5 to 0\.5$"),
        ({"friction": -0.1}, r"^surface\.friction: expected a value of 0 or more, got -0\.1 to -0\.1$"),
        ({"half": np.array([0.1, 0.0, 0.1]), "axes": np.eye(3)}, r"^surface\.half: expected 3 half edges above 0 m"),
        ({"half": np.ones(3), "axes": np.ones((3, 3))}, r"^surface\.axes: expected 3 perpendicular unit vectors"),
        ({"half": np.ones(3)}, r"^surface\.axes: expected 3 perpendicular unit vectors"),
        ({"normal": 2 * UP}, r"^surface: expected a finite point and a normal of length 1, got"),
    ],
)
def test_a_wrong_surface_gets_one_line(panda, change, message):
    robot, d, _ = pressing(panda)
    with pytest.raises(UserError, match=message):
        Simulator(robot, replace(d, surface=replace(d.surface, **change)), 1, 1)


def test_a_surface_needs_a_tool(panda):
    _, d, _ = pressing(panda)
    with pytest.raises(UserError, match=r"^robot\.tool: panda has no tool that could touch the surface"):
        Simulator(panda, d, 1, 1)


@pytest.mark.long
@pytest.mark.parametrize("name", ["sigmoid", "coulomb", "stribeck"])
def test_an_independent_simulator_presses_alike(name):
    """Replayed open loop in windows of 0.5 s, from the true depth, normal forces agree within 0.5 N RMS."""
    if not SHARED.is_dir():
        pytest.skip(f"the independent contact recordings are not here: {SHARED}")
    sys.path.insert(0, str(ROOT / "benchmarks"))
    from contact_physics import replay_errors

    errors = replay_errors(SHARED / name, 500)
    assert len(errors) > 20_000
    assert np.sqrt(np.mean(errors**2)) <= 0.5
