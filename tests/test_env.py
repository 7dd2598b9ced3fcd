"""The reaching task: reproducible, inside the driver's limits, cut off on time, rewarded by eq. (2)."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
import torch
from conftest import conf
from hypothesis import given, settings
from hypothesis import strategies as st
from torchrl.envs import EnvBase
from torchrl.envs.utils import check_env_specs

from r2s.errors import UserError
from r2s.learning.env import TaskEnv
from r2s.learning.randomization import UniformRandomization
from r2s.physics.actuation import Actuation, low_pass_factor
from r2s.physics.dynamics import nominal_dynamics
from r2s.tasks.reach import ReachTask, observe
from r2s.tasks.rewards import MAX_FACTOR, PAPER, TERMS, Curriculum, terms
from r2s.tasks.track import TrackTask

K1, K2, K3, K4, K5, K6 = 2.0, 0.03, 0.05, 1.15, 0.03, 0.15  # shared/paper/tables.yaml, reward


@pytest.fixture(scope="module")
def draw(panda):
    center = nominal_dynamics(panda, **conf("friction/paper"), inertia_scale=conf("inertia/paper")["scale"])
    return UniformRandomization(panda, center, **conf("dr/paper"))


@pytest.fixture(scope="module")
def task():
    settings = conf("task/reach")
    exact = {"reach": tuple(settings["reach"]), "speed_noise": 0.0}  # noise: tests/test_speed_noise.py
    return ReachTask(**(settings | exact))


@pytest.fixture
def make(panda, task, draw):
    """Return (nsim, ...) -> TaskEnv of short episodes."""

    def maker(nsim, nthread=1, **change):
        short = replace(task, episode_s=change.pop("episode_s", 0.2))
        return TaskEnv(panda, short, draw, nsim, nthread=nthread, seed=change.pop("seed", 0), **change)

    return maker


def run(env, actions):
    """Return the tensordicts after each action (steps, nsim, n), with resets where episodes end."""
    state, rows = env.reset(), []
    for action in actions:
        state["action"] = action
        step, state = env.step_and_maybe_reset(state)
        rows.append(step["next"].clone())
    return rows


def actions(steps, nsim, n=7, seed=0):
    return torch.from_numpy(np.random.default_rng(seed).uniform(-1, 1, (steps, nsim, n)).astype(np.float32))


def test_torchrl_finds_the_specs_kept(make):
    """check_env_specs: what the environment returns is what its specs announce."""
    check_env_specs(make(3))


def test_same_seed_and_actions_give_the_same_bits(make):
    """Observations, rewards and ends of 25 steps with resets are bit-identical at one thread and at two."""
    one, two = (run(make(5, nthread), actions(25, 5)) for nthread in (1, 2))
    for a, b in zip(one, two, strict=True):
        for key in ("observation", "reward", "reward_terms", "distance", "truncated"):
            assert torch.equal(a[key], b[key])
    other = run(make(5, seed=1), actions(25, 5))
    assert not torch.equal(one[0]["observation"], other[0]["observation"])


def test_set_seed_starts_over(make):
    """An environment that is given its seed again resets to the same arms, starts and goals."""
    env = make(8, stagger=True)
    seen, ends = [], []
    for _ in range(2):
        env.set_seed(11)
        seen.append(env.reset()["observation"])
        ends.append(env.state()["_count"])
    assert torch.equal(*seen)
    assert np.array_equal(*ends)
    assert len(set(ends[0])) > 2
    assert not torch.equal(env.reset()["observation"], seen[0])


def test_episodes_are_cut_off_at_their_length_and_never_terminate(make):
    """`truncated` and `done` come true exactly at step task.steps, then again after as many."""
    env = make(3)
    steps = env.task.steps
    rows = run(env, actions(2 * steps + 1, 3))
    for k, row in enumerate(rows, 1):
        assert row["truncated"].all() == (k % steps == 0)
        assert row["truncated"].any() == (k % steps == 0)
        assert torch.equal(row["done"], row["truncated"])
        assert not row["terminated"].any()
    assert ReachTask().steps == 200
    assert ReachTask().substeps == 20


def test_a_partial_reset_leaves_the_other_arms_alone(make):
    """Only the arms of `_reset` get new goals, starts and commands; the others go on to the bit."""
    changed, untouched = make(4), make(4)
    first = actions(3, 4)
    for env in (changed, untouched):
        run(env, first)
    before = changed.read()
    mask = torch.tensor([[False], [True], [False], [True]])
    after = changed.reset(before.clone().set("_reset", mask))
    keep, new = [0, 2], [1, 3]
    assert torch.equal(after["observation"][keep], before["observation"][keep])
    assert (after["observation"][new] != before["observation"][new]).any(-1).all()
    assert torch.equal(after["observation"][new][:, 7:14], torch.zeros(2, 7))  # at rest
    assert not changed.arms.sim.effort[new].any()
    action = actions(1, 4, seed=3)[0]
    rows = []
    for env in (changed, untouched):
        state = env.read()
        state["action"] = action
        rows.append(env.step(state)["next"])
    for key in ("observation", "reward", "distance"):
        assert torch.equal(rows[0][key][keep], rows[1][key][keep])


def test_a_step_with_its_reset_is_torchrls(make):
    """`step_and_maybe_reset` returns what EnvBase's would: the same steps, and after them the same observations."""
    ours, theirs = make(8, stagger=True), make(8, stagger=True)
    one, other = ours.reset(), theirs.reset()
    for action in actions(2 * ours.task.steps, 8):
        one["action"] = other["action"] = action
        step, one = ours.step_and_maybe_reset(one)
        expected, other = EnvBase.step_and_maybe_reset(theirs, other)
        for key in ("observation", "reward_terms", "distance", "reward", "done", "terminated", "truncated"):
            assert torch.equal(step["next", key], expected["next", key]), key
        assert torch.equal(one["observation"], other["observation"])
        assert not one["done"].any()


