"""What was put into an arm is found again from its recording, by every search and for both kinds of torque."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from conftest import REAL, conf

from r2s.arm.record import record
from r2s.arm.simulated import SimulatedArm
from r2s.errors import UserError
from r2s.excitation import fourier
from r2s.friction import friction_level, friction_torque
from r2s.identify import identify, prediction_errors
from r2s.parameters import inertia_scale, nominal_dynamics, parameter_space
from r2s.readers import read
from r2s.recording import Recording
from r2s.residual import ReplayResidual, TorqueResidual, cut_windows, replay
from r2s.robot import load_robot
from r2s.search_ga import ga_search
from r2s.search_least_squares import least_squares_search

ARM = """
<mujoco model="threelink">
  <compiler angle="radian"/>
  <worldbody>
    <body pos="0 0 0.4">
      <body><inertial pos="0.02 0 0.1" mass="3" diaginertia="0.06 0.06 0.05"/>
        <joint name="yaw" axis="0 0 1" range="-2.6 2.6" actuatorfrcrange="-40 40"/>
        <body pos="0 0 0.2"><inertial pos="0 0 0.15" mass="2" diaginertia="0.05 0.05 0.01"/>
          <joint name="pitch" axis="0 1 0" range="-1.6 1.6" actuatorfrcrange="-40 40"/>
          <body pos="0 0 0.3"><inertial pos="0.03 0 0.1" mass="1" diaginertia="0.02 0.02 0.01"/>
            <joint name="elbow" axis="0 1 0" range="-2 2" actuatorfrcrange="-20 20"/>
            <site name="tip" pos="0 0 0.25"/>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
</mujoco>
"""
SCALE = [1.3, 0.8, 1.2]
SETTINGS = conf("config")["identify"]
HOW = {"window_s": SETTINGS["window_s"], "cutoff_hz": SETTINGS["cutoff_hz"], "nthread": 1}
NOISE = {k: conf("data/simulated")[k] for k in ("position_noise", "velocity_noise")}


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    path = tmp_path_factory.mktemp("arm") / "arm.xml"
    path.write_text(ARM)
    return load_robot(str(path), ddq_max=15.0)


@pytest.fixture(scope="module")
def truth(arm):
    return nominal_dynamics(
        arm,
        phi1=[1.8, 1.4, 0.9],
        phi2=[12.0, 8.0, 15.0],
        phi3=[0.02, -0.02, 0.01],
        offset=[0.3, -0.4, 0.1],
        breakaway_positive=[0.6, 0.5, 0.3],
        breakaway_negative=[-0.5, -0.6, -0.35],
        inertia_scale=SCALE,
    )


@pytest.fixture(scope="module")
def wrong(arm):
    return nominal_dynamics(arm, **conf("friction/uniform"))


def recorded(robot, dynamics, seconds, seed):
    """Return a commanded recording of an arm with these dynamics and the sensor noise of conf/data/simulated."""
    return record(SimulatedArm(robot, dynamics, **NOISE, seed=seed), fourier(robot, duration=seconds, seed=seed))


@pytest.fixture(scope="module")
def motion(arm, truth):
    return recorded(arm, truth, 8.0, seed=0)


@pytest.fixture(scope="module")
def found(arm, wrong, motion):
    return identify(
        arm,
        wrong,
        motion,
        [least_squares_search()],
        bounds=SETTINGS["bounds"],
        prior=SETTINGS["prior"]["commanded"],
        nthread=1,
    )


def curve_error(found, truth, dq):
    """Return (n,): the largest error of friction over the speeds of dq (98 % quantile), over the friction's level."""
    fastest = np.quantile(np.abs(dq), 0.98, axis=0)
    grid = np.linspace(-1, 1, 201)[:, None] * fastest
    error = np.abs(friction_torque(grid, found.phi) - friction_torque(grid, truth.phi)).max(0)
    return error / friction_level(truth.phi, fastest)


