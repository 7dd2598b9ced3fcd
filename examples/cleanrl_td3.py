"""Train TD3 as CleanRL writes it, in one file, on a batch of simulated arms.

`python examples/cleanrl_td3.py 200000 calibration=runs/identify/arm dr=identified`: environment steps, then options
of the command line. Every loop over a Gymnasium vector environment looks like this one. The buffer keeps the terms of
the reward, so that old transitions follow the weights of the curriculum.
"""

import copy
import sys

import gymnasium as gym
import numpy as np
import torch
from torch import nn
from torch.nn import functional as F

from r2s.learning.evaluate import make_evaluation

ARMS, LEARNING_STARTS, BATCH_SIZE = 32, 3200, 256
GAMMA, TAU, LR = 0.97, 0.02, 1e-3
EXPLORATION_NOISE, POLICY_NOISE, NOISE_CLIP, POLICY_FREQUENCY = 0.5, 0.2, 0.5, 2


def mlp(inputs: int, outputs: int) -> nn.Sequential:
    """Return a network with two hidden layers."""
    return nn.Sequential(
        *(nn.Linear(inputs, 128), nn.ReLU(), nn.Linear(128, 128), nn.ReLU(), nn.Linear(128, outputs))
    )


class Policy:
    """The actor for observations (B, d) in SI units, as the evaluation of r2s calls it."""

    def __init__(self, actor: nn.Module, envs: gym.vector.VectorEnv):
        self.actor, self.envs = actor, envs.unwrapped

    def action(self, observation: torch.Tensor) -> torch.Tensor:
        """Return the actions (B, a)."""
        return self.actor(torch.from_numpy(self.envs.normalized(observation.numpy())))


def train(env_steps: int, *overrides: str, seed: int = 0, episodes: int = 200) -> dict[str, float]:
    """Return the measures of the trained policy on goals that no training uses."""
    torch.manual_seed(seed)
    name, mode = "r2s.envs:r2s/PandaReach-v0", "SameStep"
    envs = gym.make_vec(name, num_envs=ARMS, autoreset_mode=mode, overrides=overrides)
    d, a = envs.single_observation_space.shape[0], envs.single_action_space.shape[0]
    actor, qf1, qf2 = nn.Sequential(mlp(d, a), nn.Tanh()), mlp(d + a, 1), mlp(d + a, 1)
    target_actor, qf1_target, qf2_target = (copy.deepcopy(n) for n in (actor, qf1, qf2))
    q_optimizer = torch.optim.Adam([*qf1.parameters(), *qf2.parameters()], lr=LR)
    actor_optimizer = torch.optim.Adam(actor.parameters(), lr=LR)
    sizes = {"obs": d, "next_obs": d, "action": a, "terms": len(envs.unwrapped.env.weights), "terminated": 1}
    replay = {key: torch.zeros(env_steps, size) for key, size in sizes.items()}

    obs, _ = envs.reset(seed=seed)
    envs.action_space.seed(seed)
    for global_step in range(0, env_steps - ARMS + 1, ARMS):
        envs.unwrapped.set_progress(global_step / env_steps)
        if global_step < LEARNING_STARTS:
            actions = envs.action_space.sample()
        else:
            with torch.no_grad():
                mean = actor(torch.from_numpy(obs))
                actions = (mean + EXPLORATION_NOISE * torch.randn_like(mean)).clamp(-1.0, 1.0).numpy()
        next_obs, _, terminations, truncations, infos = envs.step(actions)
        real_next_obs, terms = next_obs.copy(), infos["reward_terms"]
        for i in np.flatnonzero(truncations | terminations):  # next_obs begins the next episode there
            real_next_obs[i], terms[i] = infos["final_obs"][i], infos["final_info"]["reward_terms"][i]
        for key, value in zip(replay, (obs, real_next_obs, actions, terms, terminations[:, None]), strict=True):
            replay[key][global_step : global_step + ARMS] = torch.from_numpy(np.asarray(value, dtype=np.float32))
        obs = next_obs
        if global_step < LEARNING_STARTS:
            continue

        rows = torch.randint(global_step + ARMS, (BATCH_SIZE,))
        x, next_x, action = (replay[key][rows] for key in ("obs", "next_obs", "action"))
        weights = torch.from_numpy(envs.unwrapped.env.weights[:, None].astype(np.float32))
        reward, terminated = replay["terms"][rows] @ weights, replay["terminated"][rows]
        with torch.no_grad():
            noise = (POLICY_NOISE * torch.randn_like(action)).clamp(-NOISE_CLIP, NOISE_CLIP)
            after = torch.cat([next_x, (target_actor(next_x) + noise).clamp(-1.0, 1.0)], 1)
            target = reward + GAMMA * (1.0 - terminated) * torch.min(qf1_target(after), qf2_target(after))
        both = torch.cat([x, action], 1)
        q_optimizer.zero_grad()
        (F.mse_loss(qf1(both), target) + F.mse_loss(qf2(both), target)).backward()
        q_optimizer.step()
        if global_step // ARMS % POLICY_FREQUENCY == 0:
            actor_optimizer.zero_grad()
            own = actor(x)
            (0.5 * own.pow(2).mean() - qf1(torch.cat([x, own], 1)).mean()).backward()
            actor_optimizer.step()
            for net, slow in ((actor, target_actor), (qf1, qf1_target), (qf2, qf2_target)):
                for p, p_target in zip(net.parameters(), slow.parameters(), strict=True):
                    p_target.data.lerp_(p.data, TAU)
    env = envs.unwrapped.env
    return env.task.measures(make_evaluation(env.robot, env.task, env.draw, episodes=episodes)(Policy(actor, envs)))


if __name__ == "__main__":
    measures = train(int(sys.argv[1]), *sys.argv[2:])
    print(*(f"{name} {value:.3g}" for name, value in measures.items()), sep="\n")
