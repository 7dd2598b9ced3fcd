"""`r2s export`: the bundle is whole, its runtime does what r2s does, and it refuses what it was not made for."""

import ast
import copy
import importlib.util
import json
import shutil
import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import Any

import mujoco
import numpy as np
import pandas as pd
import pytest
import torch
import yaml
from conftest import ROOT, conf, unfenced

from r2s import commands
from r2s.arm.clients import fr3_limits
from r2s.arm.clients.fr3 import as_driven, within_fr3
from r2s.arm.interface import ArmState
from r2s.arm.policy_runner import as_state, episode_driver
from r2s.control.torque import torque as torque_control
from r2s.errors import UserError
from r2s.export.bundle import one_file
from r2s.export.card import card
from r2s.export.contract import make_contract
from r2s.export.law import Driver, Model
from r2s.learning.networks import Policy
from r2s.learning.policy import export_onnx, make_policy, save_policy
from r2s.physics.rigid_body import Kinematics
from r2s.physics.robot import Robot, load_robot
from r2s.tasks.reach import ReachTask
from r2s.tasks.task import observation_scale, observe

EPISODE = 50  # cycles, of hostile motion
LIBFRANKA = ROOT / "examples" / "libfranka"
COMPILER = shutil.which("g++") or shutil.which("clang++")
LAW_NM = 1e-9  # three writings of one law: sums of some tens of terms of 100 Nm, each to 1e-16
# of what an action of 1 asks for: sums of float32 (eps 1.2e-7) in another order, of three layers of a gain of about 1
POLICY = 1e-6
# Largest difference of the torques of two evaluations of a policy in float32, over the largest torque that the
# rounding of one explains: each differs from float64 by its own error, and the errors of two orders of summation have
# the same size. The law between action and torque projects onto convex sets, so it does not lengthen a difference.
ROUNDINGS = 4.0


@dataclass
class Exported:
    """A bundle and what it was made of."""

    run: Path
    folder: Path
    robot: Robot
    task: Any
    policy: Policy
    friction: np.ndarray


def drawn(run: Path, *overrides: str) -> Exported:
    """Return what becomes the bundle of a policy as it was drawn: nothing tested here is a matter of training."""
    from hydra import compose, initialize_config_dir
    from omegaconf import OmegaConf

    from r2s.stages.build import CONF, make_dynamics, make_robot, make_task

    run.mkdir(parents=True)
    with initialize_config_dir(str(CONF.resolve()), version_base="1.3"):
        config = compose("config", ["algo.hidden=[16,16]", *overrides])
    OmegaConf.save(config, run / "config.yaml")
    robot = make_robot(config)
    center = make_dynamics(config, robot)
    task = make_task(config, robot, center)
    torch.manual_seed(0)
    policy = make_policy(robot, task, (16, 16)).eval()
    save_policy(run, policy)
    export_onnx(run / "policy.onnx", policy, robot, task)
    best = {"env_steps": 960, "updates": 30, "success_1cm": 0.5, "return_paper": -100.0}
    (run / "summary.json").write_text(json.dumps({"best": best, "last": best}))
    (run / "meta.json").write_text(json.dumps({"status": "done", "inputs": {}, "seed": 3}))
    return Exported(run, run / "bundle", robot, task, policy, center.level)


@pytest.fixture(scope="module")
def exported(tmp_path_factory) -> Exported:
    """The bundle of a policy that reaches."""
    made = drawn(run := tmp_path_factory.mktemp("runs") / "train" / "drawn")
    transfer = run.parent.parent / "transfer" / "there"
    transfer.mkdir(parents=True)
    row = {"success_1cm": 0.9, "success_5cm": 1.0, "stops": 2, "episodes": 20, "asked": 20}
    (transfer / "summary.json").write_text(json.dumps({"twin": row, "predicted": row}))
    (transfer / "meta.json").write_text(json.dumps({"status": "done", "parents": [str(run)]}))
    commands.run_command(["export", str(run)])
    return made


@pytest.fixture(scope="module")
def runtime(exported) -> ModuleType:
    return loaded(exported.folder)


