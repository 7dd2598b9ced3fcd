"""Residuals of the arm's momentum are exact, and motion without a payload corrects the model behind them."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from test_adaptation import DELAY, PAYLOAD, recording, robot, standard, terms_of, truth

from r2s.adaptation.arm_model import make_arm_model
from r2s.adaptation.model_correction import (
    ModelCorrection,
    apply_correction,
    corrected_residuals,
    fit_model_correction,
)
from r2s.adaptation.noise_model import momentum_residuals
from r2s.adaptation.offline_estimation import fit_correction
from r2s.adaptation.tuning import SPAN
from r2s.physics.actuation import Motors
from r2s.physics.newton_euler import MASS, WORK, equations, links_of
from r2s.physics.payload import mass_and_moment, with_payload
from r2s.physics.robot import SIM_DT
from r2s.physics.simulator import Simulator
from r2s.recordings.recording import Recording


def test_momentum_is_mass_times_speed_and_linear_in_the_payload():
    """Momentum p = M dq, C^T dq = dM/dt dq - C dq; the payload's columns are the difference to the loaded arm."""
    r, rng = robot(), np.random.default_rng(0)
    arm = make_arm_model(r, truth())._replace(armature=np.zeros(7))
    alone = links_of(r, r.mass, r.com, r.inertia)
    full = links_of(r, *with_payload(r, PAYLOAD, (r.mass, r.com, r.inertia)))
    q, dq = r.q_home + 0.3 * rng.normal(size=7), rng.normal(size=7)

    def of(links, q):
        mass, bias = np.empty((7, 7)), np.empty(7)
        equations(links, r.gravity, q, dq, mass, bias, np.empty((7, WORK)))
        still = np.empty(7)
        equations(links, r.gravity, q, 0 * dq, np.empty((7, 7)), still, np.empty((7, WORK)))
        return mass, bias - still, still

    without, loaded_arm = (terms_of(arm._replace(links=links), q, dq) for links in (alone, full))
    mass, coriolis, still = of(full, q)
    step = 1e-6
    rate = (of(full, q + step * dq)[0] - of(full, q - step * dq)[0]) / (2 * step)
    np.testing.assert_allclose(loaded_arm.p, mass @ dq, atol=1e-12)
    np.testing.assert_allclose(
        loaded_arm.coriolis, rate @ dq - coriolis, atol=1e-7
    )  # error of the difference: step^2
    np.testing.assert_allclose(without.uncompensated, 0.0, atol=1e-12)
    np.testing.assert_allclose(without.compensated + loaded_arm.uncompensated, still, atol=1e-12)
    np.testing.assert_allclose(without.p + without.payload_p @ standard(PAYLOAD), loaded_arm.p, atol=1e-12)
    added, torque = without.payload_torque @ standard(PAYLOAD), loaded_arm.coriolis - loaded_arm.uncompensated
    np.testing.assert_allclose(without.coriolis - without.uncompensated + added, torque, atol=1e-12)


def test_a_vibrating_gear_is_no_torque():
    """A vibration of the speeds at 55 Hz, as of motors behind elastic gears, passes three means over T s.

    Between two moments T apart a vibration of v rad/s changes the momentum by up to 2 M v, a torque of 2 M v / T. A
    mean over T leaves sinc(f T) of a vibration at f; three leave pi f T sinc(f T)^3 = 0.0025. Friction adds its
    slope, about 1 Nm s/rad, times v.
    """
    arm, data, v = make_arm_model(robot(), truth()), recording(), 0.03
    swings = replace(data, dq=data.dq + v * np.sin(2 * np.pi * 55 * data.t)[:, None] * np.eye(7)[0])
    plain, swung = (np.array([b.y[0] for b in momentum_residuals(arm, d)]) for d in (data, swings))
    mass, bias = np.empty((7, 7)), np.empty(7)
    own = links_of(robot(), robot().mass, robot().com, robot().inertia)
    equations(own, np.zeros(3), robot().q_home, np.zeros(7), mass, bias, np.empty((7, WORK)))
    left = np.pi * 55 * SPAN * SIM_DT * np.abs(np.sinc(55 * SPAN * SIM_DT)) ** 3
    assert np.abs(swung - plain).max() < 2 * left * 2 * mass[0, 0] * v / (SPAN * SIM_DT) + 1.0 * v


