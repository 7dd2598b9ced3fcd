"""Train stable-baselines3's SAC on a batch of simulated arms.

`python examples/sb3_sac.py 200000 calibration=runs/identify/arm dr=identified`: environment steps, then options of
the command line. Settings are those of conf/algo/sac.yaml. `Arms` serves any algorithm of sb3, and `WeightedReplay`
any that learns off-policy: stored rewards follow the curriculum's weights.
"""

import sys

import gymnasium as gym
import numpy as np
import torch
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.vec_env import VecEnv, VecMonitor
from stable_baselines3.sac.policies import Actor, SACPolicy

from r2s.learning.evaluate import make_evaluation

RANDOM = 3200  # env steps before the first update


class Arms(VecEnv):
    """A vector environment of Gymnasium with autoreset_mode="SameStep", as sb3 expects one."""

    def __init__(self, envs: gym.vector.VectorEnv):
        self.envs = envs
        super().__init__(envs.num_envs, envs.single_observation_space, envs.single_action_space)

    def reset(self):
        """Start new episodes of all arms."""
        observation, _ = self.envs.reset(seed=self._seeds)
        self._reset_seeds()
        return observation

    def step_async(self, actions):
        """Keep the actions."""
        self.actions = actions

    def step_wait(self):
        """Step all arms; sb3 expects the last observations of ended episodes in a dict per arm."""
        observation, reward, terminated, truncated, info = self.envs.step(self.actions)
        infos = [{"reward_terms": terms} for terms in info["reward_terms"]]
        for i in np.flatnonzero(terminated | truncated):
            infos[i] = {"terminal_observation": info["final_obs"][i], "TimeLimit.truncated": not terminated[i]}
            infos[i]["reward_terms"] = info["final_info"]["reward_terms"][i]
        return observation, reward.astype(np.float32), terminated | truncated, infos

    def close(self):
        """Close the environments."""
        self.envs.close()

    def get_attr(self, attr_name, indices=None):
        """Return an attribute for each arm; they share it."""
        return [getattr(self.envs.unwrapped, attr_name)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name, value, indices=None):
        """Set an attribute of all arms."""
        setattr(self.envs.unwrapped, attr_name, value)

    def env_method(self, method_name, *method_args, indices=None, **method_kwargs):
        """Call a method of all arms."""
        return [getattr(self.envs.unwrapped, method_name)(*method_args, **method_kwargs)]

    def env_is_wrapped(self, wrapper_class, indices=None):
        """Return False for each arm: `VecMonitor` watches them."""
        return [False] * len(list(self._get_indices(indices)))


class NormReLU(torch.nn.Module):
    """ReLU after a layer normalization without parameters: it keeps critics stable at this learning rate."""

    def forward(self, x):
        """Return the activations (B, n)."""
        return torch.relu(torch.nn.functional.layer_norm(x, x.shape[-1:]))


class QuietActor(Actor):
    """sb3's actor; its loss has half the mean squared action beside its own terms, conf/algo's `action_l2`."""

    def action_log_prob(self, obs):
        """Return actions (B, a), whose gradients include the penalty's, and their log-density (B,)."""
        action, log_prob = super().action_log_prob(obs)
        if action.requires_grad:
            action.register_hook(lambda gradient: gradient + action.detach() / action.numel())
        return action, log_prob


class QuietPolicy(SACPolicy):
    """sb3's networks with a `QuietActor`, which has no normalization."""

    def make_actor(self, features_extractor=None):
        """Return the actor."""
        settings = self._update_features_extractor(self.actor_kwargs, features_extractor)
        return QuietActor(**settings | {"activation_fn": torch.nn.ReLU}).to(self.device)


class WeightedReplay(ReplayBuffer):
    """sb3's buffer, whose rewards are the stored terms under the present weights of the reward."""

    def __init__(self, *given, arms, **named):
        super().__init__(*given, **named)
        self.arms, self.terms = arms, np.zeros((*self.rewards.shape, len(arms.env.weights)), np.float32)

    def add(self, obs, next_obs, action, reward, done, infos):
        """Add a step of all arms."""
        self.terms[self.pos] = [info["reward_terms"] for info in infos]
        super().add(obs, next_obs, action, reward, done, infos)

    def sample(self, batch_size, env=None):
        """Draw transitions."""
        self.rewards[:] = self.terms @ self.arms.env.weights.astype(np.float32)
        return super().sample(batch_size, env)


class Policy:
    """sb3's policy for observations in SI units, as the evaluation of r2s calls it."""

    def __init__(self, model, envs):
        self.model, self.envs = model, envs

    def action(self, observation):
        """Return the deterministic actions (B, a) for observations (B, d)."""
        action, _ = self.model.predict(self.envs.normalized(observation.numpy()), deterministic=True)
        return torch.from_numpy(action)


def train(env_steps: int, *overrides: str, seed: int = 0, episodes: int = 200) -> dict[str, float]:
    """Return the measures of the trained policy on goals that no training uses."""
    name, mode = "r2s.envs:r2s/PandaReach-v0", "SameStep"
    arms = gym.make_vec(name, num_envs=32, autoreset_mode=mode, overrides=overrides).unwrapped
    model = SAC(
        QuietPolicy,
        VecMonitor(Arms(arms)),
        replay_buffer_class=WeightedReplay,
        replay_buffer_kwargs={"arms": arms},
        learning_rate=lambda left: 2e-3 * min(1.0, 0.1 + 2.25 * left),
        **{"seed": seed, "gamma": 0.97, "tau": 0.02, "batch_size": 256},
        **{"learning_starts": RANDOM, "buffer_size": env_steps, "ent_coef": "auto_0.01", "target_entropy": -10.0},
        policy_kwargs={"net_arch": [128, 128], "activation_fn": NormReLU},
    )
    model.learn(env_steps, callback=lambda now, _: arms.set_progress(now["self"].num_timesteps / env_steps) or True)
    evaluate = make_evaluation(arms.env.robot, arms.env.task, arms.env.draw, episodes=episodes)
    return arms.env.task.measures(evaluate(Policy(model, arms)))


if __name__ == "__main__":
    measures = train(int(sys.argv[1]), *sys.argv[2:])
    print(*(f"{name} {value:.3g}" for name, value in measures.items()), sep="\n")
