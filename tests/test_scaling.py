"""An identification fits arms of any size and logs at any rate: what a Panda at 1 kHz made right is nowhere fixed."""

import re
from dataclasses import replace
from functools import cache

import mujoco
import numpy as np
import pytest
from conftest import conf
from test_identify import ARM, TORQUE, run
from test_motor import recorded

from r2s.identification.parameters import logarithmic, sizes
from r2s.identification.terms import blocks_of
from r2s.physics.actuation import Motors
from r2s.physics.dynamics import Dynamics, nominal_dynamics
from r2s.physics.friction import COULOMB, FAMILIES
from r2s.physics.robot import load_robot
from r2s.physics.simulator import Simulator
from r2s.recordings.recording import Recording

BOUNDS = conf("identify/default")["bounds"]
SMALL, LARGE = 0.25, 10.0  # the usual arm of 40 and 20 Nm, scaled to 10 and 5, 400 and 200 Nm
PHI = np.array([0.1, 0.0, 0.01])  # of tau_max: Coulomb torque, asymmetry, viscous coefficient
OFFSET, NOISE = np.array([3e-3, -3e-3, 3e-3]), 2e-3  # of tau_max


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    @cache
    def make(size, file=""):
        """Return an arm of scaled torque limits, masses and tensors; `file`: more attributes of its joints."""

        def scaled(match):
            return f'{match[1]}="{" ".join(str(size * float(x)) for x in match[2].split())}"'

        text = re.sub(r'(mass|diaginertia|actuatorfrcrange)="([^"]*)"', scaled, ARM)
        path = tmp_path_factory.mktemp("arm") / "arm.xml"
        path.write_text(text.replace(' range="-', f' {file} range="-'))
        return load_robot(str(path), ddq_max=15.0)

    return make


def truth_of(robot):
    return replace(Dynamics.of(robot, PHI * robot.tau_max[:, None], COULOMB), offset=OFFSET * robot.tau_max)


def log_of(robot, torque="measured"):
    """Return 4 s of inverse dynamics; as a command without gravity."""
    floating = replace(robot, gravity=np.zeros(3)) if torque == "commanded" else robot
    return recorded(floating, truth_of(robot), 4.0, torque, noise=NOISE * robot.tau_max)


def found_in(robot, recording, **change):
    """Identify friction and offset from a start that knows nothing of the arm."""
    how = {"family": "coulomb", "terms": ["offset", "link"] if recording.torque == "measured" else ["offset"]}
    return run(robot, nominal_dynamics(robot, **conf("friction/uniform")), recording, [TORQUE], **how | change)


@pytest.mark.long
@pytest.mark.parametrize("torque", ["measured", "motor", "commanded"])
def test_an_arm_of_forty_times_the_size_has_forty_times_the_values(arm, torque):
    """In Nm: values, and intervals up to the scatter of 512 draws; friction is that of the truth."""
    by_size = []
    for size in (SMALL, LARGE):
        robot = arm(size)
        found = found_in(robot, log_of(robot, torque))
        at = np.concatenate([found.space.where(name) for name in ("coulomb", "offset")])
        values = np.stack([found.x, found.found.low, found.found.high])
        by_size.append((values / found.space.expand(sizes(robot.tau_max), 1.0))[:, at])
        friction = [COULOMB.level(d.phi, np.ones(3)) for d in (found.dynamics, truth_of(robot))]
        np.testing.assert_allclose(*friction, rtol=0.1)
        assert not found.at_bounds
    np.testing.assert_allclose(by_size[0][0], by_size[1][0], rtol=1e-3, atol=1e-5)
    width = np.ptp(by_size, axis=1)
    np.testing.assert_allclose(width[0], width[1], rtol=0.25, atol=1e-6)


@pytest.mark.long
def test_a_value_at_its_bound_says_so(arm):
    """It is not identifiable, lies in its interval, and one line names key, value and bound."""
    robot = arm(LARGE)
    found = found_in(robot, log_of(robot, "commanded"), bounds=BOUNDS | {"coulomb": [1e-3, 0.05]})
    at, f = found.space.where("coulomb"), found.found
    np.testing.assert_allclose(found.x[at], 0.05 * robot.tau_max)
    assert not f.identifiable[at].any()
    assert (f.low <= found.x).all()
    assert (found.x <= f.high).all()
    lines = [line for line in found.at_bounds if "coulomb" in line]
    assert len(lines) == len(found.note["at_bounds"]) == 3
    assert lines[0] == (
        "identify.bounds.coulomb: coulomb of joint 1 is 20 Nm, its upper bound; the data may want more, so widen it"
    )


