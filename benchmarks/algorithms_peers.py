"""Train TQC of TorchRL or of sb3-contrib on the arms of r2s, with the settings of conf/algo/tqc.yaml.

`python benchmarks/algorithms_peers.py torchrl|sb3 SEED MINUTES FOLDER` trains once, on one thread, for
benchmarks/algorithms.py. Evaluations are those of a training of r2s and count in its time. The script writes
FOLDER/evaluations.csv, FOLDER/summary.json (the last policy on the goals of reports) and FOLDER/distances.npy, (200,)
m, of the policy that the evaluations select.

Arms, observations, reward and its curriculum, networks, rates, batch and updates per step equal those of r2s. The
peers have their own losses, without `action_l2` (sb3 also without LayerNorm), and do not compile.
"""

import copy
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from common import ROOT, conf

from r2s.learning.evaluate import REPORT, SELECTION, make_evaluation
from r2s.learning.train import Loop, fastest_matmul
from r2s.tasks.rollout import HOLD_S

ALGO = conf("algo/base") | conf("algo/tqc")
EVALUATIONS = 6  # of a training
OVERRIDES = ("dr=paper", "threads=1")


class Course:
    """A training's evaluations and its time limit; `share` of the time has passed."""

    def __init__(self, arms: Any, seconds: float) -> None:
        self.task, self.seconds, self.rows, self.best = arms.task, seconds, [], {}
        self._loop = Loop(lr_decay=ALGO["lr_decay"], lr_end=ALGO["lr_end"])
        self._select, self._report = (
            make_evaluation(arms.robot, arms.task, arms.draw, nthread=1, seed=seed) for seed in (SELECTION, REPORT)
        )
        self._began = time.perf_counter()

    @property
    def share(self) -> float:
        """Return the share of the time that has passed, at most 1."""
        return min((time.perf_counter() - self._began) / self.seconds, 1.0)

    def lr(self) -> float:
        """Return the learning rate."""
        return ALGO["lr"] * self._loop.lr_share(self.share)

    def goes_on(self, policy: Callable[[], Any], env_steps: int, updates: int) -> bool:
        """Evaluate a copy of the policy when it is due; return whether the training goes on."""
        if self.share < (len(self.rows) + 1) / EVALUATIONS:
            return True
        self.policy = policy()
        row = self.task.measures(self._select(self.policy))
        row |= {"env_steps": env_steps, "updates": updates, "wall_clock_s": time.perf_counter() - self._began}
        self.rows.append(row)
        if not self.best or self.task.score(row) >= self.task.score(self.best):
            self.best, self.selected = row, self.policy
        return self.share < 1.0

    def write(self, folder: Path) -> None:
        """Write the files that the module names."""
        folder.mkdir(parents=True, exist_ok=True)
        pd.DataFrame(self.rows).to_csv(folder / "evaluations.csv", index=False)
        np.save(folder / "distances.npy", final_distances(self._report(self.selected), self.task))
        last = self.rows[-1] | self.task.measures(self._report(self.policy))
        (folder / "summary.json").write_text(json.dumps({"last": last}, default=float))


def final_distances(episodes: Any, task: Any) -> np.ndarray:
    """Return the largest distance (E,) m from the goal in the last 0.5 s, in which success counts."""
    return episodes.distance[:, -round(HOLD_S * task.ctrl_hz) :].max(axis=1)


