"""The stiffness of gears is identified from slow slides under a multisine torque."""

import sys
from dataclasses import replace

import numpy as np
import pytest
from cli_runs import r2s
from conftest import ROOT, conf

from r2s.arm.gear_motions import check_gear_motions, record_gear_motions
from r2s.arm.interface import ArmStopped
from r2s.arm.simulated import SimulatedArm
from r2s.arm.twins.elastic_joints import STIFF
from r2s.arm.twins.elastic_twin import ElasticTwin
from r2s.errors import UserError
from r2s.excitation.motion_checks import check_derivatives, check_motion
from r2s.excitation.multisine import (
    LINES_HZ,
    PERIOD_S,
    RATE_SHARE,
    SPEED,
    TORQUE_SHARE,
    gear_motion,
    multisine,
    slides,
)
from r2s.identification.contact.surface_space import SurfaceSpace, identified_gears, unknown_gears
from r2s.identification.gears.estimate import DEFLECTION, gear_problem, identify_gears
from r2s.identification.gears.gears_file import load_gears, save_gears
from r2s.identification.gears.response import Drives, Slides, motor_response, slides_of
from r2s.identification.parameter_file import save_parameters
from r2s.identification.parameters import ParameterEstimate
from r2s.physics.dynamics import nominal_dynamics
from r2s.physics.robot import SIM_DT, load_robot
from r2s.recordings.recording import Recording

sys.path.insert(0, str(ROOT / "benchmarks"))
from pressing import estimated_arm

PANDA = load_robot(**conf("robot/panda"))
ROBOTS = ("panda", "fr3", "ur10e", "kinova_gen3", "iiwa14", "xarm7")
NOISE = 1e-5  # rad, of an encoder
ROWS = round(PERIOD_S / SIM_DT)


@pytest.fixture(scope="module")
def arm():
    return estimated_arm(PANDA, 1)


@pytest.fixture(scope="module")
def drives(arm):
    """Vector of drives: gears 25 % softer and 35 % stiffer than expected in turn, and all else unexpected, too."""
    x = np.random.default_rng(3).normal(0.0, 0.7, (8, PANDA.n))
    x[1] = np.log(np.where(np.arange(PANDA.n) % 2, 1.35, 0.75)) / DEFLECTION[1]
    return x.ravel()


@pytest.fixture(scope="module")
def recording(arm, drives):
    return responding(arm, drives)


@pytest.fixture(scope="module")
def found(arm, recording):
    return identify_gears(arm, recording)


def planned():
    """Return a recording of slides without any response to the multisine."""
    q, tau = [], []
    for j in range(PANDA.n):
        motion = gear_motion(PANDA, j)
        wave = multisine(PANDA, j, motion)
        for rows in slides():
            q.append(motion.q[rows])
            tau.append(wave[rows, None] * np.eye(PANDA.n)[j])
    index = np.repeat(np.arange(len(q)), ROWS + 1)
    t = np.tile(np.arange(ROWS + 1) * SIM_DT, len(q)) + index * (PERIOD_S + 1.0)
    q, tau = np.concatenate(q), np.concatenate(tau)
    return Recording(t=t, q=q, dq=np.zeros_like(q), tau=tau, torque="commanded", trajectory=index)


def responding(arm, x):
    """Return slides of an arm with drives x (8 n,), measured with encoder noise."""
    plan = planned()
    spectra = slides_of(plan)
    response = gear_problem(arm.robot, arm.space.dynamics(arm.x), spectra).response(x) * spectra.torque
    wave = np.exp(2j * np.pi * np.outer(np.arange(ROWS + 1) * SIM_DT, LINES_HZ))
    q = plan.q + np.random.default_rng(0).normal(0.0, NOISE, plan.q.shape)
    for stretch, j, lines in zip(plan.stretches, spectra.joint, response, strict=True):
        q[stretch, j] += (wave @ lines).real
    return Recording(plan.t, q, plan.dq, plan.tau, "commanded", plan.trajectory)


