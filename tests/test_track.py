"""Tracking: paths are smooth and within limits, a right model follows them, and every stage takes the task."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from conftest import ROOT, conf

from r2s.errors import UserError
from r2s.learning.env import TaskEnv
from r2s.learning.evaluate import fixed_episodes, make_evaluation
from r2s.learning.model_based import Oracle, ZeroAction, computed_torque
from r2s.learning.policy import make_policy
from r2s.learning.randomization import ForceRandomization
from r2s.learning.vector_arms import VectorArms
from r2s.physics.dynamics import Dynamics, nominal_dynamics
from r2s.physics.inverse_dynamics import InverseDynamics
from r2s.physics.rigid_body import Kinematics
from r2s.physics.robot import load_robot
from r2s.physics.safety_filter import RATE
from r2s.physics.simulator import Simulator
from r2s.tasks.reach import ReachTask
from r2s.tasks.rollout import rollout
from r2s.tasks.task import State
from r2s.tasks.track import TrackTask
from r2s.tasks.trajectory import ACCELERATION, KINDS, SPEED, TORQUE, Paths, clock, curve, smooth

PANDA = load_robot(**conf("robot/panda"))
NEW = nominal_dynamics(PANDA, **conf("friction/paper"), inertia_scale=conf("inertia/paper")["scale"])
# friction without a dead zone: what a model can know exactly
SMOOTH = replace(NEW, breakaway=0 * NEW.breakaway)
SETTINGS = {k: tuple(v) if isinstance(v, list) else v for k, v in conf("task/track").items()}
TASK = TrackTask(**SETTINGS | {"pool": 4}).with_model(PANDA, SMOOTH)
N = PANDA.n


@pytest.fixture(scope="module")
def plans():
    """Return four plans, one of each kind."""
    return np.concatenate(
        [replace(TASK, kinds=(k,)).goals(PANDA, np.random.default_rng(i), 1) for i, k in enumerate(KINDS)]
    )


def joints(plans):
    """Return q, dq, ddq of plans."""
    return (plans[..., 6 + i * N : 6 + (i + 1) * N] for i in range(3))


def test_a_clock_is_smooth_and_goes_from_rest_to_rest():
    """Its pace and slope are the derivatives of its way, to what differences of 1 ms see; both are 0 at the ends."""
    t = np.arange(0, 4.0005, 1e-3)
    come, pace, slope = clock(t, 4.0, 0.6)
    np.testing.assert_allclose(np.gradient(come, t)[1:-1], pace[1:-1], atol=1e-5)
    np.testing.assert_allclose(np.gradient(pace, t)[1:-1], slope[1:-1], atol=1e-4)
    assert np.abs([pace[[0, -1]], slope[[0, -1]]]).max() < 1e-12
    assert come[-1] == pytest.approx(4.0 - 0.6)
    assert np.all((pace >= 0) & (pace <= 1 + 1e-12))
    assert smooth(np.array([0.0, 0.5, 1.0])) == pytest.approx([0.0, 0.5, 1.0])


@pytest.mark.parametrize("kind", KINDS)
def test_a_curve_keeps_its_size_and_its_speed(kind):
    """It begins at 0; a metre of u is no more than a metre of way, and somewhere it is one; two sizes hold it."""
    u = np.arange(0, 4, 1e-3)
    x = curve(kind, np.random.default_rng(3), 0.15)(u)
    speed = np.linalg.norm(np.diff(x, axis=0), axis=1) / 1e-3
    np.testing.assert_allclose(x[0], 0, atol=1e-12)
    assert 0.9 < speed.max() < 1.001
    assert np.linalg.norm(x - x[:, None, :][::200], axis=-1).max() <= 2 * 0.15 + 1e-9


@pytest.mark.parametrize("kind", KINDS)
def test_a_path_is_continuous_to_the_second_derivative(kind):
    """Every ms: speeds and accelerations are the derivatives of what they belong to, and none of them jumps.

    Where an acceleration changes by at most j within h, a central difference of speeds over h is off by j.
    """
    h = 1e-3
    paths = Paths(PANDA, TASK.torque_limit(PANDA), 4.0, 0.6)
    shape = curve(kind, np.random.default_rng(5), 0.12)
    q, dq, ddq = joints(paths.plan(np.array([0.5, 0.0, 0.5]), shape, 0.7, np.arange(0, 4.0, h)))
    j = np.abs(np.diff(ddq, axis=0)).max()
    assert j < 0.1 * np.abs(ddq).max()
    np.testing.assert_allclose(np.gradient(dq, h, axis=0)[1:-1], ddq[1:-1], atol=j)
    np.testing.assert_allclose(np.gradient(q, h, axis=0)[1:-1], dq[1:-1], atol=h * j)


def test_a_plan_begins_and_ends_at_rest_and_has_the_hands_motion(plans):
    """Neither speed nor acceleration at both ends and beyond; the hand is where kinematics has it."""
    _, dq, ddq = joints(plans)
    for rests in (dq[:, 0], ddq[:, 0], dq[:, TASK.steps :], ddq[:, TASK.steps :]):
        np.testing.assert_allclose(rests, 0, atol=1e-9)
    kinematics = Kinematics(PANDA)
    for plan in plans:
        place, jacobian = kinematics(plan[123, 6 : 6 + N])
        np.testing.assert_allclose(plan[123, :3], place, atol=1e-9)
        np.testing.assert_allclose(plan[123, 3:6], jacobian @ plan[123, 6 + N : 6 + 2 * N], atol=1e-6)


def test_a_path_is_as_fast_as_the_limits_let_it():
    """A pace that is far too fast is made slower until torque, speed or acceleration is just at its share."""
    paths = Paths(PANDA, TASK.torque_limit(PANDA), 4.0, 0.6)
    t = np.arange(0, 4, 0.02)
    for seed in range(3):
        plan = paths.plan(np.array([0.5, 0.0, 0.5]), curve("circle", np.random.default_rng(seed), 0.08), 1.0, t)
        q, dq, ddq = joints(plan)
        assert 0.8 < paths.strain(q, dq, ddq) <= 1.0
        rigid = InverseDynamics(PANDA, Dynamics.of(PANDA, np.zeros((N, 3)))).rigid(q, dq, ddq)
        assert np.all(np.abs(rigid) <= TORQUE * TASK.torque_limit(PANDA) + 1e-9)
        allowed = 0.66 * PANDA.dq_max
        assert np.all(np.abs(dq) <= SPEED * allowed)
        assert np.all(ddq <= ACCELERATION * RATE * (SPEED * allowed - dq) + 1e-9)
        assert np.all((q > PANDA.q_min) & (q < PANDA.q_max))


def test_inverse_dynamics_is_what_the_simulator_needs():
    """The torque of a model with offsets, drag, load and other links makes the acceleration that it was asked for.

    A step of 1e-6 s is off by what friction's slope and the Coriolis torque change in it.
    """
    rng = np.random.default_rng(0)
    arm = replace(
        SMOOTH, mass=1.05 * NEW.mass, com=NEW.com + 3e-3, drag=rng.uniform(-0.2, 0.2, (N, 2)), load=np.full(N, 0.02)
    )
    q, dq = PANDA.q_home + rng.uniform(-0.3, 0.3, (4, N)), rng.uniform(0.1, 0.8, (4, N))
    ddq = rng.uniform(-3, 3, (4, N))
    sim = Simulator(PANDA, arm, 4, 1, dt=1e-6)
    sim.reset(q, dq)
    sim.rollout(InverseDynamics(PANDA, arm)(q, dq, ddq, dq)[:, None])
    np.testing.assert_allclose((sim.dq - dq) / 1e-6, ddq, atol=2e-2)


def test_a_right_model_follows_within_the_time_that_it_is_late(plans):
    """Computed torque with the arm's own model: off by less than the way of half a control period.

    A torque that is held for a period is right up to a shift in time of half of it; all else is compensated.
    """
    arms = VectorArms(PANDA, TASK, SMOOTH, len(plans), 1)
    done = rollout(ZeroAction(N), arms, TASK, TASK.begin(np.zeros((len(plans), N)), plans), plans)
    fastest = np.linalg.norm(plans[:, :, 3:6], axis=-1).max(1)
    assert np.all(done.distance.max(1) < 0.5 / TASK.ctrl_hz * fastest + 1e-4)
    row = TASK.measures(done)
    assert row["within_5mm"] == 1.0
    assert row["stopped"] == row["collision"] == 0.0
    touched = replace(done, collision=np.array(["0.50 s: hand and the table", "", "", ""], dtype=object))
    assert TASK.measures(touched)["collision"] == 0.25
    assert row["path_rmse_mm"] == pytest.approx(1e3 * np.sqrt((done.distance**2).mean()))
    wrong = TASK.with_model(PANDA, nominal_dynamics(PANDA, **conf("friction/gaz2019")))
    off = rollout(ZeroAction(N), arms, wrong, TASK.begin(np.zeros((len(plans), N)), plans), plans)
    assert TASK.measures(off)["path_rmse_mm"] > 2 * row["path_rmse_mm"]


def test_the_preview_is_the_path(plans):
    """An observation has the next places of the path, from the hand, and the plan's posture, from the arm's."""
    rng = np.random.default_rng(1)
    q = PANDA.q_home + rng.uniform(-0.1, 0.1, (len(plans), N))
    m, rest = len(plans), np.zeros((len(plans), N))
    ee, none = rng.uniform(0, 1, (m, 3)), (np.zeros(m, dtype=bool), np.zeros(m))
    state = State(np.full(m, 1.23), q, rest, ee, np.zeros((m, 3, N)), rest, rest, *none)
    seen = TASK.observe(state, plans, TASK.torque_limit(PANDA))
    assert seen.shape == (len(plans), len(TASK.observation_scale(PANDA)[0]))
    first = 6 * N + 12
    for j in range(TASK.preview):
        ahead = seen[:, first + 3 * j : first + 3 * j + 3]
        np.testing.assert_allclose(ahead, plans[:, 124 + j, :3] - state.ee, atol=1e-6)
    plan = first + 3 * TASK.preview + 3 + 3 + 1
    np.testing.assert_allclose(seen[:, plan : plan + N], plans[:, 123, 6 : 6 + N] - q, atol=1e-6)


def test_the_same_seed_is_the_same_path():
    """Goals repeat with their seed to the bit, and starts are where the paths begin, at rest."""
    short = replace(TASK, episode_s=1.5)
    (q, one), (_, two) = fixed_episodes(PANDA, short, 3), fixed_episodes(PANDA, short, 3)
    assert np.array_equal(one, two)
    assert not np.array_equal(one, fixed_episodes(PANDA, short, 3, seed=1)[1])
    assert np.array_equal(q, one[:, 0, 6 : 6 + N])
    evaluate = make_evaluation(PANDA, short, lambda rng, m: NEW, episodes=3, nthread=1)
    policy = make_policy(PANDA, short, (8,))
    first, second = evaluate(policy), evaluate(policy)
    assert np.array_equal(first.ee, second.ee)
    assert first.goal.shape == (3, short.steps, 3)
    np.testing.assert_allclose(first.distance, np.linalg.norm(first.ee - first.goal, axis=-1), atol=1e-12)


def test_random_forces_push_and_repeat():
    """dr=force: the same seed and actions give the same bits, other forces another motion, and none is the centre."""
    short = replace(TASK, episode_s=1.5)

    def after(share):
        env = TaskEnv(PANDA, short, ForceRandomization(PANDA, NEW, share), 2, nthread=1)
        state = env.reset()
        for _ in range(20):
            state["action"] = torch.zeros(2, N)
            state = env.step_and_maybe_reset(state)[1]
        return env, state["observation"]

    pushed, again, still = after(0.5), after(0.5), after(0.0)
    assert torch.equal(pushed[1], again[1])
    assert not torch.equal(pushed[1], still[1])
    env = still[0]
    kept = env.state()
    env.set_state(kept)
    assert torch.equal(env.read()["observation"], still[1])


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"preview": 500}, "task.preview: 500 samples are longer than the path, which has 400"),
        ({"preview": 0}, "task.preview: expected a whole number"),
        ({"ctrl_hz": 40}, "task.ctrl_hz: 40 is not allowed; 50, 100, 125 and 200 are"),
        ({"speed": (1.0, 0.1)}, r"task.speed: \(1.0, 0.1\) is not allowed"),
        ({"kinds": ("circel",)}, "task.kinds: 'circel'; .*did you mean 'circle'"),
        ({"ramp_s": 3.0}, "task.episode_s: expected a number in"),
    ],
)
def test_mistakes_are_said_in_a_line(change, said):
    with pytest.raises(UserError, match=said) as error:
        TrackTask(**SETTINGS | change)
    assert "\n" not in str(error.value)


def test_a_path_out_of_reach_is_said_in_a_line():
    """A region as thin as a shell: every path leaves it."""
    with pytest.raises(UserError, match=r"task.size: paths of 0.08 to 0.25 m are out of the reach of panda") as error:
        TrackTask(**SETTINGS | {"reach": (0.5, 0.53)}).goals(PANDA, np.random.default_rng(0), 1)
    assert "\n" not in str(error.value)


def test_computed_torque_needs_no_policy_or_is_the_oracle():
    """Tracking leaves it to the controller, reaching gets a minimum-jerk motion; torque control has neither."""
    assert isinstance(computed_torque(PANDA, TASK, NEW), ZeroAction)
    assert isinstance(computed_torque(PANDA, ReachTask(), NEW), Oracle)
    pure = TrackTask(**SETTINGS)
    with pytest.raises(UserError, match=r"algo: computed_torque cannot do TrackTask under control=torque"):
        computed_torque(PANDA, pure, NEW)
    command = pure.control(PANDA).command(np.ones((1, N)), pure, np.zeros(1), np.zeros((1, 404, 27)))
    np.testing.assert_allclose(command[0], pure.torque_limit(PANDA))


@pytest.mark.slow
def test_every_stage_takes_it(tmp_path, monkeypatch, capsys):
    """Train, transfer and compare, in this process; tables have the task's own measures."""
    import json

    from hydra import compose, initialize_config_dir

    from r2s.stages.compare import compare
    from r2s.stages.train import train
    from r2s.stages.transfer import transfer

    def stage(run, *words):
        with initialize_config_dir(str(ROOT / "conf"), version_base=None):
            cfg = compose("config", overrides=[f"root={tmp_path}", "threads=1", *words])
        run(cfg, list(words))

    short = ["task=track", "task.episode_s=1.5", "task.pool=4", "name=a", "+experiment=toy", "budget.env_steps=900"]
    stage(train, *short)
    summary = json.loads((tmp_path / "train" / "a" / "summary.json").read_text())
    assert np.isfinite(summary["last"]["path_rmse_mm"])
    stage(train, *short[:3], "name=b", "algo=computed_torque", "dr=none", "evaluation.episodes=4")
    policy = f"policy={tmp_path / 'train' / 'a'}"
    stage(transfer, "stage=transfer", policy, "name=a", "arm=twin", "evaluation.episodes=2")
    rows = json.loads((tmp_path / "transfer" / "a" / "summary.json").read_text())
    assert {"mujoco", "predicted", "twin"} == rows.keys()
    assert rows["twin"]["path_rmse_mm"] > 0
    assert (tmp_path / "transfer" / "a" / "recording.rrd").is_file()
    stage(compare, "stage=compare", f"runs={tmp_path}/train/*", "name=a")
    said = capsys.readouterr().out
    assert "RMSE, mm" in said
    assert "success" not in said