@cache
def other(seed):
    """Return the motion of an arm with other links, cables and load-dependent friction than its model."""
    n = 7
    found = replace(truth(), load=np.full(n, 0.01), drag=np.tile([0.1, -0.05], (n, 1)))
    found = replace(found, mass=1.01 * found.mass, com=found.com + 1e-3)
    rng = np.random.default_rng(seed)
    sim, motors = Simulator(robot(), found, 1, 1), Motors(1, n, DELAY)
    sim.reset(robot().q_home[None], np.zeros((1, n)))
    spring, phase, rate = np.array([60, 120, 60, 60, 10, 10, 5.0]), rng.uniform(0, 6, n), rng.uniform(2, 5, n)
    rows = []
    for k in range(6000):
        t = k * SIM_DT
        goal = robot().q_home + 0.7 * np.sin(rate * t + phase) * min(1.0, t)
        tau = spring * (goal - sim.q[0]) - 0.15 * spring * sim.dq[0]
        rows.append((sim.q[0].copy(), sim.dq[0] + 1e-3 * rng.normal(size=n), tau))
        sim.rollout(motors(tau[None, None]), record=())
    q, dq, tau = (np.array(x) for x in zip(*rows, strict=True))
    return Recording(t=SIM_DT * np.arange(len(q)), q=q, dq=dq, tau=tau, torque="commanded")


def unexplained(arm, rows):
    """Return (7,) Nm, root mean square of residuals beside a share of friction and a constant."""
    out = []
    for j in range(7):
        own = np.array([[b.friction[j], 1.0, b.y[j]] for b in rows if b.sliding[j] > 0])
        found = np.linalg.lstsq(own[:, :2], own[:, 2], rcond=None)[0]
        out.append(np.sqrt(np.mean((own[:, 2] - own[:, :2] @ found) ** 2)))
    return np.array(out)


@pytest.mark.long
def test_motion_without_a_payload_corrects_the_model():
    """It finds load-dependent friction, cables and other links: residuals of other motion shrink to a fraction.

    With the true model only the error of the time step and the noise of the speeds remain.
    """
    arm = make_arm_model(robot(), truth())
    found = replace(truth(), load=np.full(7, 0.01), drag=np.tile([0.1, -0.05], (7, 1)))
    found = replace(found, mass=1.01 * found.mass, com=found.com + 1e-3)
    correction = fit_model_correction(robot(), arm, momentum_residuals(arm, other(1)))
    before, after = (
        unexplained(arm, momentum_residuals(arm, other(2))),
        unexplained(arm, momentum_residuals(apply_correction(arm, correction), other(2))),
    )
    floor = unexplained(arm, momentum_residuals(make_arm_model(robot(), found), other(2)))
    assert ((after**2 - floor**2) < 0.25**2 * (before**2 - floor**2)).all()


def test_motor_motion_gives_the_compliance_of_gears():
    """Links behind springs of K Nm/rad follow their motors less tau / K; motors so far ahead give 1 / K.

    The prior, of the size of 1 / K, shrinks the result by up to a quarter.
    """
    arm, data, K = make_arm_model(robot(), truth()), other(1), 1e4
    late = round(DELAY / SIM_DT)
    felt = np.concatenate([np.zeros((late, 7)), data.tau[:-late]])
    felt = np.apply_along_axis(np.convolve, 0, felt, np.full(5, 0.2), "same")  # removes the noise of the commands
    ahead = replace(data, q=data.q + felt / K, dq=data.dq + np.gradient(felt, SIM_DT, axis=0) / K)
    found = [fit_model_correction(robot(), arm, momentum_residuals(arm, d)).compliance for d in (data, ahead)]
    np.testing.assert_allclose((found[1] - found[0])[:4], 1 / K, rtol=0.25)  # the wrist's links are too light


def test_corrected_residuals_are_those_of_the_corrected_arm():
    """Corrections of means over 60 ms equal a run through all cycles, to a twentieth of the correction."""
    arm, data = make_arm_model(robot(), truth()), other(1)
    rows = momentum_residuals(arm, data)
    correction = fit_model_correction(robot(), arm, rows)
    correction = correction._replace(inertia=np.zeros((7, 7)), latency=np.zeros((7, 7)))
    quick = corrected_residuals(robot(), arm, correction, rows)
    exact = momentum_residuals(apply_correction(arm, correction), data)
    sliding = np.array([b.sliding > 0 for b in rows])
    for name in ("y", "friction"):
        plain, means, cycles = (np.array([getattr(b, name) for b in x])[sliding] for x in (rows, quick, exact))
        assert np.sqrt(np.mean((means - cycles) ** 2)) < 0.05 * np.sqrt(np.mean((plain - cycles) ** 2))
    none = arm.links.copy()
    none[4, MASS] = 0.0
    for part in apply_correction(
        arm._replace(links=none), fit_model_correction(robot(), arm._replace(links=none), rows)
    ):
        assert np.isfinite(part).all()
    nothing = apply_correction(arm, ModelCorrection.none(7))
    for one, two in zip(arm, nothing, strict=True):
        np.testing.assert_allclose(one, two, atol=1e-15)


def test_a_declared_payload_changes_no_noise():
    """The recordings of an identification come from an arm without a declared payload."""
    free = recording(noise=2e-3)
    plain, declared = (
        fit_correction(robot(), replace(truth(), declared_payload=load), None, (free, free))
        for load in (np.zeros(4), mass_and_moment(robot(), PAYLOAD))
    )
    for one, other in zip((*plain[0], *plain[1]), (*declared[0], *declared[1]), strict=True):
        np.testing.assert_array_equal(one, other)
