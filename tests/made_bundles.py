"""Bundles of policies as they were drawn, motions that no driver should meet, and what r2s makes of them."""

import copy
import importlib.util
import json
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch
from conftest import ROOT, unfenced

from r2s.arm.interface import ArmState
from r2s.arm.policy_runner import as_state, episode_driver
from r2s.learning.networks import Policy
from r2s.learning.policy import export_onnx, make_policy, save_policy
from r2s.physics.rigid_body import Kinematics
from r2s.physics.robot import Robot
from r2s.tasks.task import observe

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
