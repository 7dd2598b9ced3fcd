"""Policies that press and wipe travel: bundle and C++ do what r2s does in contact, stops and the bound included."""

import json
import re
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import ROOT, unfenced
from made_bundles import COMPILER, LAW_NM, LIBFRANKA, POLICY, Exported, arm_of, drawn, loaded
from test_faults import composed

from r2s import commands
from r2s.arm.policy_runner import as_state, episode_driver
from r2s.arm.simulated import SimulatedArm
from r2s.errors import UserError
from r2s.export.contract import make_contract
from r2s.export.law import BundleError, Driver, Model
from r2s.export.push import PushLimit
from r2s.export.surface import check_surface_plan
from r2s.export.surface_contract import surface_plans
from r2s.physics.rigid_body import Kinematics
from r2s.physics.surface import Surface
from r2s.stages.build import make_dynamics, make_robot, make_task
from r2s.tasks.task import observe

FORCE_MAX = 40.0  # N
QUICK = "task.step_s=1.0", "task.episode_s=2.0", "task.approach_speed=0.08"
SLOWER = "hold", "retreat"
SEEN = 1e-6  # of observations: float32 of numbers up to about 3
SLIDING = 0.2  # friction of the surfaces


def export(folder: Path, *overrides: str) -> Exported:
    made = drawn(folder / "runs" / "train" / "drawn", f"safety.force_max={FORCE_MAX}", *overrides)
    commands.run_command(["export", str(made.run)])
    return made


@pytest.fixture(scope="module")
def pressing(tmp_path_factory) -> Exported:
    """The bundle of a policy that presses by hybrid control within a limit of pushes."""
    return export(tmp_path_factory.mktemp("pressing"), "task=press", *QUICK)


class Log:
    """What r2s's driver received and sent, and what the policy observed, cycle by cycle."""

    def __init__(self):
        self.rows: dict[str, list] = {}

    def add(self, **values) -> None:
        """Add a cycle."""
        for name, value in values.items():
            self.rows.setdefault(name, []).append(np.array(value, dtype=float))

    def arrays(self) -> dict[str, np.ndarray]:
        """Return the columns, (cycles, ...)."""
        return {name: np.array(values) for name, values in self.rows.items()}


def in_contact(
    exported: Exported, episodes: int, stop_at: int | None = None, push: float = 0.0
) -> dict[str, np.ndarray]:
    """Return episodes of the bundle's own plans behind r2s's driver, on simulated surfaces of 3e3 to 1e5 N/m.

    Args:
        stop_at: cycle of an episode in which a stop is asked for.
        push: N, by which a hostile command pushes inwards, where commands are torques.
    """
    robot, task = exported.robot, exported.task
    torque, kinematics, control = task.torque_limit(robot), Kinematics(robot), task.control(robot)
    goals, rng = task.goals(robot, np.random.default_rng(0), 4), np.random.default_rng(1)
    point, normal = task.plane(robot)
    driver, log = episode_driver(robot, unfenced(robot, task), 0.0, exported.friction), Log()
    for episode in range(episodes):
        goal, stiffness = goals[episode % 4, None], 10 ** rng.uniform(3.5, 5.0)
        surface = Surface(point + rng.uniform(-1, 1) * 4e-3 * normal, normal, stiffness, 1.0, 0.5, SLIDING)
        dynamics = replace(task.model.dynamics, surface=surface)
        arm = SimulatedArm(robot, dynamics, position_noise=1e-6, velocity_noise=1e-3, seed=episode)
        arm.move_to(task.begin(robot.q_home[None], goal)[0])
        driver.reset()
        changed, seen, command = 0, np.zeros(0), np.zeros(0)
        for k in range(task.steps * task.substeps):
            state, new = arm.read(), k % task.substeps == 0
            if k == stop_at:
                driver.stop("asked for")
            if new:
                share, changed = (driver.limited - changed) / task.substeps, driver.limited
                now = as_state(kinematics, state, driver.effort, False, share)
                seen = observe(task, control, now, goal, torque)
                with torch.no_grad():
                    action = exported.policy.action(torch.from_numpy(seen)).numpy().astype(float)
                command = control.command(action, task, now.t, goal)[0]
                if push:
                    inwards = -normal @ task.tip(state.q[None])[1][0]
                    command = np.clip(push * rng.choice([-1.0, 1.0, 1.0]) * inwards, -torque, torque)
            tau = driver(state, command if new else None)
            limit = task.push_limit.bound(robot, state.q, stiffness, SLIDING) if k % 100 == 0 else np.inf
            log.add(
                q=state.q, dq=state.dq, last=state.tau_J_d, tau=tau, force=arm._sim.contact_force[0] @ normal,
                which=episode % 4, cycle=k, ends=[driver.stopping is not None, driver.done], seen=seen[0],
                command=command, new=new, stop=k == stop_at, bound=limit,
            )  # fmt: skip
            if driver.done:
                break
            arm.command(tau)
    return log.arrays()


