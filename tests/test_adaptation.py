"""Identification at work: balance and estimate are exact, intervals widen at rest, sudden changes are seen."""

from dataclasses import replace
from functools import cache

import numpy as np
import pandas as pd
import pytest
from conftest import conf

from r2s.adaptation.balance import SPAN, Balance
from r2s.adaptation.believed import believed
from r2s.adaptation.estimator import Estimator, body
from r2s.adaptation.kalman import BODY, TAME, Filter, update
from r2s.adaptation.listen import at_rate, learn, listen, table
from r2s.adaptation.momentum import WIDE, momentum
from r2s.adaptation.noise import balances, learnt, noise_of
from r2s.adaptation.refinement import Beyond, beyond, corrected, refined
from r2s.errors import UserError
from r2s.identification.link_inertia import pseudo_inertia
from r2s.physics.actuation import Motors
from r2s.physics.dynamics import nominal_dynamics
from r2s.physics.newton_euler import MASS, WORK, equations, links_of
from r2s.physics.payload import carrying, loaded, moment, payload_of
from r2s.physics.rigid_body import LinkInertia
from r2s.physics.robot import SIM_DT, load_robot
from r2s.physics.simulator import Simulator
from r2s.recordings.recording import Recording

THING = payload_of({"mass": 1.0, "centre": [0.02, -0.01, 0.05]})
DELAY = 3e-3


@cache
def robot():
    return load_robot(**conf("robot/panda"))


@cache
def truth():
    """Return friction without a dead zone, which no model hides anything behind, and a delay."""
    found = nominal_dynamics(robot(), **conf("friction/paper"))
    return replace(found, delay=DELAY, breakaway=np.zeros((7, 2)), offset=np.zeros(7))


@cache
def recording(on=None, off=None, seconds=3.0, noise=0.0):
    """Return what an arm of known truth does under swinging torques and a spring to home; payload from on to off."""
    rng = np.random.default_rng(1)
    sims = {False: truth(), True: loaded(robot(), truth(), THING)}
    sim, motors = Simulator(robot(), sims[False], 1, 1), Motors(1, 7, DELAY)
    sim.reset(robot().q_home[None], np.zeros((1, 7)))
    spring = np.array([60, 120, 60, 60, 10, 10, 5.0])
    phase, rate = rng.uniform(0, 6, 7), rng.uniform(3, 6, 7)
    rows, holds = [], False
    for k in range(round(seconds / SIM_DT)):
        t = k * SIM_DT
        now = on is not None and on <= t < (np.inf if off is None else off)
        if now != holds:
            sim.set_dynamics(sims[now])
            holds = now
        q, dq = sim.q[0].copy(), sim.dq[0].copy()
        goal = robot().q_home + 0.5 * np.sin(rate * t + phase) * min(1.0, t)
        tau = spring * (goal - q) - 0.15 * spring * dq
        seen = dq + noise * rng.normal(size=7)
        rows.append((q, seen, tau))
        sim.rollout(motors(tau[None, None]), record=())
    q, dq, tau = (np.array(x) for x in zip(*rows, strict=True))
    return Recording(t=SIM_DT * np.arange(len(q)), q=q, dq=dq, tau=tau, torque="commanded")


def standard(thing):
    return LinkInertia(thing.mass, thing.centre, thing.inertia).standard()


def held(arm, q):
    """Return (7,) Nm that hold an arm with the payload at q."""
    out = [np.empty(7) for _ in range(4)] + [np.empty((7, BODY)) for _ in range(2)]
    momentum(arm.links, arm.moments, arm.hand, arm.gravity, arm.armature, q, 0 * q, np.empty((7, WIDE)), *out)
    return -out[-1] @ standard(THING)


def listener(arm, free):
    """Return the estimator of an arm with what these balances without a payload say."""
    more, noise = learnt(robot(), arm, None, free, free)
    return Estimator(refined(arm, more), noise)


def quiet():
    """Return the noise of a model that is nearly right."""
    arm = believed(robot(), truth())._replace(edge=np.array([1.0, 1, 1, 1, 0.5, 0.5, 0.5]))
    none = noise_of(arm)
    small = {name: 0.01 * arm.level for name in ("white", "model")}
    zero = np.zeros(7)
    prior = none.prior.copy()
    prior[BODY:] *= 0.1
    return arm, none._replace(
        **small, moving=zero + 1e-3, turning=zero + 0.01, loaded=1e-3, creeping=0.0, prior=prior
    )


