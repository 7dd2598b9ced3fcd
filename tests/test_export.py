"""`r2s export`: the bundle is whole, and its runtime does what r2s does."""

import ast
import json
import subprocess
import sys
from dataclasses import dataclass, replace
from types import ModuleType
from typing import Any

import mujoco
import numpy as np
import pandas as pd
import pytest
import yaml
from conftest import ROOT, conf, unfenced
from made_bundles import (  # noqa: F401 (bare is a fixture)
    COMPILER,
    LAW_NM,
    LIBFRANKA,
    ROUNDINGS,
    Exported,
    bare,
    compare,
    drawn,
    hostile,
    loaded,
    runs_in,
)

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
from r2s.physics.rigid_body import Kinematics
from r2s.physics.robot import Robot, load_robot
from r2s.tasks.reach import ReachTask
from r2s.tasks.task import observation_scale


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


@pytest.mark.slow
def test_it_runs_where_there_is_nothing_but_numpy_and_onnxruntime(exported, bare, tmp_path):  # noqa: F811
    """The torques are those that r2s wrote down, over 10,000 cycles."""
    runs_in(bare, exported, hostile(exported.robot, exported.task, 10_000), tmp_path)
