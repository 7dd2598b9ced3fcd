"""Hostile streams of states through r2s's driver, a bundle's law in NumPy and C++, its runtime, and the C++ loop.

No command breaks a rule of the arm, none follows the end of a motion, and every motion ends at rest.
"""

import json
import os
import signal
import subprocess
import time
from collections.abc import Iterator

import numpy as np
import pytest
from conftest import ROOT, conf, unfenced
from made_bundles import COMPILER, LAW_NM, LIBFRANKA, Exported, arm_of, drawn, loaded

from r2s import commands
from r2s.arm.clients.fr3 import as_driven
from r2s.arm.drive_cycle import STILL
from r2s.arm.driver import DAMP_S
from r2s.arm.interface import ArmState
from r2s.arm.policy_runner import episode_driver
from r2s.arm.simulated import SimulatedArm
from r2s.export.law import Driver, Model
from r2s.physics.dynamics import nominal_dynamics

FAULTS = ("nan", "infinity", "jump", "stale", "lost", "stall", "lie", "garbage", "flips")
EPISODES = 18  # per arm; each has one fault and then, if it goes on, the end of its commands
BEGIN, END, LONGEST = 150, 450, 1500  # cycles: of the faults, of the commands, of an episode
PERIOD = 20  # cycles between two commands


@pytest.fixture(scope="module", params=["panda", pytest.param("fr3", marks=pytest.mark.slow)])
def exported(request, tmp_path_factory) -> Exported:
    made = drawn(tmp_path_factory.mktemp("campaign") / "train" / request.param, f"robot={request.param}")
    commands.run_command(["export", str(made.run)])
    return made


def simulated(exported: Exported) -> SimulatedArm:
    dynamics = nominal_dynamics(exported.robot, **conf("friction/paper"))
    return SimulatedArm(exported.robot, dynamics, position_noise=1e-5, velocity_noise=1e-3)


def hostile_stream(arm: SimulatedArm, torque: np.ndarray, seed: int) -> Iterator[tuple[ArmState, np.ndarray | None]]:
    """Yield the state that a driver receives and the policy's torque (n,) Nm, None without a new one, cycle by cycle.

    The arm is commanded by the caller between two cycles. One fault of FAULTS, by the seed, begins between cycles
    BEGIN and END and lasts 1 to 80 cycles; in lost cycles the arm keeps its last command, and nothing is yielded.
    """
    rng, fault = np.random.default_rng(seed), FAULTS[seed % len(FAULTS)]
    n, first = len(torque), int(rng.integers(BEGIN, END))
    last, j = first + int(rng.integers(1, 80)), int(rng.integers(n))
    wanted, state = np.zeros(n), arm.read()
    for k in range(LONGEST):
        faulty, real = first <= k < last, arm.read()
        if faulty and fault == "lost" and k < first + 19:  # with 20 lost cycles the arm stops itself
            arm.command(real.tau_J_d)
            continue
        state = state if faulty and fault == "stale" else real
        q, dq, applied, command = state.q.copy(), state.dq.copy(), state.tau_J_d.copy(), None
        if k % PERIOD == 0 and k < END + 100 and not (faulty and fault == "stall"):
            wanted = torque * rng.choice([-1.0, 0.3, 1.0], n)
            command = wanted
        if faulty:
            if fault in ("nan", "infinity"):
                (q, dq)[k % 2][j] = np.nan if fault == "nan" else np.inf
            q[j] += 0.5 * (fault == "jump")
            applied[j] += 3.0 * (fault == "lie" and k < first + 3)  # longer, and the commands follow it
            if fault == "garbage":
                command = rng.choice([np.nan, 1e9, -np.inf, 0.0], n)
            if fault == "flips":
                command = torque * (-1.0) ** k
        yield ArmState(1e-3 * k, q, dq, np.zeros(n), applied), command


def obey(arm: SimulatedArm, exported: Exported, tau: np.ndarray) -> None:
    """Command an arm. After a lie about its torque, a command is too large a step, which an arm refuses: clip it."""
    last, step = arm.read().tau_J_d, (1 - 1e-9) * 1e-3 * exported.robot.dtau_max  # a whole step may be rounded up
    arm.command(last + np.clip(tau - last, -step, step))