def test_momentum_is_mass_times_speed_and_linear_in_the_payload():
    """It is p = M dq; push = C^T dq = dM/dt dq - C dq; the payload's columns add what the arm with it has more."""
    r, rng = robot(), np.random.default_rng(0)
    arm = believed(r, truth())
    alone = links_of(r, r.mass, r.com, r.inertia)
    full = links_of(r, *carrying(r, THING, (r.mass, r.com, r.inertia)))
    q, dq = r.q_home + 0.3 * rng.normal(size=7), rng.normal(size=7)

    def of(links, q):
        mass, bias = np.empty((7, 7)), np.empty(7)
        equations(links, r.gravity, q, dq, mass, bias, np.empty((7, WORK)))
        still = np.empty(7)
        equations(links, r.gravity, q, 0 * dq, np.empty((7, 7)), still, np.empty((7, WORK)))
        return mass, bias - still, still

    def moved(links):
        out = [np.empty(7) for _ in range(4)] + [np.empty((7, BODY)) for _ in range(2)]
        momentum(links, arm.moments, arm.hand, arm.gravity, np.zeros(7), q, dq, np.empty((7, WIDE)), *out)
        return out

    p, push, pull, weight, payload_p, payload_push = moved(alone)
    p_full, push_full, pull_full, _, _, _ = moved(full)
    mass, coriolis, still = of(full, q)
    step = 1e-6
    rate = (of(full, q + step * dq)[0] - of(full, q - step * dq)[0]) / (2 * step)
    np.testing.assert_allclose(p_full, mass @ dq, atol=1e-12)
    np.testing.assert_allclose(push_full, rate @ dq - coriolis, atol=1e-7)  # of the difference: step^2
    np.testing.assert_allclose(pull, 0.0, atol=1e-12)
    np.testing.assert_allclose(weight + pull_full, still, atol=1e-12)
    np.testing.assert_allclose(p + payload_p @ standard(THING), p_full, atol=1e-12)
    np.testing.assert_allclose(push - pull + payload_push @ standard(THING), push_full - pull_full, atol=1e-12)


def test_the_estimate_from_data_of_known_truth_is_exact():
    """A step of h s is wrong by half a step, h / 2 of each joint's torque rate; no estimate is off by more."""
    arm, noise = quiet()
    data = recording(on=0.0)
    own = 0.5 * np.sqrt(np.mean(np.diff(data.tau, axis=0) ** 2, axis=0))  # Nm
    rows = balances(arm, data)
    slid = np.array([b.slides > 0 for b in rows])
    error = np.array([b.y - b.payload @ standard(THING) for b in rows])
    assert (np.sqrt((slid * error**2).sum(0) / slid.sum(0)) < 2 * own).all()  # the payload's rate is not in tau's
    estimator = Estimator(arm, noise._replace(white=3 * own, model=own))
    last = listen(robot(), estimator, data)[-1]
    assert abs(last.mass - 1.0) < own[1] / (9.81 * 0.4)  # kg, at 0.4 m from joint 2
    np.testing.assert_allclose(last.centre, THING.centre, atol=own[5] / 9.81 + 1e-3)
    assert (np.abs(last.friction - 1.0) < last.friction_half).all()
    assert last.friction_half.max() < 0.05
    assert estimator.changes == []


def test_no_payload_is_no_alarm_and_no_mass():
    arm, noise = quiet()
    estimator = Estimator(arm, noise)
    known = listen(robot(), estimator, recording())
    assert estimator.changes == []
    assert known[-1].mass < 4e-3
    assert np.isnan(known[-1].centre).all()


def test_a_payload_put_on_or_taken_off_is_seen_within_a_fifth_of_a_second():
    """With the noise of real speeds, and what that motion without a payload says of the noise."""
    arm = believed(robot(), truth())
    free = balances(arm, recording(noise=2e-3))
    estimator = listener(arm, free)
    known = listen(robot(), estimator, recording(on=1.0, off=2.0, noise=2e-3))
    assert len(estimator.changes) == 2
    for at, event in zip(estimator.changes, (1.0, 2.0), strict=True):
        assert event <= at <= event + 0.2
    before = known[round(1.9 / (SPAN * SIM_DT))]
    assert abs(before.mass - 1.0) < before.mass_half < 0.1
    assert abs(known[-1].mass) < known[-1].mass_half + 1e-9


