"""The elastic variant of twin: exact static friction, oscillating elastic gears, a clock with jitter."""

import json
import subprocess
import sys
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from r2s.arm.interface import Arm
from r2s.arm.twins import elastic_joints as ej
from r2s.arm.twins.elastic_twin import ElasticTwin
from r2s.arm.twins.make_twin import make_twin
from r2s.arm.twins.rigid_twin import RigidTwin
from r2s.errors import UserError
from r2s.physics.rigid_body import Kinematics
from r2s.physics.robot import load_robot

ROOT = Path(__file__).parent.parent
PUSH = np.array([4, 5, 3.5, 4, 1.6, 1.0, 0.5])  # Nm
HZ = 1.4 * np.array([1.1, 0.9, 1.3, 1.7, 2.3, 1.9, 2.1])


@cache
def panda():
    return load_robot(
        q_home=[0, -0.785, 0, -2.356, 0, 1.571, 0.785],
        dq_max=[2.175] * 4 + [2.61] * 3,
        ddq_max=[15, 7.5, 10, 12.5, 15, 20, 20],
        tau_max=[87] * 4 + [12] * 3,
    )


def sway(arm, cycles):
    """Command a sine wave on every joint; return the states, (cycles, 4, n)."""
    arm.move_to(arm.robot.q_home)
    rows = []
    for k in range(cycles):
        s = arm.read()
        rows.append([s.q, s.dq, s.tau_J, s.tau_J_d])
        arm.command(PUSH * np.sin(2 * np.pi * HZ * k * 1e-3))
    return np.array(rows)


def silent(arm):
    """Return the arm with quantised sensors without noise."""
    arm._hidden[ej.NOISE_Q : ej.NOISE_TAU + 1] = 0
    return arm


def friction_free(arm):
    """Return the torque on the motors without friction, (n,) Nm."""
    p, s = arm._hidden, arm._state
    gear = p[ej.STIFF] * (s[ej.THETA] - s[ej.LINK_Q]) + p[ej.GEAR] * (s[ej.W] - s[ej.LINK_V])
    return s[ej.MOTOR] + p[ej.OFFSET] - gear


def edges(arm, side):
    """Return the motors' breakaway torque against motion to this side, (n,) Nm."""
    p, s = arm._hidden, arm._state
    gear = p[ej.STIFF] * (s[ej.THETA] - s[ej.LINK_Q])
    edge = [ej.level(p, 0.0, gear[i], side, i) for i in range(arm.robot.n)]
    factor = [ej.warmth(p, s[ej.HEAT, i], i) * ej.ripple(p, s[ej.THETA, i], i) for i in range(arm.robot.n)]
    return np.array(edge) * factor


def test_equal_seeds_are_bit_identical_and_other_seeds_differ():
    arm: Arm = make_twin(panda(), variant="elastic", seed=3)
    first, again, other = (sway(a, 300) for a in (arm, ElasticTwin(panda(), 3), ElasticTwin(panda(), 4)))
    assert np.array_equal(first, again)
    assert np.abs(first[-1, 0] - other[-1, 0]).max() > 1e-3
    assert np.array_equal(ElasticTwin(panda(), 3, noise=1)._hidden, arm._hidden)
    assert not np.array_equal(sway(ElasticTwin(panda(), 3, noise=1), 3), first[:3])
    assert isinstance(make_twin(panda()), RigidTwin)
    with pytest.raises(UserError, match=r"arm\.variant: 'plastic'; allowed: rigid, elastic"):
        make_twin(panda(), variant="plastic")


def test_steps_are_fine_enough():
    """0.35 s of open loop with stick and slip end as with steps a quarter as long."""
    ends = []
    for steps in (1, 4):
        arm = ElasticTwin(panda(), 0)
        arm._steps *= steps
        sway(arm, 350)
        ends.append(arm._state[ej.LINK_Q].copy())
    assert np.abs(ends[0] - panda().q_home).max() > 0.1
    np.testing.assert_allclose(*ends, atol=2e-6)