def test_staggered_episodes_end_at_different_times(make):
    """With `stagger` the first episodes are cut off one by one, later ones last their full length."""
    env = make(8, stagger=True)
    steps = env.task.steps
    cut = np.array([row["truncated"][:, 0].numpy() for row in run(env, actions(2 * steps, 8))])
    assert len(set(cut.argmax(0))) > 2
    assert np.array_equal(cut.sum(0), np.full(8, 2))
    assert np.array_equal(np.diff(np.argwhere(cut.T)[:, 1].reshape(8, 2), axis=1), np.full((8, 1), steps))


@settings(deadline=None, max_examples=40)
@given(
    scale=st.sampled_from([0.1, 1.0, 10.0, 1e6]),
    seed=st.integers(0, 1000),
    cutoff=st.sampled_from([5.0, 100.0, 400.0]),
)
def test_commands_keep_the_drivers_limits(panda, scale, seed, cutoff):
    """|tau| <= tau_max and |step| <= 1 Nm per ms from zero on, for targets small, extreme and jumping about."""
    rng = np.random.default_rng(seed)
    actuation = Actuation(panda, 3, cutoff_hz=cutoff)
    command = [np.zeros((3, 1, 7))]
    for _ in range(4):
        target = scale * panda.tau_max * rng.choice([-1.0, 0.0, 1.0, rng.uniform(-1, 1)], (3, 7))
        command.append(actuation(target, 20))
    command = np.concatenate(command, axis=1)
    assert np.all(np.abs(command) <= panda.tau_max)
    assert np.abs(np.diff(command, axis=1)).max() <= 1.0 + 1e-12
    assert np.array_equal(command[:, -1], actuation.last)


def test_the_environment_commands_what_the_actuation_says(make):
    """Commands never exceed torque_fraction of tau_max, also for actions beyond one."""
    env = make(2)
    limit = env.task.torque_limit(env.robot)
    state = env.reset()
    for _ in range(8):
        state["action"] = torch.full((2, 7), 50.0)
        state = env.step(state)["next"].exclude("reward")
        assert np.all(np.abs(env.arms.sim.effort) <= limit)
    slow = limit > 20 * 8  # Nm that the rate limit lets pass in 8 steps
    np.testing.assert_allclose(env.arms.sim.effort[:, ~slow], np.broadcast_to(limit, (2, 7))[:, ~slow], rtol=1e-6)


def test_the_law_contains_an_arm_under_full_torque(make):
    """Joints driven with all that actions can ask for stay within the position and velocity limits."""
    env = make(4, episode_s=4.0)
    r, state, rng = env.robot, env.reset(), np.random.default_rng(0)
    for k in range(env.task.steps):
        if k % 50 == 0:
            action = torch.from_numpy(rng.choice([-1.0, 1.0], (4, 7)).astype(np.float32))
        state["action"] = action
        state = env.step(state)["next"].exclude("reward")
        assert np.all((env.arms.sim.q > r.q_min) & (env.arms.sim.q < r.q_max))
        assert np.all(np.abs(env.arms.sim.dq) < r.dq_max)