def test_least_squares_finds_what_was_injected(arm, found, truth, wrong, motion):
    """From a wrong start: friction within 2 % of its level, offsets within 0.02 Nm, inertia scales within 10 %."""
    dynamics = found.dynamics
    assert curve_error(wrong, truth, motion.dq).min() > 0.05
    assert curve_error(dynamics, truth, motion.dq).max() < 0.02
    np.testing.assert_allclose(dynamics.offset, truth.offset, atol=0.02)
    np.testing.assert_allclose(inertia_scale(dynamics.inertia, arm.inertia), SCALE, rtol=0.10)


def test_breakaway_edges_are_found(found, truth):
    """At least five of the six edges of the dead zone are within 0.08 Nm."""
    assert np.sum(np.abs(found.dynamics.breakaway - truth.breakaway) < 0.08) >= 5


def test_the_history_tells_what_the_search_did(found):
    """Each row has search, evaluations, cost and time; the cost of least squares never rises within a run."""
    history = found.history
    assert set(history["search"]) == {"least_squares", "breakaway", "least_squares, reweighed"}
    assert history["seconds"].is_monotonic_increasing
    assert (history["done"] <= history["total"]).all()
    scan = np.flatnonzero(history["search"] == "breakaway")
    before, after = history.iloc[: scan[0]], history.iloc[scan[-1] + 1 :]
    for part in (before, after):
        assert part["cost"].is_monotonic_decreasing
        assert part["evaluations"].is_monotonic_increasing
    assert before["cost"].iloc[-1] < 0.1 * before["cost"].iloc[0]
    assert after["cost"].iloc[-1] < before["cost"].iloc[-1]


def test_identified_dynamics_predict_motion_that_was_not_fitted(arm, truth, wrong, found):
    """On a second excitation every error of the identified arm is far below the nominal one's, at every horizon."""
    other = recorded(arm, truth, 5.0, seed=1)
    errors = prediction_errors(arm, wrong, found.dynamics, other, **HOW)
    for name in ("torque_rmse_Nm", "position_rmse_mrad"):
        assert len(errors[name]) == 3
        assert np.all(np.array(errors[name]) < 0.5 * np.array(errors[f"nominal_{name}"]))
    assert set(errors["ee_error_mm"]) == {"0.1", "0.5", "2"}
    for horizon, error in errors["ee_error_mm"].items():
        assert error < 0.2 * errors["nominal_ee_error_mm"][horizon]


def test_the_truth_predicts_to_within_sensor_noise(arm, truth, wrong, motion):
    """Replayed with the injected dynamics the windows stay below 2 mrad: command, row and step belong together."""
    errors = prediction_errors(arm, wrong, truth, motion, **HOW)
    assert max(errors["position_rmse_mrad"]) < 2.0
    assert errors["ee_error_mm"]["0.1"] < 0.5


def test_a_replay_without_noise_is_the_recording(arm, truth):
    """Without sensor noise, a window from the exact state does what the recorded arm did, to 1e-9 rad."""
    clean = record(
        SimulatedArm(arm, truth, position_noise=0.0, velocity_noise=0.0), fourier(arm, duration=2.5, seed=3)
    )
    windows = cut_windows(clean, 0.2)
    rows = (windows.t / 1e-3).round().astype(int)
    exact = replace(windows, q0=clean.q[rows], dq0=clean.dq[rows])
    np.testing.assert_allclose(replay(arm, truth, exact, nthread=1), exact.q, rtol=0, atol=1e-9)


def test_replays_of_many_candidates_are_those_of_each(arm, truth, wrong, motion):
    """The residual of a batch of candidates, in chunks, is the residual of each alone, to the bit."""
    space = parameter_space(arm, wrong, SETTINGS["bounds"])
    x = space.from_unit(np.random.default_rng(0).random((5, len(space.start))))
    short = motion.select(motion.t < 1.5)
    together = ReplayResidual(arm, space, short, batch=2, nthread=1)
    rows = together(x)
    assert rows.shape == (5, len(together.clusters))
    alone = ReplayResidual(arm, space, short, batch=1, nthread=1)
    assert np.array_equal(rows, np.concatenate([alone(x[k : k + 1]) for k in range(5)]))
    assert together.candidates == 5