@pytest.mark.long
def test_the_stiffness_of_the_gears_is_identified(arm, drives, found):
    """Within three standard deviations for each of seven joints, and within a twentieth for the strong ones.

    The model is exact here, so the residual has the size of the noise: misfits above 1 would be errors of the sigma.
    """
    true = gear_problem(arm.robot, arm.space.dynamics(arm.x), found.slides).drives(drives)
    error = np.log(found.drives.stiffness / true.stiffness)
    assert (np.abs(error) < 3 * found.spread).all()
    assert np.abs(error[:4]).max() < 0.05
    assert found.identifiable.all()
    assert found.misfit.max() < 1.2


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_the_gears_of_an_elastic_twin_are_identified(seed):
    """A plant of its own: stiction, ripple, jitter and lost commands; the arm is the nominal one."""
    twin = ElasticTwin(PANDA, seed, noise=4)
    arm = estimated_arm(PANDA, 1)
    found = identify_gears(replace(arm, x=arm.space.start), record_gear_motions(twin))
    error = np.log(found.drives.stiffness / twin._hidden[STIFF])
    assert (np.abs(error) < 3 * found.spread).all()
    assert np.abs(error[:4]).max() < 0.08


@pytest.mark.long
def test_rigid_gears_are_stiff_or_undetermined(arm, drives):
    """Gears that resonate above all lines: no interval claims a gear softer than half of the true one."""
    x = drives.reshape(8, -1).copy()
    x[1] = np.log(50.0) / DEFLECTION[1]
    found = identify_gears(arm, responding(arm, x.ravel()))
    true = gear_problem(arm.robot, arm.space.dynamics(arm.x), found.slides).drives(x.ravel()).stiffness
    high = np.percentile(found.draws, 97.5, axis=0)
    assert (~found.identifiable | (high > 0.5 * true)).all()


def test_two_inertias_and_a_spring():
    """One joint without damping: the closed form, and its limits for stiff and for soft gears."""
    zero, one = np.zeros(1), np.ones(1)
    lines = len(LINES_HZ)
    own = Slides(np.zeros(1, int), np.zeros((1, 1)), one, np.zeros((1, lines, 1)), np.ones((1, lines)), None)
    mass, s2 = 0.7 * np.ones((1, 1, 1)), -((2 * np.pi * LINES_HZ) ** 2)

    def response(K):
        return motor_response(own, mass, Drives(0.3 * one, K * one, zero, zero, zero, zero, zero))[0]

    K = 2e4
    closed = (0.7 * s2 + K) / (s2 * (0.3 * 0.7 * s2 + (0.3 + 0.7) * K))
    np.testing.assert_allclose(response(K), closed, rtol=1e-9)
    np.testing.assert_allclose(response(1e12), 1 / (1.0 * s2), rtol=1e-5)
    np.testing.assert_allclose(response(1e-6), 1 / (0.3 * s2), rtol=1e-5)
    late = motor_response(own, mass, Drives(0.3 * one, K * one, zero, zero, zero, 2e-3 * one, 1e-3 * one))[0]
    s = 2j * np.pi * LINES_HZ
    np.testing.assert_allclose(late, closed * np.exp(-2e-3 * s) / (1 + 1e-3 * s), rtol=1e-9)


def test_other_motors_that_move_are_accounted_for(arm, drives):
    """The measured motion of another motor changes the predicted response, in the slides in which it moves alone."""
    spectra = slides_of(responding(arm, drives))
    problem = gear_problem(arm.robot, arm.space.dynamics(arm.x), spectra)
    alone = problem.response(drives)
    pushed = np.array(spectra.angles)
    pushed[:4, :, 3] += 1e-4  # another motor moves while joint 1 slides
    other = replace(problem, slides=replace(spectra, angles=pushed)).response(drives)
    assert np.abs(other[:4] / alone[:4] - 1.0).max() > 0.01
    np.testing.assert_array_equal(other[4:], alone[4:])


