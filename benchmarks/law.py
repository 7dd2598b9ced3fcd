"""What the driver's law does to a trained policy, seen every millisecond: python benchmarks/law.py RUN [OF_TWIN ...]

RUN is a run folder of stage=train. Its policy reaches for the first goals that nothing was chosen on, on arms of
known truth with delays of 0 to 8 ms; each OF_TWIN, a training on the identification of a twin, does so on that twin.
What is asked for and what is sent are written down in every cycle. docs/law.md is made of it.

The action of the law is what is sent less what is asked for. Its spectrum is judged by its largest line above 20 Hz,
against the largest below: a loop that shakes has its line there.

`python benchmarks/law.py cost [RUN]` says what the law, and the motors' delay behind it, cost a training's
environment: CPU time of one thread, with and without, in turns, under random actions and those of RUN's policy.
"""

import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from common import MACHINE, NEW, ROBOT, ROOT, conf, markdown
from omegaconf import OmegaConf

from r2s.arm.deploy import DrivenArm
from r2s.arm.simulated import SimulatedArm
from r2s.arm.twins import twin
from r2s.learning.env import TaskEnv
from r2s.learning.evaluate import fixed_episodes
from r2s.learning.networks import Policy
from r2s.learning.policy import load_policy
from r2s.physics.limits import limits
from r2s.stages.build import make_dynamics, make_robot, make_task
from r2s.stages.transfer import trained_config
from r2s.tasks.episode import rollout
from r2s.tasks.reach import ReachTask

DELAYS_MS = (0, 2, 4, 6, 8)
GOALS = 50
ARMS, STEPS, TURNS = 32, 25, 41
ACTIONS = {"gentle": 0.1, "wild": 0.5}  # standard deviation of random actions: the wild are those of a new policy


class Watched:
    """A driver that writes down what is asked for and what is sent, (cycles, n) Nm each."""

    def __init__(self, driver):
        self._driver = driver
        self.asked, self.sent = [], []

    def __getattr__(self, name):
        return getattr(self._driver, name)

    def __call__(self, state, target, added=None):
        """Return the command of a cycle."""
        command = self._driver(state, target, added)
        self.asked.append(self._driver.effort.copy())
        self.sent.append(command.copy())
        return command


def judged(arm, dynamics, policy, task, starts, goals) -> dict[str, float]:
    """Return one row: how the policy does on the arm, and what the law does to it."""
    driven = DrivenArm(arm, task, dynamics.level, rotors=dynamics.armature)
    watched = driven._driven.driver = Watched(driven._driven.driver)
    row = task.measures(rollout(policy, driven, task, starts, goals))
    asked, sent = np.array(watched.asked), np.array(watched.sent)
    cycles = task.steps * task.substeps
    whole = len(sent) // cycles * cycles  # an episode that stopped is shorter
    action = (sent - asked)[:whole].reshape(-1, cycles, sent.shape[1])
    lines = np.abs(np.fft.rfft(action * np.hanning(cycles)[None, :, None], axis=1)).max((0, 2)) * 4 / cycles
    hz = np.fft.rfftfreq(cycles, 1e-3)
    return {
        "< 1 cm, %": 100 * row["success_1cm"],
        "at rest, %": 100 * row["rest"],
        "stops": len(driven.stops),
        "limited, % of cycles": 100 * row["limited"],
        "line below 20 Hz, Nm": lines[(hz > 0) & (hz <= 20)].max(),
        "line above, Nm": lines[hz > 20].max(),
        "rms of steps sent / asked for": np.sqrt(
            (np.diff(sent, axis=0) ** 2).mean() / (np.diff(asked, axis=0) ** 2).mean()
        ),
    }


def cost(act: Callable[[torch.Tensor], torch.Tensor]) -> dict[str, float]:
    """Return one row: what the law costs an environment in which observations (ARMS, d) are answered by `act`."""
    task = ReachTask(**{k: tuple(v) if isinstance(v, list) else v for k, v in conf("task/reach").items()})
    envs = [TaskEnv(ROBOT, task, lambda rng, m: NEW, ARMS, nthread=1) for _ in range(2)]
    envs[1].arms.sim.drive(np.zeros_like(limits(ROBOT, task.torque(ROBOT))))  # a TAU_MAX of 0: there is none
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
        "limited, % of cycles": 100 * limited,
        "with the law, arm steps/s": rate[0],
        "without": rate[1],
        "cost, %": 100 * (1 - np.median(took[1:, 1] / took[1:, 0])),
    }