def check_rules(exported: Exported, state: ArmState, tau: np.ndarray) -> None:
    """Assert that a command is finite, in range, and within a step of the torque that the driver read."""
    robot = exported.robot
    assert np.isfinite(tau).all()
    assert (np.abs(tau) <= robot.tau_max + 1e-9).all()
    assert (np.abs(tau - state.tau_J_d) <= 1e-3 * robot.dtau_max + 1e-9).all()


def check_end(exported: Exported, arm: SimulatedArm, stopped_at: int | None, k: int) -> None:
    """Assert that a motion was stopped, came to rest within DAMP_S, and stayed within the arm's limits."""
    assert stopped_at is not None
    assert k - stopped_at <= 1e3 * DAMP_S
    state, robot = arm.read(), exported.robot
    assert np.abs(state.dq).max() < 5 * STILL  # of the sensors' noise and a cycle's coasting
    assert ((robot.q_min < state.q) & (state.q < robot.q_max)).all()


def campaign(exported: Exported) -> dict[str, np.ndarray]:
    """Return what r2s's driver received and sent, episode after episode, and how it ended; check its rules."""
    robot, task = as_driven(exported.robot), exported.task
    driver = episode_driver(robot, unfenced(robot, task), 0.0, exported.friction)
    rows: dict[str, list] = {name: [] for name in ("q", "dq", "last", "target", "flags", "tau", "ends")}
    for seed in range(EPISODES):
        driver.reset()
        arm, stopped_at, begin = simulated(exported), None, True
        for k, (state, command) in enumerate(hostile_stream(arm, task.torque_limit(robot), seed)):
            tau = driver(state, command)
            check_rules(exported, state, tau)
            target = np.zeros(robot.n) if command is None else command
            ends = [driver.stopping is not None, driver.done]
            values = state.q, state.dq, state.tau_J_d, target, [command is not None, begin], tau, ends
            for name, value in zip(rows, values, strict=True):
                rows[name].append(np.array(value, dtype=float))
            begin, stopped_at = False, k if stopped_at is None and driver.stopping else stopped_at
            if driver.done:
                break
            obey(arm, exported, tau)
        check_end(exported, arm, stopped_at, k)
    return {name: np.array(values) for name, values in rows.items()}


@pytest.fixture(scope="module")
def stream(exported) -> dict[str, np.ndarray]:
    return campaign(exported)


@pytest.mark.long
def test_the_law_in_numpy_sends_what_r2s_sends(exported, stream):
    """Command by command, with the same stop in the same cycle."""
    contract = json.loads((exported.folder / "contract.json").read_text())
    driver = Driver(contract["law"], Model(contract["model"]))
    for k in range(len(stream["q"])):
        new, begin = stream["flags"][k]
        if begin:
            driver.reset()
        with np.errstate(invalid="ignore", over="ignore"):
            tau = driver(stream["q"][k], stream["dq"][k], stream["last"][k], stream["target"][k] if new else None)
        assert np.abs(tau - stream["tau"][k]).max() < LAW_NM
        assert [driver.stopping is not None, driver.done] == stream["ends"][k].tolist()


CHECK = """
#include <cstdio>
#include "law.hpp"
int main() {
  constexpr int n = law::n;
  law::Driver driver;
  double x[4 * n + 2];
  while (std::fread(x, sizeof *x, 4 * n + 2, stdin) == 4 * n + 2) {
    law::Joints v[4];
    for (int k = 0; k < 4 * n; ++k) v[k / n][k % n] = x[k];
    if (x[4 * n + 1] > 0) driver = law::Driver();
    driver.model.place(v[0]);
    const law::Joints tau = driver(v[0], v[1], v[2], x[4 * n] > 0 ? &v[3] : nullptr);
    const double ends[] = {driver.why != law::Driver::runs ? 1.0 : 0.0, driver.done() ? 1.0 : 0.0};
    std::fwrite(tau.data(), sizeof *x, n, stdout);
    std::fwrite(ends, sizeof *x, 2, stdout);
  }
}
"""
needs_compiler = pytest.mark.skipif(COMPILER is None, reason="no C++ compiler here")