def by_runtime(exported: Exported, motion: dict[str, np.ndarray]) -> float:
    """Return the largest difference of the bundle's runtime, of the most that is asked for, over a motion."""
    runtime = loaded(exported.folder)
    other = runtime.Runtime(exported.folder, runtime.Arm(**arm_of(exported)))
    plans, worst = np.load(exported.folder / "plans.npz")["plans"], 0.0
    torque = exported.task.torque_limit(exported.robot)
    for k in range(len(motion["q"])):
        if motion["cycle"][k] == 0:
            other.reset(plans[int(motion["which"][k])])
        if motion["stop"][k]:
            other.stop("asked for")
        tau = other(motion["q"][k], motion["dq"][k], motion["last"][k])
        worst = max(worst, float((np.abs(tau - motion["tau"][k]) / torque).max()))
        assert [other.driver.stopping is not None, other.done] == motion["ends"][k].tolist()
    return worst


CHECK = """
#include <cstdio>
#include "surface.hpp"
int main(int, char** argv) {  // q, dq, tau_J_d, command, new, begin, stop, plan, row; torque, ends, observation back
  constexpr int n = law::n, many = law::Command().size(), all = 3 * n + many + 5;
  std::vector<law::Plan> plans;
  for (int k = 1; k < 5; ++k) plans.emplace_back(argv[k]);
  law::Driver driver;
  long limited = 0;
  double x[all];
  while (std::fread(x, sizeof *x, all, stdin) == all) {
    law::Joints v[3];
    law::Command command;
    for (int k = 0; k < 3 * n; ++k) v[k / n][k % n] = x[k];
    std::copy_n(x + 3 * n, many, command.begin());
    const double* more = x + 3 * n + many;
    if (more[1] > 0) driver = law::Driver(), limited = 0;
    if (more[2] > 0) driver.stop();
    driver.model.place(v[0]);
    std::array<float, contract::observations> seen{};
    if (more[0] > 0) {
      const double share = (driver.limited - limited) * double(contract::policy_hz) / contract::cycle_hz;
      limited = driver.limited;
      seen = law::observe(driver, v[0], v[1], v[2], plans[int(more[3])].row(long(more[4])), share);
    }
    const law::Joints tau = driver(v[0], v[1], v[2], more[0] > 0 ? &command : nullptr);
    const double ends[] = {driver.why != law::Driver::runs ? 1.0 : 0.0, driver.done() ? 1.0 : 0.0};
    std::fwrite(tau.data(), sizeof *x, n, stdout);
    std::fwrite(ends, sizeof *x, 2, stdout);
    for (double s : seen) std::fwrite(&s, sizeof s, 1, stdout);
  }
}
"""


def by_cpp(exported: Exported, motion: dict[str, np.ndarray], to: Path) -> tuple[float, float]:
    """Return the largest difference, Nm, of the torques of examples/libfranka, and of its observations."""
    (to / "check.cpp").write_text(CHECK)
    words = [str(COMPILER), "-std=c++17", "-O1", "-Wall", "-Wextra", "-Wpedantic", "-Werror", "-I", str(LIBFRANKA)]
    subprocess.run([*words, "-I", str(exported.folder), "check.cpp", "-o", "check"], cwd=to, check=True)
    plans, files = np.load(exported.folder / "plans.npz")["plans"], [str(to / f"{k}.npy") for k in range(4)]
    for file, plan in zip(files, plans, strict=True):
        np.save(file, plan)
    m = motion
    step = m["cycle"] // exported.task.substeps
    flags = np.column_stack([m["new"], m["cycle"] == 0, m["stop"], m["which"], step])
    sent = np.ascontiguousarray(np.concatenate([m["q"], m["dq"], m["last"], m["command"], flags], 1))
    done = subprocess.run([to / "check", *files], input=sent.tobytes(), capture_output=True, check=True)
    got, n = np.frombuffer(done.stdout).reshape(len(sent), -1), exported.robot.n
    assert (got[:, n : n + 2] == m["ends"]).all()
    new = m["new"] > 0
    return np.abs(got[:, :n] - m["tau"]).max(), np.abs(got[new, n + 2 :] - m["seen"][new]).max()


