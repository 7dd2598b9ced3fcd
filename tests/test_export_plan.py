"""A policy that follows plans travels: its bundle's runtime does what r2s does, and refuses what cannot be."""

import json
import re
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import ROOT, conf
from made_bundles import ROUNDINGS, arm_of, bare, compare, drawn, hostile, loaded, runs_in  # noqa: F401

from r2s import commands
from r2s.arm.policy_runner import PolicyRunner
from r2s.arm.simulated import SimulatedArm
from r2s.errors import UserError
from r2s.export.contract import make_contract
from r2s.export.control import Control
from r2s.export.plan import Follower
from r2s.physics.dynamics import nominal_dynamics, with_family
from r2s.physics.friction import FAMILIES, SIGMOID
from r2s.physics.robot import load_robot
from r2s.tasks.rollout import rollout
from r2s.tasks.track import TrackTask

SETTINGS = {k: tuple(v) if isinstance(v, list) else v for k, v in conf("task/track").items()}
SHORT = "task=track", "task.episode_s=1.2", "task.kinds=[circle]"  # one second and a fifth: the least, with its ramps
# two writings of inverse dynamics: sums of some tens of terms of the result's size, each to 1e-16
BASE = 1e-12
CALM_RAD, CALM_SHARE = 0.01, 0.05  # of joints off their plan, and of their largest speed


def export(folder: Path, *overrides: str):
    made = drawn(folder / "runs" / "train" / "drawn", *SHORT, *overrides)
    commands.run_command(["export", str(made.run)])
    return made


@pytest.fixture(scope="module")
def planned(tmp_path_factory):
    """The bundle of a policy whose torque is added to the model's."""
    return export(tmp_path_factory.mktemp("planned"))


@pytest.fixture(scope="module")
def runtime(planned):
    return loaded(planned.folder)


def along(exported, cycles: int, calm: int) -> dict[str, np.ndarray]:
    """Return a `hostile` motion whose first `calm` cycles are one that is near its plan; goals are plans.

    Each cycle's joints are off the plan by other amounts, so that the law has something to do.
    """
    robot, task = exported.robot, exported.task
    motion, rng, n = hostile(robot, task, cycles), np.random.default_rng(1), robot.n
    plans = np.load(exported.folder / "plans.npz")["plans"]
    motion |= {"goal": plans, "which": motion["which"] % len(plans)}
    begin = motion["begin"]
    motion["q"][begin], motion["dq"][begin] = plans[motion["which"][begin], 0, 6 : 6 + n], 0.0  # else it is refused
    t = np.arange(calm) / task.substeps
    row = np.minimum(t.astype(int), task.steps)
    plan, share = plans[0], np.where(row < task.steps, t - row, 0.0)[:, None]
    near = plan[row] + share * (plan[row + 1] - plan[row])
    motion["q"][:calm] = near[:, 6 : 6 + n] + CALM_RAD * rng.normal(size=(calm, n))
    motion["dq"][:calm] = near[:, 6 + n : 6 + 2 * n] + CALM_SHARE * robot.dq_max * rng.normal(size=(calm, n))
    motion["dq"][0] = 0.0
    motion["begin"][1:calm], motion["which"][:calm], motion["applied"][:calm] = False, 0, np.nan
    return motion


def dynamics_of(robot, family: str):
    """Return dynamics that have something of all that a model may say, with one family of friction."""
    friction = conf("friction/paper") if robot.n == 7 else {"phi1": 1.0, "phi2": 20.0, "phi3": 0.01}
    rng, d = np.random.default_rng(2), with_family(nominal_dynamics(robot, **friction), family)
    optional = 0.3 * rng.random((robot.n, len(d.family.names) - d.phi.shape[-1]))
    d = replace(d, phi=np.concatenate([d.phi, optional], -1), offset=rng.normal(size=robot.n), delay=0.004, lag=0.002)
    d = replace(d, drag=rng.normal(size=(robot.n, 2)), load=0.1 * rng.random(robot.n), armature=np.full(robot.n, 0.1))
    return replace(d, mass=1.1 * d.mass, com=d.com + 0.01, inertia=1.2 * d.inertia)


@pytest.mark.long
@pytest.mark.parametrize("family", [f.name for f in FAMILIES])
@pytest.mark.parametrize("arm", ["panda", "six_joints"])
def test_the_torque_of_the_model_is_that_of_r2s(panda, arm, family):
    """At any state and in any row of any plan, the end and what comes after included."""
    robot = panda if arm == "panda" else load_robot(str(ROOT / "tests" / "models" / "six_joints.xml"))
    more = {} if arm == "panda" else {"reach": None, "torque_fraction": 0.2}
    task = TrackTask(**SETTINGS | more).with_model(robot, dynamics_of(robot, family))
    contract = json.loads(json.dumps(make_contract(robot, task, task.model.level), allow_nan=False))
    control, rng, n = task.control(robot), np.random.default_rng(3), robot.n
    follow = Follower(contract, Control(contract))
    plan = rng.normal(size=contract["goal"]["shape"])
    follow.take(plan)
    for step in (0, 1, 17, task.steps - 2, task.steps - 1, task.steps, task.steps + 50):
        q, dq, t = *rng.normal(size=(2, n)), np.array([step / task.ctrl_hz])
        command = control.command(np.zeros((1, n)), task, t, plan[None])
        wanted = control.torque(q[None], dq[None], command)[0]
        made = follow(step, {"q": q, "dq": dq, "ee": np.zeros(3)}, 0.0)["control"]
        assert np.abs(made - wanted).max() < BASE * np.abs(wanted).max()