def measured(robot, dynamics, scale, seconds, noise=0.0, seed=0, moving=(1, 1, 1)):
    """Return a recording of link-side torque: inverse dynamics with gravity, plus friction, minus offset, plus noise.

    The tensors are scaled in the compiled model, not through r2s. Joints where `moving` is 0 stand at angle 0.
    """
    e = fourier(robot, duration=seconds, seed=seed)
    e = replace(e, q=e.q * moving, dq=e.dq * moving, ddq=e.ddq * moving)
    model = robot.model(gravity=True)
    model.body_inertia[model.jnt_bodyid] *= np.array(scale)[:, None]
    data = mujoco.MjData(model)
    tau = np.empty_like(e.q)
    for k in range(len(e.t)):
        data.qpos[:], data.qvel[:], data.qacc[:] = e.q[k], e.dq[k], e.ddq[k]
        mujoco.mj_inverse(model, data)
        tau[k] = data.qfrc_inverse
    tau += friction_torque(e.dq, dynamics.phi) - dynamics.offset
    tau += noise * np.random.default_rng(seed + 100).normal(size=tau.shape)
    return Recording(t=e.t, q=e.q, dq=e.dq, tau=tau, torque="measured")


def fit(arm, wrong, recording, cutoff_hz=10.0, folds=0):
    return identify(
        arm,
        wrong,
        recording,
        [least_squares_search(ftol=1e-12)],
        bounds=SETTINGS["bounds"],
        prior={},
        cutoff_hz=cutoff_hz,
        folds=folds,
        nthread=1,
    )


def test_torque_with_gravity_gives_friction_and_offset(arm, truth, wrong):
    """Noise-free link-side torque: friction curves, offsets and scales are found to 1e-3."""
    recording = measured(arm, truth, SCALE, 8.0)
    dynamics = fit(arm, wrong, recording, cutoff_hz=50.0).dynamics
    assert curve_error(dynamics, truth, recording.dq).max() < 1e-3
    np.testing.assert_allclose(dynamics.offset, truth.offset, atol=1e-3)
    np.testing.assert_allclose(inertia_scale(dynamics.inertia, arm.inertia), SCALE, rtol=1e-3)


def test_predicted_torque_is_inverse_dynamics(arm, truth, wrong):
    """The linear prediction equals MuJoCo's inverse dynamics of the true tensors, with and without gravity."""
    recording = measured(arm, truth, SCALE, 3.0)
    space = parameter_space(arm, wrong, SETTINGS["bounds"])
    for torque in ("measured", "commanded"):
        residual = TorqueResidual(arm, space, replace(recording, torque=torque), cutoff_hz=50.0)
        m = residual.motion
        model = arm.model(gravity=torque == "measured")
        model.body_inertia[model.jnt_bodyid] *= np.array(SCALE)[:, None]
        data = mujoco.MjData(model)
        expected = []
        for q, dq, ddq in zip(m.q, m.dq, m.ddq, strict=True):
            data.qpos[:], data.qvel[:], data.qacc[:] = q, dq, ddq
            mujoco.mj_inverse(model, data)
            expected.append(data.qfrc_inverse + friction_torque(dq, truth.phi) - truth.offset)
        np.testing.assert_allclose(residual.predict(truth), expected, atol=1e-9)


def test_intervals_contain_the_truth(arm, truth, wrong):
    """With 0.1 Nm of white noise, the 95 % intervals of five recordings hold at least 80 % of the true values."""
    inside = []
    for seed in range(5):
        result = fit(arm, wrong, measured(arm, truth, SCALE, 8.0, noise=0.1, seed=seed), cutoff_hz=50.0)
        expected = np.concatenate([*truth.phi.T, SCALE, truth.offset])
        low, high = result.interval
        assert np.all(low <= result.x + 1e-12)
        assert np.all(result.x <= high + 1e-12)
        inside.append((low <= expected) & (expected <= high))
    assert np.mean(inside) >= 0.8