def costs(policy: Policy | None = None) -> pd.DataFrame:
    """Return what the law costs under gentle and wild actions, and under those of a trained policy."""
    rows = {k: cost(lambda o, s=size: (s * torch.randn(len(o), ROBOT.n)).clamp(-1, 1)) for k, size in ACTIONS.items()}
    if policy is not None:
        with torch.no_grad():
            rows["of a trained policy"] = cost(policy.action)
    return pd.DataFrame.from_dict(rows, orient="index").rename_axis("actions")


def loaded(folder: str):
    """Return what a training trained with: robot, dynamics, task and policy."""
    source, trained = trained_config(OmegaConf.create({"policy": folder}))
    robot = make_robot(trained)
    dynamics = make_dynamics(trained, robot)
    task = make_task(trained, robot, dynamics)
    return robot, dynamics, task, load_policy(source, robot, task)


def which_twin(folder: str):
    """Return conf/arm of the twin that the calibration of a training was identified on, or end with one line."""
    found = Path(OmegaConf.load(Path(folder) / "config.yaml").calibration or "") / "config.yaml"
    if not found.is_file():
        raise SystemExit(f"error: {folder} was not trained on an identification that is there from here: no {found}")
    return OmegaConf.load(found).arm


def main(folder: str, of_twins: list[str]) -> None:
    """Write docs/law.md."""
    twins = {own: which_twin(own) for own in of_twins}
    robot, dynamics, task, policy = loaded(folder)
    typed = [w for w in OmegaConf.load(Path(folder) / "overrides.yaml") if not w.startswith(("name=", "threads="))]
    starts, goals = fixed_episodes(robot, task, GOALS)
    rows = {}
    for ms in DELAYS_MS:
        arm = SimulatedArm(
            robot, replace(dynamics, delay=1e-3 * ms, lag=np.float64(2e-3)), position_noise=1e-5, velocity_noise=3e-3
        )
        rows[f"simulated, {ms} ms + 2 ms of lag"] = judged(arm, dynamics, policy, task, starts, goals)
    for own, known in twins.items():
        robot, dynamics, task, its = loaded(own)
        starts, goals = fixed_episodes(robot, task, GOALS)
        arm = twin(robot, make=known.make, seed=known.seed)
        rows[f"twin {known.seed} of make {known.make}"] = judged(arm, dynamics, its, task, starts, goals)
    table = pd.DataFrame.from_dict(rows, orient="index").rename_axis("arm")
    text = f"""# The driver's law at 1 kHz

`python benchmarks/law.py RUN OF_TWIN ...` on {MACHINE}, {GOALS} goals on each arm, sensors with noise.
RUN is a training with `{" ".join(typed)}`; on a twin a policy acts that was trained on its identification.
The law's action is what is sent less what is asked for; a line is its spectrum's largest over joints and episodes.

{markdown(table.round(3))}

What the law, and the motors' delay behind it, cost a training's environment of {ARMS} arms, in CPU time of one
thread, in turns (asked: 10 %):

{markdown(costs(policy).round(1))}

Gentle and wild are random actions of a standard deviation of 0.1 and 0.5. A trained policy is limited in 1 to 5 % of
the cycles, a new one in many: where the law acts, it solves for the nearest torque. Until its loops were compiled for
seven joints it cost 12.3, 19.6 and 12.5 % on an AMD EPYC, 9.9, 18.2 and 8.9 % on an Intel Xeon.
"""
    (ROOT / "docs" / "law.md").write_text(text)
    print(table.round(3).to_string())


if __name__ == "__main__":
    words = sys.argv[1:]
    if words == ["cost"]:
        print(costs().round(1).to_string())
        raise SystemExit
    folders = words[words[:1] == ["cost"] :]
    if not folders or not all(Path(x).is_dir() for x in folders):
        raise SystemExit(__doc__)
    if folders == words:
        main(words[0], words[1:])
    else:
        print(costs(loaded(folders[0])[-1]).round(1).to_string())
