"""Train SAC with TorchRL's own parts: collector, transforms, replay buffer, loss, target networks.

`python examples/torchrl_sac.py 200000 dr=paper`: environment steps, then options. Settings: conf/algo/sac.yaml.
"""

import sys

import torch
from tensordict.nn import TensorDictModule
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import ClipTransform, Compose, ObservationNorm, TransformedEnv
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import SACLoss, SoftUpdate

from r2s.envs import torchrl_env
from r2s.learning.evaluate import make_evaluation
from r2s.learning.policy import make_policy

ARMS, RANDOM, BATCH, HIDDEN = 32, 3200, 256, (128, 128)  # random: env steps before the first update


def train(env_steps: int, *overrides: str, seed: int = 0, episodes: int = 200) -> dict[str, float]:
    """Return the measures of the trained policy on goals that no training uses."""
    torch.manual_seed(seed)
    arms = torchrl_env(ARMS, task="reach", seed=seed, overrides=overrides)
    policy = make_policy(arms.robot, arms.task, HIDDEN)
    scale = ObservationNorm(policy.normalizer.mean, policy.normalizer.std, ["observation"], standard_normal=True)
    env = TransformedEnv(arms, Compose(scale, ClipTransform(["observation"], low=-10.0, high=10.0)))
    network = TensorDictModule(policy.actor, in_keys=["observation"], out_keys=["loc", "scale"])
    actor = ProbabilisticActor(network, ["loc", "scale"], distribution_class=TanhNormal)
    norm = {"norm_class": torch.nn.LayerNorm, "norm_kwargs": [{"normalized_shape": n} for n in HIDDEN]}
    critic = MLP(out_features=1, num_cells=HIDDEN, activation_class=torch.nn.ReLU, **norm)
    critic = ValueOperator(critic, in_keys=["observation", "action"])
    critic(actor(env.reset()))  # makes the lazy layers
    loss = SACLoss(actor, critic, loss_function="l2", alpha_init=0.01, target_entropy=-10.0)
    loss.make_value_estimator(gamma=0.97)
    targets, optimizer = SoftUpdate(loss, tau=0.02), torch.optim.Adam(loss.parameters(), lr=2e-3)
    rate = torch.optim.lr_scheduler.LambdaLR(optimizer, lambda k: min(1.0, 0.1 + 2.25 * (1 - k * ARMS / env_steps)))
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(env_steps), batch_size=BATCH)
    collector = Collector(env, actor, frames_per_batch=ARMS, total_frames=env_steps, init_random_frames=RANDOM)
    for k, steps in enumerate(collector):
        arms.set_progress(k * ARMS / env_steps)
        buffer.extend(steps.reshape(-1))
        if len(buffer) < RANDOM:
            continue
        batch = buffer.sample()  # rewards under the present weights of the curriculum
        batch["next", "reward"] = batch["next", "reward_terms"] @ torch.tensor(arms.weights[:, None]).float()
        losses = loss(batch)
        losses["loss_l2"] = 0.5 * torch.tanh(network(batch.select("observation"))["loc"]).square().mean()
        sum(value for name, value in losses.items() if name.startswith("loss_")).backward()
        for part in (optimizer, rate, targets):
            part.step()
        optimizer.zero_grad()
    collector.shutdown()
    return arms.task.measures(make_evaluation(arms.robot, arms.task, arms.draw, episodes=episodes)(policy))


if __name__ == "__main__":
    print(*(f"{k} {v:.3g}" for k, v in train(int(sys.argv[1]), *sys.argv[2:]).items()), sep="\n")
