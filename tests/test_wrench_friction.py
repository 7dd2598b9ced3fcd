"""Wrench observer and joint friction: what friction hides at rest, at breakaway and in slow motion."""

from dataclasses import replace

import numpy as np
import pytest
from test_wrench import BAND, NOISE, ROBOT, SPRING, free, jacobian, run, truth

from r2s.adaptation import tuning
from r2s.adaptation.wrench import GAUSSIAN, WrenchObserver, observe_recording, wrench_noise
from r2s.arm.command_loop import CommandLoop
from r2s.arm.driver import Driver
from r2s.arm.simulated import SimulatedArm
from r2s.physics.friction import BRISTLE, COULOMB, STRIBECK
from r2s.physics.inverse_dynamics import InverseDynamics
from r2s.physics.robot import SIM_DT
from r2s.recordings.recording import Recording


@pytest.mark.long
def test_a_joint_that_breaks_away_late_is_no_contact():
    """Stiction holds the wrist up to 1.2 times the identified breakaway torque while other joints move: no force.

    The squared force stays below the least threshold, which holds for independent normal errors. Before the edges
    had an error, it exceeded this threshold.
    """
    observer = WrenchObserver(ROBOT, replace(truth(), breakaway=np.column_stack([-BAND, BAND])))
    motion, rng = free(1), np.random.default_rng(0)
    q, dq, tau = motion.q.copy(), motion.dq.copy(), motion.tau.copy()
    noise = rng.standard_normal((2, len(q)))
    q[:, -1], dq[:, -1] = ROBOT.q_home[-1] + 1e-2 * NOISE * noise[0], NOISE * noise[1]
    tau[:, -1] = 1.2 * BAND[-1] * np.sin(2.0 * motion.t)
    table = observe_recording(ROBOT, observer, replace(motion, q=q, dq=dq, tau=tau))
    assert table["square"].rolling(tuning.CONFIRMED).min().max() < GAUSSIAN


def slow_motion(dynamics, seconds=3.0):
    """Return a recording in which all joints move at 0.03 rad/s, to and fro."""
    arm = SimulatedArm(ROBOT, dynamics, position_noise=1e-2 * NOISE, velocity_noise=NOISE, seed=0)
    loop = CommandLoop(arm, Driver(ROBOT, 0.3 * ROBOT.tau_max, truth().level))
    loop.place(ROBOT.q_home)
    rows, speed = [], 0.03 * np.array([1, -1, 1, -1, 1, -1, 1])
    for k in range(round(seconds / SIM_DT)):
        s, t = loop.state, k * SIM_DT
        forth = t < seconds / 2
        goal, rate = ROBOT.q_home + speed * min(t, seconds - t), speed if forth else -speed
        loop(5.0 * SPRING * (goal - s.q) + 0.5 * SPRING * (rate - s.dq))
        rows.append((s.q, s.dq, loop.sent))
    q, dq, tau = (np.array(x) for x in zip(*rows, strict=True))
    return Recording(np.arange(len(q)) * SIM_DT, q, dq, tau, "commanded")


@pytest.mark.long
def test_a_model_without_stribeck_effect_finds_no_force_in_slow_motion():
    """The model is Coulomb friction with a 40 % larger breakaway torque; the arm has, or lacks, a Stribeck effect."""
    phi = dict.fromkeys(STRIBECK.names, np.zeros(7)) | {"coulomb": BAND / 1.4, "viscous": 0.2 * BAND}
    phi |= {"rise": np.full(7, 0.4), "stribeck_velocity": np.full(7, 0.03)}
    arms = [
        replace(
            truth(),
            family=family,
            phi=np.stack([phi[name] for name in family.names], -1),
            breakaway=np.column_stack([-BAND, BAND]),
        )
        for family in (STRIBECK, COULOMB)
    ]
    rms = {}
    for arm in arms:
        motion = slow_motion(arm)
        for blind in (False, True):
            observer = WrenchObserver(ROBOT, arms[1])
            if blind:  # as if friction did not depend on the breakaway torque
                observer._noise = observer._noise._replace(excess=0.0 * observer._noise.excess)
            found, half, touches = (x[500:] for x in run(observer, motion))
            rms[arm.family.name, blind] = np.sqrt((found**2).mean())
            assert not touches.any()
            assert blind or (np.abs(found) < half).mean() > 0.95
    assert rms["stribeck", False] < 0.9 * rms["stribeck", True]  # by hand: 0.27 and 0.33 N


@pytest.mark.parametrize("joint", [1, 3])
def test_slow_motion_determines_the_sign_of_friction(joint):
    """A joint moves to and fro at 5 mrad/s (1.7 times the noise of its speed); all other joints rest.

    Just after the reversal, the sign of friction is uncertain. Later, at the same speed, the friction's standard
    deviation is less than half as large.
    """
    observer = WrenchObserver(ROBOT, replace(truth(), breakaway=np.column_stack([-BAND, BAND])))
    rng, turn, zero = np.random.default_rng(0), 600, np.zeros(7)
    q, dq, tau, error = ROBOT.q_home.copy(), zero.copy(), zero.copy(), []
    for k in range(2 * turn):
        dq[joint] = 5e-3 if k < turn else -5e-3
        q[joint] += dq[joint] * SIM_DT
        tau[joint] = BAND[joint] * np.sign(dq[joint])
        observer(q + 1e-2 * NOISE * rng.standard_normal(7), dq + NOISE * rng.standard_normal(7), tau)
        error.append(np.sqrt(observer._state.P[3 + joint, 3 + joint]))
    assert np.mean(error[turn + 100 :]) < 0.5 * np.max(error[turn : turn + 60])