@needs_compiler
def test_the_law_in_cpp_sends_what_r2s_sends(exported, stream, tmp_path):
    (tmp_path / "check.cpp").write_text(CHECK)
    words = [str(COMPILER), "-std=c++17", "-O1", "-Wall", "-Wextra", "-Werror", "-I", str(LIBFRANKA)]
    subprocess.run([*words, "-I", str(exported.folder), "check.cpp", "-o", "check"], cwd=tmp_path, check=True)
    sent = np.concatenate([stream[name] for name in ("q", "dq", "last", "target", "flags")], 1)
    done = subprocess.run([tmp_path / "check"], input=sent.tobytes(), capture_output=True, check=True)
    got, n = np.frombuffer(done.stdout).reshape(len(sent), -1), exported.robot.n
    assert np.abs(got[:, :n] - stream["tau"]).max() < LAW_NM
    assert (got[:, n:] == stream["ends"]).all()


@pytest.mark.long
def test_the_runtime_keeps_the_rules(exported):
    """In closed loop, with its own policy: each fault, a stop that is asked for, a failing policy, a goal too far."""
    runtime, goal = loaded(exported.folder), np.array([0.5, 0.1, 0.4])
    other = runtime.Runtime(exported.folder, runtime.Arm(**arm_of(exported)))
    act = other.act
    for seed in range(EPISODES):
        other.reset()
        other.act = act
        arm, stopped_at = simulated(exported), None
        for k, (state, _) in enumerate(hostile_stream(arm, np.ones(exported.robot.n), seed)):
            if k == END + seed:
                other.stop("asked for")
            if k == 300 and seed == 1:
                other.act = lambda seen: 1 / 0
            tau = other(state.q, state.dq, state.tau_J_d, goal + (k >= 300 and seed == 2))
            check_rules(exported, state, tau)
            stopped_at = k if stopped_at is None and other.driver.stopping else stopped_at
            if other.done:
                break
            obey(arm, exported, tau)
        check_end(exported, arm, stopped_at, k)
        with pytest.raises(runtime.BundleError, match="the motion is over"):
            other(state.q, state.dq, state.tau_J_d, goal)


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT", "SIGTSTP"])
def test_a_signal_brings_the_runtime_to_rest(exported, name):
    """The first is the reason that is kept; after the motion the program has its own handlers again."""
    runtime, home, still = loaded(exported.folder), exported.robot.q_home, np.zeros(7)
    other = runtime.Runtime(exported.folder, runtime.Arm(**arm_of(exported)))
    before = signal.getsignal(getattr(signal, name))
    with runtime.stopped_by_signals(other):
        for k in range(40):
            other(home, still + 0.05 * (k > 0), still, np.array([0.5, 0.1, 0.4]))
        os.kill(os.getpid(), getattr(signal, name))
        os.kill(os.getpid(), signal.SIGTERM)
        other(home, still, still, np.array([0.5, 0.1, 0.4]))
    assert other.driver.stopping == name
    assert other.done
    assert signal.getsignal(getattr(signal, name)) == before


def test_a_policy_beside_the_cycle_that_stalls_is_stopped(exported):
    """With live=True a cycle does not wait for it: commands go on, and the deadline of the driver acts."""
    runtime, home, still = loaded(exported.folder), exported.robot.q_home, np.zeros(7)
    other = runtime.Runtime(exported.folder, runtime.Arm(**arm_of(exported)), live=True)
    goal, made = np.array([0.5, 0.1, 0.4]), []
    other._thread._act = lambda seen: (made.append(seen), np.full(7, 1.0))[1]
    while not made or other.driver.effort[0] < 0.5:  # the newest action arrives
        tau = other(home, still, still, goal)
        time.sleep(1e-3)
        assert other.driver.stopping is None
    other._thread._act = lambda seen: time.sleep(600)
    for _ in range(200):
        if other.done:
            break
        tau = other(home, still + 0.05, tau, goal)
        time.sleep(1e-3)
    assert other.driver.stopping == "no finite action for 50 ms"


