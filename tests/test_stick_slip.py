"""Stick and slip within a step: net torque with coupling, and exact times of stops, reversals and breakaway."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from conftest import conf
from numba import njit
from test_physics import (
    THREE,
    compiled_slope,
    light,
    mass_matrix,
    named,
    rounding,
    set_links,
    some_dynamics,
    some_motion,
    weight,
    with_everything,
)

from r2s.errors import UserError
from r2s.identification.parameter_file import load_parameters, save_parameters
from r2s.identification.parameters import ParameterEstimate, parameter_space
from r2s.physics.dynamics import Dynamics, nominal_dynamics
from r2s.physics.friction import BRISTLE, COULOMB, SIGMOID, STRIBECK
from r2s.physics.robot import SIM_DT
from r2s.physics.simulator import Simulator
from r2s.physics.stick_slip import TINY, JointForces, coming_velocity

__all__ = ["light"]  # a fixture
REST = 1e-12  # rad/s, velocity of a sticking joint from round-off


def by_events(mass, damping, v, drive, friction, rest, edges, dq_min):
    """Return the velocities (n,) after a step, and its events, by dense algebra; arguments as in coming_velocity."""
    h, able = SIM_DT, (edges != 0).any(0)
    side = np.where(able, np.where(np.abs(v) <= dq_min, 0.0, np.sign(v)), 2.0)
    w, now, left, slow = np.where(np.abs(v) < TINY, 0.0, v), friction.copy(), h, True
    for events in range(100):
        while True:
            slides, a = side != 0, np.zeros_like(v)
            implicit = (mass + h * np.diag(damping))[np.ix_(slides, slides)]
            a[slides] = np.linalg.solve(implicit, (drive - now)[slides])
            net = drive - mass @ a
            beyond = np.where(slides, -np.inf, np.maximum(net - edges[1], edges[0] - net))
            j = int(beyond.argmax())
            if beyond[j] <= 0:
                break
            side[j] = np.sign(w[j] or net[j])
            now[j] = friction[j] if side[j] * v[j] > 0 else rest[int(side[j] > 0), j]
        if slow:
            impulse = mass @ np.where(slides, 0.0, w)
            w[slides] += np.linalg.solve(implicit, impulse[slides])
            w[~slides] = 0.0
        wrong = able & slides & (side * w < 0)  # by an impulse
        stops = able & slides & (side * (w + left * a) < 0)
        when = np.where(wrong, 0.0, np.where(stops, -w / np.where(stops, a, 1.0), left))
        j = int(when.argmin())
        w += when[j] * a
        if not (wrong | stops).any():
            return w, events
        w[j] = w[j] if wrong[j] else 0.0
        left, side[j], slow = left - when[j], 0.0, wrong[j]
    raise AssertionError("no end of events")


def agree_step_by_step(robot, dynamics, k, q, dq, tau, out):
    """Assert that each step of simulation k is the one of `by_events` from the same state; count held, and events."""
    model, d = robot.model(gravity=False), dynamics.one(k)
    set_links(model, d.mass, d.com, d.inertia)
    data = mujoco.MjData(model)
    qs, dqs = (np.vstack([start[k], out[name][k]]) for start, name in ((q, "qpos"), (dq, "qvel")))
    held = events = 0
    for i, torque in enumerate(tau[k]):
        v = np.where(np.abs(dqs[i]) < TINY, 0.0, dqs[i])
        data.qpos[:], data.qvel[:] = qs[i], dqs[i]
        mujoco.mj_forward(model, data)  # the bias, and M
        bias, mass = data.qfrc_bias.copy(), mass_matrix(model, data)
        links = (robot.mass, robot.com), (d.mass, d.com)
        nominal, actual = (weight(model, data, *one, robot.gravity) for one in links)
        loaded = d.load * np.abs(nominal)
        friction = d.friction(v, np.sign(v)) + loaded * np.sign(v)
        slope = compiled_slope(d.family, v, d.phi, sharp=True)
        damping = model.dof_damping + np.maximum(slope, 0.0)
        pull = d.offset + d.drag[:, 0] * np.sin(data.qpos) + d.drag[:, 1] * np.cos(data.qpos) + actual - nominal
        drive = torque + pull - bias - model.dof_damping * v
        ones = np.ones_like(v)
        rest = np.stack([d.friction(0 * v, sign * ones) + sign * loaded for sign in (-1, 1)])
        edges = np.stack([np.minimum(d.breakaway[:, 0], rest[0]), np.maximum(d.breakaway[:, 1], rest[1])])
        after, count = by_events(mass, damping, v, drive, friction, rest, edges, d.dq_min)
        forces = sum(map(np.abs, (torque, pull, friction, actual, nominal, damping * v, bias)))
        bound = (1 + count) * rounding(mass + SIM_DT * np.diag(damping), forces, v, after)
        np.testing.assert_allclose(dqs[i + 1], after, rtol=0, atol=bound, err_msg=f"step {i}")
        held, events = held + int((np.abs(dqs[i + 1]) < TINY).sum()), events + count
    return held, events


@pytest.mark.long
@pytest.mark.parametrize("law", THREE, ids=named)
@pytest.mark.parametrize("everything", [False, True])
def test_native_stiction_is_that_of_dense_algebra(panda, everything, law):
    """Each of 60 steps agrees to round-off: family, load, drag, links, sticking joints, stops and reversals."""
    nsim, steps = 4, 60
    dynamics = replace(some_dynamics(panda, nsim, law=law), stiction_model="net", dq_min=2e-3)
    dynamics = with_everything(panda, dynamics) if everything else dynamics
    q, dq, tau = some_motion(panda, nsim, steps)
    sim = Simulator(panda, dynamics, nsim, 1)
    sim.reset(q, 0.3 * dq)
    out = sim.rollout(tau, record=("qpos", "qvel"))
    seen = [agree_step_by_step(panda, dynamics, k, q, 0.3 * dq, tau, out) for k in range(nsim)]
    held, events = np.sum(seen, 0)
    assert 0.02 < held / tau.size < 0.98
    assert events > 10


def one_joint(light, **change):
    """Return the light joint with exact Coulomb friction of 0.1 Nm, held up to 0.13 Nm."""
    d = Dynamics.of(light, np.array([[0.1, 0.0, 0.0]]), COULOMB, dq_min=0.0)
    return replace(d, breakaway=np.array([[-0.13, 0.13]]), stiction_model="net", **change)


def exactly(tau, inertia, level, edge):
    """Return the velocities after each ms of one joint at rest under torques (T,), every event solved for."""
    v, out = 0.0, []
    for torque in tau:
        left = SIM_DT
        while True:
            if v == 0.0 and abs(torque) <= edge:
                break
            side = np.sign(v or torque)
            a = (torque - side * level) / inertia
            until = -v / a if side * a < 0 else np.inf
            if until >= left:
                v += a * left
                break
            v, left = 0.0, left - until
        out.append(v)
    return np.array(out)


def test_events_of_one_joint_are_exact(light):
    """Without viscous friction a joint has constant accelerations between events: velocities are exact to round-off.

    What round-off adds up to in 3000 steps of velocities up to 10 rad/s: eps each.
    """
    rng = np.random.default_rng(2)
    smooth = 0.3 * np.sin(np.arange(3000) * 0.013) * rng.uniform(0.2, 1.5, 3000)
    tau = np.stack([smooth, rng.uniform(-0.4, 0.4, 3000)])
    sim = Simulator(light, one_joint(light), 2, 1)
    sim.reset(np.zeros((2, 1)), np.zeros((2, 1)))
    dq = sim.rollout(tau[..., None], record=("qvel",))["qvel"][..., 0]
    for seen, torque in zip(dq, tau, strict=True):
        expected = exactly(torque, 0.005, 0.1, 0.13)
        turned = np.sum(np.diff(np.sign(expected)) != 0)
        assert turned > 20
        np.testing.assert_allclose(seen, expected, rtol=0, atol=3000 * np.finfo(float).eps * np.abs(expected).max())


def test_a_ramped_joint_lets_go_at_its_edge(panda):
    """At rest to the bit before the net torque passes the edge, moving after the first step in which it has."""
    d = replace(some_dynamics(panda, 1, law=STRIBECK), stiction_model="net", offset=np.zeros((1, 7)))
    d = replace(d, breakaway=np.stack([np.full((1, 7), -9.0), np.full((1, 7), 9.0)], -1))
    rest = STRIBECK.at_rest(d.phi)[0]
    for joint, sign in ((1, 1.0), (4, -1.0), (6, 1.0)):
        edge = 1.1 * abs(rest[joint, int(sign > 0)])
        edges = d.breakaway.copy()
        edges[0, joint] = np.array([-edge, edge])
        edges[0, joint, int(sign < 0)] *= 5
        ramp = np.zeros((1, 1000, 7))
        ramp[0, :, joint] = sign * edge * (0.6 + 0.5 * np.arange(1000) / 1000)
        sim = Simulator(panda, replace(d, breakaway=edges), 1, 1)
        sim.reset(panda.q_home[None], np.zeros((1, 7)))
        out = sim.rollout(ramp, record=("qpos", "qvel"))
        first = int(np.argmax(np.abs(ramp[0, :, joint]) > edge))
        assert np.array_equal(out["qpos"][0, first - 1], panda.q_home)
        assert sign * out["qvel"][0, first, joint] > 1e-6
        assert sign * np.diff(out["qpos"][0, first:, joint]).min() > 0 or sign < 0


def needed(robot, d, q, dq, after, tau):
    """Return (n,) Nm that friction must have held with in a step, by MuJoCo's inverse dynamics."""
    model = robot.model(gravity=False)
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_LIMIT)
    set_links(model, d.mass, d.com, d.inertia)
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:], data.qacc[:] = q, dq, (after - dq) / SIM_DT
    mujoco.mj_inverse(model, data)
    return tau + d.offset - data.qfrc_inverse