@pytest.mark.parametrize("cutoff", [5.0, 20.0, 100.0])
def test_the_low_pass_has_its_time_constant(panda, cutoff):
    """A small step is answered as 1 - exp(-t / T) with T = 1 / (2 pi cutoff), to two cycles of 1 ms."""
    actuation = Actuation(panda, 1, cutoff_hz=cutoff)
    answer = actuation(np.full((1, 7), 0.5), 1000)[0] / 0.5
    factor = low_pass_factor(cutoff)
    k = np.arange(1, 1001)[:, None]
    np.testing.assert_allclose(answer, np.broadcast_to(1 - (1 - factor) ** k, answer.shape), atol=1e-12)
    constant = 1 / (2 * np.pi * cutoff)
    reached = 1e-3 * (1 + np.argmax(answer[:, 0] >= 1 - np.exp(-1)))
    assert 0 <= reached - constant <= 2e-3


def test_actuation_in_pieces_is_actuation_at_once(panda):
    """20 ms and then 20 ms equal 40 ms: filter and rate limit carry over."""
    whole, parts = Actuation(panda, 2, cutoff_hz=30.0), Actuation(panda, 2, cutoff_hz=30.0)
    target = np.random.default_rng(0).uniform(-30, 30, (2, 7))
    expected = whole(target, 40)
    assert np.array_equal(np.concatenate([parts(target, 20), parts(target, 20)], axis=1), expected)
    parts.reset(np.array([1]))
    assert not parts.last[1].any()
    assert np.array_equal(parts.last[0], whole.last[0])


@settings(deadline=None)
@given(
    distance=st.floats(0, 2),
    distance0=st.floats(1e-3, 2),
    dq=st.lists(st.floats(-20, 20), min_size=7, max_size=7),
    ddq=st.lists(st.floats(-2000, 2000), min_size=7, max_size=7),
)
def test_the_first_two_terms_are_equation_2(distance, distance0, dq, ddq):
    """Distance + smoothness is eq. (2) with the paper's constants, term by term."""
    d = distance / distance0
    expected = -K1 * d
    for v, a in zip(dq, ddq, strict=True):
        expected -= K2 * np.tanh(abs(v))
        expected -= K3 * np.tanh(abs(a)) / abs(K4 - min(1.0, d))
        expected -= K5 * np.tanh(abs(a)) / (K6 + d)
    out = terms(np.array([distance]), np.array([distance0]), np.array([dq]), np.array([ddq]), np.array([0.3]))[0]
    assert len(out) == len(TERMS)
    assert out[0] + out[1] == pytest.approx(expected, rel=1e-9, abs=1e-9)
    assert out @ PAPER == pytest.approx(expected, rel=1e-9, abs=1e-9)
    assert 0 <= out[TERMS.index("precision")] <= 1  # a bonus
    assert -out[TERMS.index("precision")] <= out[TERMS.index("stillness")] <= 0  # takes away no more than that
    assert out[TERMS.index("filter_penalty")] == -0.3  # a price


def test_the_environments_reward_is_equation_2_of_its_own_motion(make):
    """Reward and terms of a step follow from the velocities and distances before and after it."""
    env = make(3)
    state = env.reset()
    before = state["observation"].double().numpy()
    distance0 = state["distance"].double().numpy()[:, 0]
    for action in actions(4, 3):
        state["action"] = action
        step = env.step(state)["next"]
        after = step["observation"].double().numpy()
        dq, ddq = after[:, 7:14], (after[:, 7:14] - before[:, 7:14]) * 50
        distance = np.linalg.norm(after[:, 14:17] - after[:, 17:20], axis=1)
        np.testing.assert_allclose(step["distance"][:, 0], distance, atol=1e-6)
        d, jerk = distance / distance0, np.tanh(np.abs(ddq)).sum(1)
        expected = (
            -K1 * d - K2 * np.tanh(np.abs(dq)).sum(1) - jerk * (K3 / np.abs(K4 - np.minimum(1, d)) + K5 / (K6 + d))
        )
        np.testing.assert_allclose(step["reward"][:, 0], expected, rtol=1e-4)
        np.testing.assert_allclose(step["reward_terms"][:, :2].sum(1), expected, rtol=1e-4)
        before, state = after, step.exclude("reward")


def test_the_curriculum_goes_from_one_end_to_the_other():
    """The first weights until the first fraction of the budget, the last from the second, a line between."""
    settings = conf("reward/curriculum")
    start, end = settings["anneal"]
    first, last = ([1.0, *(settings[name][k] for name in TERMS[1:])] for k in (0, 1))
    for progress, weights in ((0.0, first), (start, first), (end, last), (1.0, last), (2.0, last)):
        np.testing.assert_allclose(Curriculum(**settings).weights(None, progress), weights)
    np.testing.assert_allclose(
        Curriculum(**settings).weights(None, 0.5 * (start + end)), np.mean([first, last], axis=0)
    )


