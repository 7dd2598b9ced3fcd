"""Time updates of sb3-contrib's TQC in its own environment; bench.py starts this script.

Reads "THREADS UPDATES PRECISION" from standard input, does that many updates with this precision of matrix products
and answers with their duration in s. Networks, batch, quantiles and optimiser equal those of bench.py's `learner`,
except LayerNorm, absent in sb3's networks: it would only make sb3 slower.
"""

import sys
import time

import gymnasium as gym
import numpy as np
import torch
from sb3_contrib import TQC


class NoPhysics(gym.Env):
    """The spaces of the task without physics: only the learner is timed."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (47,), np.float32)
    action_space = gym.spaces.Box(-1.0, 1.0, (7,), np.float32)

    def reset(self, seed=None, options=None):
        """Return a random observation."""
        return np.random.randn(47).astype(np.float32), {}

    def step(self, action):
        """Return a random transition."""
        return np.random.randn(47).astype(np.float32), float(np.random.randn()), False, False, {}


def main() -> None:
    """Answer requests until the input ends."""
    torch.set_num_threads(1)
    policy = {"net_arch": [256, 256], "n_critics": 2, "n_quantiles": 25}
    settings = {"batch_size": 256, "gamma": 0.98, "tau": 0.005, "learning_rate": 5e-4, "learning_starts": 0}
    algo = TQC("MlpPolicy", NoPhysics(), **settings, policy_kwargs=policy, top_quantiles_to_drop_per_net=2)
    algo.learn(2000)  # fills the buffer
    print("ready", flush=True)
    for line in sys.stdin:
        threads, updates, matmul = line.split()
        torch.set_num_threads(int(threads))
        torch.set_float32_matmul_precision(matmul)
        began = time.perf_counter()
        algo.train(gradient_steps=int(updates), batch_size=256)
        print(time.perf_counter() - began, flush=True)


if __name__ == "__main__":
    main()
