"""Measure the effect of the safety filter on a trained policy: python benchmarks/law.py RUN [OF_TWIN ...]

RUN is a run folder of stage=train. Its policy reaches for the first goals that selected nothing, on arms of known
truth with delays of 0 to 8 ms. Each OF_TWIN, a training on the identification of a twin, acts on that twin. Writes
benchmarks/results/law.md.

The filter's action is the sent minus the requested torque. The table compares the largest line of its spectrum above
20 Hz with the largest below: an oscillating loop has its line above.

`python benchmarks/law.py cost [RUN]` prints the cost of the filter and of the motor delay behind it in a training
environment: CPU time of one thread, with and without, alternating, for random actions and those of RUN's policy.
"""

import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from common import NEW, ROBOT, default_task, load_training, markdown, write_page
from omegaconf import OmegaConf

from r2s.arm.policy_runner import PolicyRunner
from r2s.arm.simulated import SimulatedArm
from r2s.arm.twins.make_twin import make_twin
from r2s.learning.env import TaskEnv
from r2s.learning.evaluate import fixed_episodes
from r2s.learning.networks import Policy
from r2s.physics.safety_filter import filter_limits
from r2s.tasks.rollout import rollout

DELAYS_MS = (0, 2, 4, 6, 8)
GOALS = 50
ARMS, STEPS, TURNS = 32, 25, 41
ACTIONS = {"gentle": 0.1, "wild": 0.5}  # standard deviation of random actions; a new policy acts wildly


class LoggingDriver:
    """A driver that logs requested and sent torque, (cycles, n) Nm each."""

    def __init__(self, driver):
        self._driver = driver
        self.requested, self.sent = [], []

    def __getattr__(self, name):
        return getattr(self._driver, name)

    def __call__(self, *cycle):
        """Return the command of a cycle."""
        command = self._driver(*cycle)
        self.requested.append(self._driver.effort.copy())
        self.sent.append(command.copy())
        return command


def evaluate(arm, dynamics, policy, task, starts, goals) -> dict[str, float]:
    """Return the scores of a policy on an arm and the effect of the filter."""
    runner = PolicyRunner(arm, task, dynamics.level, rotors=dynamics.armature)
    driver = runner._loop.driver = LoggingDriver(runner._loop.driver)
    row = task.measures(rollout(policy, runner, task, starts, goals))
    requested, sent = np.array(driver.requested), np.array(driver.sent)
    cycles = task.steps * task.substeps
    full = len(sent) // cycles * cycles  # a stopped episode is shorter
    action = (sent - requested)[:full].reshape(-1, cycles, sent.shape[1])
    lines = np.abs(np.fft.rfft(action * np.hanning(cycles)[None, :, None], axis=1)).max((0, 2)) * 4 / cycles
    hz = np.fft.rfftfreq(cycles, 1e-3)
    return {
        "< 1 cm, %": 100 * row["success_1cm"],
        "at rest, %": 100 * row["rest"],
        "stops": len(runner.stops),
        "cycles limited, %": 100 * row["limited"],
        "line below 20 Hz, Nm": lines[(hz > 0) & (hz <= 20)].max(),
        "line above, Nm": lines[hz > 20].max(),
        "rms of steps, sent / requested": np.sqrt(
            (np.diff(sent, axis=0) ** 2).mean() / (np.diff(requested, axis=0) ** 2).mean()
        ),
    }