@pytest.mark.long
def test_bundle_and_cpp_press_as_r2s_does(pressing, tmp_path):
    """Through the touch, the hold and a stop in contact; in C++ the driver within rounding, and its observation."""
    motion = in_contact(pressing, 1, stop_at=1500)
    assert (motion["force"] > 1.0).mean() > 0.3
    assert motion["stop"].any()
    assert by_runtime(pressing, motion) < POLICY
    if COMPILER is not None:
        off, unlike = by_cpp(pressing, motion, tmp_path)
        assert off < LAW_NM
        assert unlike < SEEN


def by_numpy(exported: Exported, motion: dict[str, np.ndarray]) -> float:
    """Return the largest difference, Nm, of the runtime's driver without its policy, where commands are torques."""
    contract = json.loads((exported.folder / "contract.json").read_text())
    model, worst = Model(contract["model"]), 0.0
    driver = Driver(contract["law"], model, push=PushLimit(contract["law"], model))
    for k in range(len(motion["q"])):
        if motion["cycle"][k] == 0:
            driver.reset()
        if motion["stop"][k]:
            driver.stopping = "asked for"
        given = [motion[name][k] for name in ("q", "dq", "last")]
        tau = driver(*given, motion["command"][k] if motion["new"][k] else None)
        worst = max(worst, float(np.abs(tau - motion["tau"][k]).max()))
        assert [driver.stopping is not None, driver.done] == motion["ends"][k].tolist()
    return worst


@pytest.fixture(
    scope="module", params=["release", *(pytest.param(s, marks=pytest.mark.slow) for s in ("hold", "retreat"))]
)
def hostile(request, tmp_path_factory) -> Exported:
    """The bundle of a policy of torques, and what a stop does with a force."""
    torques = ("control=torque",)
    return export(tmp_path_factory.mktemp("hostile"), "task=press", *torques, f"task.stop={request.param}", *QUICK)


def pushed(exported: Exported, episodes: int, stop_at: int) -> dict[str, np.ndarray]:
    """Return a motion of hostile pushes up to 150 N; its largest force is within the certified bound."""
    motion = in_contact(exported, episodes, stop_at=stop_at, push=150.0)
    assert motion["force"].max() > 0.5 * FORCE_MAX
    assert of_bound(motion) < 1.0
    return motion


def of_bound(motion: dict[str, np.ndarray]) -> float:
    """Return the largest force of an episode as a share of its certified bound."""
    parts = np.split(np.arange(len(motion["q"])), np.flatnonzero(motion["cycle"] == 0)[1:])
    return max(motion["force"][rows].max() / motion["bound"][rows].min() for rows in parts)


@pytest.mark.long
def test_bundle_and_cpp_limit_hostile_pushes_as_r2s_does(hostile, tmp_path):
    """The same torque within rounding, through touches, pushes that the limit cuts, and a stop in contact."""
    motion = pushed(hostile, 1, stop_at=1200)
    assert by_numpy(hostile, motion) < LAW_NM
    if COMPILER is not None:
        assert by_cpp(hostile, motion, tmp_path)[0] < LAW_NM


@pytest.mark.slow
@pytest.mark.parametrize("task", ["press", "wipe"])
def test_ten_thousand_cycles_in_contact(tmp_path, task):
    """With the task's own times; runtime, C++ and certified bound, a stop after each episode's contact included."""
    exported = export(tmp_path, f"task={task}")
    motion = in_contact(exported, 3, stop_at=6500)
    assert (motion["force"] > 0.5).sum() > 10_000
    assert of_bound(motion) < 1.0
    assert by_runtime(exported, motion) < POLICY
    if COMPILER is not None:
        off, unlike = by_cpp(exported, motion, tmp_path)
        assert off < LAW_NM
        assert unlike < SEEN


@pytest.mark.slow
def test_ten_thousand_cycles_of_hostile_pushes(hostile, tmp_path):
    motion = pushed(hostile, 8, stop_at=1400)
    assert len(motion["q"]) > 10_000
    assert by_numpy(hostile, motion) < LAW_NM
    if COMPILER is not None:
        assert by_cpp(hostile, motion, tmp_path)[0] < LAW_NM