def test_what_the_data_cannot_tell_is_said(arm, truth, wrong):
    """Of a joint that stands still friction is not identifiable; of joints that move it is."""
    result = fit(arm, wrong, measured(arm, truth, SCALE, 8.0, noise=0.1, moving=(1, 1, 0)))
    names = np.array(result.space.names)
    assert set(names[~result.identifiable]) >= {"phi2[3]", "phi3[3]"}
    assert set(names[result.identifiable]) >= {"phi1[1]", "offset[1]", "phi1[2]", "offset[2]"}


def test_the_genetic_search_only_improves_and_keeps_its_seed(arm, truth, wrong):
    """The GA's best cost never rises, falls far below the start's, and a seed gives the same generations twice."""
    recording = measured(arm, truth, SCALE, 4.0)
    runs = [
        identify(
            arm,
            wrong,
            recording,
            [ga_search(population=40, generations=15, seed=seed)],
            bounds=SETTINGS["bounds"],
            prior=SETTINGS["prior"]["measured"],
            nthread=1,
        )
        for seed in (0, 0, 1)
    ]
    cost = runs[0].history["cost"]
    assert len(cost) >= 15
    assert cost.is_monotonic_decreasing
    assert cost.iloc[-1] < 0.5 * cost.iloc[0]
    assert np.array_equal(runs[0].x, runs[1].x)
    assert cost.tolist() == runs[1].history["cost"].tolist()
    assert not np.array_equal(runs[0].x, runs[2].x)


def test_a_joint_whose_refit_does_not_pay_keeps_its_friction(arm, truth, wrong):
    """With `folds`, a joint that is as the nominal model says stays so and is not called identified; others are."""
    mixed = replace(
        truth, phi=np.where(np.arange(3)[:, None] == 1, wrong.phi, truth.phi), offset=truth.offset * [1, 0, 1]
    )
    result = fit(arm, wrong, measured(arm, mixed, [1, 1, 1], 8.0, noise=0.3), folds=4)
    np.testing.assert_allclose(result.dynamics.phi[1], wrong.phi[1], rtol=1e-2, atol=1e-3)
    assert abs(result.dynamics.offset[1]) < 1e-2
    assert abs(result.dynamics.offset[0] - truth.offset[0]) < 0.05
    names = np.array(result.space.names)
    assert not result.identifiable[[n in ("phi1[2]", "phi2[2]", "phi3[2]", "offset[2]") for n in names]].any()
    assert result.identifiable[[n in ("phi1[1]", "offset[1]", "phi1[3]", "offset[3]") for n in names]].all()


def test_the_genetic_search_stops_at_its_generations():
    """`generations` is G_max: not one more is evaluated or told of."""
    rows = []
    ga_search(population=10, generations=4)(lambda u: u - 0.3, np.full(3, 0.9), rows.append)
    assert [row["generation"] for row in rows] == [1, 2, 3, 4]


def test_searches_run_one_after_the_other(arm, truth, wrong):
    """Least squares after the GA starts where the GA ended and ends no worse than it."""
    recording = measured(arm, truth, SCALE, 4.0)
    result = identify(
        arm,
        wrong,
        recording,
        [ga_search(population=30, generations=5, seed=0), least_squares_search()],
        bounds=SETTINGS["bounds"],
        prior={},
        nthread=1,
    )
    cost = result.history.groupby("search", sort=False)["cost"]
    assert list(cost.groups) == ["ga", "least_squares", "least_squares, reweighed"]
    assert cost.first()["least_squares"] == pytest.approx(cost.last()["ga"], rel=1e-2)
    assert cost.last()["least_squares"] < cost.last()["ga"]


