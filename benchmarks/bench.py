"""Measure the cost of r2s over its peers as ratios (`make bench`). Writes runs/bench/bench.json.

Every ratio alternates r2s and its peer and takes the median, so that a slower machine slows both down.
"""

import copy
import json
import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import mujoco
import mujoco.batch
import numpy as np
import torch
from common import MACHINE, NEW, ROBOT, ROOT, conf, default_task
from rich.console import Console
from rich.table import Table

from r2s.arm.twins.rigid_twin import RigidTwin
from r2s.learning.env import TaskEnv
from r2s.learning.randomization import UniformRandomization
from r2s.learning.tqc import TQC
from r2s.learning.train import keep_memory, matmul_precision
from r2s.physics.robot import SIM_DT
from r2s.physics.simulator import Simulator
from r2s.tasks.reach import ReachTask

REPEATS = 15


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


def learner(robot, threads: int, matmul: str) -> tuple[float, float]:
    """Compare TQC updates with TorchRL's eager TQCLoss, same networks, batch and optimiser, updates/s.

    Updates of r2s are compiled, same as in training; `matmul` is the precision of their matrix products.
    """
    from tensordict import TensorDict
    from tensordict.nn import TensorDictModule
    from torch import nn
    from torchrl.modules import ProbabilisticActor, ValueOperator
    from torchrl.modules.distributions import TanhNormal
    from torchrl.objectives import SoftUpdate, TQCLoss

    torch.set_num_threads(threads)
    mean, std = (torch.from_numpy(x).float() for x in ReachTask().observation_scale(robot))
    d, n, b = len(mean), robot.n, 256
    algo = TQC((mean, std), torch.ones(n), hidden=(256, 256))
    with matmul_precision(matmul):
        algo.compile(b)

    class Critic(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            body = [nn.Linear(d + n, 256), nn.LayerNorm(256), nn.ReLU(), nn.Linear(256, 256), nn.LayerNorm(256)]
            self.net = nn.Sequential(*body, nn.ReLU(), nn.Linear(256, 25))

        def forward(self, observation, action):
            return self.net(torch.cat([observation, action], -1))

    actor = ProbabilisticActor(
        TensorDictModule(copy.deepcopy(algo.actor), in_keys=["observation"], out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
    )
    critic = ValueOperator(Critic(), in_keys=["observation", "action"])
    loss = TQCLoss(actor, critic, num_qvalue_nets=2, target_entropy=-float(n), alpha_init=0.01)
    loss.make_value_estimator(gamma=0.98)
    target = SoftUpdate(loss, eps=0.995)
    optimizer = torch.optim.Adam(loss.parameters(), lr=5e-4, fused=True)
    seen, after, action, reward = torch.randn(b, d), torch.randn(b, d), torch.rand(b, n) * 2 - 1, torch.randn(b)
    flags = torch.zeros(b, 1, dtype=torch.bool)
    following = {"observation": after, "reward": reward[:, None], "done": flags, "terminated": flags.clone()}
    theirs = TensorDict({"observation": seen, "action": action, "next": following}, batch_size=[b])
    batch = {"observation": seen, "next_observation": after, "action": action, "reward": reward}
    batch["terminated"] = torch.zeros(b)

    def ours() -> None:
        with matmul_precision(matmul):
            for _ in range(10):
                algo.update(batch)

    def peer() -> None:
        for _ in range(10):
            out = loss(theirs)
            (out["loss_qvalue"] + out["loss_actor"] + out["loss_alpha"]).backward()
            optimizer.step()
            optimizer.zero_grad()
            target.step()

    return duel(ours, peer, 10)


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

    def update(self, threads: int, count: int) -> float:
        """Return the duration of `count` updates, s."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(f"{threads} {count}\n")
        return float(self._process.stdout.readline())

    def close(self) -> None:
        """End the process."""
        self._process.terminate()


def against_sb3(robot, threads: int, matmul: str, sb3: Sb3) -> tuple[float, float]:
    """Compare TQC updates with replay sampling with sb3-contrib's `train`, which samples too, updates/s."""
    from tensordict import TensorDict
    from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

    torch.set_num_threads(threads)
    mean, std = (torch.from_numpy(x).float() for x in ReachTask().observation_scale(robot))
    d, n, count = len(mean), robot.n, 50
    algo = TQC((mean, std), torch.ones(n), hidden=(256, 256), gamma=0.98, tau=0.005)
    with matmul_precision(matmul):
        algo.compile(256)
    replay = TensorDictReplayBuffer(storage=LazyTensorStorage(100_000), batch_size=256)
    rows = {"observation": torch.randn(2000, d), "next_observation": torch.randn(2000, d)}
    rows |= {"action": torch.rand(2000, n) * 2 - 1, "reward": torch.randn(2000), "terminated": torch.zeros(2000)}
    replay.extend(TensorDict(rows, batch_size=[2000]))

    def ours() -> None:
        with matmul_precision(matmul):
            for _ in range(count):
                algo.update(replay.sample())

    return duel(ours, lambda: sb3.update(threads, count), count)


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


def main() -> None:
    """Run all comparisons and print one table."""
    robot, dynamics = ROBOT, NEW
    cores = os.cpu_count() or 1
    keep_memory()  # same as in training
    rows, sb3 = {"hidden twin / real time, cycles/s, 1 thread": twin(robot)}, Sb3()
    for threads in sorted({1, cores}):
        at = f"{threads} thread{'s' * (threads > 1)}"
        rows[f"physics with friction / bare Batch, steps/s, {at}"] = friction(robot, dynamics, threads)
        rows[f"TorchRL environment / bare Batch, arm steps/s, {at}"] = environment(robot, dynamics, threads)
        for matmul, name in (("highest", "float32"), ("medium", "bfloat16")):
            way = f"updates/s, {name} products, {at}"
            rows[f"TQC / TorchRL's TQCLoss, {way}"] = learner(robot, threads, matmul)
            rows[f"TQC / sb3-contrib's TQC, {way}"] = against_sb3(robot, threads, matmul, sb3)
    sb3.close()
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
