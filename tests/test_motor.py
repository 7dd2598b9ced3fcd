"""Motor torque: recordings of it and of currents, rotor inertia everywhere, and a payload beside the links."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from conftest import conf
from test_identify import ARM

from r2s.errors import UserError
from r2s.excitation.fourier import fourier
from r2s.identification.identify import identify
from r2s.identification.parameter_file import load_parameters, save_parameters
from r2s.identification.parameters import parameter_space
from r2s.identification.prediction import prediction_errors
from r2s.identification.problem import Problem
from r2s.identification.residuals.torque_residual import TorqueResidual
from r2s.identification.search.least_squares import LeastSquares
from r2s.identification.settings import Settings
from r2s.identification.terms import scaled_prior, search_space
from r2s.learning.randomization import UniformRandomization
from r2s.physics.description import write_description
from r2s.physics.dynamics import nominal_dynamics
from r2s.physics.friction import family
from r2s.physics.robot import load_robot
from r2s.physics.simulator import Simulator, single_arm
from r2s.recordings.lateness import lateness
from r2s.recordings.readers import read
from r2s.recordings.recording import Recording

SETTINGS = conf("identify/default")
NOISE = 0.5  # Nm, white, of every sample
COULOMB = np.array([[32.0, 0.0, 14.0], [24.0, 0.0, 9.0], [11.0, 0.0, 5.0]])  # friction of tens of Nm
OFFSET = np.array([2.0, -1.5, 0.8])
ARMATURE = np.array([1.4, 0.9, 0.25])
PAYLOAD, PLACE = 1.5, np.array([0.03, 0.0, 0.3])


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    """Three joints with gears of 150, 150 and 60 Nm."""
    path = tmp_path_factory.mktemp("arm") / "arm.xml"
    path.write_text(ARM.replace('-40 40"/>', '-150 150" armature="0.2"/>').replace("-20 20", "-60 60"))
    return load_robot(str(path), ddq_max=15.0)


@pytest.fixture(scope="module")
def start(arm):
    return nominal_dynamics(arm, **conf("friction/uniform"))


@pytest.fixture(scope="module")
def truth(start):
    return replace(start, family=family("coulomb"), phi=COULOMB, offset=OFFSET, armature=ARMATURE)


def recorded(arm, truth, seconds, torque="motor", seed=0, noise=NOISE, payload=0.0):
    """Return a recording by MuJoCo's own inverse dynamics of a compiled arm, not through r2s."""
    e = fourier(arm, duration=seconds, seed=seed)
    model = arm.model(gravity=True)
    model.dof_armature[:] = truth.armature if torque == "motor" else 0.0
    if payload:
        last = model.jnt_bodyid[-1]
        m, c = model.body_mass[last], model.body_ipos[last].copy()
        square = payload * m / (payload + m) * (np.sum((PLACE - c) ** 2) * np.eye(3) - np.outer(PLACE - c, PLACE - c))
        moments, axes = np.linalg.eigh(np.diag(model.body_inertia[last]) + square)
        axes[:, 0] *= np.linalg.det(axes)
        model.body_inertia[last] = moments
        mujoco.mju_mat2Quat(model.body_iquat[last], axes.ravel())
        model.body_mass[last], model.body_ipos[last] = m + payload, (m * c + payload * PLACE) / (m + payload)
    mujoco.mj_setConst(model, mujoco.MjData(model))
    data, tau = mujoco.MjData(model), np.empty_like(e.q)
    for k in range(len(e.t)):
        data.qpos[:], data.qvel[:], data.qacc[:] = e.q[k], e.dq[k], e.ddq[k]
        mujoco.mj_inverse(model, data)
        tau[k] = data.qfrc_inverse
    tau += truth.friction(e.dq) - truth.offset + noise * np.random.default_rng(seed).normal(size=tau.shape)
    return Recording(t=e.t, q=e.q, dq=e.dq, tau=tau, torque=torque)


def settings(torque="motor", **change):
    own = {k: SETTINGS[k] for k in ("bounds", "cutoff_hz")} | {k: SETTINGS[k][torque] for k in ("terms", "prior")}
    return Settings(**own | {"family": "coulomb", "breakaway": None} | change)


def found_in(arm, start, recording, **change):
    return identify(arm, start, recording, [LeastSquares()], settings(recording.torque, nthread=1, **change))


@pytest.fixture(scope="module")
def motion(arm, truth):
    return recorded(arm, truth, 8.0)


