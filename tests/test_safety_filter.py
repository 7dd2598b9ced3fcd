"""Safety filter: nearest torque within the bounds, continuous, stable with delays, equal in simulation and driver."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from conftest import conf, unfenced

from r2s.arm.policy_runner import PolicyRunner
from r2s.arm.simulated import SimulatedArm
from r2s.learning.evaluate import fixed_episodes
from r2s.learning.vector_arms import VectorArms
from r2s.physics.dynamics import Dynamics, nominal_dynamics
from r2s.physics.robot import load_robot
from r2s.physics.safety_filter import ADDED, ALLOWED, LATENCY_S, Q_HIGH, RATE, SafetyFilter, filter_limits
from r2s.physics.simulator import Simulator, single_arm
from r2s.tasks.reach import ReachTask
from r2s.tasks.rollout import rollout

PANDA = load_robot(**conf("robot/panda"))
TASK = ReachTask(**{k: tuple(v) if isinstance(v, list) else v for k, v in conf("task/reach").items()})
TORQUE = TASK.torque_limit(PANDA)
FOLLOWS = np.array(conf("task/track")["torque_fraction"]) * PANDA.tau_max  # of a timed path: more of the wrist
ARM = nominal_dynamics(PANDA, **conf("friction/paper"))
MODEL = PANDA.model(gravity=False)
NONE, LEVEL = np.zeros(7), ARM.level
FREE = replace(PANDA, dtau_max=np.full(7, 1e9))  # the rate limit is another rule


def some_states(count, seed=0):
    """Return q, dq, effort (count, 7), many of them near limits."""
    rng = np.random.default_rng(seed)
    q = rng.uniform(PANDA.q_min + 0.05, PANDA.q_max - 0.05, (count, 7))
    return q, 0.45 * PANDA.dq_max * rng.normal(size=(count, 7)), TORQUE * rng.uniform(-1, 1, (count, 7))


def inertia(safety_filter):
    """Return the (7, 7) mass matrix, with added inertia, of the last call of a filter."""
    out, rows = np.zeros((7, 7)), np.tril_indices(7)
    out[rows] = safety_filter._data.M
    return out + np.tril(out, -1).T + np.diag(safety_filter._limits[:, ADDED])


def test_the_nearest_torque_that_keeps_to_the_bounds():
    """Accelerations are within their bounds, a joint is pushed only at a bound, only inwards: the nearest's KKT."""
    safety_filter, pushed = SafetyFilter(MODEL, FREE, TORQUE, NONE), 0
    for q, dq, effort in zip(*some_states(400), strict=True):
        q = np.clip(q, PANDA.q_min + 0.1, PANDA.q_max - 0.1)
        dq = np.clip(dq, -ALLOWED * PANDA.dq_max, ALLOWED * PANDA.dq_max)  # nothing fades
        push = safety_filter(q, dq, effort, np.zeros(7)) - effort
        if (np.abs(push + effort) >= PANDA.tau_max).any():
            continue
        ddq = np.linalg.solve(inertia(safety_filter), effort + push - safety_filter._data.qfrc_bias)
        most = ALLOWED * PANDA.dq_max
        up = np.minimum(most, 0.25 * RATE * (PANDA.q_max - 0.1 - q))
        down = np.minimum(most, 0.25 * RATE * (q - PANDA.q_min - 0.1))
        high, low = RATE * (up - dq), -RATE * (down + dq)
        assert np.all((ddq <= high + 1e-6) & (ddq >= low - 1e-6))
        at = np.where(push < 0, high, low)
        assert np.all((push == 0) | (np.abs(ddq - at) < 1e-6))
        pushed += (push != 0).any()
    assert 100 < pushed < 400


def test_friction_is_no_motion():
    """A wrist at half its speed keeps the torque for its friction; a filter without that friction reduces it."""
    dq, effort = 0.6 * PANDA.dq_max * np.eye(7)[4], 1.3 * np.eye(7)[4]
    knows, blind = SafetyFilter(MODEL, FREE, FOLLOWS, 2 * LEVEL), SafetyFilter(MODEL, FREE, FOLLOWS, NONE)
    np.testing.assert_array_equal(knows(PANDA.q_home, dq, effort, np.zeros(7)), effort)
    assert blind(PANDA.q_home, dq, effort, np.zeros(7))[4] < 0.9 * effort[4]


