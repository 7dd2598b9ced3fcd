"""A task as Gymnasium environments: `ArmVectorEnv` for a batch of simulated arms, `ArmEnv` for a single arm.

Each arm of a batch has its own random generator, so arm i runs the same episodes as an `ArmEnv` with arm i's seed.
Observations are normalized with the task's fixed mean and standard deviation, as in r2s's policies.
"""

from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium.utils.seeding import np_random
from gymnasium.vector import AutoresetMode
from tensordict import TensorDict

from r2s.errors import UserError, choices
from r2s.learning.env import TaskEnv
from r2s.learning.networks import CLIP
from r2s.learning.randomization import Draw, Pushes
from r2s.learning.vector_arms import ALL, VectorArms
from r2s.physics.robot import Robot
from r2s.tasks.rewards import Reward
from r2s.tasks.task import State, Task, observation_scale

SEEDS = 2**63  # all episode seeds are below this number


class SeparateArms(VectorArms):
    """`VectorArms` with a random generator for each arm (`streams`), for sensor noise and the torques of `Pushes`."""

    def seed(self, seed: int | np.random.SeedSequence) -> None:
        """Restart the random generators of all arms from `seed`."""
        super().seed(seed)
        self.streams = self._rng.spawn(self.width)

    def _sense(self, at: np.ndarray | slice = ALL) -> None:
        noisy, seen = self._sigma.any(), self._pose is not None
        for i in np.arange(self.width)[at] if noisy or seen else ():
            if noisy:
                self._noise[i] = self._sigma[i] * self.streams[i].standard_normal(self.robot.n)
            if seen:
                self._pose_noise[i] = self._pose_sigma * self.streams[i].standard_normal(3)


class SeparateEnv(TaskEnv):
    """`TaskEnv` that draws the seeds of arm i's episodes from `rngs[i]`."""

    arms_type = SeparateArms
    arms: SeparateArms
    rngs: list[np.random.Generator]

    def _restart(self, ids: np.ndarray) -> State:
        for i in ids:
            self.rng = self.arms.streams[i] = np.random.default_rng(self.rngs[i].integers(SEEDS))
            super()._restart(np.array([i]))
        return self.arms.read()

    def _forces(self, draw: Pushes) -> np.ndarray:
        return np.concatenate([draw.forces(stream, 1) for stream in self.arms.streams])


