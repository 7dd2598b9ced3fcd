"""Measure the cost of r2s over its peers as ratios (`make bench`). Writes runs/bench/bench.json.

Every ratio alternates r2s and its peer and takes the median, so that a slower machine slows both down. Learners are
compared like with like: eager with eager, compiled with compiled, each with float32 and with bfloat16 products.
"""

import copy
import json
import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import mujoco
import mujoco.batch
import numpy as np
import torch
from common import MACHINE, NEW, ROBOT, ROOT, conf, default_task
from rich.console import Console
from rich.table import Table

from r2s.adaptation.adapters import AdapterContext
from r2s.adaptation.estimator import Estimator
from r2s.adaptation.wrench import WrenchObserver
from r2s.arm.twins.rigid_twin import RigidTwin
from r2s.learning.env import TaskEnv
from r2s.learning.randomization import UniformRandomization
from r2s.learning.replay import Replay
from r2s.learning.tqc import TQC
from r2s.learning.train import keep_memory, matmul_precision
from r2s.physics.robot import SIM_DT
from r2s.physics.simulator import Simulator
from r2s.physics.surface import Tool
from r2s.tasks.reach import ReachTask

REPEATS = 15
HIDDEN = (256, 256)  # units per hidden layer of actor and critics
LR = 5e-4


@dataclass(frozen=True)
class Mode:
    """How updates run: compiled or eager; `matmul`: precision of products, see `matmul_precision`."""

    compiled: bool
    matmul: str

    def __str__(self) -> str:
        precision = {"highest": "float32", "medium": "bfloat16"}[self.matmul]
        return f"{'compiled' if self.compiled else 'eager'} {precision}"


MODES = [Mode(compiled, matmul) for compiled in (False, True) for matmul in ("highest", "medium")]


def duel(ours: Callable[[], object], peer: Callable[[], object], work: float) -> tuple[float, float]:
    """Return median rates of both, work per second, of alternating calls; a call may return its own duration, s."""
    seconds: list[list[float]] = [[], []]
    for k in range(REPEATS + 2):
        for side, call in enumerate((ours, peer)):
            began = time.perf_counter()
            duration = call()
            if k >= 2:
                seconds[side].append(duration if isinstance(duration, float) else time.perf_counter() - began)
    return work / float(np.median(seconds[0])), work / float(np.median(seconds[1]))


def friction(robot, dynamics, threads: int) -> tuple[float, float]:
    """Compare batched rollouts with friction, breakaway and offsets with the bare Batch, steps/s."""
    arms, steps = 256, 200
    tau = 0.3 * np.cumsum(np.random.default_rng(0).normal(size=(arms, steps, robot.n)), axis=1)
    sim = Simulator(robot, dynamics, arms, threads)
    bare = mujoco.batch.Batch(robot.model(gravity=False), arms, threads)
    q0, spec = np.tile(robot.q_home, (arms, 1)), int(mujoco.mjtState.mjSTATE_QFRC_APPLIED)

    def ours() -> None:
        sim.reset(q0, np.zeros_like(q0))
        sim.rollout(tau)

    def peer() -> None:
        bare.reset()
        bare.bind("qpos")[:] = q0
        bare.rollout(steps, tau, control_spec=spec, record=("qpos",))

    return duel(ours, peer, arms * steps)


def environment(robot, dynamics, threads: int) -> tuple[float, float]:
    """Compare the TorchRL environment (observation, reward, randomised resets) with its bare physics, arm steps/s."""
    arms, steps, task = 32, 50, default_task("reach")
    env = TaskEnv(
        robot, task, UniformRandomization(robot, dynamics, **conf("dr/paper")), arms, nthread=threads, stagger=True
    )
    state = env.reset()
    action = env.action_spec.rand()
    bare = mujoco.batch.Batch(robot.model(gravity=False), arms, threads)
    tau, spec = np.zeros((arms, task.substeps, robot.n)), int(mujoco.mjtState.mjSTATE_QFRC_APPLIED)

    def ours() -> None:
        nonlocal state
        for _ in range(steps):
            state["action"] = action
            _, state = env.step_and_maybe_reset(state)

    def peer() -> None:
        for _ in range(steps):
            bare.rollout(task.substeps, tau, control_spec=spec, record=("qpos",))

    return duel(ours, peer, arms * steps)


def replay(robot) -> tuple[float, float]:
    """Compare the replay buffer with TorchRL's: transitions of 32 arms added, 256 drawn, times/s."""
    from tensordict import TensorDict
    from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

    torch.set_num_threads(1)
    buffer, count, rows = Replay(100_000), 200, random_batch(robot, 32)
    theirs = TensorDictReplayBuffer(storage=LazyTensorStorage(100_000), batch_size=256)

    def ours() -> None:
        for _ in range(count):
            buffer.extend(rows)
            buffer.sample(256)

    def peer() -> None:
        for _ in range(count):
            theirs.extend(TensorDict(rows, batch_size=[32]))
            theirs.sample()

    return duel(ours, peer, count)


