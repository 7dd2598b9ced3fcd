"""What joints feel of their commands: a pure delay, fractions of a step included, and a first-order lag."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from conftest import conf
from hypothesis import given, settings
from hypothesis import strategies as st

from r2s.arm.simulated import SimulatedArm
from r2s.learning.env import TaskEnv
from r2s.physics.actuation import MAX_DELAY, Motors
from r2s.physics.dynamics import nominal_dynamics
from r2s.physics.robot import SIM_DT
from r2s.tasks.reach import ReachTask


def noise(m, steps, n=3, seed=0):
    return np.random.default_rng(seed).normal(size=(m, steps, n))


def held(tau):
    """Return what a simulated arm feels of commands that are not delayed: half of it comes with the next step."""
    before = np.concatenate([np.zeros_like(tau[:, :1]), tau[:, :-1]], 1)
    return 0.5 * (tau + before)


def test_without_delay_and_lag_commands_come_half_a_step_late():
    """Which makes up for the half step that a semi-implicit step answers early."""
    tau = noise(2, 30)
    np.testing.assert_allclose(Motors(2, 3)(tau), held(tau), rtol=0, atol=1e-15)


@pytest.mark.parametrize(("delay", "lag"), [(0.0, 0.0), (2.3e-3, 0.0), (1.7e-3, 1.1e-3), (0.0, 4e-3)])
def test_a_simulated_mass_moves_as_one_whose_time_is_continuous(delay, lag):
    """Steps of 1 ms end where the exact motion is, to a hundredth of what half a millisecond would do."""
    fine, steps = 400, 400
    t = SIM_DT * np.arange(steps)
    tau = np.sin(2 * np.pi * 3 * t) + 0.5 * np.sin(2 * np.pi * 11 * t + 1) - 0.5 * np.sin(1)
    late = np.floor((np.arange(steps * fine) + 0.5) / fine - delay / SIM_DT).astype(int)
    force, h = np.where(late >= 0, tau[np.maximum(late, 0)], 0.0), SIM_DT / fine
    if lag:
        state, factor = 0.0, -np.expm1(-h / lag)
        for k, u in enumerate(force):
            middle = state + (u - state) * -np.expm1(-0.5 * h / lag)
            state += factor * (u - state)
            force[k] = middle
    speed = h * np.concatenate([[0.0], np.cumsum(force)])
    place = np.concatenate([[0.0], np.cumsum(h * (speed[:-1] + 0.5 * h * force))])[::fine]
    velocity, q = 0.0, [0.0]
    for u in Motors(1, 1, delay, lag)(tau[None, :, None])[0, :, 0]:
        velocity += SIM_DT * u
        q.append(q[-1] + SIM_DT * velocity)
    assert np.abs(np.array(q) - place).max() < 0.01 * 0.5 * SIM_DT * np.abs(speed).max()


@pytest.mark.parametrize("steps", [1, 4, 20])
def test_a_delay_of_whole_steps_is_a_shift(steps):
    """What is felt is what would have been felt so many ms before; at first, nothing."""
    tau = noise(2, 50)
    out = Motors(2, 3, steps * SIM_DT)(tau)
    np.testing.assert_allclose(out[:, steps:], held(tau)[:, :-steps], rtol=0, atol=1e-15)
    assert not out[:, :steps].any()


@settings(deadline=None, max_examples=40)
@given(delay=st.floats(0, MAX_DELAY), slope=st.floats(-50, 50))
def test_a_fractional_delay_of_a_ramp_is_exact(delay, slope):
    """A ramp that always was comes out as the same ramp, later by the delay, however it lies between two steps."""
    steps = np.arange(-40, 60)
    ramp = (slope * SIM_DT * steps)[None, :, None]
    out = Motors(1, 1, delay)(ramp)
    expected = slope * (SIM_DT * (steps[40:] - 0.5) - delay)
    np.testing.assert_allclose(out[0, 40:, 0], expected, rtol=0, atol=1e-12)


def test_a_delay_longer_than_can_be_kept_is_the_longest():
    """Beyond MAX_DELAY, and below zero, the delay is the nearest that exists."""
    tau = noise(1, 60)
    assert np.array_equal(Motors(1, 3, 1.0)(tau), Motors(1, 3, MAX_DELAY)(tau))
    assert np.array_equal(Motors(1, 3, -1.0)(tau), Motors(1, 3, 0.0)(tau))


@pytest.mark.parametrize("lag", [5e-4, 2e-3, 1e-2])
def test_a_step_is_answered_as_a_first_order_does(lag):
    """The mean of 1 - exp(-t / lag) about each ms, with no error of discretisation; with a delay, that much later."""
    t = SIM_DT * np.arange(1, 100)
    step = np.ones((1, 100, 2))
    ends = [np.exp(-(t + side * SIM_DT) / lag) for side in (-0.5, 0.5)]
    answer = 1 - lag / SIM_DT * (ends[0] - ends[1])
    np.testing.assert_allclose(Motors(1, 2, 0.0, lag)(step)[0, 1:], np.stack([answer] * 2, 1), rtol=0, atol=1e-12)
    late = Motors(1, 2, 0.003, lag)(step)[0, :, 0]
    np.testing.assert_allclose(late[4:], answer[:-3], rtol=0, atol=1e-12)


@settings(deadline=None, max_examples=40)
@given(
    cuts=st.lists(st.integers(1, 40), min_size=1, max_size=6),
    delay=st.floats(0, MAX_DELAY),
    lag=st.sampled_from([0.0, 1e-3, 5e-3]),
)
def test_in_pieces_is_at_once(cuts, delay, lag):
    """Chunks of any length give the bits of one call: the delay line and the lag carry over, arm by arm."""
    tau = noise(3, sum(cuts), 2)
    delays, lags = np.array([delay, 0.5 * delay, 0.0]), np.array([lag, 0.0, 0.5 * lag])
    whole = Motors(3, 2, delays, lags)(tau)
    motors = Motors(3, 2, delays, lags)
    parts = [motors(part) for part in np.split(tau, np.cumsum(cuts)[:-1], axis=1)]
    assert np.array_equal(np.concatenate(parts, axis=1), whole)


def test_each_arm_has_its_own_delay_and_lag():
    """A batch is its arms one by one, and `set` changes the arms that are named only."""
    tau = noise(3, 60)
    delay, lag = np.array([0.0, 0.0025, 0.007]), np.array([1e-3, 0.0, 4e-3])
    out = Motors(3, 3, delay, lag)(tau)
    for k in range(3):
        np.testing.assert_allclose(out[k], Motors(1, 3, delay[k], lag[k])(tau[k : k + 1])[0], rtol=0, atol=1e-14)
    motors = Motors(3, 3, 0.002, 1e-3)
    motors.set(delay[1:], lag[1:], np.array([0, 2]))
    expected = Motors(3, 3, np.array([delay[1], 0.002, delay[2]]), np.array([lag[1], 1e-3, lag[2]]))
    assert np.array_equal(motors(tau), expected(tau))


def test_a_reset_forgets_for_the_arms_that_are_named():
    """Arms that are reset feel nothing of before; the others go on to the bit."""
    first, then = noise(3, 40), noise(3, 40, seed=1)
    kept, some = Motors(3, 3, 0.004, 2e-3), Motors(3, 3, 0.004, 2e-3)
    kept(first), some(first)
    some.reset(np.array([0, 2]))
    out, expected = some(then), kept(then)
    assert np.array_equal(out[1], expected[1])
    fresh = Motors(3, 3, 0.004, 2e-3)(then)
    assert np.array_equal(out[[0, 2]], fresh[[0, 2]])
    assert not np.array_equal(out[0], expected[0])


def test_a_reset_may_start_from_a_torque_that_was_there_for_long():
    """After reset(tau=...), going on with that torque is felt without a change; per arm, and with ids."""
    level = np.array([[1.0, -2.0], [3.0, 0.5]])
    motors = Motors(2, 2, 0.0035, 3e-3)
    motors(noise(2, 30, 2))
    motors.reset(tau=level)
    np.testing.assert_allclose(motors(np.repeat(level[:, None], 20, 1)), np.repeat(level[:, None], 20, 1), atol=1e-14)
    motors.reset(np.array([1]), level[:1])
    motors.reset(np.array([0]))
    out = motors(np.zeros((2, 3, 2)))
    assert not out[0].any()
    np.testing.assert_allclose(out[1], np.repeat(level[:1], 3, 0), atol=1e-14)


@pytest.fixture(scope="module")
def still(panda):
    """An arm that stands still to the bit while nothing is commanded."""
    return nominal_dynamics(panda, **conf("friction/paper") | {"offset": 0.0})


def test_a_delayed_environment_is_the_same_one_later(panda, still):
    """With a delay of one control period every state comes one step later; the observed command does not."""
    task = ReachTask(episode_s=0.4)
    # so little that the driver's law, which feeds states back, has nothing to change
    actions = np.random.default_rng(0).uniform(-0.1, 0.1, (10, 3, 7)).astype(np.float32)

    def states(dynamics):
        env = TaskEnv(panda, task, lambda rng, m: dynamics, 3, nthread=1, seed=4)
        state, rows = env.reset(), []
        for action in actions:
            state["action"] = torch.from_numpy(action)
            state = env.step(state)["next"].exclude("reward")
            assert not env.arms.sim.limited.any()
            rows.append(np.concatenate([env.arms.sim.q, env.arms.sim.dq, env.arms.sim.effort], 1))
        return np.array(rows)

    prompt, late = states(still), states(replace(still, delay=task.substeps * SIM_DT))
    np.testing.assert_allclose(late[1:, :, :14], prompt[:-1, :, :14], rtol=0, atol=1e-10)
    assert np.array_equal(late[..., 14:], prompt[..., 14:])
    assert np.abs(np.diff(prompt[..., :7], axis=0)).max() > 1e-3
    lagging = states(replace(still, lag=3e-3))
    assert np.abs(lagging[..., :14] - prompt[..., :14]).max() > 1e-3


def test_an_environment_delays_each_arm_as_drawn(panda, still):
    """Delays drawn per arm act per arm, and an episode starts with no torque on its way."""
    task = ReachTask(episode_s=0.06)
    delays = np.array([0.0, 0.02])
    env = TaskEnv(panda, task, lambda rng, m: replace(still, delay=delays[:m]), 2, nthread=1)
    for _ in range(2):
        state, moved = env.reset(), []
        start = env.arms.sim.q.copy()
        for _ in range(task.steps):
            state["action"] = torch.ones(2, 7)
            state = env.step(state)["next"].exclude("reward")
            moved.append(np.abs(env.arms.sim.q - start).max(1))
        moved = np.array(moved)
        assert np.all(moved[:, 0] > 1e-5)
        assert moved[0, 1] == 0
        assert np.all(moved[1:, 1] > 1e-5)


def test_the_simulated_arm_delays_its_commands(panda, still):
    """Cycle by cycle it does what a batch of commands does: 5 ms of nothing, then the motion of the prompt arm."""
    tau = np.array([5.0, 5.0, 5.0, 5.0, 1.0, 1.0, 1.0])

    def motion(delay):
        arm = SimulatedArm(panda, replace(still, delay=delay), position_noise=0.0, velocity_noise=0.0)
        arm.move_to(panda.q_home)
        rows = []
        for k in range(20):
            arm.command(np.minimum(k + 1.0, tau))
            rows.append(np.array(arm.read().q))
        return np.array(rows)

    prompt, late = motion(0.0), motion(0.005)
    assert np.array_equal(late[:5], np.broadcast_to(panda.q_home, (5, 7)))
    np.testing.assert_allclose(late[5:], prompt[:-5], rtol=0, atol=1e-12)
