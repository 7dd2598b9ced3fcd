"""Link-side torque: what was injected is found, with intervals, families and whole links; searches, stops, folds."""

# ruff: noqa: F811 (the arguments are fixtures of test_identify.py)

from dataclasses import replace
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from test_identify import (  # noqa: F401
    BOUNDS,
    SCALE,
    SETTINGS,
    STAGED,
    TORQUE,
    WINDOW,
    arm,
    curve_error,
    motion,
    recorded,
    run,
    truth,
    wrong,
)

from r2s.excitation.fourier import fourier
from r2s.identification.link_inertia import LINK, inertia_scale
from r2s.identification.parameters import parameter_space
from r2s.identification.prediction import prediction_errors
from r2s.identification.residuals.torque_residual import TorqueResidual
from r2s.identification.search.genetic import Genetic
from r2s.identification.search.least_squares import LeastSquares
from r2s.identification.structure.cross_validation import held_out
from r2s.identification.terms import search_space
from r2s.learning.randomization import PosteriorRandomization as Draws
from r2s.learning.randomization import physical
from r2s.physics.dynamics import Dynamics, with_family
from r2s.physics.friction import COULOMB, FAMILIES, family
from r2s.physics.robot import load_robot
from r2s.recordings.recording import Recording

WITH_HAND = """<mujoco><compiler angle="radian"/><worldbody>
<body pos="0 0 0.3"><inertial pos="0.02 0 0.1" mass="2" diaginertia="0.02 0.02 0.01"/>
<joint axis="0 0 1" range="-2 2" actuatorfrcrange="-20 20"/>
<body pos="0 0 0.2"><inertial pos="0.1 0 0.1" mass="1" diaginertia="0.01 0.01 0.002"/>
<joint axis="0 1 0" range="-2 2" actuatorfrcrange="-10 10"/><site name="tip" pos="0 0 0.2"/>
<body name="hand" pos="0.05 0 0.2"><inertial pos="0 0 0.05" mass="0.7" diaginertia="0.001 0.001 0.001"/></body>
</body></body></worldbody></mujoco>"""


def measured(robot, dynamics, scale, seconds, noise=0.0, seed=0, moving=(1, 1, 1), mass=1.0, shift=0.0):
    """Return a recording of link-side torque: inverse dynamics with gravity, plus friction, minus offset, plus noise.

    Tensors and masses are scaled, centres shifted (m) in the compiled model, not through r2s. Joints where `moving`
    is 0 stand at angle 0.
    """
    e = fourier(robot, duration=seconds, seed=seed)
    e = replace(e, q=e.q * moving, dq=e.dq * moving, ddq=e.ddq * moving)
    model = robot.model(gravity=True)
    model.body_inertia[model.jnt_bodyid] *= np.array(scale)[:, None]
    model.body_mass[model.jnt_bodyid] *= mass
    model.body_ipos[model.jnt_bodyid] += shift
    data = mujoco.MjData(model)
    tau = np.empty_like(e.q)
    for k in range(len(e.t)):
        data.qpos[:], data.qvel[:], data.qacc[:] = e.q[k], e.dq[k], e.ddq[k]
        mujoco.mj_inverse(model, data)
        tau[k] = data.qfrc_inverse
    tau += dynamics.friction(e.dq) - dynamics.offset
    tau += noise * np.random.default_rng(seed + 100).normal(size=tau.shape)
    return Recording(t=e.t, q=e.q, dq=e.dq, tau=tau, torque="measured")


@pytest.fixture(scope="module")
def clean(arm, truth):
    """Four seconds of link-side torque without noise."""
    return measured(arm, truth, SCALE, 4.0)


def fit(arm, wrong, recording, cutoff_hz=10.0, **change):
    exact = [LeastSquares(ftol=1e-12)]
    return run(arm, wrong, recording, exact, **({"prior": {}, "cutoff_hz": cutoff_hz} | change))


@pytest.mark.long
def test_torque_with_gravity_gives_friction_and_offset(arm, truth, wrong):
    """Noise-free link-side torque: friction curves, offsets and scales are found to 1e-3."""
    recording = measured(arm, truth, SCALE, 8.0)
    dynamics = fit(arm, wrong, recording, cutoff_hz=50.0).dynamics
    assert curve_error(dynamics, truth, recording.dq).max() < 1e-3
    np.testing.assert_allclose(dynamics.offset, truth.offset, atol=1e-3)
    np.testing.assert_allclose(inertia_scale(dynamics.inertia, arm.inertia), SCALE, rtol=1e-3)


