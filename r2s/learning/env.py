"""A task as a TorchRL environment with a fixed number of simulated arms.

In a step, the task's controller converts actions to commands, and the arms run one control period (vector_arms.py).
Episodes are truncated and never terminate, so critics bootstrap from the last observation of an episode.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from r2s.learning.randomization import Draw, Pushes
from r2s.learning.vector_arms import VectorArms, check_finite
from r2s.physics.dynamics import Dynamics
from r2s.physics.robot import Robot
from r2s.tasks.rewards import Reward
from r2s.tasks.task import State, Task, observation_scale, observe

GROUPS = 8  # number of groups of arms that reset together; four arms reset almost as fast as one


class TaskEnv(EnvBase):
    """Simulate `nsim` arms that perform a task, with new goals and dynamics at every reset.

    Keys: `observation` (nsim, d), `action` (nsim, a) in [-1, 1], `reward` (nsim, 1) weighted by `weights`,
    `reward_terms` (nsim, k), `distance` (nsim, 1) m, `truncated`, `terminated`, `done`.

    Args:
        robot, task: the arm and its task.
        draw: domain randomization, called at every reset; a `Pushes` object also applies joint torques at every step.
        nsim: number of arms. nthread: number of threads; 0: all cores.
        seed: seed of goals, start postures and dynamics.
        stagger: whether the first episodes end at GROUPS different times, one for each group of arms.
        reward: reward terms and weights; None selects the terms and `paper_weights` of the task.
    """

    batch_locked = True
    arms_type: type[VectorArms] = VectorArms

    def __init__(
        self,
        robot: Robot,
        task: Task,
        draw: Draw,
        nsim: int,
        *,
        nthread: int = 0,
        seed: int = 0,
        stagger: bool = False,
        reward: Reward | None = None,
    ):
        super().__init__(device=None, batch_size=[nsim])
        self.robot, self.task, self.draw, self.nsim = robot, task, draw, nsim
        own, of_goals, of_noise = np.random.SeedSequence(seed).spawn(3)
        self.rng = np.random.default_rng(own)
        first = self._drawn(nsim)
        self.arms = self.arms_type(robot, task, first, nsim, nthread, seed=of_noise)
        self.reward, self.control = reward or Reward(), task.control(robot)
        self.reward.terms(task)  # raises UserError if the reward does not fit the task
        self.weights = self.reward.weights(task, 0.0)
        self._factor = self.reward.factor  # `set_progress` changes this factor
        self._seen, self._seen_steps = np.zeros_like(self.weights), 0
        self._torque = task.torque_limit(robot)
        self._staggered = self._stagger = stagger  # argument `stagger`; whether the next reset staggers
        self._pool = task.goals(robot, np.random.default_rng(of_goals), task.pool)
        self.goal = np.zeros((nsim, *self._pool.shape[1:]))
        self._dq, self._count = np.zeros((nsim, robot.n)), np.zeros(nsim, dtype=np.int64)
        self._scale, self._now = np.ones(nsim), self.arms.read()
        shape, wide = (nsim,), len(observation_scale(task, robot)[0])
        self.observation_spec = Composite(
            observation=Unbounded((nsim, wide), dtype=torch.float32),
            reward_terms=Unbounded((nsim, len(self.weights)), dtype=torch.float32),
            distance=Unbounded((nsim, 1), dtype=torch.float32),
            shape=shape,
        )
        self.action_spec = Bounded(-1.0, 1.0, (nsim, self.control.action_dim), dtype=torch.float32)
        self.reward_spec = Unbounded((nsim, 1), dtype=torch.float32)
        flag = Binary(1, (nsim, 1), dtype=torch.bool)
        self.full_done_spec = Composite(done=flag, terminated=flag.clone(), truncated=flag.clone(), shape=shape)

    def set_progress(self, progress: float) -> None:
        """Set the reward weights for an external training loop; progress: used share (0 to 1) of its budget.

        As in r2s's `train`, `Reward.adapt` adapts the weights to the mean reward terms since the last call.
        """
        if self._seen_steps:
            mean = self._seen / self._seen_steps
            self._factor = self.reward.adapt(self._factor, progress, mean, self._seen_steps)
            self._seen, self._seen_steps = np.zeros_like(mean), 0
        self.weights = self.reward.weights(self.task, progress, self._factor)

    def place(self, q: np.ndarray, goal: np.ndarray, ids: np.ndarray | None = None) -> State:
        """Start episodes of m arms (default: all) at rest with joint angles q (m, n) rad and goals (m, ...)."""
        state = self.arms.place(q, ids=ids)
        at = slice(None) if ids is None else ids
        self.goal[at], self._dq[at], self._count[at] = goal, 0.0, 0
        self._scale[at] = self.task.distance_scale(state, self.goal)[at]
        self._now = state
        return state

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        ids = np.arange(self.nsim) if mask is None else np.flatnonzero(mask.numpy().reshape(-1))
        if len(ids):
            self._restart(ids)
        return self.read()

    def _restart(self, ids: np.ndarray) -> State:
        """Draw dynamics, start postures and goals of the arms `ids`; return the state of all arms."""
        self.arms.set_dynamics(self._drawn(len(ids)), ids)
        q = self.task.starts(self.robot, self.rng, len(ids))
        goals = self._pool[self.rng.integers(len(self._pool), size=len(ids))]
        state = self.place(self.task.begin(q, goals), goals, ids)
        if self._stagger:
            self._count[ids] = ids * GROUPS // self.nsim * self.task.steps // GROUPS
            self._stagger = False
        return state

    def _drawn(self, m: int) -> Dynamics:
        """Draw the dynamics of m arms; each arm's speed noise is at least a draw from U(0, task.speed_noise)."""
        drawn = self.draw(self.rng, m)
        if not self.task.speed_noise:
            return drawn
        noise = self.task.speed_noise * self.rng.uniform(size=(m, 1))
        return replace(drawn, speed_noise=np.maximum(drawn.speed_noise, noise))

    def step_and_maybe_reset(self, tensordict: TensorDictBase) -> tuple[TensorDictBase, TensorDictBase]:
        """Run one step, reset truncated episodes, and return the step and the initial state of the next step.

        The method of `EnvBase` also checks and copies tensors; with 32 arms, this takes a fifth of a step's time.
        """
        after = self._step(tensordict)
        tensordict.set("next", after)
        cut = np.flatnonzero(self._count >= self.task.steps)
        return tensordict, self._present(self._restart(cut)) if len(cut) else after.exclude("reward")

    def read(self) -> TensorDict:
        """Return the tensordict of the current state."""
        return self._present(self.arms.read())

    def _present(self, state: State) -> TensorDict:
        distance, terms = self._judge(state, np.zeros_like(self._dq))
        return self._tensors(self._observe(state), np.zeros_like(terms), distance, np.zeros(self.nsim, dtype=bool))

    def _tensors(
        self, observation: np.ndarray, terms: np.ndarray, distance: np.ndarray, cut: np.ndarray
    ) -> TensorDict:
        done = torch.from_numpy(cut[:, None])
        return TensorDict(
            {
                "observation": torch.from_numpy(observation),
                "reward_terms": torch.from_numpy(terms.astype(np.float32)),
                "distance": torch.from_numpy(distance[:, None].astype(np.float32)),
                "done": done,
                "terminated": torch.zeros_like(done),
                "truncated": done.clone(),
            },
            batch_size=self.batch_size,
        )

    def _observe(self, state: State) -> np.ndarray:
        return observe(self.task, self.control, state, self.goal, self._torque)

    def _judge(self, state: State, ddq: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return self.reward.judge(self.task, state, ddq, self.goal, self._scale)

    def state(self) -> dict[str, Any]:
        """Return the state of simulation and random generators, as arrays, numbers and names, for `set_state`."""
        own = {name: getattr(self, name).copy() for name in ("goal", "_dq", "_count", "_scale")}
        return own | {"arms": self.arms.state(), "rng": self.rng.bit_generator.state, "_stagger": self._stagger}

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Restore a saved `state`; equal actions then produce equal steps, bit for bit."""
        for name in ("goal", "_dq", "_count", "_scale"):
            getattr(self, name)[:] = state[name]
        self.arms.set_state(state["arms"])
        self.rng.bit_generator.state = state["rng"]
        self._stagger = state["_stagger"]
        self._now = self.arms.read()

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = tensordict["action"].numpy().astype(np.float64)
        if isinstance(self.draw, Pushes):
            self.arms.push(self._forces(self.draw))
        state = self.arms.step(self.control.command(action, self.task, self._now.t, self.goal))
        self._now = state
        self._count += 1
        ddq = (state.dq - self._dq) * self.task.ctrl_hz
        self._dq[:] = state.dq
        distance, terms = self._judge(state, ddq)
        observation = self._observe(state)
        check_finite("observation", observation, self._count)
        check_finite("reward", terms, self._count)
        self._seen, self._seen_steps = self._seen + terms.sum(0), self._seen_steps + self.nsim
        after = self._tensors(observation, terms, distance, self._count >= self.task.steps)
        after["reward"] = torch.from_numpy((terms @ self.weights)[:, None].astype(np.float32))
        return after

    def _forces(self, draw: Pushes) -> np.ndarray:
        """Return the external joint torques (nsim, n) Nm of the next control period."""
        return draw.forces(self.rng, self.nsim)

    def _set_seed(self, seed: int | None) -> None:
        self.rng, self._stagger = np.random.default_rng(seed), self._staggered
        self.arms.seed(np.random.SeedSequence(seed).spawn(3)[2])