@pytest.mark.long
@pytest.mark.parametrize("torque", ["measured", "motor", "commanded"])
def test_friction_of_the_file_is_a_start_and_no_floor(arm, torque):
    """The file has five times the damping and a third of the frictionloss; the rigid model has neither."""
    bare, tau = arm(LARGE), 400.0
    robot = arm(LARGE, f'damping="{5 * PHI[2] * tau}" frictionloss="{PHI[0] * tau / 3}"')
    nominal = nominal_dynamics(robot, **conf("friction/uniform"))
    model = robot.model(gravity=True)
    assert not model.dof_damping.any()
    assert not model.dof_frictionloss.any()
    np.testing.assert_allclose(nominal.phi, [[PHI[0] * tau / 3, 0.0, 5 * PHI[2] * tau]] * 3)
    np.testing.assert_allclose(nominal.breakaway, [[-PHI[0] * tau / 3, PHI[0] * tau / 3]] * 3)
    found = found_in(robot, log_of(bare, torque))
    for speed in (0.2, 1.0):
        levels = [d.friction(np.full(3, speed)) for d in (found.dynamics, truth_of(bare))]
        np.testing.assert_allclose(*levels, rtol=0.05)


@pytest.mark.parametrize("family", FAMILIES, ids=lambda f: f.name)
def test_another_family_keeps_the_viscous_part(family):
    """At 1 rad/s, and beyond the Stribeck velocity, friction is that of Coulomb and viscous friction."""
    phi = np.array([[3.0, 0.0, 2.0]])
    other = family.matched_to(COULOMB, phi)
    np.testing.assert_allclose(family.torque(np.ones(1), other), 5.0, rtol=1e-6)
    if family.name != "sigmoid":  # its viscous term is optional
        np.testing.assert_allclose(family.torque(np.full(1, 2.0), other), 7.0, rtol=1e-6)


def driven(robot, truth, every, seconds=5.0, share=(1.0, 1.0, 1.0)):
    """Return a recording of commands that change every `every` ms, logged when they do; share: of the motion."""
    sim, motors = Simulator(robot, truth, 1, 1), Motors(1, robot.n, truth.delay, truth.lag)
    model, data = robot.model(gravity=False), None
    data, t = mujoco.MjData(model), 1e-3 * np.arange(round(1e3 * seconds))
    w, phase = 2 * np.pi * np.array([0.4, 1.1, 2.3])[:, None], np.arange(9).reshape(3, 3)
    q, dq, tau = np.zeros((3, len(t), 3))
    for k, now in enumerate(t):
        q[k], dq[k] = sim.q[0], sim.dq[0]
        if k % every == 0:
            wave = 0.2 / np.sqrt([1, 2, 4])[:, None] * np.sin(w * now + phase)
            data.qpos, data.qvel, data.qacc = q[k], dq[k], 100 * (share * wave.sum(0) - q[k]) - 10 * dq[k]
            mujoco.mj_inverse(model, data)
            command = data.qfrc_inverse.copy()
        tau[k] = command
        sim.rollout(motors(tau[None, k : k + 1]))
    noise = np.random.default_rng(0).normal(size=q.shape)
    return Recording(*(x[::every] for x in (t, q + 2e-5 * noise, dq, tau)), "commanded")


@pytest.mark.long
@pytest.mark.parametrize("every", [1, 2, 4, 8])
def test_the_delay_of_a_command_does_not_depend_on_the_rate_of_the_log(arm, every):
    """A command in every row is held until the next: 2 ms are found within 0.1 ms at 1000, 500, 250 and 125 Hz."""
    robot = arm(1.0)
    truth = replace(Dynamics.of(robot, np.array([0.02, 0.0, 0.01]) * robot.tau_max[:, None], COULOMB), delay=2e-3)
    found = found_in(robot, driven(robot, truth, every), terms=["offset", "delay"])
    assert 1e3 * float(found.dynamics.delay) == pytest.approx(2.0, abs=0.1)


@pytest.mark.long
@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_a_joint_at_rest_has_no_say_in_family_and_terms(arm):
    """No candidate enters that the arm lacks, and the family is that of the arm: a resting joint has no error."""
    robot, candidates = arm(1.0), conf("identify/default")["candidate_terms"]["commanded"]
    phi = np.array([[0.02, 0.0, 0.01], [0.02, 0.0, 0.01], [0.2, 0.0, 0.01]]) * robot.tau_max[:, None]
    truth = Dynamics.of(robot, phi, COULOMB)
    recording = driven(robot, truth, 1, 8.0, share=np.array([1.0, 1.0, 0.0]))
    assert np.ptp(recording.q[:, 2]) < 1e-3
    found = found_in(robot, recording, family="auto", candidate_terms=candidates)
    assert found.dynamics.family == COULOMB
    assert not {b for term in candidates for b in blocks_of(term)} & set(found.space.blocks)