def test_predicted_torque_is_inverse_dynamics(arm, truth, wrong):
    """The linear prediction equals MuJoCo's inverse dynamics of the true links, with and without gravity.

    Without gravity the arm compensates that of its nominal links: only what is wrong about them is felt.
    """
    recording = measured(arm, truth, SCALE, 2.0)
    mass, shift = np.array([1.1, 0.8, 1.3]), np.array([0.01, -0.02, 0.03])
    other = replace(truth, mass=arm.mass * mass, com=arm.com + shift)
    space = parameter_space(arm, wrong, {k: BOUNDS[k] for k in ("phi1", "offset", *LINK)})
    for torque in ("measured", "commanded"):
        residual = TorqueResidual(space, replace(recording, torque=torque), cutoff_hz=50.0)
        m = residual.motion
        model, nominal = arm.model(gravity=True), arm.model(gravity=True)
        model.body_inertia[model.jnt_bodyid] *= np.array(SCALE)[:, None]
        model.body_mass[model.jnt_bodyid] *= mass
        model.body_ipos[model.jnt_bodyid] += shift
        data, compensated = mujoco.MjData(model), mujoco.MjData(nominal)
        expected = []
        for q, dq, ddq in zip(m.q, m.dq, m.ddq, strict=True):
            data.qpos[:], data.qvel[:], data.qacc[:] = q, dq, ddq
            mujoco.mj_inverse(model, data)
            compensated.qpos[:] = q
            mujoco.mj_inverse(nominal, compensated)
            expected.append(data.qfrc_inverse - (torque == "commanded") * compensated.qfrc_inverse)
        expected += m.filtered(truth.friction(m.friction_dq)) - truth.offset
        np.testing.assert_allclose(residual.predict(other), expected, atol=1e-9)


@pytest.mark.parametrize("torque", ["measured", "commanded"])
def test_a_welded_body_has_weight_only_in_measured_torque(tmp_path, torque):
    """MuJoCo's inverse dynamics contain the welded hand; the arm's gravity compensation holds it, too."""
    path = tmp_path / "arm.xml"
    path.write_text(WITH_HAND)
    robot = load_robot(str(path))
    dynamics = Dynamics.of(robot, np.zeros((2, 3)), COULOMB)
    t = 1e-3 * np.arange(2000)
    wave = np.array([0.3, 0.4]) * np.sin(np.array([3.0, 5.0]) * t[:, None])
    residual = TorqueResidual(
        parameter_space(robot, dynamics, {"offset": BOUNDS["offset"]}),
        Recording(t, wave, np.gradient(wave, t, axis=0), 0 * wave, torque),
        cutoff_hz=50.0,
    )
    m, model, expected = residual.motion, robot.model(gravity=True), []
    data, still = mujoco.MjData(model), mujoco.MjData(model)
    for q, dq, ddq in zip(m.q, m.dq, m.ddq, strict=True):
        data.qpos[:], data.qvel[:], data.qacc[:] = q, dq, ddq
        still.qpos[:] = q
        mujoco.mj_inverse(model, data)
        mujoco.mj_inverse(model, still)
        expected.append(data.qfrc_inverse - (torque == "commanded") * still.qfrc_inverse)
    np.testing.assert_allclose(residual.predict(dynamics), expected, atol=1e-9)


@pytest.mark.parametrize("torque", ["measured", "commanded"])
@pytest.mark.parametrize("name", [f.name for f in FAMILIES])
@pytest.mark.parametrize("inertia", ["link", "inertia_scale"])
def test_the_jacobian_of_the_torque_is_that_of_brute_force(arm, wrong, clean, torque, name, inertia):
    """`change` is what one call per stepped value gives, for every block that there is."""
    short = replace(clean.select(clean.t < 1.0), torque=torque)
    terms = ["viscous", "offset", inertia, "delay", "lag", "load", "drag_sin", "drag_cos", "gain"]
    space = search_space(arm, with_family(wrong, name), BOUNDS, terms, short)
    residual = TorqueResidual(space, short)
    rng = np.random.default_rng(0)
    u = rng.uniform(0.2, 0.8, len(space.start))
    x, stepped = space.from_unit(u), space.from_unit(u + rng.uniform(-1e-2, 1e-2, len(u)))
    each = np.where(np.eye(len(x), dtype=bool), stepped, x)
    brute = (residual(each) - residual(x[None])).T
    scale = np.abs(residual(x[None])).max()
    np.testing.assert_allclose(residual.change(x, stepped), brute, rtol=0, atol=1e-8 * max(scale, 1.0))