@pytest.mark.long
@pytest.mark.parametrize("law", [SIGMOID, COULOMB], ids=named)
def test_a_joint_is_held_against_the_motion_of_the_others(panda, law):
    """Joints 1, 3, 5 and 7 keep their angles to round-off while the others swing, as long as what holds them allows.

    The paper's rule, which only takes their command away, lets them drift.
    """
    n, steps, still = panda.n, 400, np.array([0, 2, 4, 6])
    d = Dynamics.of(panda, np.tile([0.4, 8.0, 0.0] if law is SIGMOID else [0.1, 0.1, 0.1], (n, 1)), law)
    edges = np.zeros((n, 2))
    edges[still] = [-8.0, 8.0]
    d = replace(d, breakaway=edges, stiction_model="net")
    tau = np.zeros((1, steps, n))
    tau[0, :, 1::2] = np.array([6.0, 3.0, 0.5]) * np.sin(0.02 * np.arange(steps))[:, None]
    out = {}
    for hold in ("net", "command"):
        sim = Simulator(panda, replace(d, stiction_model=hold), 1, 1)
        sim.reset(panda.q_home[None], np.zeros((1, n)))
        out[hold] = sim.rollout(tau, record=("qpos", "qvel"))
    q, dq = (out["net"][k][0] for k in ("qpos", "qvel"))
    assert np.abs(q[:, still] - panda.q_home[still]).max() < 1e-15
    assert np.abs(dq[:, still]).max() < REST
    assert np.ptp(q[:, 1::2], axis=0).min() > 1e-3
    assert np.abs(out["command"]["qpos"][0, -1, still] - panda.q_home[still]).max() > 1e-3
    held = [needed(panda, d, q[i], dq[i], dq[i + 1], tau[0, i + 1])[still] for i in range(steps - 1)]
    largest = np.abs(held).max(0)
    assert (largest > 0.01).all()
    assert (largest < 8.0).all()
    # with narrower edges each lets go in the very step in which that torque passes them
    j = int(np.argmax(largest))
    edges = edges.copy()
    edges[still[j]] = np.array([-0.7, 0.7]) * largest[j]
    sim = Simulator(panda, replace(d, breakaway=edges), 1, 1)
    sim.reset(panda.q_home[None], np.zeros((1, n)))
    moved = np.abs(sim.rollout(tau, record=("qvel",))["qvel"][0, :, still[j]]) > REST
    assert int(np.argmax(moved)) == 1 + int(np.argmax(np.abs(held)[:, j] > 0.7 * largest[j]))


