"""Task push: the reference pushes boxes to their goals, observations and draws are right, errors are one line."""

import itertools
import json
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import test_box
import torch
from cli_runs import r2s, succeed
from conftest import conf
from test_press import BARE, PANDA, TRUE, N, resting

from r2s.arm.twins.make_twin import make_twin
from r2s.control.impedance import cartesian_impedance
from r2s.control.torque import torque
from r2s.engines.dart import dart
from r2s.engines.episodes import EngineArms
from r2s.errors import UserError
from r2s.learning.box_randomization import BoxRandomization
from r2s.learning.demonstrations import make_demonstrator
from r2s.learning.evaluate import fixed_draws, fixed_episodes, make_evaluation
from r2s.learning.pusher import TOLERANCE, Pusher
from r2s.learning.vector_arms import VectorArms
from r2s.physics.box import check_size, standing_box, table_frame
from r2s.physics.contact_layout import DEPTH, MASS, POINT, TABLE, box_pose
from r2s.physics.push_limit import push_limit
from r2s.physics.tip import Tip
from r2s.tasks.push import BOX, ERROR, START, PushTask
from r2s.tasks.push_measures import GOOD_M
from r2s.tasks.rollout import rollout
from r2s.tasks.task import Episodes, observation_scale, observe

TASK_CONF = {k: tuple(v) if isinstance(v, list) else v for k, v in conf("task/push").items()}
FROM_TASK = {"point": None, "normal": None, "size": TASK_CONF["size"], "spread": 0.02, "yaw": 20.0}
DR_CONF = conf("dr/box") | FROM_TASK


def make_task(dynamics=TRUE, robot=PANDA, **changed):
    return PushTask(**TASK_CONF | changed).with_model(robot, dynamics)


def make_draw(**changed):
    return BoxRandomization(PANDA, TRUE, **DR_CONF | changed)


@pytest.fixture(scope="module")
def task():
    return make_task()


@pytest.fixture(scope="module")
def pushed(task):
    """Episodes of the reference with boxes and arms as conf/dr/box.yaml draws them."""
    return make_evaluation(PANDA, task, make_draw(), episodes=8, nthread=1)(Pusher(PANDA, task, TRUE))


def test_an_action_of_torque_is_a_share_of_what_the_task_may_command():
    """An action of 1 commands the torque limit, task.torque_fraction of tau_max; an impedance has the same."""
    task = make_task(torque_fraction=0.6)
    by_torque = task.controlled_by(torque(PANDA, task))
    for limit in (task.torque_limit(PANDA), by_torque.torque_limit(PANDA), by_torque.control(PANDA).action_scale):
        np.testing.assert_allclose(limit, 0.6 * PANDA.tau_max)


def test_the_reference_pushes_boxes_to_their_goals(task, pushed):
    """Of arms with 10 % wrong friction, boxes of 0.3 to 1.5 kg; no box starts at its goal."""
    row = task.measures(pushed)
    assert row["success"] >= 0.85  # one of eight may fail where sums round otherwise
    assert row["stopped"] == row["on_table"] == 0.0
    assert pushed.distance[:, 0].min() > GOOD_M
    assert 0.0 < row["force_peak_N"] < 20.0


@pytest.mark.parametrize("share", [0.0, 0.375, -0.75])
def test_a_push_moves_and_turns_the_box_as_the_reference_expects(share):
    """A slow frictionless push on the simulated box; within 5 % of the motion, since the lever turns by 0.01 rad."""
    pusher = Pusher(PANDA, make_task(size=tuple(2 * test_box.HALF)), TRUE)
    point = np.array([-1.0, share]) * test_box.HALF[:2]
    k = int(np.argmin(np.linalg.norm(pusher._points - point, axis=1)))
    place, speed = point - [test_box.RADIUS, 0.0], 0.002
    path = test_box.pushed(test_box.box(damping=3.0), place, (speed, 0.0), seconds=1.0)
    half = len(path) // 2  # before, the elastic deflections grow
    expected = speed * half * 1e-3 * pusher._twists[k] * TOLERANCE
    np.testing.assert_allclose(path[-1] - path[half - 1], expected, rtol=0.05, atol=0.05 * speed * half * 1e-3)