@pytest.fixture(scope="module")
def found(arm, start, motion):
    """From friction of 0.5 Nm and the MJCF's rotors, believing nothing."""
    return found_in(arm, start, motion, terms=["offset", "armature"], prior={})


def test_what_was_injected_is_found(arm, truth, motion, found):
    """Friction of tens of Nm, offsets and rotors, within 4 standard errors of least squares on this noise.

    White noise of 0.5 Nm is flat up to 500 Hz and cut at 10 Hz, so 2 * 10 * seconds numbers are independent. What
    differentiation and the filter leave of the noise-free motion adds 1 % of each value.
    """
    residual = TorqueResidual(found.space, motion)
    x = found.space.start.copy()
    true = {"coulomb": COULOMB[:, 0], "asymmetry": 0 * OFFSET, "viscous": COULOMB[:, 2]}
    true |= {"offset": OFFSET, "armature": ARMATURE}
    for name, values in true.items():
        x[found.space.where(name)] = values
    residual._weights = np.ones(arm.n), np.full(arm.n, NOISE * np.sqrt(2 * 10 / 1000))
    step = 1e-4 * np.maximum(np.abs(x), 0.1)
    jacobian = residual.change(x, x + step) / step
    rows_each = len(jacobian) / arm.n / (2 * 10 * motion.duration)
    sigma = np.sqrt(np.diag(np.linalg.inv(jacobian.T @ jacobian / rows_each)))
    allowed = 4 * sigma + 0.01 * np.maximum(np.abs(x), 0.1)
    assert sigma.max() < 0.5
    for name in true:
        at = found.space.where(name)
        assert np.all(np.abs(found.x[at] - x[at]) < allowed[at]), name
    np.testing.assert_array_equal(found.dynamics.armature, found.space.block(found.x, "armature"))


@pytest.mark.long
def test_other_motion_is_predicted_to_the_noise(arm, start, truth, motion):
    """RMSE on motion that was not fitted, with all terms and beliefs of conf/: a third above that of the truth."""
    found = found_in(arm, start, motion)
    other = recorded(arm, truth, 4.0, seed=1)
    best = prediction_errors(arm, start, truth, other, window_s=0.2, cutoff_hz=10.0)
    errors = prediction_errors(arm, start, found.dynamics, other, window_s=0.2, cutoff_hz=10.0)
    assert set(errors) == {"rows", "seconds", "torque_rmse_Nm", "nominal_torque_rmse_Nm"}
    ratio = np.array(errors["torque_rmse_Nm"]) / np.array(best["torque_rmse_Nm"])
    assert ratio.mean() < 1.33
    assert np.min(errors["nominal_torque_rmse_Nm"]) > 5


def test_beliefs_and_bounds_grow_with_the_arm(arm, start, motion):
    """Shares of the joint's largest torque, the file's or the recorded one, whatever the kind of torque."""
    arm = replace(arm, tau_max=np.array([150.0, 1.0, 60.0]))  # a limit that the recording proves wrong
    largest = np.maximum(arm.tau_max, np.abs(motion.tau).max(0))
    prior = SETTINGS["prior"]["motor"]
    own = scaled_prior(prior, arm, motion)
    for name in ("offset", "armature", "viscous"):
        np.testing.assert_allclose(own[name], prior[name] * largest)
    assert own["link_alpha"] == prior["link_alpha"]
    space = search_space(arm, start, SETTINGS["bounds"], ["offset", "armature"], motion)
    assert np.all(space.upper >= np.tile(np.minimum(largest, 0.05), len(space.blocks)))
    np.testing.assert_allclose(space.block(space.lower, "offset"), -largest)
    other = replace(motion, torque="commanded")
    np.testing.assert_equal(scaled_prior(prior, arm, other), own)
    space = search_space(arm, start, SETTINGS["bounds"], ["offset"], other)
    np.testing.assert_allclose(space.block(space.upper, "offset"), SETTINGS["bounds"]["offset"][1] * largest)
    assert len(Problem.of(*[TorqueResidual(space, other)] * 2, own).sigma) == len(space.start)