def cost(act: Callable[[torch.Tensor], torch.Tensor]) -> dict[str, float]:
    """Return the cost of the filter in an environment with actions `act` of the observations (ARMS, d)."""
    task = default_task("reach")
    envs = [TaskEnv(ROBOT, task, lambda rng, m: NEW, ARMS, nthread=1) for _ in range(2)]
    no_filter = np.zeros_like(filter_limits(ROBOT, task.torque_limit(ROBOT)))  # TAU_MAX = 0 switches the filter off
    envs[1].arms.sim.drive(no_filter)
    torch.manual_seed(0)
    states, took, limited = [env.reset() for env in envs], np.zeros((TURNS, 2)), 0.0
    for turn in range(TURNS):
        for which, env in enumerate(envs):
            torch.manual_seed(turn)
            for _ in range(STEPS):
                action = act(states[which]["observation"])
                began = time.process_time()
                _, states[which] = env.step_and_maybe_reset(states[which].set("action", action))
                took[turn, which] += time.process_time() - began
        limited += envs[0].arms.read().limited.mean() / TURNS
    rate = ARMS * STEPS / np.median(took[1:], axis=0)
    return {
        "cycles limited, %": 100 * limited,
        "with the filter, arm steps/s": rate[0],
        "without": rate[1],
        "cost, %": 100 * (1 - np.median(took[1:, 1] / took[1:, 0])),
    }


def costs(policy: Policy | None = None) -> pd.DataFrame:
    """Return the cost for gentle and wild actions, and for those of a trained policy."""
    rows = {k: cost(lambda o, s=size: (s * torch.randn(len(o), ROBOT.n)).clamp(-1, 1)) for k, size in ACTIONS.items()}
    if policy is not None:
        with torch.no_grad():
            rows["of a trained policy"] = cost(policy.action)
    return pd.DataFrame.from_dict(rows, orient="index").rename_axis("actions")


def twin_of(folder: str):
    """Return conf/arm of the twin whose identification a training used; end with one line if it is missing."""
    found = Path(OmegaConf.load(Path(folder) / "config.yaml").calibration or "") / "config.yaml"
    if not found.is_file():
        raise SystemExit(f"error: expected a training on an identification, found no {found} ({folder})")
    return OmegaConf.load(found).arm


def main(folder: str, of_twins: list[str]) -> None:
    """Write benchmarks/results/law.md."""
    twins = {own: twin_of(own) for own in of_twins}
    robot, dynamics, task, policy = load_training(folder)
    typed = [w for w in OmegaConf.load(Path(folder) / "overrides.yaml") if not w.startswith(("name=", "threads="))]
    rows = {}
    for ms in DELAYS_MS:
        true = replace(dynamics, delay=1e-3 * ms, lag=np.float64(2e-3))
        arm = SimulatedArm(robot, true, position_noise=1e-5, velocity_noise=3e-3)
        label = f"simulated, {ms} ms + 2 ms of lag"
        rows[label] = evaluate(arm, dynamics, policy, task, *fixed_episodes(robot, task, GOALS))
    for own, cfg in twins.items():
        robot, dynamics, task, its_policy = load_training(own)
        arm = make_twin(robot, variant=cfg.variant, seed=cfg.seed)
        label = f"{cfg.variant} twin {cfg.seed}"
        rows[label] = evaluate(arm, dynamics, its_policy, task, *fixed_episodes(robot, task, GOALS))
    table = pd.DataFrame.from_dict(rows, orient="index").rename_axis("arm")
    parts = [
        f"RUN is a training with `{' '.join(typed)}`; on a twin, a policy of its own identification. {GOALS} goals "
        "per arm, sensors with noise. The filter's action is the sent minus the requested torque; a line is the "
        "largest value of its spectrum over joints and episodes.",
        markdown(table.round(3)),
        f"Cost of the filter and of the motor delay behind it in a training environment of {ARMS} arms: CPU time of "
        "one thread, in turns (target: 10 %). Gentle and wild: random actions with a standard deviation of 0.1 and "
        "0.5.",
        markdown(costs(policy).round(1)),
    ]
    write_page("law", "The safety filter at 1 kHz", "python benchmarks/law.py RUN OF_TWIN ...", parts)
    print(table.round(3).to_string())


if __name__ == "__main__":
    words = sys.argv[1:]
    folders = words[words[:1] == ["cost"] :]
    if not words or not all(Path(x).is_dir() for x in folders):
        raise SystemExit(__doc__)
    if words[0] == "cost":
        print(costs(load_training(folders[0])[-1] if folders else None).round(1).to_string())
    else:
        main(words[0], words[1:])
