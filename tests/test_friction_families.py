"""Families of friction: they take energy out, and level and slope are what their parameters say, at any speed."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from test_physics import RANGES, THREE, compiled_slope, light, named, some_dynamics, some_motion, some_phi

from r2s.errors import UserError
from r2s.physics.dynamics import Dynamics
from r2s.physics.friction import BRISTLE, COULOMB, FAMILIES, SIGMOID, STRIBECK, family, presliding
from r2s.physics.inverse_dynamics import InverseDynamics
from r2s.physics.simulator import Simulator

__all__ = ["light"]  # a fixture


@pytest.mark.parametrize("law", FAMILIES, ids=named)
def test_friction_takes_energy_out(law):
    """The torque has the sign of the velocity, whatever the asymmetry, and is zero at rest."""
    rng = np.random.default_rng(3)
    shape = (20000, 3)
    phi = some_phi(law, shape, rng)
    if law is SIGMOID:
        phi[..., 2] *= 5
    dq = rng.normal(size=shape) * 10.0 ** rng.uniform(-6, 1, shape)
    assert (law.torque(dq, phi) * dq).min() >= -1e-15
    assert np.array_equal(law.torque(np.zeros(shape), phi), np.zeros(shape))


@pytest.mark.parametrize("law", THREE, ids=named)
def test_a_free_arm_only_slows_down(panda, law):
    """Without command and offset the kinetic energy of the arm never rises; load makes it fall more."""
    d = some_dynamics(panda, 3, law=law)
    level = np.array([1.0, 1.0, 1.0, 1.0, 0.2, 0.2, 0.05])[:, None] ** (np.arange(len(law.names)) == 0)
    d = replace(d, phi=d.phi * level, offset=np.zeros_like(d.offset), load=np.full((3, 7), 0.02))
    sim = Simulator(panda, d, 3, 1)
    q, dq, _ = some_motion(panda, 3, 1)
    sim.reset(q, dq)
    model, full = panda.model(gravity=False), np.empty((7, 7))
    data = mujoco.MjData(model)
    out = sim.rollout(np.zeros((3, 100, 7)), record=("qpos", "qvel"))
    for k in range(3):
        energy = []
        for q_now, dq_now in zip(out["qpos"][k], out["qvel"][k], strict=True):
            data.qpos[:] = q_now
            mujoco.mj_forward(model, data)
            mujoco.mj_fullM(model, data, full)
            energy.append(0.5 * dq_now @ full @ dq_now)
        assert np.all(np.diff(energy) <= 1e-9)
        assert energy[-1] < 0.9 * energy[0]


@pytest.mark.parametrize("law", THREE, ids=named)
def test_the_slope_is_the_derivative(law):
    """The compiled law's slope equals the central difference of Family.torque."""
    rng = np.random.default_rng(4)
    shape = (500,)
    phi = some_phi(law, shape, rng)
    dq, h = rng.normal(size=shape) * 10.0 ** rng.uniform(-2, 0, shape), 1e-7
    dq += np.sign(dq) * 1e-4  # asymmetric laws have a kink at rest
    numerical = (law.torque(dq + h, phi) - law.torque(dq - h, phi)) / (2 * h)
    np.testing.assert_allclose(compiled_slope(law, dq, phi), numerical, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("other", FAMILIES, ids=named)
@pytest.mark.parametrize("law", FAMILIES, ids=named)
def test_a_family_converted_has_the_same_level(law, other):
    """`matched_to` keeps the mean friction at plus and minus 1 rad/s, and the parameters of the same family."""
    phi = some_phi(law, (20, 7), np.random.default_rng(5))
    new, one = other.matched_to(law, phi), np.ones((20, 7))
    np.testing.assert_allclose(other.level(new, one), law.level(phi, one), rtol=1e-7)
    if law is other:
        assert np.array_equal(new, phi)
    else:
        assert new.shape == (20, 7, len(other.names) - len(other.optional))


def test_the_viscous_term_of_the_sigmoid_may_be_left_out():
    """Three parameters are four with a viscous term of zero; the fourth adds itself times the velocity."""
    rng = np.random.default_rng(6)
    phi, dq = some_phi(SIGMOID, (50, 2), rng), rng.normal(size=(50, 2))
    three = SIGMOID.torque(dq, phi[..., :3])
    np.testing.assert_allclose(SIGMOID.torque(dq, phi), three + phi[..., 3] * dq, rtol=1e-12)
    phi, dq = phi[:, 0], dq[:, 0]
    with_it, without = (compiled_slope(SIGMOID, dq, x) for x in (phi, phi[:, :3]))
    np.testing.assert_allclose(with_it, without + phi[:, 3], rtol=1e-12)


@pytest.mark.parametrize(("law", "at_rest"), [(COULOMB, 1.2), (STRIBECK, 1.2 * 1.5)], ids=("coulomb", "stribeck"))
def test_levels_follow_the_parameters(law, at_rest):
    """1 Nm with 20 % asymmetry and 50 % rise: both appear near zero speed, and the rise vanishes at high speed."""
    values = dict(coulomb=1.0, asymmetry=0.2, viscous=0.3, rise=0.5, stribeck_velocity=0.1)
    phi = np.array([values[name] for name in law.names if name in values])
    slow = np.array([0.06, -0.06])
    rise = at_rest / 1.2 - 1
    np.testing.assert_allclose(
        law.torque(slow, phi) - 0.3 * slow, [1.2 * (1 + rise * np.exp(-0.36)), -0.8 * (1 + rise * np.exp(-0.36))],
        rtol=1e-4,
    )  # fmt: skip
    np.testing.assert_allclose(law.torque(np.array([1.0, -1.0]), phi), [1.5, -1.1], rtol=1e-9)
    np.testing.assert_allclose(law.torque(np.zeros(2), phi, bristle=np.array([1.0, -1.0])), [at_rest, -at_rest / 1.5])


def test_load_dependent_friction_of_bristles_holds_at_rest(panda):
    """A joint holds its level and half of its load-dependent friction, within a few presliding distances; not 1.5."""
    n, phi = panda.n, np.tile([1.0, 0.0, 0.0, 0.0, 0.1, 5e-4, 0.0, 0.0], (panda.n, 1))
    d = replace(Dynamics.of(panda, phi, BRISTLE), load=np.full(n, 0.05))
    level = InverseDynamics(panda, d).load_friction(panda.q_home[None])[0]
    j = int(np.argmax(level))
    tau = np.zeros((2, 1500, n))
    tau[:, :, j] = 1.0 + level[j] * np.array([[0.5], [1.5]])
    sim = Simulator(panda, d, 2, 1)
    sim.reset(np.tile(panda.q_home, (2, 1)), np.zeros((2, n)))
    out = sim.rollout(tau, record=("qpos", "qvel"))
    moved, speed = np.abs(out["qpos"][:, -1, j] - panda.q_home[j]), np.abs(out["qvel"][:, -1, j])
    assert speed[0] < 1e-6
    assert moved[0] < 10 * 5e-4
    assert speed[1] > 0.01
    assert moved[1] > 100 * 5e-4


def test_presliding_goes_by_the_distance():
    """The sign changes as 1 - exp(-distance / scale), at any speed and step; after a reversal from 1 to -1."""
    for speed, dt in ((0.01, 1e-3), (0.1, 1e-3), (0.02, 5e-3)):
        path = np.full((200, 1), speed)
        z = presliding(path, dt, 1e-3)[:, 0]
        np.testing.assert_allclose(z, 1 - np.exp(-speed * dt * np.arange(1, 201) / 1e-3), rtol=0, atol=1e-12)
    wave = np.sin(0.01 * np.arange(2000))[:, None] * np.array([0.3, 1.0, 3.0])
    z = presliding(wave, 1e-3, 1e-3)
    assert np.abs(z).max() <= 1
    fast = np.abs(wave) > 0.9 * np.abs(wave).max(0)
    assert np.array_equal(np.sign(z[fast]), np.sign(wave[fast]))
    own = np.array([5e-4, 1e-3, 2e-3])  # joints of distances of their own
    alone = [presliding(wave[:, [j]], 1e-3, own[j])[:, 0] for j in range(3)]
    np.testing.assert_array_equal(presliding(wave, 1e-3, own), np.stack(alone, 1))
    assert not presliding(np.zeros((5, 2)), 1e-3, 1e-3).any()


def test_an_unknown_family_is_named():
    """One line with the nearest of those that exist."""
    assert all(family(f.name) is f for f in FAMILIES)
    with pytest.raises(UserError, match=r"^friction\.family: expected .*, got 'stribek'; did you mean 'stribeck'\?$"):
        family("stribek")


@pytest.mark.parametrize("law", FAMILIES, ids=named)
def test_the_law_is_finite_at_any_speed(light, law):
    """Neither form overflows at a million rad/s."""
    phi = np.array([[RANGES[name][1] for name in law.names]])
    for v in (-1e6, 1e6):
        assert np.isfinite(law.torque(np.array([v]), phi)).all()
        assert np.isfinite(compiled_slope(law, np.array([v]), phi)).all()
    sim = Simulator(light, Dynamics.of(light, phi, law), 1, 1)
    sim.reset(np.zeros((1, 1)), np.full((1, 1), 1e6))
    assert np.isfinite(sim.rollout(np.zeros((1, 1, 1)), record=("qvel",))["qvel"]).all()


@pytest.mark.parametrize("law", FAMILIES, ids=named)
def test_a_pushed_joint_reaches_the_speed_at_which_friction_balances(light, law):
    """Native laws end where command = Family.torque, with its asymmetry, in both directions and in every family."""
    phi = np.array([[{"viscous": 0.5, "coulomb": 1.0, "phi1": 2.0, "asymmetry": 0.2, "presliding": 1e-3}.get(
        name, 0.5 * sum(RANGES[name])) for name in law.names]])  # fmt: skip
    speed = np.array([[1.0], [-1.0]])
    push = law.torque(speed, np.broadcast_to(phi, (2, 1, phi.shape[-1])))
    sim = Simulator(light, Dynamics.of(light, phi, law), 2, 1)
    sim.reset(np.zeros((2, 1)), 0.9 * speed)
    dq = sim.rollout(np.repeat(push[:, None], 400, 1), record=("qvel",))["qvel"]
    np.testing.assert_allclose(dq[:, -1], speed, rtol=1e-6)