def test_efforts_far_from_limits_pass_unchanged():
    """Far from all limits the command equals the effort, bit for bit."""
    safety_filter = SafetyFilter(MODEL, FREE, TORQUE, NONE)
    for seed in range(20):
        _, dq, effort = (x[0] for x in some_states(1, seed))
        assert np.array_equal(safety_filter(PANDA.q_home, 0.2 * dq, 0.3 * effort, np.zeros(7)), 0.3 * effort)
    assert safety_filter.changed == 0


@pytest.mark.parametrize("torque", [TORQUE, FOLLOWS], ids=["reach", "track"])
def test_an_action_from_rest_is_allowed(torque):
    """At rest at home a full action of any one joint passes unchanged."""
    safety_filter = SafetyFilter(MODEL, FREE, torque, 2 * LEVEL)
    for j in range(7):
        effort = (1 - 1e-9) * (torque * np.eye(7)[j])
        np.testing.assert_array_equal(safety_filter(PANDA.q_home, np.zeros(7), effort, np.zeros(7)), effort)


def test_a_limited_rate_keeps_to_the_bounds():
    """On the way from one command to another no joint accelerates more than with either: rule 2 holds on it too.

    Limited joint by joint, the torques of joints 1 and 3, whose axes are nearly parallel, would come apart by up to a
    Nm a cycle: 100 rad/s^2 after ten.
    """
    free, safety_filter, far = SafetyFilter(MODEL, FREE, TORQUE, NONE), SafetyFilter(MODEL, PANDA, TORQUE, NONE), 0
    all_q, all_dq, efforts = some_states(400, 2)
    for q, dq, one, other in zip(all_q, all_dq, efforts, np.roll(efforts, 1, 0), strict=True):
        last, wanted = (free(q, dq, x, np.zeros(7)) for x in (one, other))
        sent = safety_filter(q, dq, other, last)
        assert np.all(np.abs(sent - last) <= 1e-3 * PANDA.dtau_max + 1e-12)
        now, before, after = (np.linalg.solve(inertia(safety_filter), x) for x in (sent, last, wanted))
        assert np.all((now >= np.minimum(before, after) - 1e-6) & (now <= np.maximum(before, after) + 1e-6))
        far += np.any(np.abs(wanted - last) > 2e-3 * PANDA.dtau_max)
    assert far > 100


def test_it_is_continuous():
    """A step of 1e-7 in the state or in what is asked for changes the command in proportion, wherever it is taken.

    The bound is the law's steepest slope: it fades all torque within 0.2 of a velocity limit or 0.06 rad, the push
    has RATE^2 / 4 times the inertia per rad and RATE times it per rad/s, and the nearest torque of a convex set moves
    no further than what is asked for, in the norm of the inertia, whose condition here is below 1000.
    """
    safety_filter, step = SafetyFilter(MODEL, FREE, TORQUE, NONE), 1e-7
    slopes = np.array([TORQUE.max() / 0.06 + RATE**2, TORQUE.max() / (0.2 * 2.175) + 2 * RATE, 1.0])
    for q, dq, effort in zip(*some_states(200, 1), strict=True):
        one = safety_filter(q, dq, effort, np.zeros(7))
        for k, slope in enumerate(slopes):
            moved = [q.copy(), dq.copy(), effort.copy()]
            moved[k] += step * np.random.default_rng(k).choice([-1, 1], 7)
            assert np.abs(safety_filter(*moved, np.zeros(7)) - one).max() <= step * 1000**0.5 * 7 * slope


def test_the_rate_tolerates_the_latency():
    """X' = -RATE x(t - LATENCY_S) does not overshoot; twice the rate does."""

    def lowest(rate):
        h, x = 1e-5, [1.0] * (round(LATENCY_S / 1e-5) + 1)
        for _ in range(40_000):
            x.append(x[-1] - h * rate * x[-1 - round(LATENCY_S / h)])
        return min(x)

    assert lowest(RATE) > -0.01
    assert lowest(2 * RATE) < -0.05