@pytest.mark.parametrize("seed", range(10))
def test_friction_stays_dissipative_under_compensation(seed):
    """At any speed, warm and at the lowest ripple, friction exceeds the control box's compensation."""
    p = ElasticTwin(panda(), seed)._hidden
    for i in range(7):
        for speed in np.geomspace(1e-4, panda().dq_max[i], 40):
            added = p[ej.HELP, i] * np.tanh(speed / p[ej.HELP_WIDTH, i]) + p[ej.HELP_VISCOUS, i] * speed
            least = (1 - p[ej.FALL, i]) * (1 - p[ej.RIPPLE : ej.RIPPLE + 3, i].sum())
            assert added < least * min(ej.level(p, speed, 0.0, side, i) for side in (-1, 1))
            assert p[ej.BREAK, i] > 1.1


@pytest.mark.parametrize(("seed", "warm"), [(0, 0.0), (1, 2.0)])
def test_a_motor_rests_exactly_until_breakaway(seed, warm):
    """A joint moves in the cycle in which the ramped net torque exceeds breakaway, both ways."""
    arm, n = silent(ElasticTwin(panda(), seed)), 7
    arm._loss = -1.0
    for j in range(n):
        for side in (-1.0, 1.0):
            arm._state[ej.HEAT] = warm
            arm.move_to(panda().q_home + 0.01 * j)
            at, tau, free = arm._state[ej.THETA].copy(), np.zeros(n), []
            while arm._state[ej.W, j] == 0.0:
                assert np.array_equal(arm._state[ej.THETA, j], at[j])
                free.append(side * friction_free(arm)[j])
                edge = edges(arm, side)[j]
                tau[j] += side * 0.03 * (j < 4) + side * 0.006
                arm.command(tau)
                assert len(free) < 1000
            within = 0.03 * (j < 4) + 0.006 + 0.01 * edge  # one cycle's step, and the other links' vibration
            assert abs(free[-1] - edge) < within


def test_friction_warms_up_with_motion_and_cools_at_rest():
    arm = ElasticTwin(panda(), 0)
    p, s = arm._hidden, arm._state
    assert np.all((p[ej.COOLING] >= 60) & (p[ej.COOLING] <= 180))
    assert np.all((p[ej.FALL] >= 0.1) & (p[ej.FALL] <= 0.3))
    cold = edges(arm, 1.0)
    p[ej.COOLING] = 0.1  # s
    sway(arm, 300)
    heat = s[ej.HEAT].copy()
    assert heat[:4].min() > 0.01
    arm.move_to(panda().q_home)  # without time passing
    assert np.array_equal(s[ej.HEAT], heat)
    np.testing.assert_allclose(edges(arm, 1.0) / cold, 1 - p[ej.FALL] * (1 - np.exp(-heat / 0.6)), rtol=0.02)
    for _ in range(100):
        arm.command(np.zeros(7))
    still = s[ej.W] == 0.0
    assert still.sum() >= 5
    np.testing.assert_allclose(s[ej.HEAT][still], heat[still] * np.exp(-1), rtol=0.02)


def test_gears_oscillate_at_their_natural_frequency():
    """With resting motors a displaced link oscillates at sqrt(K / M) with the gears' damping."""
    arm = silent(ElasticTwin(panda(), 2))
    p, s = arm._hidden, arm._state
    arm.move_to(panda().q_home)
    arm._gravity(arm._links, panda().q_home)
    mass, root = arm._mass.copy(), np.sqrt(p[ej.STIFF])
    values, vectors = np.linalg.eigh(root[:, None] * np.linalg.inv(mass) * root)
    hz, shape = np.sqrt(values[0]) / 2 / np.pi, vectors[:, 0] / root
    rest, along = s[ej.LINK_Q].copy(), []
    s[ej.LINK_Q] += 1e-5 * shape / np.abs(shape).max()
    for _ in range(400):
        arm.command(np.zeros(7))
        along.append((s[ej.LINK_Q] - rest) @ mass @ shape)  # orthogonal to the other modes
    assert np.all(s[ej.W] == 0.0)
    along = np.array(along)
    crossed = np.flatnonzero((along[:-1] < 0) & (along[1:] >= 0))
    crossed = crossed - along[crossed] / (along[crossed + 1] - along[crossed])
    assert 8 < hz < 40
    assert np.isclose(1e3 / np.diff(crossed).mean(), hz, rtol=0.01)
    fade = 0.5 * (p[ej.GEAR] * shape**2).sum() / (shape @ mass @ shape)  # 1/s, of a weakly damped mode
    first, last = along[30:100].argmax() + 30, along[300:].argmax() + 300
    assert np.isclose(np.log(along[first] / along[last]), fade * (last - first) * 1e-3, rtol=0.1)