@pytest.mark.parametrize("law", THREE, ids=named)
def test_friction_never_gives_energy(panda, law):
    """Without command and offset kinetic energy never rises, stops included, and in the end all joints are held."""
    d = replace(some_dynamics(panda, 3, law=law), stiction_model="net", dq_min=5e-3, offset=np.zeros((3, 7)))
    q, dq, _ = some_motion(panda, 3, 1)
    sim = Simulator(panda, d, 3, 1)
    sim.reset(q, dq)
    out = sim.rollout(np.zeros((3, 1500, 7)), record=("qpos", "qvel"))
    model = panda.model(gravity=False)
    data = mujoco.MjData(model)
    for k in range(3):
        energy = []
        for q_now, dq_now in zip(out["qpos"][k], out["qvel"][k], strict=True):
            data.qpos[:] = q_now
            mujoco.mj_forward(model, data)
            energy.append(0.5 * dq_now @ mass_matrix(model, data) @ dq_now)
        assert np.diff(energy).max() <= 1e-9
        assert np.abs(out["qvel"][k, -1]).max() < REST
        assert np.array_equal(out["qpos"][k, -1], out["qpos"][k, -100])


@njit
def moreau(inverse, level, drive, v, dt, count, sweeps):
    """Step Coulomb's law by Moreau's scheme: friction of the end of each of `count` steps, by Gauss-Seidel."""
    n, v, friction = len(v), v.copy(), np.zeros(len(v))
    for _ in range(count):
        for _ in range(sweeps):
            for j in range(n):
                without = v[j]
                for k in range(n):
                    without += dt * inverse[j, k] * (drive[k] - (friction[k] if k != j else 0.0))
                friction[j] = min(max(without / (dt * inverse[j, j]), level[0, j]), level[1, j])
        for j in range(n):
            for k in range(n):
                v[j] += dt * inverse[j, k] * (drive[k] - friction[k])
    return v