def test_a_link_side_sensor_does_not_feel_rotors(arm, start, truth):
    """Measured torque is predicted without armature, motor and commanded torque with it; nobody searches it there."""
    measured = recorded(arm, truth, 2.0, torque="measured", noise=0.0)
    space = parameter_space(arm, start, {"offset": [-5.0, 5.0]})
    heavy = replace(truth, armature=10 * ARMATURE)
    for torque, feels in (("measured", False), ("motor", True), ("commanded", True)):
        residual = TorqueResidual(space, replace(measured, torque=torque))
        moved = residual.predict(heavy) - residual.predict(truth)
        np.testing.assert_allclose(moved, 9 * ARMATURE * residual.motion.ddq * feels, atol=1e-9)
    terms = ["offset", "armature", "gain", "delay"]
    own = {"measured": {"offset", "gain"}, "motor": {"offset", "armature", "gain"}}
    for torque, names in (own | {"commanded": {"offset", "armature", "delay"}}).items():
        found = search_space(arm, start, SETTINGS["bounds"], terms, replace(measured, torque=torque))
        assert set(terms) & set(found.blocks) == names


def test_the_gain_of_a_motor_is_that_of_its_torque_constant(arm, start, truth):
    """All of the torque is wrong by it: 1 + gain times friction, rotors and links."""
    motor = recorded(arm, truth, 2.0, noise=0.0)
    residual = TorqueResidual(parameter_space(arm, start, {"offset": [-5.0, 5.0]}), motor)
    gain = np.array([0.1, -0.05, 0.2])
    predicted = residual.predict(replace(truth, gain=gain))
    np.testing.assert_allclose(predicted, (1 + gain) * residual.predict(truth), rtol=1e-12)


def test_the_jacobian_of_every_block_is_that_of_differences(arm, start, motion):
    """`change` against one evaluation per value, rotors, payload and gain included."""
    terms = ["offset", "link", "payload", "armature", "gain", "load", "drag_sin", "drag_cos"]
    space = search_space(arm, start, SETTINGS["bounds"], terms, motion)
    residual = TorqueResidual(space, motion)
    u = np.clip(space.to_unit(space.start) + 0.02, 0.0, 1.0)
    x, stepped = space.from_unit(u), space.from_unit(u + 1e-3)
    one_by_one = np.where(np.eye(len(x), dtype=bool), stepped, x)
    expected = (residual(one_by_one) - residual(x[None])).T
    np.testing.assert_allclose(residual.change(x, stepped), expected, atol=1e-9 * np.abs(expected).max())


@pytest.mark.long
@pytest.mark.parametrize("payload", [0.0, PAYLOAD])
def test_a_payload_is_distinguished_from_the_links(arm, start, truth, payload):
    """Of links and payload, both searched, only what motion left out needs is kept: a payload, or neither."""
    recording = recorded(arm, truth, 4.0, payload=payload)
    terms = ["offset", "link", "payload", "armature"]
    result = found_in(arm, start, recording, terms=terms, prunable_terms=["payload", "link"], folds=3)
    blocks = set(result.space.blocks)
    assert "link_alpha" not in blocks
    assert ("payload_mass" in blocks) == (payload > 0)
    np.testing.assert_array_equal(result.dynamics.mass[:-1], arm.mass[:-1])
    if payload:
        d, m = result.dynamics, arm.mass[-1]
        moment = d.mass[-1] * d.com[-1] - m * arm.com[-1]
        np.testing.assert_allclose(moment, PAYLOAD * PLACE, atol=0.05 * np.linalg.norm(PAYLOAD * PLACE))


def test_rotors_move_the_simulated_arm(arm, start):
    """An arm whose dynamics have rotors moves as one whose MJCF has them; each of a batch has its own."""
    quiet = replace(start, phi=0 * start.phi)
    ours = replace(quiet, armature=np.stack([ARMATURE, arm.armature]))
    np.testing.assert_allclose(arm.armature, [0.2, 0.2, 0.0])
    sim = Simulator(arm, ours, 2, 1)
    sim.reset(np.zeros((2, 3)), np.zeros((2, 3)))
    tau = np.tile([3.0, -2.0, 1.0], (2, 100, 1))
    q = sim.rollout(tau)["qpos"][:, -1]
    for k, armature in enumerate(ours.armature):
        model = arm.model(gravity=False)
        model.dof_armature[:] = armature
        mujoco.mj_setConst(model, mujoco.MjData(model))
        data = mujoco.MjData(model)
        for step in tau[k]:
            data.qfrc_applied[:] = step
            mujoco.mj_step(model, data)
        np.testing.assert_allclose(q[k], data.qpos, atol=1e-12)
        np.testing.assert_array_equal(single_arm(arm, ours.one(k)).dof_armature, armature)
    state = sim.state()
    sim.set_dynamics(quiet)
    sim.set_state(state)
    assert np.array_equal(sim.batch.expand("dof_armature"), ours.armature)


