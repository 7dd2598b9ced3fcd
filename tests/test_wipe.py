"""Task wipe: the reference keeps path and force, goals lie on the plane and in reach, and errors are one line."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import conf
from test_press import PANDA, TRUE, N, make_draw, resting

from r2s.errors import UserError
from r2s.learning.evaluate import fixed_draws, fixed_episodes, make_evaluation
from r2s.learning.model_based import hybrid_force
from r2s.physics.impedance import ACROSS, INTEGRAL_MAX, SLOPE
from r2s.physics.tip import Tip, default_plane
from r2s.tasks.surface_task import FORCES, NORMAL, POINT
from r2s.tasks.task import Episodes, observation_scale, observe
from r2s.tasks.trajectory import V, X
from r2s.tasks.wipe import A, WipeTask

TASK_CONF = {k: tuple(v) if isinstance(v, list) else v for k, v in conf("task/wipe").items()}


def make_task(dynamics=TRUE, robot=PANDA, **changed):
    return WipeTask(**TASK_CONF | changed).with_model(robot, dynamics)


@pytest.fixture(scope="module")
def task():
    return make_task()


@pytest.fixture(scope="module")
def wiped(task):
    """Episodes of the reference on surfaces as conf/dr/contact.yaml draws them."""
    return make_evaluation(PANDA, task, make_draw(), episodes=6, nthread=1)(hybrid_force(PANDA, task, TRUE))


def test_the_reference_on_the_true_model_wipes_the_path(task, wiped):
    row = task.measures(wiped)
    assert row["wiped"] >= 0.95
    assert row["stopped"] == 0.0
    assert row["contact"] == 1.0


@pytest.mark.parametrize("normal", [(0.0, 0.0, 1.0), (-0.5, 0.2, 0.84)])
def test_paths_stay_in_the_nominal_plane(task, normal):
    """On tilted planes too, within `spread`."""
    normal = np.array(normal) / np.linalg.norm(normal)
    axes = np.linalg.svd(normal[None])[2][1:]
    for seed in range(20):
        path = task.path(np.random.default_rng(seed), axes)
        np.testing.assert_allclose(path @ normal, 0.0, atol=1e-12)
        assert np.linalg.norm(path, axis=1).max() <= task.spread


def test_goals_lie_on_the_plane_and_in_reach(task):
    """The path stays within `spread`, at the drawn speed, from rest to rest; the tip starts above every surface."""
    starts, goals = fixed_episodes(PANDA, task, 12)
    point, normal = default_plane(PANDA)
    rows = task.rows(goals)
    offset = rows[..., X] - point
    np.testing.assert_allclose(offset @ normal, 0.0, atol=1e-9)
    assert np.linalg.norm(offset, axis=-1).max() <= task.spread
    np.testing.assert_array_equal(rows[:, 0, X], goals[:, POINT])
    speed = np.linalg.norm(rows[..., V], axis=-1)
    assert speed.max() < 1.05 * task.speed[1]  # a spline through the rows
    assert speed[:, : int(task.begin_s * task.ctrl_hz)].max() < 1e-6 > speed[:, -1].max()
    np.testing.assert_array_equal(goals[:, 6], goals[:, 7])
    assert 5 <= goals[:, FORCES].min() < goals[:, FORCES].max() <= 20
    tip = Tip(PANDA)
    above = np.array([tip(q)[0] for q in starts])
    assert (fixed_draws(make_draw(), 12).surface.depth(above, PANDA.tool.radius) < 0).all()
    assert all(tip.posture(place + 0.03 * normal) is not None for place in rows[0, ::100, X])


def test_the_pull_is_inertia_and_expected_friction(task):
    """Both are those of the middle of a control period, where the target is, too."""
    _, goals = fixed_episodes(PANDA, task, 4)
    t = np.full(4, task.begin_s + 1.5)
    now = task.now(t + 0.5 / task.ctrl_hz, goals)
    speed = np.linalg.norm(now[:, V], axis=1)
    assert speed.min() > 0.01
    friction = (task.friction * goals[:, 6] / speed)[:, None] * now[:, V]
    np.testing.assert_allclose(task.pull(t, goals), now[:, A] @ task.inertia + friction)
    across = task.target(t, goals)[:, X] - now[:, X]
    np.testing.assert_allclose(across, (across * goals[:, NORMAL]).sum(1, keepdims=True) * goals[:, NORMAL])
    np.testing.assert_array_equal(task.target(t, goals)[:, V], now[:, V])  # the tip no longer sinks
    setpoint = task.control(PANDA).setpoint(task, t, goals)
    np.testing.assert_array_equal(setpoint[:, -3:], task.pull(t, goals))


def test_the_law_learns_slope_and_friction(task):
    """A tip that slides up a slope of 1 in 20: the slope is found, and a lasting error fills the integral along."""
    control, normal = task.control(PANDA), np.array([0.0, 0.0, 1.0])
    _, goals = fixed_episodes(PANDA, task, 1)
    q = task.begin(np.zeros((1, N)), goals)[0]
    place, jacobian = (x[0] for x in task.tip(q[None]))
    along = np.array([0.1, 0.0, 0.0])
    dq = np.linalg.pinv(jacobian) @ (along + 0.05 * along[0] * normal)
    command = np.concatenate([np.zeros(3), place, along, normal, [10.0], np.zeros(5)])
    command[3:6] += 2e-3, 0.0, -0.05
    memory, out = np.zeros(control.memory_size), np.empty(N)
    for _ in range(1000):
        control.law(q, dq, command, control.parameters, memory, out)
    np.testing.assert_allclose(memory[SLOPE : SLOPE + 3], [0.05, 0.0, 0.0], atol=1e-4)
    most = control.parameters[INTEGRAL_MAX]
    np.testing.assert_allclose(memory[ACROSS : ACROSS + 2], [most, 0.0], atol=1e-9)
    still = command.copy()
    still[6:9] = 0.0
    before = memory[ACROSS : SLOPE + 3].copy()
    control.law(q, 0.0 * dq, still, control.parameters, memory, out)
    np.testing.assert_array_equal(memory[ACROSS : SLOPE + 3], before)  # nothing is learned at rest


def test_the_observation_has_its_terms(task):
    _, goals = fixed_episodes(PANDA, task, 5)
    state = resting(task.begin(np.zeros((5, N)), goals), t=np.full(5, 4.0))
    seen = observe(task, task.control(PANDA), state, goals, task.torque_limit(PANDA))
    wide = {"q": N, "dq": N, "tip": 3, "tip_velocity": 3, "effort": N, "path_error": 3, "velocity": 3}
    terms = task.observation_terms(PANDA)
    assert seen.shape == (5, len(observation_scale(task, PANDA)[0])) == (5, sum(wide.get(e.of, 1) for e in terms))
    np.testing.assert_allclose(seen[:, -3:], task.now(state.t, goals)[:, V], atol=1e-6)
    touched = replace(state, force=np.full((5, 3), 10.0))
    np.testing.assert_array_equal(observe(task, task.control(PANDA), touched, goals, task.torque_limit(PANDA)), seen)


def test_the_reward_is_best_on_the_path_under_the_force(task):
    _, goals = fixed_episodes(PANDA, task, 3)
    start = task.begin(np.zeros((3, N)), goals)
    asked = goals[:, 6:7] * -goals[:, NORMAL]
    right = resting(start, force=asked)
    away, terms = task.judge(right, np.zeros((3, N)), goals, np.ones(3))
    assert away.max() < 2e-4  # the tip is above the path's first point
    np.testing.assert_allclose(terms, np.tile([0.0, 0.0, 1.0, 0.0, 0.0, 0.0], (3, 1)), atol=0.05)
    for worse in (replace(right, force=1.3 * asked), replace(right, t=np.full(3, 6.0))):
        assert (task.judge(worse, np.zeros((3, N)), goals, np.ones(3))[1].sum(1) < terms.sum(1) - 0.1).all()


def test_measures_of_known_errors(task):
    """Half of the path 3 N too hard, a quarter of it 5 mm beside: what is within both is wiped."""
    begin, steps = round(task.begin_s * task.ctrl_hz), task.steps
    run = steps - begin
    asked, force, away = np.full(steps, 10.0), np.full(steps, 10.5), np.zeros(steps)
    force[:100], force[105] = 0.0, 14.0
    force[begin : begin + run // 2] = 13.0
    away[begin + run // 2 : begin + 3 * (run // 4)] = 5e-3
    none = np.zeros((2, steps, N))
    episodes = Episodes(
        t=np.arange(1, steps + 1) / 100, q=none, dq=none, ee=np.zeros((2, steps, 3)), goal=np.zeros((2, steps, 3)),
        tau=none, distance=np.stack([away, away]), reward=np.zeros((2, steps)), reward_smooth=np.zeros((2, steps)),
        q_left=np.ones(2), limited=np.zeros(2), collision=np.array(["", ""]),
        force=np.stack([force, asked], -1)[None].repeat(2, 0),
    )  # fmt: skip
    row, table = task.measures(episodes), task.measure_table
    assert {*table.rows, *table.comparison, *table.curves, *table.transfer, *table.selection} <= set(row)
    share = (run - run // 2) / run, (run - 3 * (run // 4) + run // 2) / run
    assert row["within_2N"] == pytest.approx(share[0])
    assert row["wiped"] == pytest.approx(share[0] + share[1] - 1)
    assert (row["contact"], row["impact_N"], row["success"], row["stopped"]) == (1.0, 14.0, 0.0, 0.0)
    episodes.distance[1, -1] = np.inf
    stopped = task.measures(episodes)
    assert stopped["wiped"] == pytest.approx(row["wiped"] / 2)
    assert stopped["force_rmse_N"] == pytest.approx(row["force_rmse_N"])
    assert stopped["stopped"] == 0.5


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"force": (5.0, 90.0)}, r"task.force: expected at most 22.2 N, which torque_fraction allows"),
        ({"speed": (0.3, 0.1)}, r"task.speed: \(0.3, 0.1\) is not allowed; two numbers above 0 m/s"),
        ({"size": (0.03, 0.2)}, r"task.size: expected a number in \(0, 0.0566\]"),
        ({"kinds": ("cirle",)}, r"task.kinds: 'cirle'; .*circle"),
        ({"clearance": 0.01}, r"task.clearance: 0.01 m may lie inside the surface; more than 0.012 m"),
        ({"episode_s": 3.0}, r"task.episode_s: "),
        ({"friction": -0.1}, r"task.friction: "),
    ],
)
def test_a_wrong_task_is_one_line(changed, message):
    with pytest.raises(UserError, match=message) as error:
        make_task(**changed)
    assert "\n" not in str(error.value)