def train_torchrl(seed: int, seconds: float) -> Course:
    """Train with TorchRL's collector, transforms, buffer, TQCLoss and target networks."""
    from tensordict.nn import TensorDictModule
    from torchrl.collectors import Collector
    from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
    from torchrl.envs import ClipTransform, Compose, ObservationNorm, TransformedEnv
    from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator
    from torchrl.objectives import SoftUpdate, TQCLoss

    from r2s.envs import torchrl_env
    from r2s.learning.policy import make_policy

    hidden, n = tuple(ALGO["hidden"]), ALGO["n_envs"]
    arms = torchrl_env(n, task="reach", seed=seed, overrides=OVERRIDES)
    policy = make_policy(arms.robot, arms.task, hidden)
    scale = ObservationNorm(policy.normalizer.mean, policy.normalizer.std, ["observation"], standard_normal=True)
    env = TransformedEnv(arms, Compose(scale, ClipTransform(["observation"], low=-10.0, high=10.0)))
    network = TensorDictModule(policy.actor, in_keys=["observation"], out_keys=["loc", "scale"])
    actor = ProbabilisticActor(network, ["loc", "scale"], distribution_class=TanhNormal)
    norm = {"norm_class": torch.nn.LayerNorm, "norm_kwargs": [{"normalized_shape": size} for size in hidden]}
    critic = MLP(out_features=ALGO["n_quantiles"], num_cells=hidden, activation_class=torch.nn.ReLU, **norm)
    critic = ValueOperator(critic, in_keys=["observation", "action"])
    critic(actor(env.reset()))  # makes the lazy layers
    loss = TQCLoss(
        actor,
        critic,
        num_qvalue_nets=ALGO["n_critics"],
        top_quantiles_to_drop_per_net=ALGO["drop_per_critic"],
        alpha_init=ALGO["alpha_init"],
        target_entropy=ALGO["target_entropy"],
    )
    loss.make_value_estimator(gamma=ALGO["gamma"])
    targets, optimizer = SoftUpdate(loss, tau=ALGO["tau"]), torch.optim.Adam(loss.parameters(), lr=ALGO["lr"])
    storage = LazyTensorStorage(ALGO["replay_size"])
    buffer = TensorDictReplayBuffer(storage=storage, batch_size=ALGO["batch_size"])
    starts = ALGO["learning_starts"]
    collector = Collector(env, actor, frames_per_batch=n, total_frames=-1, init_random_frames=starts)
    course, updates = Course(arms, seconds), 0
    for k, steps in enumerate(collector, 1):
        arms.weights = arms.reward.weights(arms.task, course.share)
        buffer.extend(steps.reshape(-1))
        if k * n < starts:
            continue
        optimizer.param_groups[0]["lr"] = course.lr()
        losses = loss(buffer.sample())
        sum(value for name, value in losses.items() if name.startswith("loss_")).backward()
        optimizer.step()
        optimizer.zero_grad()
        targets.step()
        updates += 1
        if not course.goes_on(lambda: copy.deepcopy(policy).eval(), k * n, updates):
            break
    collector.shutdown()
    return course


def train_sb3(seed: int, seconds: float) -> Course:
    """Train with sb3-contrib's TQC on the vector environment of examples/sb3_sac.py."""
    import gymnasium as gym
    from sb3_contrib import TQC

    sys.path.insert(0, str(ROOT / "examples"))
    from sb3_sac import Arms, Policy

    n, name = ALGO["n_envs"], "r2s.envs:r2s/PandaReach-v0"
    arms = gym.make_vec(name, num_envs=n, autoreset_mode="SameStep", overrides=OVERRIDES).unwrapped
    course = Course(arms.env, seconds)
    settings = {key: ALGO[key] for key in ("gamma", "tau", "batch_size", "learning_starts", "target_entropy")}
    quantiles = {"n_quantiles": ALGO["n_quantiles"], "n_critics": ALGO["n_critics"]}
    model = TQC(
        "MlpPolicy",
        Arms(arms),
        **settings,
        seed=seed,
        learning_rate=lambda _: course.lr(),
        buffer_size=ALGO["replay_size"],
        ent_coef=f"auto_{ALGO['alpha_init']}",
        top_quantiles_to_drop_per_net=ALGO["drop_per_critic"],
        policy_kwargs=quantiles | {"net_arch": list(ALGO["hidden"])},
    )

    def policy() -> Any:
        frozen = copy.deepcopy(model.policy).eval()
        return Policy(frozen, arms)  # a policy of sb3 predicts as its algorithm does

    def after_step(now: dict, _: dict) -> bool:
        arms.set_progress(course.share)
        return course.goes_on(policy, now["self"].num_timesteps, now["self"]._n_updates)

    model.learn(10**9, callback=after_step)
    return course


def main() -> None:
    """Train once and write its folder."""
    library, seed, minutes, folder = sys.argv[1], int(sys.argv[2]), float(sys.argv[3]), Path(sys.argv[4])
    torch.set_num_threads(1)
    torch.set_float32_matmul_precision(fastest_matmul(torch.device("cpu")))  # as conf/config.yaml
    torch.manual_seed(seed)
    {"torchrl": train_torchrl, "sb3": train_sb3}[library](seed, 60.0 * minutes).write(folder)


if __name__ == "__main__":
    main()