@pytest.mark.parametrize("on", [None, 0.0])
def test_what_was_put_on_during_a_rest_is_told_as_soon_as_the_arm_moves(on):
    """A rest lets the estimate go, so no sudden change has to explain it; without a payload nothing is told."""
    arm = believed(robot(), truth())
    free = balances(arm, recording(noise=2e-3))
    estimator = listener(arm, free)
    listen(robot(), estimator, recording(noise=2e-3))
    estimator.begin()
    for _ in range(600):
        estimator(robot().q_home, np.zeros(7), np.zeros(7))
    assert estimator.now.rests
    since = estimator.now.t
    listen(robot(), estimator, recording(on=on, noise=2e-3))
    assert len(estimator.changes) == (on is not None)
    assert all(since < at < since + 0.2 for at in estimator.changes)


def test_a_gear_that_swings_is_no_torque():
    """Speeds that swing at 55 Hz, as motors do behind elastic gears, leave what three means of T s leave of it.

    Between two moments T apart a swing of v rad/s changes momentum by up to 2 M v, so a torque of 2 M v / T comes and
    goes. Means over T are sinc(f T) of a swing of f; three of them leave pi f T sinc(f T)^3 = 0.0025 of that. What
    friction makes of the swing is not in it: that is of the order of its slope, 1 Nm s/rad, times v.
    """
    arm, data, v = believed(robot(), truth()), recording(), 0.03
    swings = replace(data, dq=data.dq + v * np.sin(2 * np.pi * 55 * data.t)[:, None] * np.eye(7)[0])
    plain, swung = (np.array([b.y[0] for b in balances(arm, d)]) for d in (data, swings))
    mass, bias = np.empty((7, 7)), np.empty(7)
    own = links_of(robot(), robot().mass, robot().com, robot().inertia)
    equations(own, np.zeros(3), robot().q_home, np.zeros(7), mass, bias, np.empty((7, WORK)))
    left = np.pi * 55 * SPAN * SIM_DT * np.abs(np.sinc(55 * SPAN * SIM_DT)) ** 3
    assert np.abs(swung - plain).max() < 2 * left * 2 * mass[0, 0] * v / (SPAN * SIM_DT) + 1.0 * v


@cache
def other(seed):
    """Return an arm that is not quite as it is believed to be, and its motion."""
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


def lacks(arm, rows):
    """Return (7,) Nm, root mean square of what balances lack beside a share of friction and a constant."""
    out = []
    for j in range(7):
        own = np.array([[b.rub[j], 1.0, b.y[j]] for b in rows if b.slides[j] > 0])
        found = np.linalg.lstsq(own[:, :2], own[:, 2], rcond=None)[0]
        out.append(np.sqrt(np.mean((own[:, 2] - own[:, :2] @ found) ** 2)))
    return np.array(out)


def test_motion_without_a_payload_tells_what_the_identification_left():
    """Friction that goes with the load, cables and other links are found: other motion lacks a fraction of it.

    With what the truth is nothing lacks but what a step of h s is wrong by and the noise of the speeds.
    """
    arm = believed(robot(), truth())
    found = replace(truth(), load=np.full(7, 0.01), drag=np.tile([0.1, -0.05], (7, 1)))
    found = replace(found, mass=1.01 * found.mass, com=found.com + 1e-3)
    more = beyond(robot(), arm, balances(arm, other(1)))
    before, after = lacks(arm, balances(arm, other(2))), lacks(arm, balances(refined(arm, more), other(2)))
    floor = lacks(arm, balances(believed(robot(), found), other(2)))
    assert ((after**2 - floor**2) < 0.25**2 * (before**2 - floor**2)).all()


def test_what_gears_give_is_told_from_motion_of_the_motors():
    """Links behind springs of K Nm/rad go as motors do, less tau / K: motors that are as far ahead tell 1 / K.

    The prior, of the size of 1 / K, holds it back by up to a quarter.
    """
    arm, data, K = believed(robot(), truth()), other(1), 1e4
    late = round(DELAY / SIM_DT)
    felt = np.concatenate([np.zeros((late, 7)), data.tau[:-late]])
    felt = np.apply_along_axis(np.convolve, 0, felt, np.full(5, 0.2), "same")  # without what noise does to commands
    ahead = replace(data, q=data.q + felt / K, dq=data.dq + np.gradient(felt, SIM_DT, axis=0) / K)
    gives = [beyond(robot(), arm, balances(arm, d)).gives for d in (data, ahead)]
    np.testing.assert_allclose((gives[1] - gives[0])[:4], 1 / K, rtol=0.25)  # the wrist's links weigh too little