@pytest.mark.long
def test_events_are_where_time_stepping_puts_them():
    """Coupled joints, edges of Coulomb's own level: as 4000 steps of Moreau's scheme, which knows of no events.

    Each of its steps may be a step late with friction, twice the level, at each of up to a dozen events.
    """
    rng, n, parts = np.random.default_rng(8), 4, 4000
    seen = 0
    for _ in range(40):
        root = rng.normal(size=(n, n))
        mass = root @ root.T + 0.3 * np.eye(n)
        inverse = np.linalg.inv(mass)
        level = np.stack([-rng.uniform(0.5, 3, n), rng.uniform(0.5, 3, n)])
        drive = rng.uniform(-4, 4, n)
        v = 2e-3 * rng.normal(size=n) * (rng.random(n) < 0.7)
        out, work = np.empty(n), np.empty((n + 4, n))
        friction = np.where(v > 0, level[1], np.where(v < 0, level[0], 0.0))
        packed = mass[np.tril_indices(n)]
        forces = JointForces(v, drive, friction, level, level)
        coming_velocity(packed, np.zeros(n), SIM_DT, forces, TINY, work, out)
        expected = moreau(inverse, level, drive, v, SIM_DT / parts, parts, 60)
        late = SIM_DT / parts * np.abs(inverse) @ np.ptp(level, axis=0)
        np.testing.assert_allclose(out, expected, rtol=0, atol=12 * late.max())
        seen += int(np.any((np.sign(out) != np.sign(v)) & (v != 0)))
    assert seen > 15