def torchrl_update(algo: TQC, batch: Mapping[str, torch.Tensor], lr: float) -> Callable[[], object]:
    """Return TorchRL's update on this batch: TQCLoss with the networks, batch and optimiser of `algo`."""
    from tensordict import TensorDict
    from tensordict.nn import TensorDictModule
    from torch import nn
    from torchrl.modules import ProbabilisticActor, ValueOperator
    from torchrl.modules.distributions import TanhNormal
    from torchrl.objectives import SoftUpdate, TQCLoss

    (b, d), n = batch["observation"].shape, batch["action"].shape[1]
    widths = [d + n, *(len(x[0, 0]) for x in algo.critics.norm_scale)]

    class Critic(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            body = [m for i, o in pairwise(widths) for m in (nn.Linear(i, o), nn.LayerNorm(o), nn.ReLU())]
            self.net = nn.Sequential(*body, nn.Linear(widths[-1], 25))

        def forward(self, observation, action):
            return self.net(torch.cat([observation, action], -1))

    actor = ProbabilisticActor(
        TensorDictModule(copy.deepcopy(algo.actor), in_keys=["observation"], out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
    )
    critic = ValueOperator(Critic(), in_keys=["observation", "action"])
    loss = TQCLoss(actor, critic, num_qvalue_nets=2, target_entropy=-float(n), alpha_init=0.01)
    loss.make_value_estimator(gamma=algo.gamma)
    target = SoftUpdate(loss, eps=1.0 - algo.tau)
    device = batch["action"].device
    loss = loss.to(device)
    optimizer = torch.optim.Adam(loss.parameters(), lr=lr, fused=True, capturable=device.type == "cuda")
    flags = torch.zeros(b, 1, dtype=torch.bool, device=device)
    following = {"observation": batch["next_observation"], "reward": batch["reward"][:, None]}
    following |= {"done": flags, "terminated": flags.clone()}
    seen = {"observation": batch["observation"], "action": batch["action"], "next": following}
    transitions = TensorDict(seen, batch_size=[b])

    def update() -> TensorDict:  # as in TorchRL's sota-implementations, which compile the whole function
        out = loss(transitions)
        (out["loss_qvalue"] + out["loss_actor"] + out["loss_alpha"]).backward()
        optimizer.step()
        optimizer.zero_grad(set_to_none=True)
        target.step()
        return out.detach()

    return update


def random_batch(robot, b: int) -> dict[str, torch.Tensor]:
    """Return a batch of b random transitions of task=reach."""
    d, n = len(ReachTask().observation_scale(robot)[0]), robot.n
    batch = {"observation": torch.randn(b, d), "next_observation": torch.randn(b, d)}
    return batch | {"action": torch.rand(b, n) * 2 - 1, "reward": torch.randn(b), "terminated": torch.zeros(b)}


def make_tqc(robot, mode: Mode, b: int, hidden: Sequence[int] = HIDDEN, device: str = "cpu") -> TQC:
    """Return a learner in this mode for batches of b."""
    mean, std = (torch.from_numpy(x).float() for x in ReachTask().observation_scale(robot))
    algo = TQC((mean, std), torch.ones(robot.n), hidden=hidden, gamma=0.98, tau=0.005, lr=LR).to(device)
    if mode.compiled:
        with matmul_precision(mode.matmul):
            if not algo.compile(b):
                sys.exit("error: the losses do not compile on this machine; install a C++ compiler")
    return algo


def learner(
    robot, threads: int, mode: Mode, b: int = 256, hidden: Sequence[int] = HIDDEN, device: str = "cpu"
) -> tuple[float, float]:
    """Compare TQC updates with TorchRL's, both in the same mode: networks, batch, optimiser; updates/s."""
    torch.set_num_threads(threads)
    algo = make_tqc(robot, mode, b, hidden, device)
    batch = {k: v.to(device) for k, v in random_batch(robot, b).items()}
    theirs = torchrl_update(algo, batch, LR)
    theirs = torch.compile(theirs) if mode.compiled else theirs

    def repeated(update: Callable[[], object]) -> Callable[[], object]:
        def run() -> None:
            with matmul_precision(mode.matmul):
                for _ in range(10):
                    update()
            if device == "cuda":
                torch.cuda.synchronize()

        return run

    return duel(repeated(lambda: algo.update(batch)), repeated(theirs), 10)


class Sb3:
    """sb3-contrib's TQC in its own virtual environment, runs/bench/sb3, created at the first use."""

    @staticmethod
    def python() -> Path:
        """Return the interpreter of that environment; create the environment if it is missing."""
        folder = ROOT / "runs" / "bench" / "sb3"
        python = folder / "bin" / "python"
        if not (folder / ".ready").is_file():
            print(f"setting up {folder} (once; a minute or two)", flush=True)
            subprocess.run([sys.executable, "-m", "venv", str(folder)], check=True)
            pip = [str(python), "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
            subprocess.run([*pip, f"torch=={torch.__version__.split('+')[0]}", "sb3-contrib==2.9.2"], check=True)
            (folder / ".ready").touch()
        return python

    def __init__(self) -> None:
        worker = [str(self.python()), str(ROOT / "benchmarks" / "sb3_worker.py")]
        self._process = subprocess.Popen(worker, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1)
        assert self._process.stdout is not None
        assert self._process.stdout.readline().strip() == "ready"

    def update(self, threads: int, count: int, matmul: str) -> float:
        """Return the duration of `count` updates with this precision of products, s."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(f"{threads} {count} {matmul}\n")
        return float(self._process.stdout.readline())

    def close(self) -> None:
        """End the process."""
        self._process.terminate()


def against_sb3(robot, threads: int, mode: Mode, sb3: Sb3) -> tuple[float, float]:
    """Compare TQC updates with replay sampling with sb3-contrib's `train`, which samples too, updates/s.

    sb3-contrib has no compiled mode: both have the same precision of products, and its update is eager.
    """
    torch.set_num_threads(threads)
    algo, buffer, count = make_tqc(robot, mode, 256), Replay(100_000), 50
    buffer.extend(random_batch(robot, 2000))

    def ours() -> None:
        with matmul_precision(mode.matmul):
            for _ in range(count):
                algo.update(buffer.sample(256))

    return duel(ours, lambda: sb3.update(threads, count, mode.matmul), count)


def twin(robot) -> tuple[float, float]:
    """Compare the rate of the rigid twin with real time, cycles/s."""
    arm, count, rates = RigidTwin(robot, 0), 2000, []
    for _ in range(REPEATS):
        arm.move_to(robot.q_home)
        began = time.perf_counter()
        for k in range(count):
            arm.command(np.full(robot.n, np.sin(0.01 * k)))
            arm.read()
        rates.append(count / (time.perf_counter() - began))
    return float(np.median(rates)), 1 / SIM_DT


def observers(robot, dynamics) -> tuple[float, float]:
    """Compare the observer of the external wrench with the online estimator of a payload, cycles/s."""
    arm = replace(robot, tool=Tool(np.array([0.0, 0.0, 0.1]), 0.01))
    t = SIM_DT * np.arange(5000)[:, None]
    rate, size = np.linspace(2.0, 5.0, robot.n), 0.3  # rad/s, rad
    q, dq = robot.q_home + size * np.sin(rate * t), size * rate * np.cos(rate * t)
    tau = 0.05 * robot.tau_max * np.cos(3.0 * t)
    wrench, estimator = WrenchObserver(arm, dynamics), Estimator(*AdapterContext(arm, dynamics).corrected)

    def repeated(observe: Callable[..., object]) -> Callable[[], object]:
        return lambda: [observe(*cycle) for cycle in zip(q, dq, tau, strict=True)]

    return duel(repeated(wrench), repeated(estimator), len(t))


def main() -> None:
    """Run all comparisons and print one table."""
    robot, dynamics = ROBOT, NEW
    cores = os.cpu_count() or 1
    keep_memory()  # same as in training
    rows, sb3 = {"hidden twin / real time, cycles/s, 1 thread": twin(robot)}, Sb3()
    rows["wrench observer / online estimator, cycles/s, 1 thread"] = observers(robot, dynamics)
    rows["replay buffer / TorchRL's, add 32 and draw 256, times/s"] = replay(robot)
    for threads in sorted({1, cores}):
        at = f"{threads} thread{'s' * (threads > 1)}"
        rows[f"physics with friction / bare Batch, steps/s, {at}"] = friction(robot, dynamics, threads)
        rows[f"TorchRL environment / bare Batch, arm steps/s, {at}"] = environment(robot, dynamics, threads)
        for mode in MODES:
            rows[f"TQC / TorchRL's TQCLoss, both {mode}, updates/s, {at}"] = learner(robot, threads, mode)
            peer = "both" if not mode.compiled else "ours"
            rows[f"TQC / sb3-contrib's TQC, {peer} {mode}, updates/s, {at}"] = against_sb3(robot, threads, mode, sb3)
    sb3.close()
    for mode in MODES if torch.cuda.is_available() else ():  # compiled, r2s captures a graph and TorchRL does not
        what = f"TQC / TorchRL's TQCLoss, both {mode}, updates/s, {torch.cuda.get_device_name()}"
        rows[what] = learner(robot, 1, mode, device="cuda")
    table = Table(title=f"{MACHINE}, mujoco {mujoco.__version__}, torch {torch.__version__}")
    for column in ("what", "r2s", "peer", "ratio"):
        table.add_column(column, justify="left" if column == "what" else "right")
    for what, (ours, peer) in rows.items():
        table.add_row(what, f"{ours:,.0f}", f"{peer:,.0f}", f"{ours / peer:.2f}")
    Console(width=110).print(table)
    folder = ROOT / "runs" / "bench"
    folder.mkdir(parents=True, exist_ok=True)
    machine = {"machine": MACHINE, "python": platform.python_version(), "torch": torch.__version__}
    measured = {k: {"r2s": o, "peer": p, "ratio": o / p} for k, (o, p) in rows.items()}
    (folder / "bench.json").write_text(json.dumps({"machine": machine, "rows": measured}, indent=1) + "\n")
    print(f"written: {folder.relative_to(ROOT)}/bench.json")


if __name__ == "__main__":
    main()