def test_the_reference_chooses_the_push_that_ends_at_the_goal(task):
    """The middle of a face for an error along its normal, by the error; off the middle if the box is to turn too."""
    pusher, behind = Pusher(PANDA, task, TRUE), np.array([-0.1, 0.0])
    k, length = pusher._best_push(behind, np.array([0.05, 0.0, 0.0]) / TOLERANCE)
    np.testing.assert_allclose(pusher._points[k], [-0.06, 0.0], atol=1e-12)
    assert length == pytest.approx(0.05)
    wanted = int(np.argmin(np.linalg.norm(pusher._points - [-0.06, -0.03], axis=1)))
    k, length = pusher._best_push(behind, 0.05 * pusher._twists[wanted])
    assert k == wanted
    assert length == pytest.approx(0.05)


def test_the_reference_does_not_push_from_the_wrong_side(task):
    """A tip behind a box that slid too far moves around it: it pushes nothing and stays at the box."""
    pusher, at = Pusher(PANDA, task, TRUE), np.array([-0.075, 0.0])
    for _ in range(60):
        velocity, push = pusher._plan(np.array([*at, task.height]), np.zeros(3), np.array([-0.03, 0.0, 0.0]))
        assert not push.any() or at[0] > 0.06
        at = at + 0.04 * velocity[:2]
        assert np.abs(at).max() < 0.06 + task.tip_radius + 0.04
    assert at[0] > 0.06


@pytest.mark.parametrize("size", [(0.12, 0.12, 0.08), (0.3, 0.08, 0.05)])
def test_the_way_around_the_box_has_one_coordinate(size):
    """Along the rectangle around the box, it advances by the length of each step, and is as long as its edges."""
    pusher = Pusher(PANDA, make_task(size=size), TRUE)
    corners = pusher._clear * np.array([[1, -1], [1, 1], [-1, 1], [-1, -1], [1, -1]])
    shares = np.linspace(0.0, 1.0, 50, endpoint=False)[:, None]
    way = np.concatenate([(1 - shares) * a + shares * b for a, b in itertools.pairwise(corners)])
    steps = np.linalg.norm(np.diff(way, axis=0), axis=1)
    along, length = pusher._along(way), 4.0 * pusher._clear.sum()
    np.testing.assert_allclose(np.mod(np.diff(along), length), steps, atol=1e-9)
    assert steps.sum() == pytest.approx(length, rel=0.01)


def test_a_seed_gives_the_same_boxes(task):
    """Perception included; the state of a training restores the box and its noise, bit for bit."""
    arms = [VectorArms(PANDA, task, make_draw()(np.random.default_rng(1), 2), 2, 1, seed=3) for _ in range(2)]
    starts, goals = fixed_episodes(PANDA, task, 2)
    command = task.control(PANDA).command(np.zeros((2, 3)), task, np.zeros(2), goals)
    states = [a.place(starts) for a in arms]
    np.testing.assert_array_equal(states[0].box, states[1].box)
    saved = arms[0].state()
    first = [arms[0].step(command).box.copy() for _ in range(3)]
    arms[0].set_state(saved)
    np.testing.assert_array_equal([arms[0].step(command).box for _ in range(3)], first)


def test_boxes_are_drawn_inside_their_ranges():
    surface = make_draw()(np.random.default_rng(3), 2000).surface
    for name in ("stiffness", "damping", "friction", "bristle", "mass", "table"):
        value, (low, high) = getattr(surface, name), DR_CONF[name]
        assert low <= value.min() < value.max() <= high
    x, y, yaw = table_frame(PANDA).planar(np.concatenate([surface.point, surface.axes[..., 0]], -1)).T
    assert 0.019 < max(np.abs(x).max(), np.abs(y).max()) <= 0.02
    assert 19.0 < np.degrees(np.abs(yaw).max()) <= 20.0


