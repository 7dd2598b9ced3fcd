"""Minutes to 95 % of goals within 2 cm: sb3-contrib's TQC on a Gymnasium wrapper of the same environment, one thread.

`python benchmarks/sb3_reach.py [SEED ...]` prints minutes, success and env steps as it goes, at last the minutes that
it took; evaluations are not counted. sb3's settings are rl-zoo's for TQC (its defaults); the observation is
normalised and the reward is shaped as for ours. It runs in the environment that `make bench` makes for sb3-contrib,
with this project's packages behind its own. Ours: docs/algorithms.md, from benchmarks/algorithms.py.
"""

import os
import subprocess
import sys
import time

LEVEL, MINUTES, EVERY = 0.95, 90.0, 10_000  # of success within 2 cm; at most; env steps between evaluations


def here(seeds: list[str]) -> None:
    """Start the same file in sb3-contrib's environment."""
    from bench import Sb3

    python = Sb3.python()
    packages = [p for p in sys.path if p.endswith("site-packages")]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(packages), "OMP_NUM_THREADS": "1"}
    for seed in seeds:
        subprocess.run([str(python), __file__, "there", seed], env=environment, check=True)


def there(seed: int) -> None:
    """Train and evaluate until the level is reached."""
    import gymnasium as gym
    import numpy as np
    import torch
    from common import NEW, ROBOT, conf
    from sb3_contrib import TQC
    from stable_baselines3.common.callbacks import BaseCallback

    from r2s import randomization
    from r2s.env import ReachEnv, Task, observation_scale
    from r2s.evaluate import make_evaluation, measures
    from r2s.rewards import curriculum

    torch.set_num_threads(1)
    task = Task(**{k: tuple(v) if isinstance(v, list) else v for k, v in conf("task/reach").items()})
    spread = {k: v for k, v in conf("dr/paper").items() if k != "name"}
    mean, std = (x.astype(np.float32) for x in observation_scale(ROBOT, task))

    def draw(rng, m):
        return randomization.draw(rng, NEW, m, **spread)

    class Reach(gym.Env):
        observation_space = gym.spaces.Box(-10.0, 10.0, mean.shape, np.float32)
        action_space = gym.spaces.Box(-1.0, 1.0, (ROBOT.n,), np.float32)

        def __init__(self):
            self.arm = ReachEnv(ROBOT, task, draw, 1, nthread=1, seed=seed)
            self.arm.weights = curriculum(0.0, **conf("reward/curriculum"))

        def reset(self, *, seed=None, options=None):
            self.state = self.arm.reset()
            return self.seen(), {}

        def step(self, action):
            self.state["action"] = torch.from_numpy(action)[None]
            self.state = self.arm.step(self.state)["next"]
            return self.seen(), float(self.state["reward"]), False, bool(self.state["truncated"]), {}

        def seen(self):
            return ((self.state["observation"][0].numpy() - mean) / std).clip(-10.0, 10.0)

    class Policy:
        def __init__(self, model):
            self.model = model

        def action(self, observation):
            x = ((observation - torch.from_numpy(mean)) / torch.from_numpy(std)).clamp(-10.0, 10.0)
            return self.model.actor(x, deterministic=True)

    evaluate = make_evaluation(ROBOT, task, draw, nthread=1)
    began, spent = time.perf_counter(), 0.0

    class Watch(BaseCallback):
        def _on_step(self) -> bool:
            nonlocal spent
            if self.num_timesteps % EVERY:
                return True
            now = time.perf_counter()
            minutes = (now - began - spent) / 60
            row = measures(evaluate(Policy(self.model)))
            spent += time.perf_counter() - now
            text = f"{100 * row['success_2cm']:.1f} % < 2 cm, {100 * row['success_1cm']:.1f} % < 1 cm"
            print(f"seed {seed}: {minutes:.1f} min, {self.num_timesteps} env steps, {text}", flush=True)
            if row["success_2cm"] >= LEVEL:
                print(f"seed {seed}: {100 * LEVEL:g} % within 2 cm after {minutes:.1f} min", flush=True)
                return False
            return minutes < MINUTES

    TQC("MlpPolicy", Reach(), seed=seed).learn(10**8, callback=Watch())


if __name__ == "__main__":
    if sys.argv[1:2] == ["there"]:
        there(int(sys.argv[2]))
    else:
        here(sys.argv[1:] or ["20"])