def test_corrected_balances_are_those_of_the_refined_arm():
    """What is worked out from means over 60 ms is what cycles give, to a twentieth of the correction."""
    arm, data = believed(robot(), truth()), other(1)
    rows = balances(arm, data)
    more = beyond(robot(), arm, rows)
    more = more._replace(inertia=np.zeros((7, 7)), late=np.zeros((7, 7)))
    quick, exact = corrected(robot(), arm, more, rows), balances(refined(arm, more), data)
    slides = np.array([b.slides > 0 for b in rows])
    for name in ("y", "rub"):
        plain, means, cycles = (np.array([getattr(b, name) for b in x])[slides] for x in (rows, quick, exact))
        assert np.sqrt(np.mean((means - cycles) ** 2)) < 0.05 * np.sqrt(np.mean((plain - cycles) ** 2))
    none = arm.links.copy()
    none[4, MASS] = 0.0
    for part in refined(arm._replace(links=none), beyond(robot(), arm._replace(links=none), rows)):
        assert np.isfinite(part).all()
    nothing = refined(arm, Beyond.none(7))
    for one, two in zip(arm, nothing, strict=True):
        np.testing.assert_allclose(one, two, atol=1e-15)


@pytest.mark.parametrize(("times", "low", "high"), [(1.0, 1.0, 1.5), (3.0, 6.0, 12.0)])
def test_what_surprises_for_long_is_taken_for_noise(times, low, high):
    """Of white noise that is `times` as large as is known, the filter believes its square, give or take a third.

    One joint's wavers by a fifth of it, for 25 spans or so: the mean of 7 joints and 1000 spans by a hundredth.
    """
    noise, rng = noise_of(believed(robot(), truth())), np.random.default_rng(0)
    noise = noise._replace(prior=np.full_like(noise.prior, 1e-6), warming=0.0, drifting=np.zeros(7), creeping=0.0)
    noise = noise._replace(model=np.zeros(7), turning=np.zeros(7), moving=np.zeros(7))
    filter, b, rough = Filter.fresh(noise), Balance.empty(7), []
    for _ in range(1200):
        b.y[:] = times * noise.white * rng.standard_normal(7)
        update(filter, noise, b)
        rough.append(filter.rough.copy())
    assert low <= np.mean(rough[200:]) <= high
    assert np.min(rough) >= 1.0
    still = Filter.fresh(noise)
    update(still, noise._replace(learning=0.0), b)
    assert (still.rough == 1.0).all()


def test_what_is_far_off_moves_the_estimate_as_what_is_a_little_off():
    """In proportion up to TAME standard deviations, beyond them no more; odds of a jump are at most z TAME / 2.

    A scalar off by z of its S standard deviations gives at most z^2 / 2 of log likelihood, and S is z / TAME times as
    large where that is above 1.
    """
    arm, noise = quiet()
    rows = balances(arm, recording())

    def after(z):
        filter = Filter.fresh(noise)
        for b in rows[:60]:
            update(filter, noise, b)
        trial = Filter(*(a.copy() for a in filter))
        update(trial, noise, rows[60])
        before, v, S = filter.x.copy(), trial.seen[0, 6], trial.seen[1, 6]
        b = rows[60]._replace(y=rows[60].y.copy())
        b.y[6] += z * np.sqrt(S) - v
        update(filter, noise, b)
        others = np.sum(filter.seen[0, :6] ** 2 / filter.seen[1, :6])
        return filter.x - before, filter.odds[0], others

    plain, near, far, farther = (after(z) for z in (0.0, 0.5 * TAME, 4 * TAME, 40 * TAME))
    assert np.abs(far[0] - farther[0]).max() < 1e-9
    assert np.allclose(far[0] - plain[0], 2 * (near[0] - plain[0]), rtol=0.0, atol=1e-9)
    assert farther[1] < 40 * TAME * TAME / 2 + farther[2]


def test_an_interval_is_wide_at_rest_and_narrow_in_motion():
    """At rest breakaway b at the lever r hides b / (r g): no interval is below the best joint's."""
    arm, noise = quiet()
    estimator, data = Estimator(arm, noise), recording(on=0.0)
    moving = listen(robot(), estimator, data)[-1]
    for _ in range(1500):  # held where it is, against the payload's weight
        estimator(data.q[-1], np.zeros(7), held(arm, data.q[-1]))
    resting = estimator.now
    assert resting.rests
    assert not moving.rests
    lever = 0.55  # m of joint 2, and of joint 4 to the hand at home
    hidden = min(arm.edge[1], arm.edge[3]) / (lever * 9.81)
    assert moving.mass_half < 0.25 * hidden < 0.5 * hidden < resting.mass_half
    assert abs(resting.mass - 1.0) < resting.mass_half