def loaded(folder: Path) -> ModuleType:
    """Return the one file of a bundle, as a program without r2s has it."""
    spec = importlib.util.spec_from_file_location("r2s_runtime", folder / "r2s_runtime.py")
    assert spec is not None
    assert spec.loader is not None
    module = sys.modules["r2s_runtime"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def arm_of(exported: Exported, **other: Any) -> dict[str, Any]:
    """Return the arm's state for a runtime, with some of it changed."""
    r = exported.robot
    own = {"joints": [f"joint{j + 1}" for j in range(r.n)], "cycle_hz": 1000, "torque": "without gravity"}
    own |= {"q_min": r.q_min, "q_max": r.q_max, "dq_max": r.dq_max, "tau_max": r.tau_max, "dtau_max": r.dtau_max}
    return own | other


def hostile(robot: Robot, task: Any, cycles: int) -> dict[str, np.ndarray]:
    """Return states and targets (cycles, n) that no driver should meet, which are said, and where motions begin.

    And goals, and which of them is asked for in a cycle.

    Joints jump beyond their limits and their speeds, a few values are not finite, targets come, go and are anything,
    and what the arm applied last is not always what was sent (that is NaN here).
    """
    rng, n = np.random.default_rng(0), robot.n
    low, high = robot.q_range
    jumps = np.arange(cycles) // 5
    inside = rng.uniform(low + 0.15, high - 0.15, (cycles, n)) + 0.2 * rng.uniform(-1, 1, (cycles, n)) * (
        rng.random((cycles, 1)) < 0.2
    )
    share = rng.choice([0.05, 0.3, 0.6, 3.0], (cycles, 1), p=[0.4, 0.4, 0.17, 0.03])
    q, dq = inside[jumps], (share * rng.uniform(-1, 1, (cycles, n)) * robot.dq_max)[jumps]
    target = 3 * rng.normal(size=(cycles, n)) * task.torque_limit(robot)
    for values, odd in ((q, 0.002), (dq, 0.002), (target, 0.02)):
        rows = np.flatnonzero(rng.random(cycles) < odd)
        values[rows, rng.integers(n, size=len(rows))] = rng.choice([np.nan, np.inf, -np.inf], len(rows))
    applied = np.where(rng.random((cycles, 1)) < 0.05, 50 * rng.normal(size=(cycles, n)), np.nan)
    new = (np.arange(cycles) % 20 == 0) | (rng.random(cycles) < 0.1)
    begin = np.arange(cycles) % EPISODE == 0
    q[begin], dq[begin] = robot.q_home + rng.uniform(-0.1, 0.1, (begin.sum(), n)), 0.0  # else it is refused
    goal, which = task.goals(robot, rng, cycles // EPISODE + 1), np.arange(cycles) // EPISODE
    motion = {"q": q, "dq": dq, "applied": applied, "target": target, "new": new, "begin": begin}
    return motion | {"goal": goal, "which": which}


def driven(
    robot: Robot, task: ReachTask, friction: np.ndarray, cycles: int, rotors: np.ndarray | None = None
) -> dict[str, np.ndarray]:
    """Return `hostile` motion with `tau` (cycles, n) Nm that r2s makes of it, and `last`, what the arm applied."""
    motion = hostile(robot, task, cycles)
    driver = episode_driver(robot, unfenced(robot, task), 0.0, friction, rotors)
    tau, last = np.zeros((2, cycles, robot.n))
    for k in range(cycles):
        if motion["begin"][k]:
            driver.reset()
        sent = tau[k - 1] if k and not motion["begin"][k] else np.zeros(robot.n)
        last[k] = np.where(np.isnan(motion["applied"][k]), sent, motion["applied"][k])
        state = ArmState(1e-3 * k, motion["q"][k], motion["dq"][k], np.zeros(robot.n), last[k])
        tau[k] = driver(state, motion["target"][k] if motion["new"][k] else None)
    return motion | {"tau": tau, "last": last}


@pytest.fixture(scope="module")
def motion(exported) -> dict[str, np.ndarray]:
    return driven(exported.robot, exported.task, exported.friction, 1000)


def by_law(contract: dict[str, Any], motion: dict[str, np.ndarray]) -> np.ndarray:
    """Return the torques (cycles, n) Nm of the runtime's driver."""
    driver = Driver(contract["law"], Model(contract["model"]))
    out = np.empty_like(motion["tau"])
    for k in range(len(out)):
        if motion["begin"][k]:
            driver.reset()
        target = motion["target"][k] if motion["new"][k] else None
        with np.errstate(invalid="ignore"):
            out[k] = driver(motion["q"][k], motion["dq"][k], motion["last"][k], target)
    return out


def test_the_law_of_the_runtime_is_that_of_r2s(exported, motion):
    """Every command of a hostile motion is the same within rounding, and the law had much to do."""
    contract = json.loads((exported.folder / "contract.json").read_text())
    assert np.abs(by_law(contract, motion) - motion["tau"]).max() < LAW_NM


@pytest.mark.parametrize("arm", ["six_joints", "kinova_gen3", "iiwa14", "fr3"])
def test_so_it_is_for_other_arms(arm, panda):
    """With rotors of its own and identified ones, joints that turn without end, less speed near position limits."""
    file = ROOT / "tests" / "models" / "six_joints.xml" if arm == "six_joints" else f"r2s:models/{arm}.xml"
    robot = load_robot(**conf("robot/fr3")) if arm == "fr3" else load_robot(str(file))
    if arm == "six_joints":
        robot = replace(robot, armature=np.full(6, 0.1))
    task, friction = ReachTask(reach=None, height=-9.0, azimuth=3.2), np.linspace(0.0, 1.0, robot.n)
    rotors = np.linspace(0.3, 0.01, robot.n) if arm == "iiwa14" else None
    contract = json.loads(json.dumps(make_contract(robot, task, friction, rotors), allow_nan=False))
    motion = driven(as_driven(robot), task, friction, 300, rotors)
    assert np.abs(by_law(contract, motion) - motion["tau"]).max() < LAW_NM


@pytest.mark.long
@pytest.mark.parametrize("arm", ["panda", "fr3"])
def test_near_each_limit_the_bundle_runs_the_law_of_its_arm(arm):
    """Joints that approach their limits, one by one: the driver of the arm's client, command by command.

    An FR3 allows less speed before its limits than a Panda; 0.3 rad before joint 2's it is 0.99 rad/s.
    """
    robot, task = load_robot(**conf(f"robot/{arm}")), ReachTask()
    friction = np.linspace(0.1, 0.5, 7)
    contract = json.loads(json.dumps(make_contract(robot, task, friction), allow_nan=False))
    real = within_fr3(robot) if arm == "fr3" else robot
    law, driver = (
        Driver(contract["law"], Model(contract["model"])),
        episode_driver(real, unfenced(real, task), 0.0, friction),
    )
    torque = task.torque_limit(robot)
    for j, sign in ((j, sign) for j in range(7) for sign in (-1.0, 1.0)):
        limit = robot.q_max[j] if sign > 0 else robot.q_min[j]
        for way in (0.05, 0.1, 0.2, 0.3, 0.5):
            law.reset()
            driver.reset()
            q, dq, sent = robot.q_home.copy(), np.zeros(7), np.zeros(7)
            q[j] = limit - sign * way
            for k in range(20):
                dq[j] = 0.05 * k * sign * robot.dq_max[j] * 0.8
                wanted = driver(ArmState(1e-3 * k, q, dq, np.zeros(7), sent), sign * torque)
                assert np.abs(law(q, dq, sent, sign * torque) - wanted).max() < LAW_NM
                sent = wanted
            if arm == "fr3":
                q[j] = fr3_limits.Q_MAX[j] - way if sign > 0 else fr3_limits.Q_MIN[j] + way
                assert law.fastest(q, sign > 0)[j] <= sign * fr3_limits.velocity_bounds(q)[int(sign > 0)][j]
    q = robot.q_home.copy()
    q[1] = robot.q_max[1] - 0.3
    assert (law.fastest(q, True)[1] <= 0.99) == (arm == "fr3")


def by_r2s(exported: Exported, motion: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return a motion with what r2s makes of its states and goals, with its own policy and memory of what was sent.

    tau: (cycles, n) Nm. last: (cycles, n) Nm, what the arm applied. stops: (cycles, 2), whether the driver stops the
    arm, and is done. rounding: largest error of the policy's actions by float32.
    """
    robot, task = exported.robot, exported.task
    torque, kinematics, control = task.torque_limit(robot), Kinematics(robot), task.control(robot)
    driver = episode_driver(robot, unfenced(robot, task), 0.0, exported.friction)
    exact, rounding = copy.deepcopy(exported.policy).double(), 0.0
    cycles = len(motion["q"])
    tau, last = np.zeros((2, cycles, robot.n))
    stops = np.zeros((cycles, 2), dtype=bool)
    for k in range(cycles):
        if begin := motion["begin"][k]:
            driver.reset()
            since, changed = k, 0
        last[k] = np.where(np.isnan(motion["applied"][k]), 0.0 if begin else tau[k - 1], motion["applied"][k])
        state = ArmState(1e-3 * (k - since), motion["q"][k], motion["dq"][k], np.zeros(robot.n), last[k])
        target = None
        if (k - since) % task.substeps == 0:
            share, changed = (driver.limited - changed) / task.substeps, driver.limited
            seen = as_state(kinematics, state, driver.effort, False, share)
            goal = motion["goal"][motion["which"][k], None]
            seen_by_policy = torch.from_numpy(observe(task, control, seen, goal, torque))
            with torch.no_grad():
                action = exported.policy.action(seen_by_policy).numpy().astype(float)
                error = np.abs(action - exact.action(seen_by_policy.double()).numpy())
            rounding = max(rounding, float(error.max()))
            target = control.command(action, task, seen.t, goal)[0]
        tau[k], stops[k] = driver(state, target), (driver.stopping is not None, driver.done)
    return motion | {"tau": tau, "last": last, "stops": stops, "rounding": rounding}


def unit_of(exported: Exported, motion: dict[str, np.ndarray]) -> float:
    """Return the length, Nm, of the torque that the largest rounding error of an action asks for in all joints."""
    return motion["rounding"] * float(np.linalg.norm(exported.task.torque_limit(exported.robot)))


def compare(exported: Exported, runtime: ModuleType, motion: dict[str, np.ndarray]) -> float:
    """Return the largest difference of the torques of Runtime and `by_r2s` over a hostile motion, in `unit_of`."""
    other = runtime.Runtime(exported.folder, runtime.Arm(**arm_of(exported)))
    motion, worst, goals, plans = by_r2s(exported, motion), 0.0, list(motion["goal"]), motion["goal"].ndim == 3
    for k, (begin, which) in enumerate(zip(motion["begin"], motion["which"], strict=True)):
        if begin:
            other.reset(*([goals[which]] if plans else []))
        if other.done:
            continue  # it commands nothing more, see test_export_campaign.py
        tau = other(*(motion[name][k] for name in ("q", "dq", "last")), None if plans else goals[which])
        worst = max(worst, float(np.linalg.norm(tau - motion["tau"][k])))
        assert [other.driver.stopping is not None, other.done] == motion["stops"][k].tolist()
    return worst / unit_of(exported, motion)


def test_the_runtime_does_what_r2s_does(exported, runtime):
    """From joint states and goals to torques, hostile ones included."""
    assert compare(exported, runtime, hostile(exported.robot, exported.task, 500)) < ROUNDINGS


@pytest.mark.slow
def test_the_runtime_does_what_r2s_does_for_ten_thousand_cycles(exported, runtime):
    assert compare(exported, runtime, hostile(exported.robot, exported.task, 10_000)) < ROUNDINGS
    motion = driven(exported.robot, exported.task, exported.friction, 10_000)
    contract = json.loads((exported.folder / "contract.json").read_text())
    assert np.abs(by_law(contract, motion) - motion["tau"]).max() < LAW_NM


CHECK = """
#include <cstdio>
#include "law.hpp"
int main() {  // q, dq, tau_J_d, target, goal, is it said, does a motion begin; torque and observation back
  constexpr int n = law::n;
  law::Driver driver;
  double x[4 * n + 5];
  while (std::fread(x, sizeof *x, 4 * n + 5, stdin) == 4 * n + 5) {
    law::Joints v[4];
    law::Command command;
    for (int k = 0; k < 4 * n; ++k) v[k / n][k % n] = x[k];
    for (int k = 0; k < contract::actions; ++k) command[k] = v[3][k];
    if (x[4 * n + 4] > 0) driver = law::Driver();
    driver.model.place(v[0]);
    const auto seen = law::observe(driver, v[0], v[1], {x[4 * n], x[4 * n + 1], x[4 * n + 2]});
    const law::Joints tau = driver(v[0], v[1], v[2], x[4 * n + 3] > 0 ? &command : nullptr);
    std::fwrite(tau.data(), sizeof *x, n, stdout);
    for (double s : seen) std::fwrite(&s, sizeof s, 1, stdout);
  }
}
"""


@pytest.mark.skipif(COMPILER is None, reason="no C++ compiler here: examples/libfranka/law.hpp is not compiled")
def test_the_law_in_cpp_is_that_of_r2s(exported, motion, tmp_path):
    """examples/libfranka/law.hpp gives the same torques within rounding, and the same observations."""
    (tmp_path / "check.cpp").write_text(CHECK)
    command = [str(COMPILER), "-std=c++17", "-O1", "-Wall", "-Wextra", "-Wpedantic", "-Werror"]
    command += ["-I", str(LIBFRANKA), "-I", str(exported.folder), "check.cpp", "-o", "check"]
    subprocess.run(command, cwd=tmp_path, check=True)
    flags = np.column_stack([motion["new"], motion["begin"]])
    rows = [motion["q"], motion["dq"], motion["last"], motion["target"], motion["goal"][motion["which"]], flags]
    sent = np.ascontiguousarray(np.concatenate(rows, 1), dtype=float)
    done = subprocess.run([tmp_path / "check"], input=sent.tobytes(), capture_output=True, check=True)
    n = exported.robot.n
    got = np.frombuffer(done.stdout).reshape(len(sent), -1)
    assert np.abs(got[:, :n] - motion["tau"]).max() < LAW_NM
    kinematics, torque = Kinematics(exported.robot), exported.task.torque_limit(exported.robot)
    k = next(k for k in range(len(sent)) if motion["begin"][k] and np.isfinite(sent[k]).all())  # the effort is zero
    state = ArmState(0.0, motion["q"][k], motion["dq"][k], np.zeros(n), np.zeros(n))
    seen = as_state(kinematics, state, np.zeros(n), False, 0.0)
    assert np.allclose(
        got[k, n:], exported.task.observe(seen, motion["goal"][motion["which"][k], None], torque)[0], atol=1e-6
    )


def has_header(name: str) -> bool:
    """Return whether the compiler finds a header."""
    words = [str(COMPILER), "-std=c++17", "-fsyntax-only", "-x", "c++", "-"]
    return subprocess.run(words, input=f"#include <{name}>\n".encode(), capture_output=True).returncode == 0


def test_the_loop_for_libfranka_compiles(exported):
    """Where libfranka's and ONNX Runtime's headers are."""
    missing = [h for h in ("franka/robot.h", "onnxruntime_cxx_api.h") if COMPILER is None or not has_header(h)]
    if missing:
        pytest.skip(f"examples/libfranka/loop.cpp is not compiled: no {' and no '.join(missing)} here")
    command = [str(COMPILER), "-std=c++17", "-fsyntax-only", "-Wall", "-I", str(exported.folder)]
    subprocess.run([*command, str(LIBFRANKA / "loop.cpp")], check=True)


@pytest.mark.slow
@pytest.mark.skipif(COMPILER is None, reason="no C++ compiler here")
def test_the_loop_compiles_against_what_it_calls_of_libfranka(exported):
    """tests/standins declares it, for where the headers themselves are not."""
    own = ["-I", str(ROOT / "tests" / "standins"), "-I", str(exported.folder)]
    words = [str(COMPILER), "-std=c++17", "-fsyntax-only", "-Wall", "-Wextra", "-Werror", *own]
    subprocess.run([*words, str(LIBFRANKA / "loop.cpp")], check=True)


def test_the_bundle_is_whole(exported, runtime):
    """Every file is in the contract with its digest; the three models are the arm, and the law is in numbers."""
    contract = runtime.load(exported.folder)
    there = {p.relative_to(exported.folder).as_posix() for p in exported.folder.rglob("*") if p.is_file()}
    assert there - {"contract.json"} == set(contract["files"])
    assert {"policy.onnx", "MODEL_CARD.md", "contract.hpp", "r2s_runtime.py"} <= there
    assert {f"model/arm.{kind}" for kind in ("xml", "urdf", "sdf")} <= there
    model = mujoco.MjModel.from_xml_path(str(exported.folder / "model" / "arm.xml"))
    assert np.allclose(model.body_mass[1:].sum(), exported.robot.mass.sum())
    assert contract["observation"]["size"] == len(observation_scale(exported.task, exported.robot)[0])


def test_the_runtime_says_what_a_bundle_wants(exported, runtime, tmp_path, monkeypatch, capsys):
    """`python bundle/r2s_runtime.py bundle`, and where there is none."""
    monkeypatch.setattr(sys, "argv", ["r2s_runtime.py", str(exported.folder)])
    assert runtime.main() == 0
    assert "policy 50 Hz, torque without gravity at 1000 Hz" in capsys.readouterr().out
    monkeypatch.setattr(sys, "argv", ["r2s_runtime.py", str(tmp_path)])
    assert runtime.main() == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


def test_the_card_says_where_it_was_measured_and_where_not(exported):
    card = (exported.folder / "MODEL_CARD.md").read_text()
    assert "| twin (there) | 100.0 | - | 90.0 |" in card
    assert "stopped in 2 of 20" in card
    assert "predicted" not in card
    untried = next(line for line in card.splitlines() if line.startswith("Not tried:"))
    assert "panda" in untried
    assert "twin" not in untried


def test_the_card_of_a_policy_that_follows_paths_says_errors_in_mm(exported, tmp_path):
    """Whatever a run's rows measure: no word of points, columns of paths, transfers beside it."""
    run = tmp_path / "train" / "drawn"
    row = {"path_rmse_mm": 1.234, "path_max_mm": 3.0, "within_2mm": 0.9, "within_5mm": 1.0, "stopped": 0.0}
    best = row | {"env_steps": 9, "updates": 3}
    for folder, said in ((run, {"best": best}), (tmp_path / "transfer/t", {"twin": row})):
        folder.mkdir(parents=True)
        (folder / "summary.json").write_text(json.dumps(said))
        (folder / "meta.json").write_text(json.dumps({"status": "done", "parents": [str(run)]}))
    config = yaml.safe_load((exported.run / "config.yaml").read_text())
    contract = json.loads((exported.folder / "contract.json").read_text())
    said = card(run, config, {}, contract, exported.folder, ["twin", "dart"])
    head, table = " ".join(map(str, next(iter(said.values())))), said["Measured"][0]
    assert "follows timed paths" in head
    assert "points" not in head
    assert isinstance(table, pd.DataFrame)
    assert list(table.index) == ["MuJoCo, as trained, goals without selection", "twin (t)"]
    assert table.loc["twin (t)", "RMSE, mm"] == "1.23"
    assert said["Not tried"][0] == "Not tried: dart."


def test_what_a_runtime_does_not_know_does_not_travel(panda):
    """Goals that are neither points nor plans, torques that are not the policy's: in one line."""

    @dataclass(frozen=True)
    class Odd(ReachTask):
        def goals(self, robot, rng, count):
            return np.zeros((count, 4, 2))

    with pytest.raises(UserError, match="goals of Odd have 4 x 2 numbers; the runtime") as refused:
        make_contract(panda, Odd(), np.zeros(panda.n))
    assert "\n" not in str(refused.value)


def test_the_runtime_needs_numpy_and_onnxruntime_alone():
    tree = ast.parse(one_file(torque_control(load_robot(**conf("robot/panda")), ReachTask())))
    names = {a.name for node in ast.walk(tree) if isinstance(node, ast.Import) for a in node.names}
    names |= {str(node.module) for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    others = {name.split(".")[0] for name in names} - set(sys.stdlib_module_names)
    assert others == {"numpy", "onnxruntime"}


LEAN = """
import sys
import numpy as np
from r2s_runtime import Arm, Runtime
data = np.load(sys.argv[1])
arm = {k[4:]: data[k] for k in data.files if k.startswith("arm_")}
arm |= {"joints": arm["joints"].tolist(), "cycle_hz": 1000, "torque": "without gravity"}
runtime, worst, goals = Runtime(sys.argv[2], Arm(**arm)), 0.0, list(data["goal"])
said = {name: data[name] for name in ("q", "dq", "last", "begin", "which", "tau")}
for k in range(len(said["tau"])):
    goal = goals[said["which"][k]]
    if said["begin"][k]:
        runtime.reset(*([goal] if goal.ndim == 2 else []))
    tau = runtime(said["q"][k], said["dq"][k], said["last"][k], *([goal] if goal.ndim == 1 else []))
    worst = max(worst, float(np.linalg.norm(tau - said["tau"][k])))
worst = worst / data["unit"]
print(worst, sorted(m for m in sys.modules if m.split(".")[0] in ("r2s", "torch", "mujoco", "scipy", "numba")))
"""


@pytest.fixture(scope="module")
def bare(tmp_path_factory) -> Path:
    """The Python of a virtual environment that has NumPy and ONNX Runtime and nothing else."""
    pins = [line for line in (ROOT / "constraints.txt").read_text().splitlines() if not line.startswith("#")]
    wanted = [line for line in pins if line.split("==")[0] in ("numpy", "onnxruntime")]
    folder = tmp_path_factory.mktemp("bare") / "venv"
    subprocess.run([sys.executable, "-m", "venv", str(folder)], check=True)
    python = folder / "bin" / "python"
    pip = [str(python), "-m", "pip", "install", "--quiet", "--disable-pip-version-check", *wanted]
    installed = subprocess.run(pip, capture_output=True, text=True)
    if installed.returncode:
        pytest.skip(f"pip cannot install {' '.join(wanted)} here: {installed.stderr.strip().splitlines()[-1]}")
    return python


def runs_in(python: Path, exported: Exported, motion: dict[str, np.ndarray], to: Path) -> None:
    """Assert that the bundle gives the torques that r2s wrote down, in an environment without r2s."""
    arm = {f"arm_{k}": np.array(v) for k, v in arm_of(exported).items() if k not in ("cycle_hz", "torque")}
    motion = by_r2s(exported, motion)
    kept = {k: motion[k] for k in ("q", "dq", "goal", "which", "begin", "tau", "last")}
    np.savez(to / "data.npz", **kept, **arm, unit=unit_of(exported, motion))
    (to / "lean.py").write_text(LEAN)
    words = [str(python), str(to / "lean.py"), str(to / "data.npz"), str(exported.folder)]
    here = {"PYTHONPATH": str(exported.folder), "PYTHONSAFEPATH": "1"}
    done = subprocess.run(words, capture_output=True, text=True, env=here)
    assert done.returncode == 0, done.stderr
    worst, modules = done.stdout.split(maxsplit=1)
    assert float(worst) < ROUNDINGS
    assert modules.strip() == "[]"


@pytest.mark.slow
def test_it_runs_where_there_is_nothing_but_numpy_and_onnxruntime(exported, bare, tmp_path):
    """The torques are those that r2s wrote down, over 10,000 cycles."""
    runs_in(bare, exported, hostile(exported.robot, exported.task, 10_000), tmp_path)