class ArmVectorEnv(gym.vector.VectorEnv):
    """Simulate `num_envs` arms that perform a task, and step them together.

    Observations (num_envs, d) float32 are normalized and clipped to [-10, 10]. Actions (num_envs, a) are clipped to
    [-1, 1]. `info["distance"]` (num_envs,) is the distance from the goal in m. `info["reward_terms"]` (num_envs, k)
    contains the unweighted terms of the reward, which are 0 for an arm that has just restarted. Each episode is
    truncated after `task.steps` steps.

    Args:
        robot, task: the arm and its task. draw: domain randomization, called at every reset.
        num_envs: number of arms. nthread: number of threads; 0: all cores.
        reward: reward terms and weights, see `TaskEnv`; only `set_progress` changes the weights.
        autoreset_mode: NextStep, SameStep or Disabled, as in `gymnasium.vector.SyncVectorEnv`.

    Raises:
        UserError: autoreset_mode is not NextStep, SameStep or Disabled.
    """

    def __init__(
        self,
        robot: Robot,
        task: Task,
        draw: Draw,
        num_envs: int = 1,
        *,
        nthread: int = 0,
        reward: Reward | None = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
    ):
        try:
            self.mode = AutoresetMode(autoreset_mode)
        except ValueError:
            modes = choices(mode.value for mode in AutoresetMode)
            raise UserError(f"autoreset_mode: expected one of {modes}, got {autoreset_mode!r}") from None
        self.env = SeparateEnv(robot, task, draw, num_envs, nthread=nthread, reward=reward)
        self.env.rngs = [np_random()[0] for _ in range(num_envs)]
        self.num_envs, self.ended = num_envs, np.zeros(num_envs, dtype=bool)
        self.metadata = {"autoreset_mode": self.mode, "render_modes": [], "render_fps": task.ctrl_hz}
        self.mean, self.std = observation_scale(task, robot)
        one = (len(self.mean),), (self.env.control.action_dim,)
        spaces = [gym.spaces.Box(-x, x, shape, np.float32) for x, shape in zip((CLIP, 1.0), one, strict=True)]
        self.single_observation_space, self.single_action_space = spaces
        self.observation_space, self.action_space = (gym.vector.utils.batch_space(s, num_envs) for s in spaces)

    def set_progress(self, progress: float) -> None:
        """Set reward weights for `progress`, the used share (0 to 1) of the budget; see `TaskEnv.set_progress`."""
        self.env.set_progress(progress)

    def normalized(self, observation: np.ndarray) -> np.ndarray:
        """Normalize and clip observations (m, d) in SI units, as `reset` and `step` do."""
        return ((observation - self.mean) / self.std).clip(-CLIP, CLIP).astype(np.float32)

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start new episodes of all arms, or of the arms that `options["reset_mask"]` (num_envs,) bool selects.

        seed: one number (arm i then has the seed `seed` + i), or one seed per arm. If None, the random generators
        continue.
        """
        mask = np.asarray((options or {}).get("reset_mask", np.ones(self.num_envs, dtype=bool)))
        if mask.shape != (self.num_envs,) or mask.dtype != bool:
            raise UserError(f"reset_mask: expected {self.num_envs} booleans, got {mask.dtype} of shape {mask.shape}")
        seeds = [seed + i for i in range(self.num_envs)] if isinstance(seed, int) else seed
        if seeds is not None and len(seeds) != self.num_envs:
            raise UserError(f"seed: expected a number or {self.num_envs} of them, got {len(seeds)}")
        for i, one in enumerate(seeds or ()):
            if one is not None and mask[i]:
                self.env.rngs[i] = np_random(one)[0]
        return self._restarted(mask)

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Run one control period.

        Raises:
            UserError: the actions have a wrong shape, or an episode has ended and automatic resets are disabled.
            FloatingPointError: an action is not finite.
        """
        waiting = self.ended.copy()  # arms that NextStep resets in this step; their actions have no effect
        if waiting.any() and self.mode == AutoresetMode.DISABLED:
            raise UserError(f"step: the episode of arm {waiting.argmax()} has ended; reset it first")
        action = np.asarray(actions, dtype=np.float32)
        if action.shape != self.action_space.shape:
            raise UserError(f"step: expected actions of shape {self.action_space.shape}, got {action.shape}")
        action = np.where(waiting[:, None], np.float32(0.0), action.clip(-1.0, 1.0))
        after = self.env._step(TensorDict({"action": torch.from_numpy(action)}, [self.num_envs]))
        reward, terminated, truncated = (after[key][:, 0].numpy() for key in ("reward", "terminated", "truncated"))
        reward, terminated, truncated = reward * ~waiting, terminated & ~waiting, truncated & ~waiting
        observation, info = self._presented(after)
        over, terms = terminated | truncated, info["reward_terms"]
        if self.mode == AutoresetMode.SAME_STEP and over.any():
            final = np.full(self.num_envs, None, dtype=object)
            for i in np.flatnonzero(over):
                final[i] = observation[i]
            last = {k: over if k[0] == "_" else (x.T * over).T for k, x in info.items()}
            observation, info = self._restarted(over)
            info["reward_terms"] = np.where(over[:, None], 0.0, terms)
            info |= {"final_obs": final, "_final_obs": over, "final_info": last, "_final_info": over}
        elif waiting.any():
            observation, info = self._restarted(waiting)
            info["reward_terms"] = np.where(waiting[:, None], 0.0, terms)
        if self.mode != AutoresetMode.SAME_STEP:
            self.ended = over
        return observation, reward.astype(np.float64), terminated, truncated, info

    def _restarted(self, mask: np.ndarray) -> tuple[np.ndarray, dict[str, Any]]:
        """Start new episodes of the arms in `mask`; return observations and info of all arms."""
        self.env._restart(np.flatnonzero(mask))
        self.ended[mask] = False
        return self._presented(self.env.read())

    def _presented(self, present: TensorDict) -> tuple[np.ndarray, dict[str, Any]]:
        distance = present["distance"][:, 0].numpy().astype(np.float64)
        info = {"distance": distance, "reward_terms": present["reward_terms"].numpy().astype(np.float64)}
        info |= {f"_{key}": np.ones(self.num_envs, dtype=bool) for key in info}
        return self.normalized(present["observation"].numpy()), info


class ArmEnv(gym.Env):
    """A single simulated arm: an `ArmVectorEnv` of one arm without automatic resets; see `ArmVectorEnv`."""

    def __init__(self, robot: Robot, task: Task, draw: Draw, *, reward: Reward | None = None):
        self.batch = ArmVectorEnv(robot, task, draw, nthread=1, reward=reward, autoreset_mode=AutoresetMode.DISABLED)
        self.metadata = {"render_modes": [], "render_fps": task.ctrl_hz}
        self.observation_space = self.batch.single_observation_space
        self.action_space = self.batch.single_action_space
        self.set_progress = self.batch.set_progress

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start a new episode; a `seed` determines the random numbers of this episode and of all later episodes."""
        super().reset(seed=seed)
        self.batch.env.rngs = [self.np_random]
        observation, info = self.batch.reset()
        return observation[0], _single(info)

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Run one control period, see `ArmVectorEnv.step`."""
        observation, reward, terminated, truncated, info = self.batch.step(np.asarray(action)[None])
        ends = bool(terminated[0]), bool(truncated[0])
        return observation[0], float(reward[0]), *ends, _single(info)


def _single(info: dict[str, Any]) -> dict[str, Any]:
    """Convert the `info` of a batch of one arm to the `info` of a single arm."""
    return {"distance": float(info["distance"][0]), "reward_terms": info["reward_terms"][0]}