@pytest.mark.long
@pytest.mark.parametrize("name", ROBOTS)
def test_every_shipped_robot_can_slide(name):
    """The motions pass all checks, slide at a constant speed, and the multisine stays within its shares."""
    robot = load_robot(**conf(f"robot/{name}"))
    check_gear_motions(robot)
    for j in range(robot.n):
        motion = gear_motion(robot, j)
        torque = multisine(robot, j, motion)
        check_derivatives(robot, motion)
        assert np.abs(torque).max() <= TORQUE_SHARE * robot.tau_max[j] * (1 + 1e-9)
        fade = 1.05  # the fade adds a little to the rate
        assert np.abs(np.diff(torque)).max() / SIM_DT <= fade * RATE_SHARE * robot.dtau_max[j]
        assert torque[0] == torque[-1] == 0.0
        for rows in slides():
            np.testing.assert_allclose(np.abs(motion.dq[rows, j]), SPEED * robot.dq_max[j])


def test_the_multisine_has_its_lines_alone():
    """In the steady slides, all power is at LINES_HZ."""
    for rows in slides():
        spectrum = np.abs(np.fft.rfft(multisine(PANDA, 1, gear_motion(PANDA, 1))[rows][:-1]))
        lines = np.round(LINES_HZ * PERIOD_S).astype(int)
        rest = np.delete(spectrum, lines)
        assert rest.max() < 1e-9 * spectrum[lines].min()


def test_a_slow_arm_slides_slowly():
    """Well within its speed limits; the motion begins and ends at rest, and its derivatives agree."""
    for share, speed in ((0.3, SPEED), (0.1, 0.03)):
        motion = gear_motion(PANDA, 5, share)
        assert np.abs(motion.dq).max() == pytest.approx(speed * PANDA.dq_max[5])
        check_motion(PANDA, motion)