def test_goals_start_behind_every_box_that_may_be_there(task):
    starts, goals = fixed_episodes(PANDA, task, 40)
    surface = fixed_draws(make_draw(), 40).surface
    places = np.array([Tip(PANDA)(q)[0] for q in starts])
    assert (surface.depth(places, PANDA.tool.radius) < 0).all()
    height = task.table.inside(places)[:, 2]
    np.testing.assert_allclose(height, task.height, atol=2e-4)
    x, y, yaw = task.table.planar(goals[:, :6]).T
    assert (np.hypot(x, y) >= task.away[0] - 1e-9).all()
    assert (np.hypot(x, y) <= task.away[1] + 1e-9).all()
    assert np.degrees(np.abs(np.arctan2(y, x)).max()) <= task.bearing
    assert np.degrees(np.abs(yaw).max()) <= task.goal_yaw
    np.testing.assert_array_equal(goals[:, START:], starts)


def test_the_observation_has_the_box_and_not_its_mass(task):
    """Its size is that of the scale; tip, box and error are in the frame of the table; the force is not in it."""
    _, goals = fixed_episodes(PANDA, task, 5)
    planar = np.random.default_rng(0).uniform(-0.05, 0.05, (5, 3))
    state = replace(resting(goals[:, -N:]), box=task.table.pose(planar, 0.04))
    seen = observe(task, task.control(PANDA), state, goals, task.torque_limit(PANDA))
    mean, std = observation_scale(task, PANDA)
    assert seen.shape == (5, 3 * N + 25) == (5, len(mean)) == (5, len(std))
    own = seen[:, 3 * N + 1 :]
    np.testing.assert_allclose(own[:, BOX], planar, atol=1e-6)
    np.testing.assert_allclose(own[:, BOX] + own[:, ERROR], task.table.planar(goals[:, :6]), atol=1e-6)
    np.testing.assert_allclose(own[:, 2], task.height, atol=2e-4)
    touched = replace(state, force=np.full((5, 3), 10.0))
    np.testing.assert_array_equal(observe(task, task.control(PANDA), touched, goals, task.torque_limit(PANDA)), seen)


@pytest.mark.parametrize("high", [0.08, 0.03])
def test_the_reward_keeps_the_tip_off_the_table(high):
    """The term `table` is 0 at the height at which the tip pushes, and negative just above the table."""
    task = make_task(size=(0.12, 0.12, high))
    _, goals = fixed_episodes(PANDA, task, 1)
    where = task.table.inside(Tip(PANDA)(goals[0, START:])[0][None])[0]
    low = Tip(PANDA).posture(task.table.outside(np.array([*where[:2], task.tip_radius + 5e-4])))
    column = task.reward_terms.index("table")
    for q, least, most in ((goals[0, START:], -0.03, 0.0), (low, -1.0, -0.1)):  # postures are exact to 0.2 mm
        terms = task.judge(resting(q[None]), np.zeros((1, N)), goals, np.ones(3))[1]
        assert least <= terms[0, column] <= most


def test_measures_of_known_poses(task):
    """3 cm and 10 degrees for the whole last 0.5 s, with the tip above the table."""
    steps = task.steps
    none, box = np.zeros((4, steps, N)), np.zeros((4, steps, 11))
    distance = np.full((4, steps), 0.02)
    box[..., 6], box[..., 7] = np.radians(9.0), 0.01
    distance[1, -2] = 0.04  # it leaves the goal
    box[2, -1, 6] = np.radians(-11.0)
    box[3, 5, 7] = -0.001
    episodes = Episodes(
        t=np.arange(1, steps + 1) / task.ctrl_hz, q=none, dq=none, ee=np.zeros((4, steps, 3)), goal=np.zeros((4, 3)),
        tau=none, distance=distance, reward=np.zeros((4, steps)), reward_smooth=np.zeros((4, steps)),
        q_left=np.ones(4), limited=np.zeros(4), collision=np.array([""] * 4), force=np.zeros((4, steps, 2)), box=box,
    )  # fmt: skip
    row = task.measures(episodes)
    assert (row["success"], row["within_3cm"], row["within_10deg"], row["on_table"]) == (0.25, 0.75, 0.75, 0.25)
    assert row["yaw_median_deg"] == pytest.approx(9.0, abs=0.2)
    ended = replace(episodes, distance=np.where(np.arange(steps) == steps - 1, np.inf, distance))
    row = task.measures(ended)
    assert (row["success"], row["within_3cm"], row["within_10deg"], row["stopped"]) == (0.0, 0.0, 0.0, 1.0)
    assert row["yaw_median_deg"] == np.inf