def test_what_an_arm_was_told_of_its_load_says_nothing_of_its_noise():
    """The recordings of an identification are of an arm that was told of nothing."""
    free = recording(noise=2e-3)
    plain, told = (
        learn(robot(), replace(truth(), told=load), None, (free, free))
        for load in (np.zeros(4), moment(robot(), THING))
    )
    for one, other in zip((*plain[0], *plain[1]), (*told[0], *told[1]), strict=True):
        np.testing.assert_array_equal(one, other)


def test_what_is_told_is_a_body_that_exists():
    """Whatever the filter believes, the pseudo-inertia of what is told is not negative."""
    rng = np.random.default_rng(0)
    for _ in range(50):
        mass, centre, tensor = body(rng.normal(size=10) * [1, *[0.1] * 3, *[0.01] * 6])
        assert mass >= 0
        if mass > 0:
            square = (centre @ centre) * np.eye(3) - np.outer(centre, centre)
            second = 0.5 * np.trace(tensor) * np.eye(3) - tensor
            assert np.linalg.eigvalsh(second).min() > -1e-12
            about = tensor + mass * square
            j = np.block([[0.5 * np.trace(about) * np.eye(3) - about, mass * centre[:, None]], [mass * centre, mass]])
            assert np.linalg.eigvalsh(j).min() > -1e-9
    thing = standard(THING)
    np.testing.assert_allclose(body(thing)[2], THING.inertia, atol=1e-12)
    assert np.linalg.eigvalsh(pseudo_inertia(THING.mass, THING.centre, THING.inertia)).min() > 0


def test_the_same_data_give_the_same_estimate():
    arm, noise = quiet()
    first, second = (table(listen(robot(), Estimator(arm, noise), recording(on=0.0))) for _ in range(2))
    assert first.equals(second)


def test_what_cannot_be_listened_to_is_said():
    data = recording()
    with pytest.raises(UserError, match="'measured' is not allowed here; commanded is"):
        at_rate(robot(), replace(data, torque="measured"))
    slow = Recording(t=data.t[::10], q=data.q[::10], dq=data.dq[::10], tau=data.tau[::10], torque="commanded")
    with pytest.raises(UserError, match="100 Hz is too slow"):
        at_rate(robot(), slow)
    with pytest.raises(UserError, match="6 joints"):
        at_rate(
            robot(), Recording(t=data.t, q=data.q[:, :6], dq=data.dq[:, :6], tau=data.tau[:, :6], torque="commanded")
        )
    arm, noise = quiet()
    estimator = Estimator(arm, noise)
    with pytest.raises(UserError, match="7 joints"):
        estimator(np.zeros(6), np.zeros(6), np.zeros(6))
    assert not estimator(np.full(7, np.nan), np.zeros(7), np.zeros(7))


@pytest.mark.slow
def test_the_stage_listens_to_a_recording(tmp_path, capsys):
    """stage=watch data=recording: lines, watch.csv, figures and a summary that holds the truth; mistakes are said."""
    from hydra import compose, initialize_config_dir

    from r2s.stages.build import CONF
    from r2s.stages.watch import watch

    recording(on=1.0, off=2.0, noise=2e-3).save(tmp_path / "heard.npz")
    words = ["stage=watch", "data=recording", f"data.path={tmp_path / 'heard.npz'}", f"root={tmp_path}", "name=w"]

    def config(*more):
        with initialize_config_dir(str(CONF.resolve()), version_base="1.3"):
            return compose("config", [*words, *more])

    with pytest.raises(UserError, match=r"data\.torque: measured is not allowed for stage=watch"):
        watch(config("data.torque=measured"), [])
    with pytest.raises(UserError, match=r"no such file: .*heart.npz; did you mean 'heard.npz'"):
        watch(config("data.torque=commanded", f"data.path={tmp_path / 'heart.npz'}"), [])
    assert not (tmp_path / "watch").exists()
    watch(config("data.torque=commanded"), [])
    folder, said = tmp_path / "watch" / "w", capsys.readouterr().out
    assert "kg" in said
    assert all((folder / name).is_file() for name in ("watch.csv", "recording.rrd", "figures/payload.png"))
    rows = pd.read_csv(folder / "watch.csv")
    before = rows.iloc[round(1.9 / (SPAN * SIM_DT))]
    # without calibration= no delay is known: 3 ms of it are an acceleration's torque amiss
    assert abs(before["mass_kg"] - 1.0) < 2 * before["mass_kg_half"]