def test_a_prior_decides_where_the_data_cannot(arm, truth, wrong):
    """A belief held very firmly keeps the nominal value; without one the data move it."""
    recording = measured(arm, truth, SCALE, 4.0)
    scales = []
    for prior in ({"inertia_scale": 1e-6}, {}):
        result = identify(
            arm, wrong, recording, [least_squares_search()], bounds=SETTINGS["bounds"], prior=prior, nthread=1
        )
        scales.append(result.space.block(result.x, "inertia_scale"))
    np.testing.assert_allclose(scales[0], 1.0, atol=1e-3)
    assert np.abs(scales[1] - 1.0).min() > 0.1


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"joints": 2}, r"^the recording has 2 joints, threelink has 3$"),
        ({"prior": {"inertia_scal": 1.0}}, r"^prior: \['inertia_scal'\] is not searched"),
        ({"bounds": {"phi9": [0, 1]}}, r"^bounds: unknown parameter 'phi9'; allowed: .*did you mean 'phi"),
        ({"rows": 150}, r"^no trajectory is as long as a window of 0\.2 s; the longest is 0\.1"),
    ],
)
def test_what_does_not_fit_is_refused_in_one_line(arm, wrong, motion, change, message):
    """Another number of joints, an unknown block and a recording that is too short are named."""
    joints, rows = change.pop("joints", 3), change.pop("rows", 400)
    short = Recording(
        t=motion.t[:rows],
        q=motion.q[:rows, :joints],
        dq=motion.dq[:rows, :joints],
        tau=motion.tau[:rows, :joints],
        torque="commanded",
    )
    settings = {"bounds": SETTINGS["bounds"], "prior": {}} | change
    with pytest.raises(UserError, match=message) as caught:
        identify(arm, wrong, short, [least_squares_search()], nthread=1, **settings)
    assert "\n" not in str(caught.value)


@pytest.mark.skipif(not REAL.is_file(), reason=f"the real recording is not here: {REAL}")
def test_the_real_recording_is_predicted_better_than_by_published_values(panda):
    """On held-out phases of the real Panda's motion the torque error falls below the published model's."""
    columns = {"t": "t", "q": "q", "dq": "dq", "tau": None, "trajectory": None}
    how = {"torque": "measured", "columns": columns, "period": 13.3333, "max_gap_s": 0.05, "n_joints": 7}
    train, validation = read(REAL, **how).split(SETTINGS["validation_fraction"])
    nominal = nominal_dynamics(panda, **conf("friction/gaz2019"))
    result = identify(
        panda,
        nominal,
        train,
        [least_squares_search()],
        bounds=SETTINGS["bounds"],
        prior=SETTINGS["prior"]["measured"],
        cutoff_hz=SETTINGS["cutoff_hz"],
        folds=SETTINGS["folds"],
        nthread=1,
    )
    errors = prediction_errors(panda, nominal, result.dynamics, validation, **HOW)
    ratio = np.array(errors["torque_rmse_Nm"]) / np.array(errors["nominal_torque_rmse_Nm"])
    assert ratio.mean() < 1


@pytest.mark.slow
def test_the_papers_new_column_is_found_from_its_old_one(panda):
    """The Panda with the paper's NEW values, started at OLD: 20 s at 1 kHz give friction within 2 % of its level."""
    new = nominal_dynamics(panda, **conf("friction/paper"), inertia_scale=conf("inertia/paper")["scale"])
    old = nominal_dynamics(panda, **conf("friction/gaz2019"), inertia_scale=conf("inertia/nominal")["scale"])
    recording = recorded(panda, new, 20.0, seed=0)
    result = identify(
        panda,
        old,
        recording,
        [least_squares_search()],
        bounds=SETTINGS["bounds"],
        prior=SETTINGS["prior"]["commanded"],
        nthread=1,
    )
    assert curve_error(result.dynamics, new, recording.dq).max() < 0.02
    np.testing.assert_allclose(result.dynamics.offset, new.offset, atol=0.02)
    assert np.mean(np.abs(result.dynamics.breakaway - new.breakaway) < 0.08) > 0.5