def test_only_a_breakaway_torque_beyond_the_model_is_an_excess():
    """Load-dependent friction at home, a breakaway torque that was not measured, and a smooth family are none."""
    phi = dict.fromkeys(COULOMB.names, np.zeros(7)) | {"coulomb": BAND, "asymmetry": np.full(7, 0.2)}
    phi = np.stack([phi[name] for name in COULOMB.names], -1)
    arm = replace(truth(), family=COULOMB, phi=phi, load=np.full(7, 0.03))
    sides = BAND[:, None] * np.array([-0.8, 1.2])
    loaded = InverseDynamics(ROBOT, arm).load_friction(ROBOT.q_home[None])[0]
    assert loaded.max() > 0.5  # Nm, joint 4
    edges = sides + np.column_stack([-loaded, loaded])
    assert np.abs(wrench_noise(ROBOT, replace(arm, breakaway=edges)).excess).max() < 1e-9
    assert not wrench_noise(ROBOT, arm).excess.any()
    assert not wrench_noise(ROBOT, replace(truth(), breakaway=2.0 * edges)).excess.any()
    found = wrench_noise(ROBOT, replace(arm, breakaway=edges + 0.3 * sides)).excess
    np.testing.assert_allclose(found, 0.3 * sides)


def test_friction_at_rest_hides_its_band_and_no_more():
    """At rest the interval grows until the most sensitive joint's torque is as uncertain as its band, and stops."""
    dynamics = replace(truth(), breakaway=np.column_stack([-BAND, BAND]))
    observer, zero = WrenchObserver(ROBOT, dynamics), np.zeros(7)
    for _ in range(round(20.0 / SIM_DT)):
        observer(ROBOT.q_home, zero, zero)
    J, P = jacobian(ROBOT.q_home), observer.covariance
    torque = np.sqrt(np.einsum("cj,cd,dj->j", J, P, J))
    hidden = BAND / np.sqrt(3.0)  # of a torque anywhere within +-BAND
    assert observer.rests.all()
    assert np.max(torque / hidden) == pytest.approx(1.0, abs=0.1)
    for _ in range(round(5.0 / SIM_DT)):
        observer(ROBOT.q_home, zero, zero)
    np.testing.assert_allclose(observer.covariance, P, rtol=1e-2, atol=1e-3)


def test_a_command_within_the_band_changes_no_force_at_rest():
    """Friction balances it; beyond the band only a force can, which is then found to be the rest of it."""
    dynamics = replace(truth(), breakaway=np.column_stack([-BAND, BAND]), delay=0.0, lag=0.0)
    observer, zero, tau = WrenchObserver(ROBOT, dynamics), np.zeros(7), np.zeros(7)
    J = jacobian(ROBOT.q_home)
    for share in np.linspace(0.0, 0.95, 500):
        observer(ROBOT.q_home, zero, share * BAND)
    np.testing.assert_allclose(observer.force, 0.0, atol=1e-2)
    for k in range(2000):
        tau = BAND * 0.95 + J.T @ np.array([0.0, 0.0, -6.0]) * min(k / 1000, 1.0)
        observer(ROBOT.q_home, zero, tau)
    torque = J.T @ observer.force
    net = tau + torque
    assert (np.abs(net) < BAND + 0.05).all()  # what friction cannot hold, the force does
    assert np.linalg.norm(observer.force) > 1.0


def test_bristles_show_a_force_on_a_resting_arm():
    """Joints creep by half a presliding distance while the force on the tip grows to 12 N and falls to 4 N.

    The angle shows the friction (BRISTLES_AT_REST), so the force is found to a third of what the most sensitive
    joint's band hides, 1.7 N.
    """
    names, n, distance = BRISTLE.names, 7, 1e-3
    values = {"coulomb": BAND, "viscous": 0.1, "presliding": distance, "stribeck_velocity": 0.1}
    phi = np.stack([np.broadcast_to(values.get(name, 0.0), n) for name in names], -1)
    dynamics = replace(truth(), family=BRISTLE, phi=phi, breakaway=np.column_stack([-BAND, BAND]), delay=0.0, lag=0.0)
    observer, rng, J = WrenchObserver(ROBOT, dynamics), np.random.default_rng(0), jacobian(ROBOT.q_home)
    t = np.arange(round(4.0 / SIM_DT)) * SIM_DT
    force = np.interp(t, [0.5, 2.0, 2.5, 3.5], [0.0, 12.0, 12.0, 4.0])
    up, way = np.array([0.0, 0.0, 1.0]), np.sign(J[2]) * np.where(np.abs(J[2]) > 0.05, 1.0, 0.0)
    creep, z, error = np.append(0.0, np.diff(-5e-4 * force / 12.0)), np.zeros(n), []
    angle = np.cumsum(creep)[:, None] * way
    for k, moved in enumerate(creep[:, None] * way):
        z += (np.sign(moved) - z) * -np.expm1(-np.abs(moved) / distance)
        tau = dynamics.friction(np.zeros(n), z) - J.T @ up * force[k]
        q = ROBOT.q_home + angle[k] + 1e-2 * NOISE * rng.normal(size=n)
        observer(q, moved / SIM_DT + NOISE * rng.normal(size=n), tau)
        error.append(observer.force @ up - force[k])
    assert observer.rests.all()
    assert np.sqrt(np.mean(np.square(error))) < np.min(BAND[:4] / np.abs(J[2, :4]).clip(0.05)) / 3