@pytest.mark.parametrize("light", [0.08, 0.2, 0.02])
def test_the_filter_penalty_settles_at_the_largest_filter_rate(light):
    """Policies with a filter rate of light / factor end at max_filter_rate; the factor stays at 1 or above."""
    curriculum = Curriculum(**conf("reward/curriculum"))
    progress, factor = curriculum.anneal[0], 1.0
    for _ in range(4000):
        factor = curriculum.adapt(factor, progress, np.array([-1.0, -1.0, 0.5, -0.3, -light / factor]), 160)
    assert factor == pytest.approx(min(max(light / curriculum.max_filter_rate, 1.0), MAX_FACTOR), rel=1e-3)
    weights = curriculum.weights(None, progress), curriculum.weights(None, progress, factor)
    np.testing.assert_array_equal(weights[1], weights[0] * [1, 1, 1, 1, factor])


def test_the_filter_penalty_is_constant_before_the_curriculum_moves():
    """Also without max_filter_rate at any time."""
    curriculum, paper = (Curriculum(**conf(f"reward/{name}")) for name in ("curriculum", "paper"))
    always = np.array([-1.0, -1.0, 0.5, -0.3, -1.0])
    assert curriculum.adapt(1.0, 0.99 * curriculum.anneal[0], always, 10_000) == 1.0
    assert paper.adapt(1.0, 1.0, always, 10_000) == 1.0


@pytest.mark.parametrize("worse", [{"success_1cm": 0.99}, {"rest": 0.98}, {"limited": 0.06}, {"return_paper": -91.0}])
def test_the_policy_that_is_saved_reaches_rests_and_is_let_be(task, worse):
    """Of two evaluations that differ in one measure the better is kept; being limited now and then costs nothing."""
    good = {"success_1cm": 1.0, "rest": 1.0, "limited": 0.01, "return_paper": -90.0}
    assert task.score(good | worse) < task.score(good)
    assert task.score(good | {"limited": 0.03}) == task.score(good)


@pytest.mark.parametrize("progress", [0.0, 0.3, 1.0])
def test_the_papers_reward_never_changes(progress):
    """conf/reward/paper weighs the terms as eq. (2) does, from the first step to the last."""
    weights = [1.0, 1.0] + [0.0] * (len(TERMS) - 2)
    assert Curriculum(**conf("reward/paper")).weights(None, progress).tolist() == PAPER.tolist() == weights


def test_goals_lie_in_the_region_and_some_posture_reaches_them(panda, task):
    """Goals keep reach, height and azimuth, and for each there are joint angles within the limits that get there."""
    goals = task.goals(panda, np.random.default_rng(0), 12)
    shoulder = np.array([0, 0, 0.333])  # the second joint's axis meets the first's here
    away = np.linalg.norm(goals - shoulder, axis=1)
    assert np.all((away >= task.reach[0]) & (away <= task.reach[1]))
    assert np.all(goals[:, 2] >= task.height)
    assert np.all(np.abs(np.arctan2(goals[:, 1], goals[:, 0])) <= task.azimuth)
    assert len(np.unique(goals.round(6), axis=0)) == 12
    model, rng = panda.model(gravity=False), np.random.default_rng(1)
    data, jacobian, site = mujoco.MjData(model), np.empty((3, 7)), model.site(panda.ee_site).id
    for goal in goals:
        left = np.inf
        for _ in range(20):
            q = rng.uniform(panda.q_min, panda.q_max)
            for _ in range(100):
                data.qpos[:] = q
                mujoco.mj_forward(model, data)
                error = goal - data.site_xpos[site]
                left = min(left, np.linalg.norm(error))
                mujoco.mj_jacSite(model, data, jacobian, None, site)
                step = jacobian.T @ np.linalg.solve(jacobian @ jacobian.T + 1e-3 * np.eye(3), error)
                q = np.clip(q + np.clip(step, -0.3, 0.3), panda.q_min, panda.q_max)
            if left < 1e-3:
                break
        assert left < 1e-3


def test_an_unreachable_region_is_one_line(panda, task):
    """A region beyond the arm is named instead of searched for ever."""
    with pytest.raises(UserError, match=r"^task\.reach 3 to 4 m.*widen them$"):
        replace(task, reach=(3.0, 4.0)).goals(panda, np.random.default_rng(0), 5)