@pytest.mark.long
@pytest.mark.parametrize("seconds", [2.5, 3.5])
def test_a_log_of_seconds_lets_no_candidate_in(arm, seconds):
    """Its held-out blocks may be too short for windows of sliding; a candidate that improves nothing stays out."""
    robot, candidates = arm(1.0), conf("identify/default")["candidate_terms"]["commanded"]
    truth = Dynamics.of(robot, np.array([0.02, 0.0, 0.01]) * robot.tau_max[:, None], COULOMB)
    found = found_in(robot, driven(robot, truth, 1, seconds), family="auto", candidate_terms=candidates)
    assert found.dynamics.family == COULOMB
    assert not {b for term in candidates for b in blocks_of(term)} & set(found.space.blocks)


@pytest.mark.long
@pytest.mark.parametrize("torque", ["measured", "motor"])
def test_intervals_allow_for_a_removed_term(arm, torque):
    """The file's masses are 10 to 15 % off, and elimination removes them: a payload and gains replace their effect.

    At least 90 % of the intervals hold the truth; those of the selected model alone are too narrow.
    """
    robot, how = arm(1.0), conf("identify/default")
    truth, share = truth_of(robot), 1 / np.array([1.15, 0.9, 1.1])
    wrong = replace(robot, mass=share * robot.mass, inertia=share[:, None, None] * robot.inertia)
    truth = replace(truth, mass=robot.mass, inertia=robot.inertia)
    own = {"terms": how["terms"][torque], "prunable_terms": how["prunable_terms"][torque]}
    found = found_in(wrong, log_of(robot, torque), **own)
    assert "link_alpha" not in found.space.blocks
    true = replace(found.space, nominal=truth).start
    inside = (found.found.low - 1e-9 <= true) & (true <= found.found.high + 1e-9)
    assert inside.mean() >= 0.9


def test_commands_between_the_rows_of_a_slow_log():
    """Held from row to row, or with a stated period interpolated at the rows that the log left out."""
    t, zero = 4e-3 * np.arange(12), np.zeros((12, 1))
    recording = Recording(t, zero, zero, np.arange(12.0)[:, None], "commanded")
    held = recording.resample(1e-3).tau[:, 0]
    np.testing.assert_allclose(held[:9], [0, 0, 0, 0, 1, 1, 1, 1, 2])
    between = replace(recording, command_period=2e-3).resample(1e-3).tau[:, 0]
    np.testing.assert_allclose(between[:6], [0, 0, 0.5, 0.5, 1, 1])
    sensed = replace(recording, torque="measured").resample(1e-3).tau[:, 0]
    np.testing.assert_allclose(sensed[:5], [0, 0.25, 0.5, 0.75, 1])


@pytest.mark.long
@pytest.mark.parametrize("torque", ["measured", "motor"])
def test_identifiable_does_not_depend_on_the_width_of_the_bounds(arm, torque):
    robot = arm(1.0)
    recording, wide = log_of(robot, torque), {}
    for name, (low, high) in BOUNDS.items():
        log = name in logarithmic()
        wide[name] = [low * low / high, high * high / low] if log else [3 * low, 3 * high]
    seen = [found_in(robot, recording, bounds=b).found for b in (BOUNDS, wide)]
    assert seen[0].identifiable.any()
    changed = seen[0].identifiable != seen[1].identifiable
    assert changed.mean() < 0.03  # 512 draws decide on which side of the limit an interval lies
    np.testing.assert_allclose(seen[0].x[:3], seen[1].x[:3], rtol=1e-3)  # Coulomb


@pytest.mark.long
def test_without_a_prior_the_nominal_value_has_no_weight(arm):
    """From another nominal offset the same value, although the prior of the others pulls."""
    robot = arm(1.0)
    recording, values = log_of(robot, "motor"), []
    prior = conf("identify/default")["prior"]["motor"] | {"offset": None}
    for offset in (0.0, 2.0):
        start = nominal_dynamics(robot, **conf("friction/uniform") | {"offset": offset})
        found = run(robot, start, recording, [TORQUE], family="coulomb", terms=["offset"], prior=prior)
        values.append(found.space.block(found.x, "offset"))
    np.testing.assert_allclose(*values, atol=1e-3)
