"""Estimates of a working arm are exact, intervals widen at rest, and payload changes are found."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from conftest import conf

from r2s.adaptation import tuning
from r2s.adaptation.arm_model import make_arm_model
from r2s.adaptation.estimator import Estimator, nearest_body
from r2s.adaptation.kalman import Filter, update
from r2s.adaptation.model_correction import apply_correction
from r2s.adaptation.momentum import BODY, MOMENTUM_WORK, MomentumTerms, momentum
from r2s.adaptation.momentum_residual import MomentumResidual
from r2s.adaptation.noise_model import default_noise, fit_noise, momentum_residuals
from r2s.adaptation.offline_estimation import estimate_recording
from r2s.adaptation.payload_jump import MEAN
from r2s.adaptation.tuning import HUBER, SPAN
from r2s.adaptation.wrench import wrench_noise
from r2s.errors import UserError
from r2s.identification.link_inertia import pseudo_inertia
from r2s.physics.actuation import Motors
from r2s.physics.dynamics import nominal_dynamics
from r2s.physics.payload import dynamics_with_payload, payload_of
from r2s.physics.rigid_body import LinkInertia
from r2s.physics.robot import SIM_DT, load_robot
from r2s.physics.simulator import Simulator
from r2s.recordings.recording import Recording

PAYLOAD = payload_of({"mass": 1.0, "centre": [0.02, -0.01, 0.05]}, (3.0, 0.15))
DELAY = 3e-3


@cache
def robot():
    return load_robot(**conf("robot/panda"))


@cache
def truth():
    """Return dynamics with friction, a delay, and no stiction that could hide a torque."""
    found = nominal_dynamics(robot(), **conf("friction/paper"))
    return replace(found, delay=DELAY, breakaway=np.zeros((7, 2)), offset=np.zeros(7))


@cache
def recording(on=None, off=None, seconds=3.0, noise=0.0):
    """Return the motion of a known arm under a spring to a swinging goal; with the payload from `on` to `off`."""
    rng = np.random.default_rng(1)
    sims = {False: truth(), True: dynamics_with_payload(robot(), truth(), PAYLOAD)}
    sim, motors = Simulator(robot(), sims[False], 1, 1), Motors(1, 7, DELAY)
    sim.reset(robot().q_home[None], np.zeros((1, 7)))
    spring = np.array([60, 120, 60, 60, 10, 10, 5.0])
    phase, rate = rng.uniform(0, 6, 7), rng.uniform(3, 6, 7)
    rows, carries = [], False
    for k in range(round(seconds / SIM_DT)):
        t = k * SIM_DT
        now = on is not None and on <= t < (np.inf if off is None else off)
        if now != carries:
            sim.set_dynamics(sims[now])
            carries = now
        q, dq = sim.q[0].copy(), sim.dq[0].copy()
        goal = robot().q_home + 0.5 * np.sin(rate * t + phase) * min(1.0, t)
        tau = spring * (goal - q) - 0.15 * spring * dq
        rows.append((q, dq + noise * rng.normal(size=7), tau))
        sim.rollout(motors(tau[None, None]), record=())
    q, dq, tau = (np.array(x) for x in zip(*rows, strict=True))
    return Recording(t=SIM_DT * np.arange(len(q)), q=q, dq=dq, tau=tau, torque="commanded")


def standard(payload):
    """Return its ten inertial parameters."""
    return LinkInertia(payload.mass, payload.centre, payload.inertia).standard()


def terms_of(arm, q, dq):
    """Return the `MomentumTerms` of an arm."""
    terms = MomentumTerms.empty(7)
    momentum(arm, q, dq, terms, np.empty((7, MOMENTUM_WORK)))
    return terms


def holding_torque(arm, q):
    """Return (7,) Nm that hold an arm with the payload at q."""
    return -terms_of(arm, q, 0 * q).payload_torque @ standard(PAYLOAD)


def estimator_of(arm, free):
    """Return the estimator of an arm, corrected by residuals without a payload."""
    correction, noise = fit_noise(robot(), arm, None, free, free)
    return Estimator(apply_correction(arm, correction), noise)


def accurate():
    """Return a nearly exact model and its noise."""
    arm = make_arm_model(robot(), truth())._replace(breakaway=np.array([1.0, 1, 1, 1, 0.5, 0.5, 0.5]))
    default, zero = default_noise(arm), np.zeros(7)
    small = {name: 0.01 * arm.level for name in ("white", "model")}
    small |= {"momentum_share": zero + 1e-3, "reversal": zero + 0.01, "payload_friction": 1e-3, "payload_drift": 0.0}
    prior = default.prior.copy()
    prior[BODY:] *= 0.1
    return arm, default._replace(**small, prior=prior)


def test_the_estimate_from_data_of_known_truth_is_exact():
    """A time step of h s causes errors of h / 2 times each joint's torque rate; no estimate is off by correction."""
    arm, noise = accurate()
    data = recording(on=0.0)
    own = 0.5 * np.sqrt(np.mean(np.diff(data.tau, axis=0) ** 2, axis=0))  # Nm
    rows = momentum_residuals(arm, data)
    slid = np.array([b.sliding > 0 for b in rows])
    error = np.array([b.y - b.payload @ standard(PAYLOAD) for b in rows])
    assert (np.sqrt((slid * error**2).sum(0) / slid.sum(0)) < 2 * own).all()  # the payload's rate is not in tau's
    estimator = Estimator(arm, noise._replace(white=3 * own, model=own))
    last = estimate_recording(robot(), estimator, data)[-1]
    assert abs(last.mass - 1.0) < own[1] / (9.81 * 0.4)  # kg, at 0.4 m from joint 2
    np.testing.assert_allclose(last.centre, PAYLOAD.centre, atol=own[5] / 9.81 + 1e-3)
    assert (np.abs(last.friction - 1.0) < last.friction_half).all()
    assert last.friction_half.max() < 0.05
    assert estimator.changes == []