def test_a_list_of_torque_fractions_must_fit(panda):
    """One share per joint or one for all; another number of them is named."""
    np.testing.assert_allclose(ReachTask(torque_fraction=(0.1,) * 7).torque_limit(panda), 0.1 * panda.tau_max)
    with pytest.raises(UserError, match=r"^task\.torque_fraction: expected 7 values, for the 7 joints"):
        ReachTask(torque_fraction=(0.1, 0.2)).torque_limit(panda)


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"torque_fraction": 30}, r"task.torque_fraction: expected a number in \[1e-6, 1\], got 30"),
        ({"torque_fraction": -0.3}, "task.torque_fraction: expected a number in .*, got -0.3"),
        ({"torque_fraction": (0.1, 0.0)}, "task.torque_fraction: expected a number in .*, got 0.0"),
        ({"torque_fraction": "half"}, "task.torque_fraction: expected a number in .*, got 'half'"),
        ({"reach": 0.5}, r"task.reach: expected \[least, most\] m or null, got 0.5"),
        ({"reach": (0.5,)}, r"task.reach: expected \[least, most\] m or null, got \(0.5,\)"),
        ({"reach": (0.7, 0.3)}, r"task.reach: expected \[least, most\] m, got \[0.7, 0.3\]"),
        ({"reach": (-0.1, 0.3)}, r"task.reach: expected a number in \[0, inf\), got -0.1"),
        ({"height": None}, "task.height: expected a number in .*, got None"),
        ({"azimuth": -1.0}, "task.azimuth: expected a number in .*, got -1.0"),
    ],
)
@pytest.mark.parametrize("kind", [ReachTask, TrackTask])
def test_a_wrong_region_or_share_of_torque_is_one_line(kind, changed, said):
    """Of reaching and of tracking: a percentage, a sign, a single distance."""
    with pytest.raises(UserError, match=f"^{said}") as error:
        kind(**changed)
    assert "\n" not in str(error.value)


def test_the_observation_is_the_one_an_arm_gives(make):
    """What the environment returns is `observe` of state, nominal kinematics, goal and last command, as on an arm."""
    from r2s.physics.rigid_body import Kinematics

    env = make(4)
    run(env, actions(3, 4))
    seen = env.read()["observation"].numpy()
    kinematics = Kinematics(env.robot)
    torque = env.task.torque_limit(env.robot)
    for k in range(4):
        q, dq = env.arms.sim.q[k].copy(), env.arms.sim.dq[k].copy()
        ee, jacobian = kinematics(q)
        effort = env.arms.sim.effort[k][None]
        own = observe(q[None], dq[None], ee[None], env.goal[k][None], jacobian[None], effort, torque)
        np.testing.assert_allclose(own[0], seen[k], atol=1e-6)


def test_the_observation_is_what_its_docstring_lists(panda):
    """6 n + 12 numbers in SI units, in the order of the docstring."""
    rng = np.random.default_rng(0)
    q, dq, effort = rng.normal(size=(3, 2, 7))
    ee, goal = rng.normal(size=(2, 2, 3))
    jacobian, torque = rng.normal(size=(2, 3, 7)), rng.uniform(1, 9, 7)
    out = observe(q, dq, ee, goal, jacobian, effort, torque)
    error = goal - ee
    pull = np.stack([j.T @ e for j, e in zip(jacobian, error, strict=True)])
    parts = [q, dq, ee, goal, error, effort / torque, np.tanh(error / 0.02), pull, np.tanh(pull / 0.015)]
    parts.append(np.tanh(dq / 0.1))
    np.testing.assert_allclose(out, np.concatenate(parts, 1), rtol=1e-6, atol=1e-7)
    assert out.shape == (2, 54)
    assert out.dtype == np.float32


def test_the_scale_of_observations_fits_them(make, panda, task):
    """Normalised observations of random motion are of order one: none is far off, all but joint 7's pull move."""
    centre, scale = task.observation_scale(panda)
    assert centre.shape == scale.shape == (54,)
    assert np.all(scale > 0)
    rows = torch.cat([row["observation"] for row in run(make(8), actions(30, 8))]).numpy()
    normal = (rows - centre) / scale
    assert np.abs(np.median(normal, axis=0)).max() < 3
    moving = np.delete(normal, [39, 46], axis=1)  # the hand is on the axis of joint 7: it cannot pull
    assert moving.std(0).min() > 1e-2


def test_a_state_that_is_no_number_stops_the_run(make):
    """NaN in the simulation raises at once and names the arm."""
    env = make(3)
    state = env.reset()
    state["action"] = torch.zeros(3, 7)
    env.goal[1] = np.nan
    with pytest.raises(FloatingPointError, match="observation of arm 1 is nan"):
        env.step(state)