@pytest.mark.long
@pytest.mark.parametrize("delay", [0.0, 2.5e-3, 5e-3, 8e-3])
def test_no_chattering(delay):
    """Pinned against speed limits, then against a position limit, commands come to rest for any delay of an arm."""
    dynamics = replace(ARM, delay=delay, lag=3e-3)
    sim = Simulator(PANDA, dynamics, 14, 1)
    sim.drive(filter_limits(PANDA, TORQUE))
    sim.reset(np.tile(PANDA.q_home, (14, 1)), np.zeros((14, 7)))
    effort = np.concatenate([np.diag(TORQUE), -np.diag(TORQUE)])
    sent = []
    for _ in range(2500):
        sim.rollout(effort[:, None], record=())
        sent.append(sim.tau.copy())
    assert sim.limited.mean() > 0.1
    late = np.array(sent)[1000:]
    spectrum = np.abs(np.fft.rfft((late - late.mean(0)) * np.hanning(len(late))[:, None, None], axis=0)) / len(late)
    hz = np.fft.rfftfreq(len(late), 1e-3)
    assert (spectrum[hz > 20].max((0, 1)) < 0.005 * TORQUE).all()
    q, high = sim.q, filter_limits(PANDA, TORQUE)[:, Q_HIGH]
    assert np.all(q < PANDA.q_max)
    assert np.any(np.abs(q - high) < 0.06)


class Mixed:
    """Pulls hands to their goals, some of them hard, some at full torque."""

    def action(self, observation):
        """Return actions (B, 7), row by row: a batch and one arm get the same to the bit."""
        seen = observation.numpy().astype(np.float64)
        action = np.clip(3.0 * seen[:, 40:47] - 0.05 * seen[:, 7:14], -1.0, 1.0)
        hard = np.round(1e3 * seen[:, 19]).astype(int) % 3 == 0
        action[hard] = np.array([1.0, -1.0, 1.0, -1.0, 1.0, -1.0, 1.0])
        return torch.from_numpy(action)


@pytest.mark.long
@pytest.mark.parametrize(("soft_start_s", "rotors"), [(0.0, 0.0), (0.3, 2e-3)])
def test_the_simulation_as_trained_in_is_the_arm_behind_the_driver(soft_start_s, rotors):
    """The same law inside the physics step and in the driver: states and commands agree to round-off, limits or not.

    Rotors (kg m^2 per Nm of a joint's torque) are those that were identified, on either side.

    Round-off of 1e-16 grows with the divergence of the motion, below exp(5 s^-1 t) here: 1e-12 in 1.5 s.
    """
    task, count = unfenced(PANDA, replace(TASK, episode_s=1.5)), 6
    dynamics = replace(ARM, delay=4e-3, lag=1e-3, armature=rotors * PANDA.tau_max)
    starts, goals = fixed_episodes(PANDA, task, count)
    goals[:, 2] = (np.floor(goals[:, 2] * 333) * 3 + np.arange(count) % 3) / 1e3
    one = rollout(Mixed(), VectorArms(PANDA, task, dynamics, count, 1, soft_start_s), task, starts, goals)
    arm = SimulatedArm(PANDA, dynamics, position_noise=0.0, velocity_noise=0.0)
    driven = PolicyRunner(arm, task, dynamics.level, soft_start_s=soft_start_s, rotors=dynamics.armature)
    other = rollout(Mixed(), driven, task, starts, goals)
    assert driven.stops == []
    assert one.limited.max() > 0.3
    for name, bound in {"q": 1e-12, "dq": 1e-10, "tau": 1e-9, "limited": 2 / 1500}.items():
        np.testing.assert_allclose(getattr(one, name), getattr(other, name), rtol=0, atol=bound)


@pytest.mark.parametrize("name", ["panda", "ur10e"])
def test_the_filter_inside_the_step_is_safety_filter(name):
    """The command of the physics step equals that of `SafetyFilter`, for 7 joints (unrolled code) and for 6.

    Both solve with an inertia of MuJoCo's, so they agree to round-off, limited or not.
    """
    robot, count = load_robot(**conf(f"robot/{name}")), 64
    dynamics = Dynamics.of(robot, np.tile([1.0, 20.0, 0.0], (robot.n, 1)))
    torque = robot.tau_max * 0.3
    rng = np.random.default_rng(0)
    q = robot.q_home + 0.5 * rng.normal(size=(count, robot.n))
    dq, effort = 0.3 * robot.dq_max * rng.normal(size=q.shape), torque * rng.uniform(-1, 1, q.shape)
    simulator = Simulator(robot, dynamics, count, 1)
    simulator.drive(filter_limits(robot, torque))
    simulator.reset(q, dq)
    simulator.rollout(effort[:, None])
    safety_filter = SafetyFilter(single_arm(robot, dynamics), robot, torque, dynamics.level)
    sent = np.array([safety_filter(q[k], dq[k], effort[k], np.zeros(robot.n)) for k in range(count)])
    assert 0 < simulator.limited.sum() == safety_filter.changed < count
    np.testing.assert_allclose(simulator.tau, sent, rtol=0, atol=1e-9)