@pytest.mark.long
def test_the_limit_of_pushes_travels_with_other_tasks(tmp_path):
    """Reaching with a tool, near a table: the contract has the limit, and the runtime loads it."""
    exported = export(tmp_path, "robot.tool=r2s:models/press_tool.json")
    contract = loaded(exported.folder).load(exported.folder)
    assert contract["goal"]["kind"] == "point"
    assert contract["law"]["push"]["force_max"] == FORCE_MAX


PLANS = {
    "none": (lambda plan: None, "this bundle follows plans: pass one to `reset`"),
    "shorter": (lambda plan: plan[:-1], "expected a plan of shape (201, 30), got (200, 30)"),
    "not finite": (lambda plan: changed(plan, 7, 2, np.nan), "got nan in row 7, column 2"),
    "off the plane": (lambda plan: changed(plan, 7, 2, 0.1), "row 7 of the plan is "),
    "another normal": (lambda plan: changed(plan, 7, 3, 0.1), "row 7 of the plan: a normal of [0.1"),
    "far": (lambda plan: changed(plan, 7, 0, 0.9), "m from the middle; the training had up to 0.05 m"),
    "too hard": (
        lambda plan: changed(plan, 7, 7, 50.0),
        "row 7 of the plan asks for 50 N; the training had up to 20",
    ),
    "deep": (lambda plan: changed(plan, 7, 6, 0.5), "row 7 of the plan: a target 500.0 mm below the plane; the"),
    "target aside": (lambda plan: changed(plan, 7, 19, plan[7, 19] + 0.3), "row 7 of the plan: the setpoint's tar"),
    "target deeper": (lambda plan: changed(plan, 7, 20, plan[7, 20] - 0.3), "row 7 of the plan: the setpoint's ta"),
    "setpoint too hard": (lambda plan: changed(plan, 7, 27, 1000.0), "row 7 of the plan: a setpoint with normal and"),
    "setpoint turned": (lambda plan: changed(plan, 7, 24, 0.1), "row 7 of the plan: a setpoint with normal and"),
    "target too fast": (
        lambda plan: changed(plan, 7, 21, 3.0),
        "row 7 of the plan: a target velocity of 3 m/s, expected at most ",
    ),
    "measured force": (lambda plan: changed(plan, 7, 29, 1.0), "row 7 of the plan: a setpoint with normal and force"),
    "another start": (lambda plan: changed(plan, 0, 12, 0.5), "mm from where the plan begins"),
}


def changed(plan: np.ndarray, row: int, column: int, value: float) -> np.ndarray:
    plan = plan.copy()
    plan[row, column] = value
    return plan


@pytest.mark.parametrize("kind", PLANS)
def test_a_plan_that_the_training_did_not_have_is_refused(pressing, kind):
    """In one line, before anything moves."""
    runtime, (change, words) = loaded(pressing.folder), PLANS[kind]
    other = runtime.Runtime(pressing.folder, runtime.Arm(**arm_of(pressing)))
    with pytest.raises(runtime.BundleError, match=re.escape(words)) as refused:
        other.reset(change(np.load(pressing.folder / "plans.npz")["plans"][0]))
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    "words",
    [
        ("task=press",),
        ("task=press", "control=cartesian_impedance"),
        ("task=press", "control=hybrid", "control.normal=[0,0,1]", "control.force=5"),
        pytest.param(("task=wipe",), marks=pytest.mark.long),
    ],
)
def test_every_plan_of_a_task_is_accepted(words):
    """Setpoint and columns agree: for each kind of controller, half a period ahead, and with its own contact."""
    cfg = composed(*words)
    robot = make_robot(cfg)
    dynamics = make_dynamics(cfg, robot)
    task = make_task(cfg, robot, dynamics)
    contract = make_contract(robot, task, dynamics.level)
    assert min(contract["law"]["reflexes"]["force_N"][:3]) > task.force[1]  # without safety.force_max too
    model, begin = Model(contract["model"]), contract["goal"]["columns"]["setpoint"][0]
    plans = surface_plans(robot, task, task.goals(robot, np.random.default_rng(27), 20))
    for plan in plans:  # for task=wipe, the last one has 1.3 times the largest feedforward force of the examples
        check_surface_plan(contract, model, plan)
    for plan in plans[:3]:
        with pytest.raises(BundleError, match="row 7 of the plan: the setpoint's target is 30"):
            check_surface_plan(contract, model, changed(plan, 7, begin + 1, plan[7, begin + 1] + 0.3))
        if plan.shape[1] > begin + 12:  # a target that slides has a feedforward force
            with pytest.raises(BundleError, match="row 7 of the plan: a feedforward force of 100 N, expected"):
                check_surface_plan(contract, model, changed(plan, 7, begin + 12, 100.0))


