"""The task: reach a point with joint torques. A batch-locked TorchRL environment on one Simulator.

A step, for all arms at once: action -> target torque (fraction of the limits) -> low-pass, clip, rate limit each
ms -> delay and lag -> physics with soft limits at 1 kHz for one control period -> kinematics -> observation, reward
terms, truncation. Episodes never terminate, they are cut off (`truncated`): values bootstrap through their end.
"""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from r2s.physics.actuation import Actuation, Motors
from r2s.physics.dynamics import Dynamics
from r2s.physics.limits import SoftLimits
from r2s.physics.robot import Robot
from r2s.physics.simulator import Simulator
from r2s.tasks import rewards
from r2s.tasks.reach import Task, observe, sample_goals

GROUPS = 8  # of arms that are reset together: a reset of four costs hardly more than one of one


class ReachEnv(EnvBase):
    """`nsim` arms reaching for random goals, each with dynamics drawn at every reset.

    Keys: `observation` (nsim, 5 n + 12), `action` (nsim, n) in [-1, 1], `reward` (nsim, 1) under `weights`,
    `reward_terms` (nsim, 3) of r2s/tasks/rewards.py, `distance` (nsim, 1) m, `truncated`, `terminated`, `done`.

    Args:
        robot, task: the arm and what is asked of it.
        draw: m -> Dynamics of m arms (or of one, for all), called at every reset with the env's generator.
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
        self.robot, self.task, self.draw = robot, task, draw
        self.rng = np.random.default_rng(seed)
        drawn = draw(self.rng, nsim)
        self.sim = Simulator(robot, drawn, nsim, nthread)
        self.sim.set_soft_limits(SoftLimits.of(robot, task.torque(robot)))
        self.actuation = Actuation(robot, nsim, cutoff_hz=task.cutoff_hz)
        self.motors = Motors(nsim, robot.n, drawn.delay, drawn.lag)
        self.weights = rewards.PAPER
        self._torque = task.torque(robot)
        self._stagger = stagger
        self._pool = sample_goals(robot, task, np.random.default_rng(seed + 1), 2048)
        self.goal = np.zeros((nsim, 3))
        self._dq, self._count = np.zeros((nsim, robot.n)), np.zeros(nsim, dtype=np.int64)
        self._distance0 = np.ones(nsim)
        shape = (nsim,)
        self.observation_spec = Composite(
            observation=Unbounded((nsim, 5 * robot.n + 12), dtype=torch.float32),
            reward_terms=Unbounded((nsim, 3), dtype=torch.float32),
            distance=Unbounded((nsim, 1), dtype=torch.float32),
            shape=shape,
        )
        self.action_spec = Bounded(-1.0, 1.0, (nsim, robot.n), dtype=torch.float32)
        self.reward_spec = Unbounded((nsim, 1), dtype=torch.float32)
        flag = Binary(1, (nsim, 1), dtype=torch.bool)
        self.full_done_spec = Composite(done=flag, terminated=flag.clone(), truncated=flag.clone(), shape=shape)

    def place(self, q: np.ndarray, goal: np.ndarray, ids: np.ndarray | None = None) -> None:
        """Start episodes of the arms `ids` (all by default) at rest at q (m, n) with goals (m, 3)."""
        at = slice(None) if ids is None else ids
        self.sim.reset(q, np.zeros_like(q), ids)
        self.actuation.reset(ids)
        self.motors.reset(ids)
        self.goal[at], self._dq[at], self._count[at] = goal, 0.0, 0
        self._distance0[at] = np.maximum(np.linalg.norm(goal - self.sim.ee[at], axis=-1), 1e-3)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        ids = np.arange(self.sim.nsim) if mask is None else np.flatnonzero(mask.numpy().reshape(-1))
        if len(ids):
            drawn = self.draw(self.rng, len(ids))
            self.sim.set_dynamics(drawn, ids)
            self.motors.set(drawn.delay, drawn.lag, ids)
            spread = self.task.start_spread
            q = self.robot.q_home + self.rng.uniform(-spread, spread, (len(ids), self.robot.n))
            self.place(q, self._pool[self.rng.integers(len(self._pool), size=len(ids))], ids)
            if self._stagger:
                self._count[ids] = ids * GROUPS // self.sim.nsim * self.task.steps // GROUPS
                self._stagger = False
        return self.read()

    def read(self) -> TensorDict:
        """Return the tensordict of the present state, before any action."""
        none = torch.zeros((self.sim.nsim, 1), dtype=torch.bool)
        distance = np.linalg.norm(self.goal - self.sim.ee, axis=-1)
        return TensorDict(
            {
                "observation": torch.from_numpy(self._observe()),
                "reward_terms": torch.zeros(self.sim.nsim, 3),
                "distance": torch.from_numpy(distance[:, None].astype(np.float32)),
                "done": none,
                "terminated": none.clone(),
                "truncated": none.clone(),
            },
            batch_size=self.batch_size,
        )

    def state(self) -> dict[str, Any]:
        """Return all that the next steps depend on, as arrays, numbers and names, for `set_state`."""
        own = {name: getattr(self, name).copy() for name in ("goal", "_dq", "_count", "_distance0")}
        parts = {name: getattr(self, name).state() for name in ("sim", "actuation", "motors")}
        return own | parts | {"rng": self.rng.bit_generator.state, "_stagger": self._stagger}

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Go back to what `state` returned; the same actions then lead to the same steps, bit for bit."""
        for name in ("goal", "_dq", "_count", "_distance0"):
            getattr(self, name)[:] = state[name]
        for name in ("sim", "actuation", "motors"):
            getattr(self, name).set_state(state[name])
        self.rng.bit_generator.state = state["rng"]
        self._stagger = state["_stagger"]

    def _observe(self) -> np.ndarray:
        s = self.sim
        return observe(s.q, s.dq, s.ee, self.goal, s.jacobian, self.actuation.last / self._torque)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = tensordict["action"].numpy().astype(np.float64)
        self._finite("action", action)
        command = self.actuation(np.clip(action, -1.0, 1.0) * self._torque, self.task.substeps)
        self.sim.rollout(self.motors(command), record=())
        self.sim.kinematics()
        dq = self.sim.dq.copy()
        ddq = (dq - self._dq) * self.task.ctrl_hz
        self._dq = dq
        self._count += 1
        distance = np.linalg.norm(self.goal - self.sim.ee, axis=-1)
        terms = rewards.terms(distance, self._distance0, dq, ddq)
        observation = self._observe()
        self._finite("observation", observation)
        self._finite("reward", terms)
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

    def _finite(self, what: str, rows: np.ndarray) -> None:
        """Raise FloatingPointError where a row of (nsim, ...) has a value that is not finite."""
        finite = np.isfinite(rows)
        if not finite.all():
            bad = ~finite.all(-1)
            arm = int(bad.argmax())
            value = rows[arm][~np.isfinite(rows[arm])][0]
            raise FloatingPointError(f"{what} of arm {arm} is {value} at step {self._count[arm]} of its episode")

    def _set_seed(self, seed: int | None) -> None:
        self.rng = np.random.default_rng(seed)