def test_the_runtime_follows_a_plan_as_r2s_does(planned, runtime):
    """Near a plan, beyond its end, and at hostile states."""
    assert compare(planned, runtime, along(planned, 200, 100)) < ROUNDINGS


@pytest.mark.slow
@pytest.mark.parametrize("control", ["computed_torque", "torque"])
def test_so_it_does_for_ten_thousand_cycles(tmp_path, control):
    """Under both controllers; the calm motion is longer than its plan."""
    exported = export(tmp_path, f"control={control}")
    assert compare(exported, loaded(exported.folder), along(exported, 10_000, 1500)) < ROUNDINGS


@pytest.mark.slow
def test_an_arm_follows_as_it_does_behind_r2s(planned, runtime):
    """In closed loop, with sensors' noise: where r2s' own episode takes it, as far as float32 tells."""
    robot, task = planned.robot, planned.task
    plan = np.load(planned.folder / "plans.npz")["plans"][0]
    start, noise = plan[0, 6 : 6 + robot.n], {"position_noise": 1e-5, "velocity_noise": 1e-3}
    driven = PolicyRunner(SimulatedArm(robot, task.model, **noise), task, planned.friction)
    wanted = rollout(planned.policy, driven, task, start[None], plan[None])
    arm, other = (
        SimulatedArm(robot, task.model, **noise),
        runtime.Runtime(planned.folder, runtime.Arm(**arm_of(planned))),
    )
    arm.move_to(start)
    other.reset(plan)
    q = np.empty((task.steps * task.substeps, robot.n))
    for k in range(len(q)):
        state = arm.read()
        arm.command(other(state.q, state.dq, state.tau_J_d))
        q[k] = arm.read().q
    assert np.abs(q[task.substeps - 1 :: task.substeps] - wanted.q[0]).max() < 1e-6
    assert not other.driver.stopping
    assert wanted.distance.max() < 0.03  # it is a path that was followed


@pytest.mark.slow
def test_it_follows_where_there_is_nothing_but_numpy_and_onnxruntime(planned, bare, tmp_path):  # noqa: F811
    runs_in(bare, planned, along(planned, 10_000, 1500), tmp_path)


def test_the_bundle_tells_what_a_plan_is_and_has_some(planned, runtime, capsys, monkeypatch):
    """Plans of the training's family, in the contract, the card and the runtime's own words; no C++ constants."""
    contract = runtime.load(planned.folder)
    plans = np.load(planned.folder / "plans.npz")["plans"]
    assert list(plans.shape[1:]) == contract["goal"]["shape"] == [124, 27]
    assert len(plans) >= 2
    assert "contract.hpp" not in contract["files"]
    card = (planned.folder / "MODEL_CARD.md").read_text()
    assert "## Plans" in card
    assert "added to computed torque" in card
    monkeypatch.setattr(sys, "argv", ["r2s_runtime.py", str(planned.folder)])
    assert runtime.main() == 0
    assert "goal: a plan of 124 x 27 numbers" in capsys.readouterr().out


def test_a_plan_is_made_of_joint_angles(planned, runtime):
    """It is r2s' own plan again, whose velocities are differences: to 1e-16 m / 1e-5 s."""
    other, n = runtime.Runtime(planned.folder, runtime.Arm(**arm_of(planned))), planned.robot.n
    plan = np.load(planned.folder / "plans.npz")["plans"][0]
    joints = [plan[:, 6 + k * n : 6 + (k + 1) * n] for k in range(3)]
    np.testing.assert_allclose(other.plan(*joints), plan, atol=1e-9)
    with pytest.raises(runtime.BundleError, match=r"shape \(124, 7\), got \(123, 7\)"):
        other.plan(*(x[1:] for x in joints))


def test_a_plan_is_made_of_a_curve(planned):
    """The hand begins at rest at its first point and keeps to the curve; a curve out of reach is refused."""
    robot, task = planned.robot, planned.task

    def line(u):
        return np.outer(u, [0.0, 1.0, 0.0])

    plan = task.plan(robot, (0.5, -0.1, 0.4), line, 0.3)
    np.testing.assert_allclose(plan[0, :3], [0.5, -0.1, 0.4], atol=2e-4)
    assert np.abs(plan[[0, -1], 3:6]).max() < 1e-9
    np.testing.assert_allclose(plan[:, [0, 2]], [[0.5, 0.4]] * len(plan), atol=2e-4)
    with pytest.raises(UserError, match="panda cannot follow this curve"):
        task.plan(robot, (1.5, 0.0, 0.4), line, 0.3)