def test_a_motion_begins_where_its_plan_does(pressing):
    runtime, plan = loaded(pressing.folder), np.load(pressing.folder / "plans.npz")["plans"][0]
    other = runtime.Runtime(pressing.folder, runtime.Arm(**arm_of(pressing)))
    other.reset(plan)
    with pytest.raises(runtime.BundleError, match=r"joint \d is at .* rad; motions begin within 0.00\d+ rad of"):
        other(plan[0, 11:18] + 0.01, np.zeros(7), np.zeros(7))


def test_a_friction_of_ones_own_does_not_travel(pressing):
    task = pressing.task
    model = replace(
        task.model, dynamics=replace(task.model.dynamics, family=replace(task.model.dynamics.family, name="x"))
    )
    with pytest.raises(UserError, match="the runtime of a bundle has no friction of family 'x'; allowed: sigmoid"):
        make_contract(pressing.robot, replace(task, model=model), np.zeros(7))


@pytest.mark.long
@pytest.mark.skipif(COMPILER is None, reason="no C++ compiler here")
def test_the_loop_for_libfranka_takes_a_plan(pressing, tmp_path):
    """With the stand-ins of tests/standins: it ends damped on a signal, and refuses what is no plan of the bundle."""
    paths = [f"-I{p}" for p in (ROOT / "tests" / "standins", LIBFRANKA, pressing.folder)]
    words = [str(COMPILER), "-std=c++17", "-O1", "-pthread", "-Wall", "-Wextra", "-Werror", *paths]
    subprocess.run([*words, str(LIBFRANKA / "loop.cpp"), "-o", str(tmp_path / "loop")], check=True)
    plan = np.load(pressing.folder / "plan.npy")
    plans = {"hard": changed(plan, 7, 7, 50.0), "short": plan[:-1], "single": plan.astype(np.float32)}
    plans |= {"deep": changed(plan, 7, 6, 0.5), "aside": changed(plan, 7, 19, 0.3), "push": changed(plan, 7, 27, 1e3)}
    plans["fast"] = changed(plan, 7, 21, 3.0)
    for name, values in plans.items():
        np.save(tmp_path / f"{name}.npy", values)

    def run(goal: str, script: str = "") -> tuple[int, bytes, str]:
        own = {"R2S_STANDIN": f"server=5 action=0.001 {script}"}
        words = [str(tmp_path / "loop"), "address", str(pressing.folder / "policy.onnx"), goal]
        done = subprocess.run(words, capture_output=True, env=own, timeout=60)
        return done.returncode, done.stdout, done.stderr.decode()

    status, out, error = run(str(pressing.folder / "plan.npy"), "signal_at=300 signal=15")
    assert (status, error) == (3, "stopped: a signal\n")
    cycles = np.frombuffer(out.rsplit(b"at rest after", 1)[0]).reshape(-1, 2 + 3 * 7)
    assert np.isfinite(cycles).all()
    assert cycles[-1, 1] == 1.0
    assert len(cycles) < 300 + 500
    for name, line in (
        ("hard", "hard.npy: row 7 asks for 50.000000 N; the training had up to 20"),
        ("short", "expected float64 of shape (201, 30), row by row, got {'descr': '<f8', 'fortran_order': False, 's"),
        ("single", "expected float64 of shape (201, 30), row by row, got {'descr': '<f4'"),
        ("deep", "deep.npy: row 7 has a target at a depth that the training did not have"),
        ("aside", "aside.npy: row 7 has a setpoint with another target"),
        ("push", "push.npy: row 7 has a setpoint with another normal or force"),
        ("fast", "fast.npy: row 7 has a target velocity of more than "),
        ("none", "none.npy is no file of numpy.save"),
    ):
        status, out, error = run(str(tmp_path / f"{name}.npy"))
        assert (status, out) == (2, b"")
        assert line in error
        assert len(error.splitlines()) == 1
    status, out, error = run(str(pressing.folder / "plan.npy"), "off=0.05")
    assert (status, out) == (2, b"")
    assert "joint 1 is at " in error