@pytest.fixture(scope="module")
def loop(exported, tmp_path_factory):
    """The program of examples/libfranka with the stand-ins of tests/standins, which run an arm and a policy."""
    if COMPILER is None:
        pytest.skip("no C++ compiler here")
    program = tmp_path_factory.mktemp("loop") / "loop"
    paths = [f"-I{p}" for p in (ROOT / "tests" / "standins", LIBFRANKA, exported.folder)]
    words = [str(COMPILER), "-std=c++17", "-O1", "-pthread", "-Wall", "-Wextra", "-Werror", *paths]
    subprocess.run([*words, str(LIBFRANKA / "loop.cpp"), "-o", str(program)], check=True)
    server = 6 if exported.run.name == "fr3" else 5

    def run(script: str = "", goal: str = "0.5 0.1 0.4", policy: str = "") -> subprocess.CompletedProcess[bytes]:
        own = {"R2S_STANDIN": f"server={server} action=9 {script}"}  # a repeated key does not count
        words = [str(program), "address", policy or str(exported.folder / "policy.onnx"), *goal.split()]
        return subprocess.run(words, capture_output=True, env=own, timeout=60)

    return run


SIGNALS = {name: int(getattr(signal, name)) for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT", "SIGTSTP")}
SCRIPTS = {f"signal_at=300 signal={number}": "a signal" for number in SIGNALS.values()} | {
    "nan_at=300": "the arm's state is not finite",
    "jump_at=300": "a joint is too close to a limit",
    "stall_at=9 stall_ms=400": "no finite action of the policy in time",
    "fail_at=9": "no finite action of the policy in time",
    "lost_at=300 lost=15 signal_at=400 signal=15": "a signal",
    "lie_at=300 signal_at=400 signal=15": "a signal",
    "stall_at=9 stall_ms=30 signal_at=400 signal=15": "a signal",
}


@pytest.mark.long
@pytest.mark.parametrize("script", SCRIPTS)
def test_the_loop_for_libfranka_ends_damped(exported, loop, script):
    """No command over a rule, none after the end, the arm at rest; exit status 3 and the cause."""
    done = loop(script)
    rows, text = done.stdout.rsplit(b"at rest after", 1)
    cycles = np.frombuffer(rows).reshape(-1, 2 + 3 * 7)
    state, tau, dq = cycles[:, 2:9], cycles[:, 9:16], cycles[:, 16:]
    assert done.returncode == 3, done.stderr
    assert done.stderr.decode().splitlines()[-1] == f"stopped: {SCRIPTS[script]}"
    assert b"mm from the goal" in text
    assert np.isfinite(tau).all()
    assert (np.abs(tau) <= exported.robot.tau_max).all()
    assert (np.abs(tau - state) <= 1e-3 * exported.robot.dtau_max + 1e-9).all()
    assert np.abs(tau).max() > 0.5
    assert cycles[:, 1].tolist() == [0.0] * (len(cycles) - 1) + [1.0]
    assert np.abs(dq[-1]).max() < 5 * STILL
    assert len(cycles) < 1200


REFUSED = {
    ("", "0,5 0.1 0.4"): "expected a number such as 0.5, got '0,5'",
    ("", "0.5 0.1 0.4m"): "expected a number such as 0.5, got '0.4m'",
    ("", "0.5 nan 0.4"): "expected a number such as 0.5, got 'nan'",
    ("", "0x1 0.1 0.4"): "expected a number such as 0.5, got '0x1'",
    ("", "0 0 0.3"): "m from the shoulder; the training had",
    ("", "0.5 0.1 0.05"): "the goal is at a height of 0.05",
    ("", "-0.5 0.1 0.4"): "rad to the side",
    ("off=0.3", "0.5 0.1 0.4"): "joint 1 is at 0.3",
    ("moves=0.5", "0.5 0.1 0.4"): "joint 1 moves at 0.5",
    ("tool=0.05", "0.5 0.1 0.4"): "mm from the bundle's: another arm or tool",
}


@pytest.mark.parametrize("case", REFUSED)
def test_the_loop_for_libfranka_refuses_what_stage_transfer_refuses(loop, case):
    done = loop(*case)
    assert (done.returncode, done.stdout) == (2, b"")
    assert REFUSED[case] in done.stderr.decode()
    assert len(done.stderr.decode().splitlines()) == 1


def test_the_loop_for_libfranka_refuses_another_policy_and_another_arm(exported, loop, tmp_path):
    (tmp_path / "policy.onnx").write_bytes((exported.folder / "policy.onnx").read_bytes() + b"\0")
    done = loop(policy=str(tmp_path / "policy.onnx"))
    assert (done.returncode, done.stdout) == (2, b"")
    assert b"is not the policy of this program: its sha256 is" in done.stderr