def test_the_page_makes_a_plan_of_a_curve(planned, tmp_path, monkeypatch):
    """The code of docs/how_to/export.md runs as written."""
    blocks = re.findall(r"^```python\n(.*?)^```", (ROOT / "docs" / "how_to" / "export.md").read_text(), re.S | re.M)
    (block,) = (b for b in blocks if "task.plan(" in b)
    monkeypatch.chdir(tmp_path)
    exec(block.replace("runs/train/NAME", str(planned.run)), {})
    plan = np.load("my_plan.npy")
    assert list(plan.shape) == json.loads((planned.folder / "contract.json").read_text())["goal"]["shape"]
    np.testing.assert_allclose(plan[0, :3], [0.5, -0.1, 0.4], atol=2e-4)


WRONG: dict[str, tuple[Callable[[np.ndarray], object], str]] = {
    "none": (lambda p: None, "follows plans: pass one to `reset`"),
    "too short": (lambda p: p[1:], r"shape \(124, 27\), got \(123, 27\)"),
    "of another arm": (lambda p: p[:, :24], r"shape \(124, 27\), got \(124, 24\)"),
    "a point": (lambda p: p[0, :3], r"shape \(124, 27\), got \(3,\)"),
    "not finite": (lambda p: np.where(np.arange(p.size).reshape(p.shape) == 30, np.nan, p), "nan in row 1, column 3"),
    "endless": (lambda p: np.where(np.arange(p.size).reshape(p.shape) == 0, np.inf, p), "inf in row 0, column 0"),
}


@pytest.mark.parametrize("kind", WRONG)
def test_a_plan_of_another_size_or_that_is_not_finite_is_refused(planned, runtime, kind):
    """In one line, before a motion; without a plan there is none."""
    change, words = WRONG[kind]
    other = runtime.Runtime(planned.folder, runtime.Arm(**arm_of(planned)))
    plan = change(np.load(planned.folder / "plans.npz")["plans"][0])
    with pytest.raises(runtime.BundleError, match=words) as refused:
        other.reset(plan)
    assert "\n" not in str(refused.value)
    with pytest.raises(runtime.BundleError, match="pass one to `reset`"):
        other(*np.zeros((3, 7)))
    with pytest.raises(runtime.BundleError, match=r"\(7,\), \(3,\); 7 joints and no goal are allowed"):
        other(*np.zeros((3, 7)), np.zeros(3))


def moved(plan: np.ndarray, row: int, column: int, by: float) -> np.ndarray:
    plan = plan.copy()
    plan[row, column] += by
    return plan


BEYOND: dict[str, tuple[Callable[[np.ndarray], np.ndarray], str]] = {
    "a joint": (lambda p: moved(p, 40, 6 + 3, 4.0), "row 40 of the plan: joint 4 at .* rad is beyond its limit"),
    "a speed": (lambda p: moved(p, 40, 13 + 4, 3.0), "row 40 of the plan: joint 5 at .* rad/s is beyond its limit"),
    "the region": (lambda p: moved(p, 40, 2, -0.4), "row 40 of the plan: the goal is "),
    "its own angles": (lambda p: moved(p, 40, 2, 0.002), "row 40 of the plan is 2.0 mm from where its joint angles"),
}


@pytest.mark.parametrize("kind", BEYOND)
def test_a_plan_beyond_limits_or_region_is_refused(planned, runtime, kind):
    """Before a motion, in one line."""
    change, words = BEYOND[kind]
    other = runtime.Runtime(planned.folder, runtime.Arm(**arm_of(planned)))
    with pytest.raises(runtime.BundleError, match=words):
        other.reset(change(np.load(planned.folder / "plans.npz")["plans"][0]))


def test_a_motion_begins_at_the_first_row_of_its_plan(planned, runtime):
    other = runtime.Runtime(planned.folder, runtime.Arm(**arm_of(planned)))
    plan = np.load(planned.folder / "plans.npz")["plans"][0]
    other.reset(plan)
    with pytest.raises(runtime.BundleError, match=r"joint . is at .* rad; motions begin within 0.05 rad of"):
        other(plan[0, 6:13] + 0.1, np.zeros(7), np.zeros(7))


def test_a_friction_of_ones_own_does_not_travel(panda):
    family = replace(SIGMOID, name="mine")
    task = TrackTask(**SETTINGS).with_model(panda, replace(dynamics_of(panda, "sigmoid"), family=family))
    with pytest.raises(UserError, match="the runtime of a bundle has no friction of family 'mine'; allowed: sig"):
        make_contract(panda, task, np.zeros(7))
    assert make_contract(panda, replace(task, model=None), np.zeros(7))["control"]["model"] is None