def test_dart_pushes_alike(task):
    """The second engine moves the same box within 3 mm of the way of 3 s, with exact perception in both."""
    task, draw = replace(task, episode_s=3.0, pose_noise=(0.0, 0.0)), make_draw()
    pusher = Pusher(PANDA, task, TRUE)
    starts, goals = fixed_episodes(PANDA, task, 1)
    ours = make_evaluation(PANDA, task, draw, episodes=1, nthread=1)(pusher)
    other = rollout(pusher, EngineArms(dart(PANDA), PANDA, task, draw, 1), task, starts, goals)
    assert np.linalg.norm(ours.box[0, -1, :3] - ours.box[0, 0, :3]) > 0.01
    np.testing.assert_allclose(other.box[0, :, :2], ours.box[0, :, :2], atol=3e-3)


@pytest.mark.parametrize("variant", ["rigid", "elastic"])
def test_a_twin_has_a_box_of_its_seed(variant):
    """Mass and friction are the seed's, the place is the episode's, and a camera perceives it within its noise."""
    twins = [make_twin(PANDA, variant=variant, seed=s, surface="box") for s in (0, 1, 1)]
    start = fixed_episodes(PANDA, make_task(), 1)[0][0]
    poses = []
    for twin in (*twins, twins[2]):
        twin.move_to(start)
        state, contact = twin.read(), twin._touch.contact
        assert contact[DEPTH] < 0
        np.testing.assert_allclose(state.box, box_pose(contact), atol=0.06)
        poses.append(contact[POINT : POINT + 3].copy())
        for _ in range(5):
            twin.command(np.zeros(N))
            np.testing.assert_array_equal(twin.read().box, state.box)  # one image for 33 ms
    hidden = [t._touch.contact[[MASS, TABLE]] for t in twins]
    np.testing.assert_array_equal(hidden[1], hidden[2])
    assert (hidden[0] != hidden[1]).all()
    np.testing.assert_array_equal(poses[1], poses[2])
    assert (poses[3] != poses[2])[:2].all()
    assert poses[0][2] == pytest.approx(table_frame(PANDA).origin[2] + 0.04)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"robot": BARE}, r"robot.tool: .* has no tool"),
        ({"size": (0.12, 0.12)}, r"task.size: expected three edges in m, got \(0.12, 0.12\)"),
        ({"size": (0.03, 0.12, 0.08)}, r"task.size: a box of 0.08 m .* tilts .* up to 0.075 m high does not"),
        ({"size": (0.2, 0.2, 0.15)}, r"task.size: a tip of 0.01 m, 0.06 m from the flange, .* 0.025 to 0.1 m height"),
        ({"away": (0.2, 0.1)}, r"task.away: expected \[least, most\] m"),
        ({"ctrl_hz": 30}, r"task.ctrl_hz: 30 is not allowed"),
        ({"bearing": 200.0}, r"task.bearing: "),
    ],
)
def test_a_wrong_task_is_one_line(changed, message):
    with pytest.raises(UserError, match=message) as error:
        make_task(**changed)
    assert "\n" not in str(error.value)


def test_the_limit_of_pushes_is_at_the_table_of_the_task():
    """Of a table elsewhere; by default, bit for bit at the plane below the tip at home."""
    normal = (0.6, 0.0, 0.8)
    elsewhere = make_task(point=(0.5, 0.0, 0.55), normal=normal).pushing_within(PANDA, TRUE.level, 40.0, 0.1)
    np.testing.assert_allclose(elsewhere.push_limit.point, elsewhere.table.origin)
    np.testing.assert_allclose(elsewhere.push_limit.normal, normal)
    usual, below = make_task().pushing_within(PANDA, TRUE.level, 40.0, 0.1), push_limit(PANDA, TRUE.level, 40.0, 0.1)
    np.testing.assert_array_equal(usual.push_limit.point, below.point)
    np.testing.assert_array_equal(usual.push_limit.normal, below.normal)