@pytest.mark.parametrize("law", THREE, ids=named)
def test_a_slow_joint_within_its_edges_comes_to_rest(panda, law):
    """Below dq_min a joint stops in one step while it is within its edges; if its command is beyond, it slides on."""
    phi = {"sigmoid": [0.4, 8.0, 0.0], "coulomb": [0.2, 0.0, 0.1], "stribeck": [0.2, 0.0, 0.1, 0.5, 0.1]}[law.name]
    edges = np.tile([-5.0, 5.0], (7, 1))
    edges[5] = -0.5, 0.5
    d = replace(Dynamics.of(panda, np.tile(phi, (7, 1)), law, dq_min=2e-3), breakaway=edges, stiction_model="net")
    slow = np.array([[1.9e-3, -1.9e-3, 2.1e-3, 0.0, 0.5, 1e-3, 0.0]])
    tau = np.zeros((1, 1, 7))
    tau[0, 0, 5] = 0.8
    sim = Simulator(panda, d, 1, 1)
    sim.reset(panda.q_home[None], slow)
    dq = sim.rollout(tau, record=("qvel",))["qvel"][0, 0]
    assert np.abs(dq[[0, 1, 3, 6]]).max() < REST
    assert dq[4] > 0.3
    assert dq[5] > 1e-3


def test_threads_and_states_do_not_change_a_bit(panda):
    """One thread and two give the same bits, and so does an arm that is put back to where it was."""
    nsim = 9
    dynamics = replace(some_dynamics(panda, nsim, law=STRIBECK), stiction_model="net", dq_min=1e-3)
    q, dq, tau = some_motion(panda, nsim, 120)
    results = []
    for nthread in (1, 2):
        sim = Simulator(panda, dynamics, nsim, nthread)
        sim.reset(q, dq)
        sim.rollout(tau[:, :40])
        state = sim.state()
        first = sim.rollout(tau[:, 40:], record=("qpos", "qvel"))
        sim.set_state(state)
        results += [first, sim.rollout(tau[:, 40:], record=("qpos", "qvel"))]
    for other in results[1:]:
        assert all(np.array_equal(results[0][name], other[name]) for name in ("qpos", "qvel"))


def test_what_has_no_edges_and_no_jump_is_the_same_by_either_rule(panda):
    """A sigmoid without breakaway, and bristles, do not depend on `stiction_model`."""
    nsim = 3
    q, dq, tau = some_motion(panda, nsim, 100)
    for law in (SIGMOID, BRISTLE):
        d = some_dynamics(panda, nsim, law=law)
        d = replace(d, breakaway=0 * d.breakaway if law is SIGMOID else d.breakaway)
        paths = []
        for hold in ("command", "net"):
            sim = Simulator(panda, replace(d, stiction_model=hold), nsim, 1)
            sim.reset(q, dq)
            paths.append(sim.rollout(tau)["qpos"])
        assert np.array_equal(*paths)


def test_the_rule_is_named(panda, tmp_path):
    """The published arm keeps the paper's rule; another is named in yaml, kept by parameters.yaml, or refused."""
    paper = nominal_dynamics(panda, **conf("friction/paper"))
    assert paper.stiction_model == "command"
    net = nominal_dynamics(panda, **conf("friction/paper") | {"stiction_model": "net"})
    space = parameter_space(panda, net, {"offset": [-1.0, 1.0]})
    x = space.start
    save_parameters(
        tmp_path / "parameters.yaml", space, ParameterEstimate(x, x, x, np.ones(len(x), bool), x[None]), {}
    )
    again, x = load_parameters(tmp_path, panda)
    assert again.dynamics(x).stiction_model == "net"
    with pytest.raises(
        UserError, match=r"^friction\.stiction_model: 'nett'; allowed: command, net; did you mean 'net'\?$"
    ):
        nominal_dynamics(panda, **conf("friction/paper") | {"stiction_model": "nett"})