def test_rotors_go_where_the_arm_goes(arm, truth, tmp_path, start):
    """Through draws, parameters.yaml and the MJCF that is written; SDF cannot say them and is left out."""
    drawn = UniformRandomization(arm, truth, 0.1, 0.05)(np.random.default_rng(0), 4)
    np.testing.assert_array_equal(drawn.armature, ARMATURE)
    write_description(tmp_path, arm, truth)
    assert {p.name for p in tmp_path.iterdir()} == {"arm.xml", "arm.urdf"}
    np.testing.assert_allclose(load_robot(str(tmp_path / "arm.xml")).armature, ARMATURE)
    space = parameter_space(arm, start, {"armature": [0.0, 5.0], "payload_mass": [0.0, 5.0], "payload_z": [-1, 1]})
    x = np.array([*ARMATURE, PAYLOAD, 0.3])
    estimate = type("Found", (), {"x": x, "low": x, "high": x, "identifiable": x > 0, "samples": x[None]})
    save_parameters(tmp_path / "parameters.yaml", space, estimate, {})
    again, values = load_parameters(tmp_path, arm)
    np.testing.assert_allclose(again.dynamics(values).armature, ARMATURE)
    np.testing.assert_allclose(again.dynamics(values).mass - arm.mass, [0, 0, PAYLOAD], atol=1e-12)
    np.testing.assert_allclose(again.nominal.armature, arm.armature)


def test_spare_terms_are_terms():
    """An unknown one gets one line; leaving motion out needs two folds, but only where a spare term is searched."""
    with pytest.raises(UserError, match=r"^identify\.prunable_terms: unknown term 'lnk'; .*did you mean 'link'"):
        settings(prunable_terms=["lnk"])
    with pytest.raises(UserError, match=r"^identify\.folds: 1 is too few"):
        settings(prunable_terms=["link"], folds=1)
    settings(terms=["offset"], prunable_terms=["link"], folds=1)


def log(path, **change):
    """Write a log of a motor torque of three joints."""
    t = 1e-3 * np.arange(50)
    q = np.sin(t)[:, None] * np.arange(1, 4)
    columns = {"t": t, "q": q, "dq": np.cos(t)[:, None] * np.arange(1, 4), "tau_motor": 10 * q + 1.0} | change
    np.savez(path, **{k: v for k, v in columns.items() if v is not None})
    return path


def test_currents_with_their_constants_are_torque(tmp_path):
    """A (T, n) current, one column per joint or named otherwise; a constant per joint, or one for all."""
    torque = read(log(tmp_path / "torque.npz"), torque="motor")
    assert torque.torque == "motor"
    constant = np.array([8.5, -11.0, 2.0])
    current = torque.tau / constant
    for name in ("current", "i"):
        path = log(tmp_path / f"{name}.npz", tau_motor=None, **{name: current})
        np.testing.assert_allclose(read(path, torque="motor", torque_constant=constant).tau, torque.tau, rtol=1e-14)
    apart = {f"my_current_{j}": current[:, j] for j in range(3)}
    path = log(tmp_path / "apart.npz", tau_motor=None, **apart)
    columns = {"tau": "my_current"}
    found = read(path, torque="motor", torque_constant=constant.tolist(), columns=columns)
    np.testing.assert_allclose(found.tau, torque.tau, rtol=1e-14)
    np.testing.assert_allclose(
        read(path, torque="motor", torque_constant=3, columns=columns).tau, 3 * current, rtol=1e-14
    )
    found.save(tmp_path / "saved.npz")
    np.testing.assert_array_equal(read(tmp_path / "saved.npz", torque="motor").tau, found.tau)