def vector(space, truth):
    """Return the injected values of a space of sigmoid friction, offset, inertia scale and delay."""
    blocks = {"phi1": truth.phi[:, 0], "phi2": truth.phi[:, 1], "phi3": truth.phi[:, 2], "offset": truth.offset}
    blocks |= {"inertia_scale": np.array(SCALE), "delay": np.array([truth.delay])}
    return np.concatenate([blocks[b] for b in space.blocks])


@pytest.mark.long
@pytest.mark.parametrize("torque", ["measured", "commanded"])
def test_intervals_contain_the_truth(arm, truth, wrong, torque):
    """The 95 % intervals of several recordings hold at least 85 % of the true values, and are not much too wide.

    Without a dead zone: where a joint sticks in some windows, no interval of the others knows of it.
    """
    free, inside, miss = replace(truth, breakaway=np.zeros((3, 2))), [], []
    for seed in range(5 if torque == "measured" else 4):
        if torque == "measured":
            result = fit(arm, wrong, measured(arm, free, SCALE, 8.0, noise=0.1, seed=seed), cutoff_hz=50.0)
        else:
            result = run(arm, wrong, recorded(arm, free, 4.0, seed), STAGED, window_s=0.2)
        expected, low, high = vector(result.space, free), result.found.low, result.found.high
        assert np.all(low <= result.x + 1e-12)
        assert np.all(result.x <= high + 1e-12)
        inside.append((low <= expected) & (expected <= high))
        miss.append(np.abs(result.x - expected) / (0.5 * (high - low)))
    assert np.mean(inside) >= 0.85
    assert np.sqrt(np.mean(np.square(miss))) > 0.15  # 0.5 were exact