def test_no_payload_gives_no_alarm_and_no_mass():
    arm, noise = accurate()
    estimator = Estimator(arm, noise)
    estimates = estimate_recording(robot(), estimator, recording())
    assert estimator.changes == []
    assert estimates[-1].mass < 4e-3
    assert np.isnan(estimates[-1].centre).all()


def test_an_attached_or_removed_payload_is_detected_within_a_fifth_of_a_second():
    """With the noise of real speeds, and a noise model fitted to motion without a payload."""
    arm = make_arm_model(robot(), truth())
    free = momentum_residuals(arm, recording(noise=2e-3))
    estimator = estimator_of(arm, free)
    estimates = estimate_recording(robot(), estimator, recording(on=1.0, off=2.0, noise=2e-3))
    assert len(estimator.changes) == 2
    for at, event in zip(estimator.changes, (1.0, 2.0), strict=True):
        assert event <= at <= event + 0.2
    before = estimates[round(1.9 / (SPAN * SIM_DT))]
    assert abs(before.mass - 1.0) < before.mass_half < 0.1
    assert abs(estimates[-1].mass) < estimates[-1].mass_half + 1e-9


@pytest.mark.parametrize("on", [None, 0.0])
def test_a_payload_attached_at_rest_is_detected_as_soon_as_the_arm_moves(on):
    """The variance grows at rest, so the change needs no jump; without a payload there is no alarm."""
    arm = make_arm_model(robot(), truth())
    free = momentum_residuals(arm, recording(noise=2e-3))
    estimator = estimator_of(arm, free)
    estimate_recording(robot(), estimator, recording(noise=2e-3))
    estimator.begin()
    for _ in range(600):
        estimator(robot().q_home, np.zeros(7), np.zeros(7))
    assert estimator.now.rests
    since = estimator.now.t
    estimate_recording(robot(), estimator, recording(on=on, noise=2e-3))
    assert len(estimator.changes) == (on is not None)
    assert all(since < at < since + 0.2 for at in estimator.changes)


@pytest.mark.parametrize(("times", "low", "high"), [(1.0, 1.0, 1.5), (3.0, 6.0, 12.0)])
def test_persistent_innovations_become_noise(times, low, high):
    """White noise `times` as large as expected scales the variance by its square, give or take a third.

    One joint's scale varies by a fifth over about 25 spans: the mean of 7 joints and 1000 spans by a hundredth.
    """
    noise, rng = default_noise(make_arm_model(robot(), truth())), np.random.default_rng(0)
    constant = {"friction_drift": 0.0, "offset_drift": np.zeros(7), "payload_drift": 0.0}
    none = dict.fromkeys(("model", "reversal", "momentum_share"), np.zeros(7))
    noise = noise._replace(prior=np.full_like(noise.prior, 1e-6), **constant, **none)
    filter, b, scales = Filter.fresh(noise), MomentumResidual.empty(7), []
    for _ in range(1200):
        b.y[:] = times * noise.white * rng.standard_normal(7)
        update(filter, noise, b)
        scales.append(filter.noise_scale.copy())
    assert low <= np.mean(scales[200:]) <= high
    assert np.min(scales) >= 1.0
    still = Filter.fresh(noise)
    update(still, noise._replace(adaptation=0.0), b)
    assert (still.noise_scale == 1.0).all()


