"""Compare the time to 95 % of goals within 2 cm with sb3-contrib's TQC on a wrapper of the same environment.

`python benchmarks/sb3_reach.py [SEED ...]`, one thread each, one after the other. Writes benchmarks/results/sb3.md.
sb3 has rl-zoo's settings for TQC (its defaults), and the same normalised observation and shaped reward as r2s. The
time of its evaluations does not count, that of r2s does. It runs in the environment that `make bench` creates for
sb3-contrib, with the packages of this project behind its own.
"""

import os
import subprocess
import sys
import time

LEVEL, MINUTES, EVERY = 0.95, 25.0, 10_000  # success within 2 cm; time limit; env steps between evaluations
OURS = 2.5  # minutes, the budget of benchmarks/results/algorithms.md


def compare(seeds: list[str]) -> None:
    """Train r2s, start this file in sb3-contrib's environment, write the page."""
    import numpy as np
    import pandas as pd
    from bench import Sb3
    from common import ROOT, markdown_rows, write_page

    python = Sb3.python()
    packages = [p for p in sys.path if p.endswith("site-packages")]
    thread = os.environ | {"OMP_NUM_THREADS": "1"}
    rows = {}
    for seed in seeds:
        ours, theirs = ROOT / f"runs/train/reach_{seed}/evaluations.csv", ROOT / f"runs/bench/sb3_reach_{seed}.csv"
        words = [f"name=reach_{seed}", f"seed={seed}", f"budget.minutes={OURS}", "threads=1", "skip_completed=true"]
        subprocess.run([sys.executable, "run.py", "algo=tqc", *words], cwd=ROOT, env=thread, check=True)
        if not theirs.is_file():
            behind = thread | {"PYTHONPATH": os.pathsep.join(packages)}
            subprocess.run([str(python), __file__, "sb3", seed, str(theirs)], env=behind, check=True)
        curves = [pd.read_csv(path) for path in (ours, theirs)]
        times = [next(iter(c["wall_clock_s"][c["success_2cm"] >= LEVEL] / 60), np.inf) for c in curves]
        end = curves[1].iloc[-1]
        last = f"{100 * end['success_2cm']:.1f} % after {end['wall_clock_s'] / 60:.1f} min"
        least = times[1] if np.isfinite(times[1]) else end["wall_clock_s"] / 60
        rows[seed] = {
            "r2s, min": f"{times[0]:.1f}",
            "sb3-contrib, min": f"{times[1]:.1f}" if np.isfinite(times[1]) else f"never: {last}",
            "ratio": f"{'' if np.isfinite(times[1]) else 'over '}{least / times[0]:.1f}",
            "sb3-contrib, env steps": f"{end['env_steps']:,.0f}",
        }
    parts = [
        f"Wall-clock minutes until an evaluation has {100 * LEVEL:g} % of 200 goals within 2 cm for the last 0.5 s; "
        "dr=paper, one thread each. sb3-contrib: rl-zoo's TQC settings on the same environment, an evaluation every "
        f"{EVERY:,} env steps (not counted), at most {MINUTES:g} minutes. r2s: {OURS:g} minutes, all counted.",
        markdown_rows(rows, "seed"),
    ]
    write_page("sb3", "Minutes to a policy, beside sb3-contrib's TQC", "python benchmarks/sb3_reach.py", parts)


def train_sb3(seed: int, path: str) -> None:
    """Train and evaluate sb3's TQC until the level is reached; write the evaluations to `path`."""
    import gymnasium as gym
    import numpy as np
    import pandas as pd
    import torch
    from common import NEW, ROBOT, conf, default_task
    from sb3_contrib import TQC
    from stable_baselines3.common.callbacks import BaseCallback

    from r2s.learning.env import TaskEnv
    from r2s.learning.evaluate import make_evaluation
    from r2s.learning.randomization import UniformRandomization
    from r2s.tasks.rewards import Curriculum
    from r2s.tasks.rollout import measures

    torch.set_num_threads(1)
    task = default_task("reach")
    draw = UniformRandomization(ROBOT, NEW, **conf("dr/paper"))
    mean, std = (x.astype(np.float32) for x in task.observation_scale(ROBOT))

    class Reach(gym.Env):
        observation_space = gym.spaces.Box(-10.0, 10.0, mean.shape, np.float32)
        action_space = gym.spaces.Box(-1.0, 1.0, (ROBOT.n,), np.float32)

        def __init__(self):
            self.arm = TaskEnv(ROBOT, task, draw, 1, nthread=1, seed=seed)
            self.arm.weights = Curriculum(**conf("reward/curriculum"))(0.0)

        def reset(self, *, seed=None, options=None):
            self.state = self.arm.reset()
            return self.observation(), {}

        def step(self, action):
            self.state["action"] = torch.from_numpy(action)[None]
            self.state = self.arm.step(self.state)["next"]
            return self.observation(), float(self.state["reward"]), False, bool(self.state["truncated"]), {}

        def observation(self):
            return ((self.state["observation"][0].numpy() - mean) / std).clip(-10.0, 10.0)

    class Policy:
        def __init__(self, model):
            self.model = model

        def action(self, observation):
            x = ((observation - torch.from_numpy(mean)) / torch.from_numpy(std)).clamp(-10.0, 10.0)
            return self.model.actor(x, deterministic=True)

    evaluate = make_evaluation(ROBOT, task, draw, nthread=1)
    began, spent, rows = time.perf_counter(), 0.0, []

    class Evaluation(BaseCallback):
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
            rows.append({"env_steps": self.num_timesteps, "wall_clock_s": 60 * minutes} | row)
            return row["success_2cm"] < LEVEL and minutes < MINUTES

    TQC("MlpPolicy", Reach(), seed=seed).learn(10**8, callback=Evaluation())
    pd.DataFrame(rows).to_csv(path, index=False)


if __name__ == "__main__":
    if sys.argv[1:2] == ["sb3"]:
        train_sb3(int(sys.argv[2]), sys.argv[3])
    else:
        compare(sys.argv[1:] or ["20"])