@pytest.mark.long
def test_what_the_data_cannot_tell_stays_nominal_and_is_said(arm, truth, wrong):
    """Of a joint that stands still friction is not identifiable, and is what it was; of joints that move it is."""
    result = fit(arm, wrong, measured(arm, truth, SCALE, 8.0, noise=0.1, moving=(1, 1, 0)))
    names = np.array(result.space.names)
    known = result.found.identifiable
    assert set(result.unseen) >= {"phi1[3]", "phi2[3]", "phi3[3]"}
    assert set(names[~known]) >= set(result.unseen)
    assert set(names[known]) >= {"phi1[1]", "offset[1]", "phi1[2]", "offset[2]"}
    unseen = np.isin(names, result.unseen)
    np.testing.assert_allclose(result.x[unseen], result.space.start[unseen], rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(result.dynamics.phi[2], wrong.phi[2], rtol=1e-12, atol=1e-15)


@pytest.mark.long
def test_combinations_that_only_the_prior_decides_are_named(arm, truth, wrong):
    """While a joint moves, Coulomb asymmetry is an offset: of noisy data the two are named together."""
    level, prior = np.array([0.8, 0.7, 0.6]), SETTINGS["prior"]["measured"]
    real = replace(truth, family=family("coulomb"), phi=np.stack([level, [0.1, -0.1, 0.05], np.zeros(3)], -1))
    recording = measured(arm, real, [1, 1, 1], 4.0, noise=1.0)
    bounds = {k: BOUNDS[k] for k in ("coulomb", "asymmetry", "offset")}
    result = run(arm, wrong, recording, [TORQUE], family="coulomb", bounds=bounds, terms=["offset"])
    assert len(result.null_directions) == 3
    assert all(0.5 < share <= 1.0 for share, _ in result.null_directions)
    directions = {name: parts for _, parts in result.null_directions for name in parts}
    for j in range(3):
        parts = directions[f"offset[{j + 1}]"]
        assert set(parts) == {f"offset[{j + 1}]", f"asymmetry[{j + 1}]"}
        # each part is in terms of its prior's sigma
        offset = parts[f"offset[{j + 1}]"] * prior["offset"] * arm.tau_max.max()
        asymmetry = parts[f"asymmetry[{j + 1}]"] * prior["asymmetry"]
        assert offset == pytest.approx(level[j] * asymmetry, rel=0.25)


PHI = {
    "sigmoid": [[1.8, 12.0, 0.02], [1.4, 8.0, -0.02], [0.9, 15.0, 0.01]],
    "coulomb": [[0.8, 0.1, 0.3], [0.6, -0.1, 0.4], [0.4, 0.0, 0.2]],
    "stribeck": [[0.6, 0.05, 0.3, 0.9, 0.12], [0.5, -0.05, 0.4, 1.1, 0.1], [0.4, 0.0, 0.2, 0.8, 0.15]],
}


@pytest.mark.long
@pytest.mark.parametrize("name", list(PHI))
def test_the_family_that_made_the_data_is_chosen(arm, truth, wrong, name):
    """family=auto picks the law that the arm has, and says by how much the others predict worse."""
    real = replace(truth, family=family(name), phi=np.array(PHI[name]))
    recording = recorded(arm, real, 6.0, seed=0)
    result = run(arm, wrong, recording, [TORQUE], family="auto")
    assert result.dynamics.family.name == name
    assert set(result.families) == {f.name for f in FAMILIES}
    assert min(result.families.values()) == 1.0
    assert result.families[name] < 1.1


def inertial(d):
    """Return mass (..., n) and the smallest eigenvalue of the pseudo-inertia (..., n) over its largest."""
    second = 0.5 * np.trace(d.inertia, axis1=-2, axis2=-1)[..., None, None] * np.eye(3) - d.inertia
    moments = np.linalg.eigvalsh(second)
    return d.mass, moments[..., 0] / moments[..., -1]


@pytest.mark.long
@pytest.mark.parametrize("data", ["a random walk", "an arm of negative mass"])
def test_whole_links_are_physical_whatever_the_data(arm, wrong, clean, data):
    """Torque of no arm at all, no prior: mass and moments positive, triangle inequality kept, in every draw."""
    if data == "a random walk":
        walk = np.cumsum(np.random.default_rng(0).normal(size=clean.tau.shape), axis=0)
        recording = replace(clean, tau=10.0 * walk / walk.std(0))
    else:
        recording = replace(clean, tau=-clean.tau)
    result = run(arm, wrong, recording, [TORQUE], prior={}, terms=["offset", "link"])
    for d in (result.dynamics, result.space.dynamics(result.found.samples)):
        mass, least = inertial(d)
        assert mass.min() > 0
        assert least.min() > 0
        assert physical(d.inertia).all()
    drawn = result.space.dynamics(result.found.samples).mass
    assert (np.abs(drawn - arm.mass).max(0) > 0.5 * arm.mass).all()  # far from nominal, if only at a bound


@pytest.fixture(scope="module")
def linked(arm, truth, wrong):
    """Whole links, of an arm with other masses and centres, from link-side torque with noise."""
    recording = measured(arm, truth, SCALE, 12.0, noise=0.1, mass=MASS, shift=SHIFT)
    return run(arm, wrong, recording, STAGED, terms=["offset", "link"])


MASS = np.array([1.2, 0.8, 1.4])
SHIFT = np.array([[0.02, 0.01, 0.0], [-0.02, 0.03, 0.02], [0.02, -0.02, 0.03]])


@pytest.mark.long
def test_whole_links_predict_an_arm_of_other_masses_and_centres(arm, truth, wrong, linked):
    """Torque with gravity of a motion that was not fitted is predicted to within 2 % of its size."""
    other = measured(arm, truth, SCALE, 4.0, seed=1, mass=MASS, shift=SHIFT)
    errors = prediction_errors(arm, wrong, linked.dynamics, other, **WINDOW)
    error, nominal = (np.array(errors[k]) for k in ("torque_rmse_Nm", "nominal_torque_rmse_Nm"))
    size = np.sqrt((other.tau**2).mean(0))
    assert (nominal / size).max() > 0.2
    assert (error / size).max() < 0.02


def test_draws_of_what_was_identified_are_physical_and_keep_its_correlation(linked):
    """dr=identified: every drawn arm is physical, and parameters vary together as in the joint distribution."""
    space, saved = linked.saved
    drawn = Draws(space, saved.samples)(np.random.default_rng(1), 3000)
    assert drawn.offset.shape == (3000, 3)
    mass, least = inertial(drawn)
    assert mass.min() > 0
    assert least.min() > 0
    assert physical(drawn.inertia).all()

    def correlation(d):
        columns = [d.phi.reshape(-1, 9), d.offset, d.mass, (d.mass[..., None] * d.com).reshape(-1, 9)]
        return np.corrcoef(np.concatenate(columns, 1).T)

    expected = correlation(space.dynamics(saved.samples))
    assert np.abs(expected - np.eye(len(expected))).max() > 0.5
    np.testing.assert_allclose(correlation(drawn), expected, atol=0.12)


class InterruptionError(Exception):
    """What a person's Ctrl-C is to a run."""


class Store:
    """A memo that keeps arrays, as a run folder does; raises before the `broken`-th new step is done."""

    def __init__(self):
        self.kept, self.broken = {}, None

    def __call__(self, name, make):
        """Return what `make` makes, or made before."""
        if name not in self.kept:
            if self.broken == 0:
                raise InterruptionError
            made = {k: np.asarray(v) for k, v in make().items()}
            self.broken = None if self.broken is None else self.broken - 1
            self.kept[name] = made
        return {k: v.copy() for k, v in self.kept[name].items()}


def same(one, other):
    """Assert that two results are the same to the bit, and tell the same story but for its times."""
    for name in ("x", "low", "high", "identifiable", "samples"):
        assert np.array_equal(getattr(one.found, name), getattr(other.found, name)), name
    assert one.families == other.families
    assert one.null_directions == other.null_directions
    assert one.unseen == other.unseen
    assert np.array_equal(one.dynamics.breakaway, other.dynamics.breakaway)
    story = [r.history.drop(columns="seconds") for r in (one, other)]
    assert story[0].equals(story[1])


@pytest.mark.long
@pytest.mark.parametrize("torque", ["measured", "commanded"])
def test_an_interrupted_run_goes_on_to_the_same_end(arm, wrong, clean, motion, torque):
    """Stopped before every step in turn, and within one, a run with the same memo ends as if it never had been."""
    how = {"family": "auto", "folds": 2}
    recording, searches = clean, [Genetic(population=12, generations=3), LeastSquares(max_evaluations=3)]
    if torque == "commanded":
        recording, searches = motion.select(motion.t < 1.5), [TORQUE, LeastSquares(max_evaluations=2)]
        how = {"breakaway": 1.5, "stride": 20}
    whole, store = Store(), Store()
    expected = run(arm, wrong, recording, searches, memo=whole, **how)
    assert len(whole.kept) >= 5

    for k in range(len(whole.kept)):
        store.broken = 1 if k else 0
        with pytest.raises(InterruptionError):
            run(arm, wrong, recording, searches, memo=store, **how)
        assert list(store.kept) == list(whole.kept)[:k]
    store.broken = None
    same(run(arm, wrong, recording, searches, memo=store, **how), expected)

    half, rows = Store(), []

    def stop(row):
        rows.append(row)
        if len(rows) == len(expected.history) - 3:
            raise InterruptionError

    with pytest.raises(InterruptionError):
        run(arm, wrong, recording, searches, memo=half, report=stop, **how)
    assert 0 < len(half.kept) < len(whole.kept)
    same(run(arm, wrong, recording, searches, memo=half, **how), expected)


@pytest.mark.long
def test_the_ga_only_improves_and_keeps_its_seed(arm, wrong, clean):
    """The best cost never rises, falls far below the start's, and a seed gives the same generations twice."""
    runs = [run(arm, wrong, clean, [Genetic(seed=seed, population=40, generations=30)]) for seed in (0, 0, 1)]
    cost = runs[0].history["cost"]
    assert len(cost) == 30
    assert cost.is_monotonic_decreasing
    assert cost.iloc[-1] < 0.5 * cost.iloc[0]
    assert np.array_equal(runs[0].x, runs[1].x)
    assert cost.tolist() == runs[1].history["cost"].tolist()
    assert not np.array_equal(runs[0].x, runs[2].x)


def test_the_ga_stops_at_its_generations_and_never_ends_worse():
    """`generations` is G_max: not one more is evaluated or reported; without an improvement it returns the start."""
    problem = SimpleNamespace(residual=lambda u: u - 0.3, prior_width=np.ones(3))
    rows, start = [], np.full(3, 0.9)
    found = Genetic(population=10, generations=4)(problem, start, rows.append)
    assert [row["generation"] for row in rows] == [1, 2, 3, 4]
    assert ((found - 0.3) ** 2).sum() == pytest.approx(rows[-1]["cost"])
    assert np.array_equal(
        Genetic(population=10, generations=2)(problem, np.full(3, 0.3), rows.append), np.full(3, 0.3)
    )


def test_searches_run_one_after_the_other(arm, wrong, clean):
    """Least squares after the GA starts where the GA ended and ends no worse than it."""
    searches = [Genetic(population=30, generations=5, seed=0), LeastSquares()]
    result = run(arm, wrong, clean, searches, prior={})
    cost = result.history.groupby("search", sort=False)["cost"]
    assert list(cost.groups) == ["ga", "least_squares", "least_squares, reweighted"]
    assert cost.last()["least_squares"] < cost.first()["least_squares"]


def test_a_prior_decides_where_the_data_cannot(arm, wrong, clean):
    """A belief held very firmly keeps the nominal value; without one the data move it."""
    scales = []
    for prior in ({"inertia_scale": 1e-6}, {}):
        result = run(arm, wrong, clean, [LeastSquares()], prior=prior)
        scales.append(result.space.block(result.x, "inertia_scale"))
    np.testing.assert_allclose(scales[0], 1.0, atol=1e-3)
    assert np.abs(scales[1] - 1.0).min() > 0.1


def test_a_joint_that_slides_has_all_of_its_friction(arm, wrong, clean):
    """In rows of one slide of a joint Coulomb friction is its whole level, however slowly the joint slides."""
    short = clean.select(clean.t < 3.0)
    space = search_space(arm, with_family(wrong, "coulomb"), BOUNDS, ["offset"], short)
    residual = TorqueResidual(space, short, slowest=0.02)
    level = np.array([0.8, 0.7, 0.6])
    alone = replace(space.nominal, phi=np.stack([level, 0 * level, 0 * level], -1))
    friction = residual.predict(alone) - residual.predict(replace(alone, phi=0 * alone.phi))
    whole = np.broadcast_to(level, friction.shape)[residual.seen]
    np.testing.assert_allclose(np.abs(friction[residual.seen]), whole, rtol=1e-9)


def test_a_search_on_the_level_of_torque_makes_no_replays(arm, wrong, clean, monkeypatch):
    """Values and intervals are both of the residual that the search minimised."""
    monkeypatch.delattr("r2s.identification.identify.ReplayResidual")
    result = run(arm, wrong, clean.select(clean.t < 3.0), [TORQUE])
    assert (result.found.low <= result.x + 1e-12).all()
    assert (result.x <= result.found.high + 1e-12).all()


def test_what_is_left_out_is_not_fitted(clean):
    """Folds cover every moment once, and what is fitted keeps 0.1 s away; of repeated motion they are phases."""
    for recording, clock in ((clean, clean.t), (replace(clean, period=1.5), clean.t % 1.5)):
        lookup = dict(zip(clean.t.tolist(), clock.tolist(), strict=True))
        folds = held_out(recording, 4)
        assert sum(len(out.t) for _, out in folds) >= len(clean.t)
        for rest, out in folds:
            near = np.array([lookup[t] for t in rest.t.tolist()])
            low, high = (f(lookup[t] for t in out.t.tolist()) for f in (min, max))
            assert np.all((near <= low - 0.099) | (near >= high + 0.099))
            if recording.period:  # on a circle: the last phases of a period are close to its first ones
                assert np.all((low - near) % recording.period > 0.099)
                assert np.all((near - high) % recording.period > 0.099)
            assert 0.15 < len(out.t) / len(clean.t) < 0.35