BAD = {
    "short": (
        lambda r: rows(r, r.t % (PERIOD_S + 1.0) < 1.0),
        r"trajectory 0 lasts 0\.999 s, expected .* 2 s or more",
    ),
    "slow": (lambda r: rows(r, slice(None, None, 5)), r"trajectory 0: 200 Hz, expected 300 Hz or more"),
    "quiet": (
        lambda r: replace(r, tau=noise(r)),
        r"no slide of joint 1 with the multisine of data\.gears: the lines of its torque exceed their neighbors",
    ),
    "missing": (lambda r: rows(r, r.trajectory // 4 != 4), r"no slide of joint 5 .*: every joint must slide in turn"),
    "gap": (lambda r: rows(r, np.abs(r.t - 1.0) > 4e-3), r"trajectory 0: a gap of 8 ms, allowed up to 4\.2 ms"),
}


def rows(r, some):
    return Recording(*(x[some] for x in (r.t, r.q, r.dq, r.tau)), "commanded", r.trajectory[some])


def noise(recording):
    return np.random.default_rng(0).normal(size=recording.tau.shape)


@pytest.mark.parametrize("what", BAD)
def test_recordings_that_show_no_gears_are_one_line(recording, what):
    change, message = BAD[what]
    with pytest.raises(UserError, match=rf"^data\.gears: .*{message}") as caught:
        slides_of(change(recording))
    assert "\n" not in str(caught.value)


def test_a_few_lost_samples_change_little(recording):
    """One state in a hundred is lost, as r2s accepts of an arm: the lines stay where they are."""
    lost = np.random.default_rng(0).uniform(size=len(recording.t)) < 0.01
    lost[np.flatnonzero(np.diff(recording.trajectory, prepend=-1))] = False  # but not the ends
    lost[np.flatnonzero(np.diff(recording.trajectory, append=-1))] = False
    lost[1:] &= ~lost[:-1]
    whole, some = slides_of(recording), slides_of(rows(recording, ~lost))
    np.testing.assert_array_equal(some.joint, whole.joint)
    error = np.abs(some.response - whole.response) / whole.sigma
    assert np.median(error) < 1.0


@pytest.mark.long
def test_the_file_gives_back_the_gears(tmp_path, found):
    """To six digits; files of another arm, and others, are refused in one line."""
    save_gears(tmp_path / "gears.yaml", PANDA, found, {"run": "here"})
    gears = load_gears(tmp_path, PANDA, "identify.gears.stiffness")
    assert gears["determined"].all()
    np.testing.assert_allclose(gears["stiffness"], found.drives.stiffness, rtol=1e-5)
    np.testing.assert_allclose(gears["spread"], found.spread, rtol=1e-5)
    other = r"^identify\.gears\.stiffness: expected gears of 'iiwa14' \(7 joints\), got 'panda' \(7\) in "
    with pytest.raises(UserError, match=other):
        load_gears(tmp_path, load_robot(**conf("robot/iiwa14")), "identify.gears.stiffness")
    for text in (
        "stiffness: {value: [1, -2], relative_sd: [0.1, 0.1], identifiable: [true, true]}",
        "7",
        "stiffness: 3",
        "a: [",
    ):
        (tmp_path / "gears.yaml").write_text(text)
        with pytest.raises(UserError, match=r"^x: .*gears\.yaml is not a gears\.yaml of r2s \("):
            load_gears(tmp_path, PANDA, "x")


def test_identified_gears_keep_their_variance():
    """Each gear's prior has its own standard deviation, part of which all gears share."""
    spread = np.linspace(0.02, 0.1, PANDA.n)
    all_seen = np.ones(PANDA.n, dtype=bool)
    gears = identified_gears(PANDA.tau_max, stiffness=150.0 * PANDA.tau_max, spread=spread, determined=all_seen)
    np.testing.assert_allclose(gears.scatter**2 + (gears.width / gears.center) ** 2, spread**2)
    space = SurfaceSpace(np.zeros(3), np.eye(3)[2], PANDA.tau_max, gears)
    u, weight = space.prior(9 + PANDA.n)
    np.testing.assert_allclose(space.compliance(u), 1 / (150.0 * PANDA.tau_max))
    assert weight.shape == u.shape
    free = replace(space, gears=unknown_gears(PANDA.n)).prior(9 + PANDA.n)[1]
    assert (weight[8:] > free[8:]).all()


def test_gears_that_slides_did_not_determine_are_like_the_others():
    """Their stiffness in the file counts for nothing; with less than half determined, there is no prior."""
    seen = np.arange(PANDA.n) < 4
    found = {"stiffness": np.where(seen, 150.0, 1.0) * PANDA.tau_max, "spread": np.full(PANDA.n, 0.02)}
    gears = identified_gears(PANDA.tau_max, **found, determined=seen)
    np.testing.assert_allclose(gears.center * gears.shape, 1 / 150.0)
    assert gears.scatter[4:].min() > 10 * gears.scatter[:4].max()
    with pytest.raises(UserError, match=r"^stiffness: slides determined 3 of 7 gears, expected at least half$"):
        identified_gears(PANDA.tau_max, **found, determined=np.arange(PANDA.n) < 3)


@pytest.fixture
def calibration(tmp_path, arm):
    low, high = np.quantile(arm.samples, [0.025, 0.975], axis=0)
    (tmp_path / "run").mkdir()
    estimate = ParameterEstimate(arm.x, low, high, low < high, arm.samples)
    save_parameters(tmp_path / "run" / "parameters.yaml", arm.space, estimate, {"torque": "commanded"})
    return f"calibration={tmp_path / 'run'}", f"root={tmp_path}"


@pytest.mark.long
def test_the_command_writes_gears_from_a_file(tmp_path, calibration, recording, found):
    """The stiffness of the function, a figure, and the arm, so that the folder can be a calibration."""
    speeds = np.gradient(recording.q.reshape(-1, ROWS + 1, PANDA.n), SIM_DT, axis=1).reshape(recording.q.shape)
    replace(recording, dq=speeds).save(tmp_path / "slides.npz")
    words = "data=recording", f"data.gears={tmp_path / 'slides.npz'}", "name=gears"
    done = r2s("stage=identify", *calibration, *words)
    assert done.returncode == 0, done.stderr
    run = tmp_path / "identify" / "gears"
    assert "joint 7" in done.stdout
    assert "gears up to" in r2s("list", "--root", str(tmp_path)).stdout
    assert all((run / name).is_file() for name in ("parameters.yaml", "posterior.npz", "figures/gears.png"))
    gears = load_gears(run, PANDA, "gears")
    # parameters.yaml rounds the arm
    np.testing.assert_allclose(gears["stiffness"], found.drives.stiffness, rtol=1e-4)
    np.testing.assert_allclose(gears["spread"], found.spread, rtol=1e-2)


@pytest.mark.slow
def test_a_stop_keeps_the_finished_joints():
    """The arm stops while joint 2 slides: the exception has the slides of joint 1."""
    arm = SimulatedArm(
        PANDA, nominal_dynamics(PANDA, phi1=1.0, phi2=20.0, phi3=0.0), position_noise=0.0, velocity_noise=0.0
    )
    send, sent = arm.command, []

    def command(tau):
        sent.append(tau)
        if len(sent) > 1.5 * len(gear_motion(PANDA, 0).t):
            raise ArmStopped("a collision reflex")
        send(tau)

    arm.command = command
    with pytest.raises(ArmStopped) as stop:
        record_gear_motions(arm)
    assert np.ptp(stop.value.recording.q, axis=0).argmax() == 0
    assert len(stop.value.recording.stretches) == len(slides())


@pytest.mark.slow
def test_the_command_lets_a_twin_slide(tmp_path, calibration):
    """On an elastic twin, with an arm that was not identified."""
    done = r2s("stage=identify", *calibration, "arm.variant=elastic", "arm.seed=3", "data.gears=true", "name=gears")
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "identify" / "gears" / "gears.npz").is_file()
    gears = load_gears(tmp_path / "identify" / "gears", PANDA, "gears")
    assert (np.abs(np.log(gears["stiffness"] / ElasticTwin(PANDA, 3)._hidden[STIFF])) < 3 * gears["spread"]).all()


WRONG = {
    "data.gears=true": "data.gears: give the arm, identified from free motion, by calibration=RUN_FOLDER",
    "data.gears=true data.presses=6 calibration=x": "data.gears: cannot be combined with data.presses; identify the",
    "data.gears=maybe calibration=x": "data.gears: expected true or false, got 'maybe'",
    "data=recording data.gears=true calibration=x": "data.gears: expected a file with slides, got True",
    "data=recording data.gears=a.npz data.path=b.npz calibration=x": "data.gears: cannot be combined with data.path",
    "data.gears=true data.torque=measured calibration=x": "data.gears: gears need commanded torque",
    "data.gears=true identify.gears.stiffness=1e4 calibration=x": "data.gears: identifies the stiffness that",
    "data=recording data.contact=5 calibration=x": "data.contact: expected a file, got 5",
    "data=recording data.loaded=true calibration=x": "data.loaded: expected a file, got True",
    "data.gears=true identify.gears.accuracy=7 calibration=x": "identify.gears.accuracy: expected a number in",
    "stage=pipeline data.gears=true": "data.gears: stage=pipeline identifies the arm from free motion",
    "data=recording data.gears=nowhere.npz calibration=x": "nowhere.npz",
    "data=recording data.gears=a.npz data.torque=measured calibration=x": "gears need commanded torque",
}


@pytest.mark.parametrize("words", WRONG)
def test_wrong_words_are_one_line(words):
    done = r2s(*(() if "stage=" in words else ("stage=identify",)), *words.split())
    assert done.returncode == 2
    assert WRONG[words] in done.stdout + done.stderr
    assert "Traceback" not in done.stderr
