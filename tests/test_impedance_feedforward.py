"""What impedance control feeds forward: the model's torque at rest, friction of the reference, and of bristles."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import conf
from test_impedance import DT, PANDA, REACH, N

from r2s.control.impedance import joint_impedance
from r2s.physics import impedance as law
from r2s.physics.dynamics import Dynamics, nominal_dynamics
from r2s.physics.friction import BRISTLE, presliding
from r2s.physics.inverse_dynamics import InverseDynamics
from r2s.tasks.track import TrackTask


def random_model():
    """Return dynamics with every error that the feedforward knows."""
    rng, d = np.random.default_rng(5), nominal_dynamics(PANDA, **conf("friction/paper"))
    errors = {"offset": rng.normal(size=N), "drag": rng.normal(size=(N, 2)), "com": d.com + 0.01}
    return replace(d, mass=1.1 * d.mass, **errors)


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
