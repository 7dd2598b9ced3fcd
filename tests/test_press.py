"""Task press: the reference holds its force, observations and draws are what they say, and errors are one line."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from cli_runs import r2s, succeed
from conftest import conf
from test_trust import composed

from r2s.control.torque import torque
from r2s.errors import UserError
from r2s.learning.evaluate import fixed_draws, fixed_episodes, make_evaluation
from r2s.learning.model_based import hybrid_force
from r2s.learning.randomization import ContactRandomization
from r2s.physics.dynamics import Dynamics, nominal_dynamics
from r2s.physics.friction import COULOMB
from r2s.physics.robot import load_robot
from r2s.physics.tip import Tip, default_plane
from r2s.stages.build import make_dynamics
from r2s.tasks.press import PressTask
from r2s.tasks.surface_task import FORCES, NORMAL, POINT
from r2s.tasks.task import Episodes, State, observation_scale, observe

BARE = load_robot(**conf("robot/panda"))
PANDA = load_robot(**conf("robot/panda") | {"tool": conf("task/press")["tool"]})
N = PANDA.n
TRUE = nominal_dynamics(PANDA, **conf("friction/paper"), inertia_scale=conf("inertia/paper")["scale"])
FRICTIONLESS = Dynamics.of(PANDA, np.zeros((N, 3)))
TASK_CONF = {k: tuple(v) if isinstance(v, list) else v for k, v in conf("task/press").items()}
# the yaml takes these from the task
DR_CONF = conf("dr/contact") | {"point": None, "normal": None, "place": 0.005, "tilt": 5.0}


def make_task(dynamics=TRUE, robot=PANDA, **changed):
    return PressTask(**TASK_CONF | changed).with_model(robot, dynamics)


def make_draw(**changed):
    exact = {"phi_relative": 0.0, "inertia_relative": 0.0}
    return ContactRandomization(PANDA, TRUE, **DR_CONF | exact | changed)


def pressed(task, draw, episodes=4):
    """Return the episodes of the reference."""
    evaluate = make_evaluation(PANDA, task, draw, episodes=episodes, nthread=1)
    return evaluate(hybrid_force(PANDA, task, TRUE))


def resting(q, **changed):
    """Return m arms at rest at q (m, n) under `changed`."""
    m, none = len(q), np.zeros((len(q), N))
    arm = {"t": np.zeros(m), "q": q, "dq": none, "tau": none, "effort": none}
    rest = {
        "ee": np.zeros((m, 3)),
        "jacobian": np.zeros((m, 3, N)),
        "stopped": np.zeros(m, bool),
        "limited": np.zeros(m),
    }
    return State(**arm | rest | changed)


def test_an_action_of_torque_is_a_share_of_what_the_task_may_command():
    """An action of 1 commands the torque limit, task.torque_fraction of tau_max; an impedance has the same."""
    task = make_task(torque_fraction=0.6)
    by_torque = task.controlled_by(torque(PANDA, task))
    for limit in (task.torque_limit(PANDA), by_torque.torque_limit(PANDA), by_torque.control(PANDA).action_scale):
        np.testing.assert_allclose(limit, 0.6 * PANDA.tau_max)


@pytest.mark.long
@pytest.mark.parametrize("stiffness", [2e3, 1e5])
def test_the_reference_on_the_true_model_ends_within_a_newton(stiffness):
    """On the softest and on the most rigid surface, before the step and at the end, without a jump at the step.

    The rest is friction: the feedforward has that of joints about to move, and the arm's are at rest.
    """
    task = make_task()
    row = task.measures(pressed(task, make_draw(stiffness=[stiffness, stiffness])))
    assert row["success"] == 1.0
    assert row["force_rmse_first_N"] < 1.0
    assert row["force_rmse_last_N"] < 1.0
    assert row["contact"] > 0.98  # the first touch of the most rigid one may bounce


@pytest.mark.long
def test_joints_at_rest_hold_the_force_of_a_contact():
    """Eq. (6) is replaced where a task touches: with it a resting joint yields, and friction feedforward is force."""
    phi = np.array([1.0, 0.0, 0.1]) * np.linspace(1.0, 0.4, N)[:, None]
    edges = np.linspace(1.0, 0.4, N)[:, None] * np.array([-1.0, 1.0])
    eq6 = replace(Dynamics.of(PANDA, phi, COULOMB), breakaway=edges)
    errors = []
    for model in (eq6, eq6.holding_contact()):
        draw = ContactRandomization(PANDA, model, **DR_CONF | {"phi_relative": 0.0, "inertia_relative": 0.0})
        task = PressTask(**TASK_CONF).with_model(PANDA, model)
        evaluate = make_evaluation(PANDA, task, draw, episodes=4, nthread=1)
        errors.append(task.measures(evaluate(hybrid_force(PANDA, task, model)))["force_rmse_last_N"])
    assert errors[1] < 1.0 < errors[0]
    for name, stiction in (("press", "net"), ("reach", "command")):
        cfg = composed(f"task={name}", "friction.family=coulomb", "friction.stiction_model=command")
        assert make_dynamics(cfg, PANDA).stiction_model == stiction
    assert TRUE.holding_contact() is TRUE  # the paper's friction has no jump at rest


def test_a_seed_gives_the_same_forces():
    task = replace(make_task(), episode_s=4.5)
    first, second = (pressed(task, make_draw(), 2) for _ in range(2))
    np.testing.assert_array_equal(first.force, second.force)
    assert (first.force[:, -1, 0] > 0).all()


def test_the_tip_meets_the_surface_no_faster_than_its_target():
    """Friction and damping hold the tip back; 10 % for the noise of the first cycles."""
    task = make_task()
    episodes = pressed(task, make_draw(phi_relative=0.1))
    tip = Tip(PANDA)
    for q, force in zip(episodes.q, episodes.force[..., 0], strict=True):
        height = np.array([tip(row)[0][2] for row in q[: np.argmax(force > 0.1)]])
        assert -np.diff(height).min() * task.ctrl_hz < 1.1 * task.approach_speed


def test_surfaces_are_drawn_inside_their_ranges():
    draw = make_draw()
    surface = draw(np.random.default_rng(3), 2000).surface
    point, normal = default_plane(PANDA)
    for name in ("stiffness", "exponent", "damping", "friction", "bristle"):
        value, (low, high) = getattr(surface, name), DR_CONF[name]
        assert low <= value.min() < value.max() <= high
    along = (surface.point - point) @ normal
    tilt = np.degrees(np.arccos((surface.normal @ normal).clip(-1, 1)))
    assert np.abs(along).max() <= 5e-3 < 1.05 * np.abs(along).max()
    assert tilt.max() <= 5.0 < 1.05 * tilt.max()
    np.testing.assert_allclose(np.linalg.norm(surface.normal, axis=1), 1.0, atol=1e-12)
    again = draw(np.random.default_rng(3), 2000).surface
    np.testing.assert_array_equal(surface.point, again.point)


def test_goals_start_above_every_surface_that_may_be_there():
    """The tip is over its point, outside of all drawn surfaces; forces lie in their range, apart."""
    task, draw = make_task(), make_draw()
    starts, goals = fixed_episodes(PANDA, task, 40)
    surface = fixed_draws(draw, 40).surface
    places = np.array([Tip(PANDA)(q)[0] for q in starts])
    assert (surface.depth(places, PANDA.tool.radius) < 0).all()
    across = places - goals[:, POINT]
    across -= (across * goals[:, NORMAL]).sum(1, keepdims=True) * goals[:, NORMAL]
    assert np.abs(across).max() < 2e-4
    assert 5 <= goals[:, FORCES].min() < goals[:, FORCES].max() <= 20
    assert np.abs(np.diff(goals[:, FORCES])).min() >= 3.0


def test_the_observation_has_its_terms():
    """Its size is that of the scale and of the terms; what the arm does not know is not in it."""
    task = make_task()
    _, goals = fixed_episodes(PANDA, task, 5)
    state = resting(goals[:, -N:])
    seen = observe(task, task.control(PANDA), state, goals, task.torque_limit(PANDA))
    mean, std = observation_scale(task, PANDA)
    assert seen.shape == (5, 3 * N + 12) == (5, len(mean)) == (5, len(std))
    wide = {"q": N, "dq": N, "tip - point": 3, "velocity of the tip": 3, "effort / torque": N}
    assert sum(wide.get(term.name, 1) for term in task.observation_terms(PANDA)) == 3 * N + 12
    offset = (seen[:, 2 * N : 2 * N + 3] * goals[:, NORMAL]).sum(1)
    np.testing.assert_allclose(offset, task.clearance + PANDA.tool.radius, atol=2e-4)
    touched = replace(state, force=np.full((5, 3), 10.0))
    np.testing.assert_array_equal(observe(task, task.control(PANDA), touched, goals, task.torque_limit(PANDA)), seen)


def test_the_estimate_is_the_force_of_the_command():
    """Without friction, at rest, J^T F is estimated as F; friction of a wrong model is its bias."""
    task = make_task(FRICTIONLESS)
    _, goals = fixed_episodes(PANDA, task, 5)
    q = goals[:, -N:]
    force = -12.0 * goals[:, NORMAL]
    tau = np.array([Tip(PANDA)(row)[1].T @ f for row, f in zip(q, force, strict=True)])
    np.testing.assert_allclose(task.estimate(resting(q, tau=tau), goals[:, NORMAL]), 12.0, rtol=0.02)
    sliding = resting(q, tau=tau, dq=np.full((5, N), -0.1))
    assert np.abs(make_task().estimate(sliding, goals[:, NORMAL]) - 12.0).min() > 0.1


def test_measures_of_known_forces():
    """A constant error is the RMSE, the highest force beyond a step its overshoot, and 0.1 s the impact."""
    task = make_task()
    steps, step = task.steps, 350
    asked = np.where(np.arange(steps) < step, 8.0, 12.0)
    force = asked + 0.5
    force[:50] = 0.0
    force[52], force[360] = 15.0, 13.0
    none = np.zeros((1, steps, N))
    episodes = Episodes(
        t=np.arange(1, steps + 1) / 100, q=none, dq=none, ee=np.zeros((1, steps, 3)), goal=np.zeros((1, 3)), tau=none,
        distance=np.abs(force - asked)[None], reward=np.zeros((1, steps)), reward_smooth=np.zeros((1, steps)),
        q_left=np.ones(1), limited=np.zeros(1), collision=np.array([""]), force=np.stack([force, asked], -1)[None],
    )  # fmt: skip
    row = task.measures(episodes)
    assert row["force_rmse_first_N"] == pytest.approx(0.5)
    assert row["force_rmse_last_N"] == pytest.approx(0.5)
    assert row["overshoot_N"] == pytest.approx(1.0)
    assert row["overshoot_share"] == pytest.approx(0.25)
    assert (row["impact_N"], row["contact"], row["success"]) == (15.0, 1.0, 1.0)
    stopped = replace(episodes, distance=np.full((1, steps), np.inf))
    assert task.measures(stopped)["success"] == 0.0
    assert task.measures(stopped)["stopped"] == 1.0


def test_a_step_down_turns_the_direction_of_friction():
    task = make_task()
    goals = np.tile(fixed_episodes(PANDA, task, 1)[1], (2, 1))
    goals[:, FORCES] = [[8.0, 15.0], [15.0, 8.0]]
    early, late = (task.target(np.full(2, t), goals)[:, 3:] @ goals[0, NORMAL] for t in (1.0, 5.0))
    np.testing.assert_allclose(early, -task.creep)
    np.testing.assert_allclose(late, [-task.creep, task.creep])
    asked = [task.contact(np.full(2, t), goals)[:, 3].tolist() for t in (1.0, 3.6, 6.0)]
    np.testing.assert_allclose(asked, [[8.0, 15.0], [12.0, 11.0], [15.0, 8.0]])


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"force": (5.0, 90.0)}, r"task.force: expected at most 22.2 N, which torque_fraction allows"),
        ({"force": (9.0, 5.0)}, r"task.force: \(9.0, 5.0\) is not allowed"),
        ({"robot": BARE}, r"robot.tool: .* has no tool"),
        ({"clearance": 0.005}, r"task.clearance: 0.005 m may lie inside the surface; more than 0.00937 m"),
        ({"step_s": 0.5}, r"task.step_s: "),
        ({"episode_s": 4.0}, r"task.episode_s: "),
        ({"ctrl_hz": 30}, r"task.ctrl_hz: 30 is not allowed"),
    ],
)
def test_a_wrong_task_is_one_line(changed, message):
    with pytest.raises(UserError, match=message) as error:
        make_task(**changed)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"stiffness": [0.0, 1e5]}, r"dr.stiffness: "),
        ({"friction": [0.5, 0.1]}, r"dr.friction: expected \[least, most\]"),
        ({"exponent": 1.5}, r"dr.exponent: expected \[least, most\], got 1.5"),
        ({"tilt": 90.0}, r"dr.tilt: "),
        ({"normal": [0, 0, 0]}, r"normal: expected 3 numbers"),
    ],
)
def test_a_wrong_draw_is_one_line(changed, message):
    with pytest.raises(UserError, match=message) as error:
        make_draw(**changed)
    assert "\n" not in str(error.value)


def test_what_does_not_fit_is_one_line():
    """A plane out of reach, arms without a surface, a reference without force control."""
    with pytest.raises(UserError, match=r"task.point: the tip of panda does not reach"):
        fixed_episodes(PANDA, make_task(point=(2.0, 0.0, 0.2), normal=(0.0, 0.0, 1.0)), 1)
    with pytest.raises(UserError, match=r"dr: PressTask touches a surface; dr=contact draws one"):
        make_evaluation(PANDA, make_task(), lambda rng, m: TRUE, episodes=1, nthread=1)
    task = make_task()
    with pytest.raises(UserError, match=r"algo: hybrid_force cannot do PressTask under control=torque"):
        hybrid_force(PANDA, task.controlled_by(torque(PANDA, task)), TRUE)
    assert torch.equal(hybrid_force(PANDA, task, TRUE).action(torch.zeros(2, 5)), torch.zeros(2, 3))


@pytest.mark.slow
@pytest.mark.parametrize("task", ["press", "wipe"])
def test_train_and_transfer_to_a_twin(task, tmp_path):
    """From the command line: a short training improves nothing yet, but the policy touches the surface of a twin."""
    short = (
        "budget.env_steps=4000",
        "budget.minutes=null",
        "evaluation.episodes=2",
        "algo.n_envs=8",
        "compile=false",
        "algo.demonstrations=800",
    )
    succeed(f"task={task}", *short, f"root={tmp_path}", "name=toy", "threads=1")
    transfer = "stage=transfer", f"policy={tmp_path}/train/toy", "arm=twin", "evaluation.episodes=2", "threads=1"
    refused = r2s(*transfer, f"root={tmp_path}")
    assert refused.returncode == 2
    assert (
        f"arm.surface: {task.title()}Task touches a surface, and this arm has none" in refused.stdout + refused.stderr
    )
    succeed(*transfer, "arm.surface=true", f"root={tmp_path}", "name=twin")
    rows = json.loads((tmp_path / "transfer/twin/summary.json").read_text())
    assert {"mujoco", "predicted", "twin"} <= set(rows)
    assert rows["twin"]["contact"] > 0.9
    assert rows["twin"]["force_rmse_N"] < 5.0


def test_a_training_says_that_contact_changes_the_stiction_model(capsys):
    """Eq. (6) holds commands alone; a task without contact, and a smooth law, keep it."""
    for words, changes in ((["task=press", "friction.family=coulomb"], True), (["task=press"], False), ([], False)):
        cfg = composed("friction=gaz2019", *words)
        dynamics = make_dynamics(cfg, load_robot(**conf("robot/panda")), announce=True)
        assert (dynamics.stiction_model == "net") == changes
        assert ("friction.stiction_model=net instead of command" in capsys.readouterr().out) == changes