def test_the_reference_uses_the_spring_of_its_controller(task):
    """Its stiffness and damping, not those of the task's own; it refuses actions that set no target, or rotate."""
    make = partial(cartesian_impedance, PANDA, task, TRUE)
    soft = Pusher(PANDA, task.controlled_by(make(stiffness=400.0, damping=0.7)), TRUE)
    full = Pusher(PANDA, task.controlled_by(make(stiffness=400.0)), TRUE)
    assert soft._stiffness == 400.0
    assert soft._damping == pytest.approx(0.7 * full._damping)
    for wrong in ({"action": "stiffness"}, {"action": "both"}, {"rotational_stiffness": 5.0}):
        other = task.controlled_by(make(**wrong))
        with pytest.raises(UserError, match=r"algo: pusher cannot do .* its targets as actions is allowed"):
            Pusher(PANDA, other, TRUE)
        assert make_demonstrator(PANDA, other, TRUE) is None


def test_what_does_not_fit_is_one_line(task):
    """A place out of reach, arms without a box, a reference without impedance, wrong draws and settings of a twin."""
    with pytest.raises(UserError, match=r"task.point: the tip of panda does not reach"):
        fixed_episodes(PANDA, make_task(point=(2.0, 0.0, 0.2), normal=(0.0, 0.0, 1.0)), 1)
    with pytest.raises(UserError, match=r"dr: PushTask touches a surface; dr=box draws one"):
        make_evaluation(PANDA, task, lambda rng, m: TRUE, episodes=1, nthread=1)
    with pytest.raises(UserError, match=r"algo: pusher cannot do PushTask under control=torque"):
        Pusher(PANDA, task.controlled_by(torque(PANDA, task)), TRUE)
    with pytest.raises(UserError, match=r"dr.mass: expected \[least, most\], got 1.0"):
        make_draw(mass=1.0)
    with pytest.raises(UserError, match=r"arm.surface.box: expected three edges"):
        make_twin(PANDA, surface={"box": 0.1})
    with pytest.raises(UserError, match=r"arm.surface: expected false, true, box or"):
        make_twin(PANDA, surface="boxes")
    with pytest.raises(UserError, match=r"surface.mass: only a box moves"):
        replace(task.expected(PANDA, TRUE).surface, half=None, axes=None).check()
    with pytest.raises(UserError, match=r"surface.mass: expected a value above 0 kg"):
        standing_box(task.table, np.zeros(3), task.size, stiffness=1e4, mass=0.0).check()
    assert check_size("task.size", [0.1, 0.2, 0.1], 0.5).tolist() == [0.1, 0.2, 0.1]
    assert torch.isfinite(Pusher(PANDA, task, TRUE).action(torch.zeros(2, 3 * N + 25))).all()


@pytest.mark.slow
def test_train_and_transfer_to_a_twin(tmp_path):
    """From the command line: a short training, and a twin with a box; one without is refused in one line."""
    short = "budget.env_steps=8000", "budget.minutes=null", "evaluation.episodes=2", "algo.n_envs=8", "compile=false"
    succeed("task=push", *short, f"root={tmp_path}", "name=toy", "threads=1")
    transfer = "stage=transfer", f"policy={tmp_path}/train/toy", "arm=twin", "evaluation.episodes=2", "threads=1"
    for words, message in (
        ((), "arm.surface: PushTask touches a surface, and this arm has none; box is allowed"),
        (("arm.surface=true",), "arm: PushTask needs the pose of a box, which arm=twin does not report"),
    ):
        refused = r2s(*transfer, *words, f"root={tmp_path}")
        assert refused.returncode == 2
        assert message in refused.stdout + refused.stderr
    succeed(*transfer, "arm.surface=box", "simulator=dart", f"root={tmp_path}", "name=twin")
    rows = json.loads((tmp_path / "transfer/twin/summary.json").read_text())
    assert {"mujoco", "dart", "predicted", "twin"} <= set(rows)
    assert rows["twin"]["distance_median_m"] < 0.5