def test_an_outlier_moves_the_estimate_no_more_than_huber_standard_deviations():
    """In proportion up to HUBER standard deviations, and no more beyond; log odds of a jump are at most z HUBER / 2.

    A scalar off by z standard deviations adds at most z^2 / 2 to the log likelihood, and its variance S grows by
    z / HUBER if that is above 1.
    """
    arm, noise = accurate()
    rows = momentum_residuals(arm, recording())

    def after(z):
        filter = Filter.fresh(noise)
        for b in rows[:60]:
            update(filter, noise, b)
        trial = Filter(*(a.copy() for a in filter))
        update(trial, noise, rows[60])
        before, (v, S) = filter.x.copy(), trial.innovations[:, 6]
        b = rows[60]._replace(y=rows[60].y.copy())
        b.y[6] += z * np.sqrt(S) - v
        update(filter, noise, b)
        others = np.sum(filter.innovations[0, :6] ** 2 / filter.innovations[1, :6])
        return filter.x - before, filter.log_odds[MEAN], others

    plain, near, far, farther = (after(z) for z in (0.0, 0.5 * HUBER, 4 * HUBER, 40 * HUBER))
    assert np.abs(far[0] - farther[0]).max() < 1e-9
    assert np.allclose(far[0] - plain[0], 2 * (near[0] - plain[0]), rtol=0.0, atol=1e-9)
    assert farther[1] < 40 * HUBER * HUBER / 2 + farther[2]


def test_an_interval_is_wide_at_rest_and_narrow_in_motion():
    """At rest, breakaway b at the lever r hides b / (r g): no interval is smaller than the best joint's."""
    arm, noise = accurate()
    estimator, data = Estimator(arm, noise), recording(on=0.0)
    moving = estimate_recording(robot(), estimator, data)[-1]
    for _ in range(1500):  # held against the payload's weight
        estimator(data.q[-1], np.zeros(7), holding_torque(arm, data.q[-1]))
    resting = estimator.now
    assert resting.rests
    assert not moving.rests
    lever = 0.55  # m of joint 2, and of joint 4 to the hand at home
    hidden = min(arm.breakaway[1], arm.breakaway[3]) / (lever * 9.81)
    assert moving.mass_half < 0.25 * hidden < 0.5 * hidden < resting.mass_half
    assert abs(resting.mass - 1.0) < resting.mass_half


def test_the_reported_payload_is_a_physical_body():
    """For any filter state, the pseudo-inertia of the report is not negative."""
    rng = np.random.default_rng(0)
    for _ in range(50):
        mass, centre, tensor = nearest_body(rng.normal(size=10) * [1, *[0.1] * 3, *[0.01] * 6])
        assert mass >= 0
        if mass > 0:
            square = (centre @ centre) * np.eye(3) - np.outer(centre, centre)
            second = 0.5 * np.trace(tensor) * np.eye(3) - tensor
            assert np.linalg.eigvalsh(second).min() > -1e-12
            about = tensor + mass * square
            j = np.block([[0.5 * np.trace(about) * np.eye(3) - about, mass * centre[:, None]], [mass * centre, mass]])
            assert np.linalg.eigvalsh(j).min() > -1e-9
    np.testing.assert_allclose(nearest_body(standard(PAYLOAD))[2], PAYLOAD.inertia, atol=1e-12)
    assert np.linalg.eigvalsh(pseudo_inertia(PAYLOAD.mass, PAYLOAD.centre, PAYLOAD.inertia)).min() > 0


def test_what_counts_as_nothing_is_in_proportion_to_the_arm():
    """A force, a wrist's friction and a mass: 0.25 N, 3 mNm and 20 g for a Panda, a tenth for a tenth of it."""
    tenth = replace(robot(), payload_max=(0.3, 0.15), tau_max=0.1 * robot().tau_max)
    still = replace(truth(), phi=0.0 * truth().phi)
    for r, share in ((robot(), 1.0), (tenth, 0.1)):
        noise, arm = wrench_noise(r, still), make_arm_model(r, still)
        assert noise.floor == pytest.approx(0.25 * share)
        np.testing.assert_allclose(noise.friction - tuning.WRENCH_FRICTION * arm.level, 3e-3 * share)
        estimator = Estimator(arm, default_noise(arm))
        estimator.internals[0].P[:] = 0.0
        for grams, seen in ((19.0, False), (21.0, True)):
            estimator.internals[0].x[0] = 1e-3 * grams * share
            assert estimator.payload.any() == seen


def test_payload_limits_are_those_of_the_arm():
    """The configuration says them, else torque limits and reach do; a Panda's are 3 kg and 15 cm within a fifth."""
    assert robot().payload_max == (3.0, 0.15)
    np.testing.assert_allclose(load_robot().payload_max, robot().payload_max, rtol=0.2)
    strong = load_robot(tau_max=[870.0, 870, 870, 870, 120, 120, 120])
    assert strong.payload_max[0] == pytest.approx(10 * load_robot().payload_max[0])
    heavy = replace(robot(), payload_max=(10.0, 0.3))
    small, large = (default_noise(make_arm_model(r, truth())) for r in (robot(), heavy))
    np.testing.assert_allclose((large.prior / small.prior)[:4], [10 / 3, *[20 / 3] * 3])
    assert (small.rest_drift, large.rest_drift) == pytest.approx((0.02, 0.02 * (10 / 3) ** 2))  # kg^2/s
    with pytest.raises(UserError, match=r"robot\.payload_max"):
        load_robot(payload_max=-1.0)
