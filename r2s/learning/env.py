"""A task as a batch-locked TorchRL environment on one batch of simulated arms.

A step, for all arms at once: action -> target torque (fraction of the limits) -> one control period of
r2s/learning/batch.py -> observation, reward terms, truncation. Episodes never terminate, they are cut off
(`truncated`): values bootstrap through their end.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from r2s.learning.batch import ArmBatch, check_finite
from r2s.learning.randomization import Pushes, TellingDraw
from r2s.physics.dynamics import Dynamics
from r2s.physics.robot import Robot
from r2s.tasks.task import State, Task, observed

GROUPS = 8  # of arms that are reset together: a reset of four costs hardly more than one of one


class TaskEnv(EnvBase):
    """`nsim` arms at a task, each with goals and dynamics drawn at every reset.

    Keys: `observation` (nsim, d), `action` (nsim, n) in [-1, 1], `reward` (nsim, 1) under `weights`,
    `reward_terms` (nsim, k) of the task, `distance` (nsim, 1) m, `truncated`, `terminated`, `done`.

    Args:
        robot, task: the arm and what is asked of it.
        draw: m -> Dynamics of m arms (or of one, for all), called at every reset with the env's generator. One that
            `Pushes` is asked for torques at every step as well; a `TellingDraw`, for what a policy is told.
        nsim: arms. nthread: 0 is all.
        seed: of goals, starts and draws.
        stagger: let the first episodes of eight groups of arms end at different times, not those of all at once.
    """

    batch_locked = True

    def __init__(
        self,
        robot: Robot,
        task: Task,
        draw: Callable[[np.random.Generator, int], Dynamics],
        nsim: int,
        *,
        nthread: int = 0,
        seed: int = 0,
        stagger: bool = False,
    ):
        super().__init__(device=None, batch_size=[nsim])
        self.robot, self.task, self.draw, self.nsim = robot, task, draw, nsim
        own, of_goals, of_noise = np.random.SeedSequence(seed).spawn(3)
        self.rng = np.random.default_rng(own)
        first = self._drawn(nsim)
        self.arms = ArmBatch(robot, task, first, nsim, nthread, seed=of_noise)
        self._tell(first)
        self.weights = task.paper_weights
        self._torque = task.torque(robot)
        self._stagger = stagger
        self._pool = task.goals(robot, np.random.default_rng(of_goals), task.pool)
        self.goal = np.zeros((nsim, *self._pool.shape[1:]))
        self._dq, self._count = np.zeros((nsim, robot.n)), np.zeros(nsim, dtype=np.int64)
        self._reference, self._now = np.ones(nsim), self.arms.read()
        told = self._now.told
        shape, wide = (nsim,), len(task.observation_scale(robot)[0]) + (0 if told is None else told.shape[1])
        self.observation_spec = Composite(
            observation=Unbounded((nsim, wide), dtype=torch.float32),
            reward_terms=Unbounded((nsim, len(self.weights)), dtype=torch.float32),
            distance=Unbounded((nsim, 1), dtype=torch.float32),
            shape=shape,
        )
        self.action_spec = Bounded(-1.0, 1.0, (nsim, robot.n), dtype=torch.float32)
        self.reward_spec = Unbounded((nsim, 1), dtype=torch.float32)
        flag = Binary(1, (nsim, 1), dtype=torch.bool)
        self.full_done_spec = Composite(done=flag, terminated=flag.clone(), truncated=flag.clone(), shape=shape)

    def place(self, q: np.ndarray, goal: np.ndarray, ids: np.ndarray | None = None) -> State:
        """Start episodes of the arms `ids` (all by default) at rest at q (m, n) with goals (m, ...)."""
        state = self.arms.place(q, ids=ids)
        at = slice(None) if ids is None else ids
        self.goal[at], self._dq[at], self._count[at] = goal, 0.0, 0
        self._reference[at] = self.task.reference(state, self.goal)[at]
        self._now = state
        return state

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        ids = np.arange(self.nsim) if mask is None else np.flatnonzero(mask.numpy().reshape(-1))
        if len(ids):
            self._restart(ids)
        return self.read()

    def _restart(self, ids: np.ndarray) -> State:
        """Draw arms, starts and goals for `ids`; return the state of all arms."""
        drawn = self._drawn(len(ids))
        self.arms.set_dynamics(drawn, ids)
        self._tell(drawn, ids)
        q = self.task.starts(self.robot, self.rng, len(ids))
        goals = self._pool[self.rng.integers(len(self._pool), size=len(ids))]
        state = self.place(self.task.begin(q, goals), goals, ids)
        if self._stagger:
            self._count[ids] = ids * GROUPS // self.nsim * self.task.steps // GROUPS
            self._stagger = False
        return state

    def _drawn(self, m: int) -> Dynamics:
        """Return the dynamics of m arms, each with sensors at least as noisy as a draw of the task's noise."""
        drawn = self.draw(self.rng, m)
        if not self.task.speed_noise:
            return drawn
        noise = self.task.speed_noise * self.rng.uniform(size=(m, 1))
        return replace(drawn, speed_noise=np.maximum(drawn.speed_noise, noise))

    def _tell(self, drawn: Dynamics, ids: np.ndarray | None = None) -> None:
        """Tell policies of the arms `ids` what is to be told of their dynamics, if anything is."""
        if isinstance(self.draw, TellingDraw):
            self.arms.tell(*self.draw.said(self.rng, drawn), ids)

    def step_and_maybe_reset(self, tensordict: TensorDictBase) -> tuple[TensorDictBase, TensorDictBase]:
        """Return the step and the state after it, of which episodes that were cut off have begun anew.

        As EnvBase's, without its checks and copies, which cost a fifth of a step of 32 arms.
        """
        after = self._step(tensordict)
        tensordict.set("next", after)
        cut = np.flatnonzero(self._count >= self.task.steps)
        return tensordict, self._tensors(self._restart(cut)) if len(cut) else after.exclude("reward")

    def read(self) -> TensorDict:
        """Return the tensordict of the present state, before any action."""
        return self._tensors(self.arms.read())

    def _tensors(self, state: State) -> TensorDict:
        none = torch.zeros((self.nsim, 1), dtype=torch.bool)
        distance, _ = self.task.judge(state, np.zeros_like(self._dq), self.goal, self._reference)
        return TensorDict(
            {
                "observation": torch.from_numpy(observed(self.task, state, self.goal, self._torque)),
                "reward_terms": torch.zeros(self.nsim, len(self.weights)),
                "distance": torch.from_numpy(distance[:, None].astype(np.float32)),
                "done": none,
                "terminated": none.clone(),
                "truncated": none.clone(),
            },
            batch_size=self.batch_size,
        )

    def state(self) -> dict[str, Any]:
        """Return all that the next steps depend on, as arrays, numbers and names, for `set_state`."""
        own = {name: getattr(self, name).copy() for name in ("goal", "_dq", "_count", "_reference")}
        return own | {"arms": self.arms.state(), "rng": self.rng.bit_generator.state, "_stagger": self._stagger}

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Go back to what `state` returned; the same actions then lead to the same steps, bit for bit."""
        for name in ("goal", "_dq", "_count", "_reference"):
            getattr(self, name)[:] = state[name]
        self.arms.set_state(state["arms"])
        self.rng.bit_generator.state = state["rng"]
        self._stagger = state["_stagger"]
        self._now = self.arms.read()

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = tensordict["action"].numpy().astype(np.float64)
        if isinstance(self.draw, Pushes):
            self.arms.push(self.draw.forces(self.rng, self.nsim))
        state = self.arms.step(self.task.target(action, self._now.seen(), self.goal, self._torque))
        self._now = state
        self._count += 1
        ddq = (state.dq - self._dq) * self.task.ctrl_hz
        self._dq[:] = state.dq
        distance, terms = self.task.judge(state, ddq, self.goal, self._reference)
        observation = observed(self.task, state, self.goal, self._torque)
        check_finite("observation", observation, self._count)
        check_finite("reward", terms, self._count)
        cut = torch.from_numpy((self._count >= self.task.steps)[:, None])
        return TensorDict(
            {
                "observation": torch.from_numpy(observation),
                "reward_terms": torch.from_numpy(terms.astype(np.float32)),
                "distance": torch.from_numpy(distance[:, None].astype(np.float32)),
                "reward": torch.from_numpy((terms @ self.weights)[:, None].astype(np.float32)),
                "done": cut,
                "terminated": torch.zeros_like(cut),
                "truncated": cut.clone(),
            },
            batch_size=self.batch_size,
        )

    def _set_seed(self, seed: int | None) -> None:
        self.rng = np.random.default_rng(seed)
        self.arms.seed(np.random.SeedSequence(seed).spawn(3)[2])
