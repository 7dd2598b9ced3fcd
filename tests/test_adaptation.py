"""Estimates of a working arm: residual and estimate are exact, intervals widen at rest, payload changes are found."""

from dataclasses import replace
from functools import cache

import numpy as np
import pandas as pd
import pytest
from conftest import conf

from r2s.adaptation import tuning
from r2s.adaptation.arm_model import make_arm_model
from r2s.adaptation.estimator import Estimator, nearest_body
from r2s.adaptation.kalman import Filter, update
from r2s.adaptation.model_correction import (
    ModelCorrection,
    apply_correction,
    corrected_residuals,
    fit_model_correction,
)
from r2s.adaptation.momentum import BODY, MOMENTUM_WORK, MomentumTerms, momentum
from r2s.adaptation.momentum_residual import MomentumResidual
from r2s.adaptation.noise_model import default_noise, fit_noise, momentum_residuals
from r2s.adaptation.offline_estimation import (
    UNKNOWN_PAUSE_S,
    at_rate,
    estimate_recording,
    fit_correction,
    pauses,
    table,
)
from r2s.adaptation.payload_jump import MEAN
from r2s.adaptation.tuning import HUBER, SPAN
from r2s.adaptation.wrench import wrench_noise
from r2s.errors import UserError
from r2s.identification.link_inertia import pseudo_inertia
from r2s.physics.actuation import Motors
from r2s.physics.dynamics import nominal_dynamics
from r2s.physics.newton_euler import MASS, WORK, equations, links_of
from r2s.physics.payload import dynamics_with_payload, mass_and_moment, payload_of, with_payload
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


def test_a_declared_payload_changes_no_noise():
    """The recordings of an identification come from an arm without a declared payload."""
    free = recording(noise=2e-3)
    plain, declared = (
        fit_correction(robot(), replace(truth(), declared_payload=load), None, (free, free))
        for load in (np.zeros(4), mass_and_moment(robot(), PAYLOAD))
    )
    for one, other in zip((*plain[0], *plain[1]), (*declared[0], *declared[1]), strict=True):
        np.testing.assert_array_equal(one, other)


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


def test_the_same_data_give_the_same_estimate():
    arm, noise = accurate()
    first, second = (table(estimate_recording(robot(), Estimator(arm, noise), recording(on=0.0))) for _ in range(2))
    assert first.equals(second)


def test_an_unsuitable_recording_gets_one_line():
    data = recording()
    with pytest.raises(UserError, match="expected commanded, got measured"):
        at_rate(robot(), replace(data, torque="measured"))
    slow = Recording(t=data.t[::10], q=data.q[::10], dq=data.dq[::10], tau=data.tau[::10], torque="commanded")
    with pytest.raises(UserError, match="expected at least 200 Hz, got 100 Hz"):
        at_rate(robot(), slow)
    with pytest.raises(UserError, match="expected 7 joints of panda, got 6"):
        at_rate(
            robot(), Recording(t=data.t, q=data.q[:, :6], dq=data.dq[:, :6], tau=data.tau[:, :6], torque="commanded")
        )
    arm, noise = accurate()
    estimator = Estimator(arm, noise)
    with pytest.raises(UserError, match=r"expected q, dq and tau of 7 joints, got \(6,\)"):
        estimator(np.zeros(6), np.zeros(6), np.zeros(6))
    assert not estimator(np.full(7, np.nan), np.zeros(7), np.zeros(7))


@pytest.mark.slow
def test_the_stage_estimates_from_a_recording(tmp_path, capsys):
    """stage=estimate data=recording writes lines, estimate.csv, figures and a summary; mistakes get one line."""
    from hydra import compose, initialize_config_dir

    from r2s.stages.build import CONF
    from r2s.stages.estimate import estimate

    recording(on=1.0, off=2.0, noise=2e-3).save(tmp_path / "work.npz")
    words = ["stage=estimate", "data=recording", f"data.path={tmp_path / 'work.npz'}", f"root={tmp_path}", "name=w"]

    def config(*others):
        with initialize_config_dir(str(CONF.resolve()), version_base="1.3"):
            return compose("config", [*words, *others])

    with pytest.raises(UserError, match=r"data\.torque: expected commanded for stage=estimate, got measured"):
        estimate(config("data.torque=measured"), [])
    with pytest.raises(UserError, match=r"no file .*wrk.npz; did you mean 'work.npz'"):
        estimate(config("data.torque=commanded", f"data.path={tmp_path / 'wrk.npz'}"), [])
    assert not (tmp_path / "estimate").exists()
    estimate(config("data.torque=commanded"), [])
    folder = tmp_path / "estimate" / "w"
    assert "kg" in capsys.readouterr().out
    written = ("estimate.csv", "wrench.csv", "recording.rrd", "figures/payload.png", "figures/wrench.png")
    assert all((folder / name).is_file() for name in written)
    with pytest.raises(UserError, match=r"^robot\.tool: estimate\.surface needs the tip that touches"):
        estimate(config("data.torque=commanded", f"estimate.surface={tmp_path}"), [])
    rows = pd.read_csv(folder / "estimate.csv")
    before = rows.iloc[round(1.9 / (SPAN * SIM_DT))]
    # without calibration= no delay is known: 3 ms of it cause torque errors in every acceleration
    assert abs(before["mass_kg"] - 1.0) < 2 * before["mass_kg_half"]


@pytest.mark.slow
def test_the_old_name_of_the_stage_gives_the_new_one():
    from r2s.override_checks import check_overrides

    with pytest.raises(UserError, match=r"^stage=watch is now stage=estimate$"):
        check_overrides(["stage=watch"], None)


def test_a_pause_widens_the_estimate_by_the_clock():
    """Ten seconds without rows add the drift of ten seconds, a restarted clock that of a minute, and `t` has both."""
    data, half = recording(noise=2e-3), round(1.5 / SIM_DT)
    arm = make_arm_model(robot(), truth())
    noise, trajectory = default_noise(arm), np.arange(len(data.t)) // half
    offset, after = BODY + 7, {}
    for pause in (0.0, 10.0, -1.5):  # s
        cut = replace(data, t=data.t + pause * trajectory, trajectory=trajectory)
        assert pauses(cut)[1] == pytest.approx(max(pause + SIM_DT, 0.0) or UNKNOWN_PAUSE_S)
        estimator = Estimator(arm, noise)
        estimates = estimate_recording(robot(), estimator, cut.select(cut.trajectory == 0))
        before = estimator.internals[0].P.diagonal().copy()
        estimator.begin(pauses(cut)[1])
        after[pause] = estimator.internals[0].P.diagonal() - before
        assert estimator.now.t == pytest.approx(estimates[-1].t + pauses(cut)[1], abs=2 * SPAN * SIM_DT)
    for pause, seconds in ((10.0, 10.0 + SIM_DT), (-1.5, UNKNOWN_PAUSE_S)):
        np.testing.assert_allclose(after[pause][offset : offset + 7], seconds * noise.offset_drift**2, rtol=1e-9)
        np.testing.assert_allclose(after[pause][BODY:offset], seconds * noise.friction_drift**2, rtol=1e-9)
    assert after[10.0][0] > 0.1 * noise.prior[0] ** 2  # the payload may have been changed unseen


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