def test_each_joint_has_its_own_delay():
    """Motor torque follows a command step after the joint's delay, at most the jitter later."""
    idle, pushed = ElasticTwin(panda(), 0), ElasticTwin(panda(), 0)
    begun = np.full(7, -1)
    for arm in (idle, pushed):
        arm._loss = -1.0
        arm.move_to(panda().q_home)
    for k in range(10):
        idle.command(np.zeros(7))
        pushed.command(np.full(7, 0.5))
        differ = idle._state[ej.MOTOR] != pushed._state[ej.MOTOR]
        begun[differ & (begun < 0)] = k
    delay = idle._hidden[ej.DELAY]
    assert np.all((np.floor(delay) <= begun) & (begun <= np.floor(delay + idle._jitter)))
    assert np.ptp(delay) > 0.5
    assert len(np.unique(delay)) == 7


def test_the_clock_jitters_and_loses_packets():
    """Sensor times vary, commands are late or lost, and t does not show it."""
    arm = silent(ElasticTwin(panda(), 1))
    arm._loss = 0.05
    arm.move_to(panda().q_home)
    kept, ages = 0, []
    for k in range(600):
        tau, before = PUSH * np.sin(2 * np.pi * HZ * k * 1e-3), arm.read().tau_J_d
        arm.command(tau)
        state = arm.read()
        assert state.t == (k + 1) * 1e-3
        lost = np.array_equal(state.tau_J_d, before) and k > 0
        assert lost or np.array_equal(state.tau_J_d, tau)
        kept += lost
        w = arm._state[ej.W, 0]
        if abs(w) > 0.3:
            ages.append((arm._state[ej.THETA, 0] - state.q[0]) / w)
    assert 15 <= kept <= 48  # 30 expected, within 3 deviations of a Bernoulli's
    resolution = 2e-5 / 0.3  # s, of quantisation
    assert -resolution < min(ages) < 2e-4
    assert 0.5e-3 * arm._jitter < max(ages) < 1e-3 * arm._jitter + resolution


def test_the_hand_sags_and_a_payload_pulls_it_down():
    """At rest the motors are at the target and the links lower, by their load over the gears' stiffness."""
    robot = panda()
    arm, loaded = (ElasticTwin(robot, 0, payload=kg, stiffness=1e4) for kg in (0.0, 1.0))
    assert np.array_equal(arm._hidden[ej.STIFF], robot.tau_max * 1e4 / 87)
    begin = arm.move_to(robot.q_home)
    np.testing.assert_allclose(begin.q, robot.q_home, atol=1e-4)
    bent = robot.q_home - arm._state[ej.LINK_Q]
    held = arm._gravity(arm._links, arm._state[ej.LINK_Q])
    assert np.all(np.abs(bent * arm._hidden[ej.STIFF] - held) <= 0.3 + 1e-9)  # the cable's drag is the rest
    loaded.move_to(robot.q_home)
    for _ in range(300):
        arm.command(np.zeros(7))
        loaded.command(np.zeros(7))
    assert np.abs(arm._state[ej.THETA] - robot.q_home).max() == 0.0
    before, after = (Kinematics(robot)(a.read().q)[0][2] for a in (arm, loaded))
    assert after < before - 0.01


def test_too_stiff_gears_are_refused():
    with pytest.raises(UserError, match=r"arm.stiffness: gears of 1e\+12 Nm/rad oscillate at .* Hz on this arm"):
        ElasticTwin(panda(), 0, stiffness=1e12)
    with pytest.raises(UserError, match=r"arm.payload: expected .*, got -1"):
        ElasticTwin(panda(), 0, payload=-1)


@pytest.mark.slow
def test_the_pipeline_runs_on_it(tmp_path):
    """Recording, identification, training, transfer and report; the toy budget learns nothing."""
    overrides = [
        "stage=pipeline",
        "+experiment=toy",
        "pipeline.train_minutes=null",
        "arm.variant=elastic",
        f"root={tmp_path}",
    ]
    done = subprocess.run([sys.executable, "run.py", *overrides], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    summary = json.loads(next(tmp_path.glob("transfer/*/summary.json")).read_text())
    assert summary["twin"]["success_5cm"] >= 0.0
    assert (next(tmp_path.glob("pipeline/*")) / "report.md").is_file()