WRONG = [
    ({}, {}, "column 'current' is a current: set data.torque_constant="),
    ({}, {"columns": {"tau": "current"}}, "column 'current' is a current: set data.torque_constant="),
    ({}, {"torque_constant": [1.0, 2.0]}, "data.torque_constant: expected 3 values, one per joint, got 2"),
    ({}, {"torque_constant": [1.0, np.nan, 2.0]}, "data.torque_constant: expected finite Nm/A other than 0"),
    ({}, {"torque_constant": [1.0, 0.0, 2.0]}, "data.torque_constant: expected finite Nm/A other than 0"),
    ({}, {"torque_constant": "a few"}, "data.torque_constant: expected a number of Nm/A or one per joint, got a few"),
    (
        {},
        {"torque_constant": 1.0, "torque": "measured"},
        "data.torque_constant: expected null unless data.torque=motor",
    ),
    ({"tau_motor": 1.0}, {"torque_constant": 1.0}, "no column 'current' for tau (motor torque)"),
    ({"tau_motor": 1.0}, {"torque_constant": 1.0}, "if tau_motor is in Nm, leave data.torque_constant null"),
    ({"tau_motor": 1.0}, {"torque": "measured"}, "tau_motor is motor torque (set data.columns.tau)"),
    ({"tau_motor": 1.0}, {"torque": "moter"}, "unknown torque 'moter'; allowed: measured, commanded, motor; did you"),
    ({"tau_motor": 0.0}, {}, "is 0 in every row: this log holds no motor torque"),
]


@pytest.mark.parametrize(("change", "how", "said"), WRONG)
def test_a_wrong_current_is_named_in_one_line(tmp_path, change, how, said):
    columns = {k: np.full((50, 3), v) for k, v in change.items()} or {"tau_motor": None, "current": np.ones((50, 3))}
    path = log(tmp_path / "log.npz", **columns)
    with pytest.raises(UserError) as error:
        read(path, **{"torque": "motor"} | how)
    assert said in str(error.value)
    assert "\n" not in str(error.value)


def late(recording, *, dq_s=0.0, tau_rows=0):
    """Return a recording whose dq is behind a first-order filter of dq_s, and whose torque comes some rows late."""
    dq, tau = recording.dq.copy(), recording.tau
    factor = -np.expm1(-1e-3 / dq_s) if dq_s else 1.0
    for k in range(1, len(dq)):
        dq[k] = dq[k - 1] + factor * (dq[k] - dq[k - 1])
    tau = np.concatenate([np.repeat(tau[:1], tau_rows, axis=0), tau[: len(tau) - tau_rows]])
    return replace(recording, dq=dq, tau=tau)


@pytest.mark.long
@pytest.mark.parametrize("lateness", [{}, {"dq_s": 0.01}, {"tau_rows": 8}, {"dq_s": 0.01, "tau_rows": 8}])
def test_a_late_signal_does_not_go_into_the_rotors(arm, start, motion, lateness):
    """With dq behind a filter of 10 ms and torque 8 ms late, rotors and torque delay are within their intervals."""
    recording = late(motion, **lateness)
    own = found_in(arm, start, recording, terms=["offset", "armature", "signal_delay"], prior={"signal_delay": 0.004})
    rotors, delay = (own.space.where(name) for name in ("armature", "signal_delay"))
    true = np.append(ARMATURE, 1e-3 * lateness.get("tau_rows", 0))
    at = np.append(rotors, delay)
    half = 0.5 * (own.found.high - own.found.low)[at]
    assert np.all(np.abs(own.x[at] - true) < 1.5 * half)  # of eight intervals at 95 % one may miss narrowly
    assert np.all(half < np.append(0.1 * ARMATURE, 1e-3))


def test_the_lateness_of_dq_is_found(motion):
    """Noise of the sensor is no lateness, 10 ms of a filter or a delay are 10 ms, another scale is another signal.

    The corrected velocity is then within 1 % of the derivative of q, where 10 ms are 4 % and more.
    """
    noisy = replace(motion, dq=motion.dq + 3e-3 * np.random.default_rng(0).standard_normal(motion.dq.shape))
    np.testing.assert_array_equal(lateness(noisy, 10.0).sure, 0.0)
    delayed = replace(motion, dq=np.concatenate([np.repeat(motion.dq[:1], 10, axis=0), motion.dq[:-10]]))
    for recording, filtered in (late(motion, dq_s=0.01), True), (delayed, False):
        found, smooth = lateness(recording, 10.0), recording.smooth(10.0)
        np.testing.assert_allclose(found.sure, 0.01, rtol=0.05)
        assert found.filtered == filtered
        inside, slope = slice(200, -200), smooth.derivative(smooth.q)
        for dq, small in (found.corrected(smooth), True), (smooth.dq, False):
            error = np.sqrt(((dq - slope)[inside] ** 2).mean(0) / (slope[inside] ** 2).mean(0))
            assert np.all((error < 0.01) == small)
    other = lateness(replace(motion, dq=motion.dq * [1.0, 1.2, 1.0]), 10.0)
    assert np.isnan(other.sure).tolist() == [False, True, False]
