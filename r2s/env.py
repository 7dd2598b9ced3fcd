"""The task: reach a point with joint torques. A batch-locked TorchRL environment on one Simulator.

A step, for all arms at once: action -> target torque (fraction of the limits) -> low-pass, clip, rate limit each
ms -> delay and lag -> physics with soft limits at 1 kHz for one control period -> kinematics -> observation, reward
terms, truncation. Episodes never terminate, they are cut off (`truncated`): values bootstrap through their end.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
import torch
from numba import njit
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from r2s import rewards
from r2s.actuation import Actuation, Motors, SoftLimits
from r2s.errors import UserError, check_number
from r2s.robot import SIM_DT, Robot
from r2s.simulator import Dynamics, Simulator

FINE_M = 0.02  # tanh scales of the observation: the last centimetres fill the range of a network's input
FINE_RAD = 0.015
GROUPS = 8  # of arms that are reset together: a reset of four costs hardly more than one of one


@dataclass(frozen=True)
class Task:
    """What is asked of the arm; conf/task/reach.yaml.

    Attributes:
        ctrl_hz: policy rate. episode_s: length of an episode, s.
        torque_fraction: an action of 1 asks for this much of tau_max; one for all joints, or one each.
        cutoff_hz: low-pass on the torque.
        start_spread: rad, episodes start at q_home + U(-spread, spread).
        reach: (low, high) m, distance of goals from the shoulder (the second joint).
        height: lowest goal, m. azimuth: goals lie within +- this angle of straight ahead, rad.
    """

    ctrl_hz: int = 50
    episode_s: float = 4.0
    torque_fraction: float | tuple[float, ...] = 0.3
    cutoff_hz: float = 100.0
    start_spread: float = 0.1
    reach: tuple[float, float] = (0.3, 0.75)
    height: float = 0.1
    azimuth: float = 1.57

    def __post_init__(self):
        cycles = round(1 / SIM_DT)
        if not isinstance(self.ctrl_hz, int) or self.ctrl_hz < 1 or cycles % self.ctrl_hz:
            raise UserError(f"task.ctrl_hz: {self.ctrl_hz!r} is not allowed; what divides {cycles} is, such as 50")
        check_number("task.episode_s", self.episode_s, f"[{1 / self.ctrl_hz}, inf)")
        check_number("task.cutoff_hz", self.cutoff_hz, "(0, inf)")
        check_number("task.start_spread", self.start_spread, "[0, inf)")

    def torque(self, robot: Robot) -> np.ndarray:
        """(n,) Nm that an action of 1 asks for."""
        share = np.array(self.torque_fraction, dtype=float)
        if share.ndim and share.shape != (robot.n,):
            raise UserError(f"task.torque_fraction: {share.size} values for the {robot.n} joints of {robot.name}")
        return share * robot.tau_max

    @property
    def steps(self) -> int:
        """Control steps of an episode."""
        return round(self.episode_s * self.ctrl_hz)

    @property
    def substeps(self) -> int:
        """Physics steps of a control step."""
        return round(1.0 / (self.ctrl_hz * SIM_DT))


def sample_goals(robot: Robot, task: Task, rng: np.random.Generator, count: int) -> np.ndarray:
    """Return (count, 3) m: end-effector positions of random joint angles, so that every goal can be reached.

    Raises:
        UserError: hardly any position of the arm lies within the task's region.
    """
    model = robot.model(gravity=False)
    data = mujoco.MjData(model)
    site = model.site(robot.ee_site).id
    data.qpos = robot.q_home
    mujoco.mj_kinematics(model, data)
    shoulder = data.xanchor[min(1, robot.n - 1)].copy()
    middle, half = 0.5 * (robot.q_min + robot.q_max), 0.45 * (robot.q_max - robot.q_min)
    goals: list[np.ndarray] = []
    for tried in range(1, 1000 * count + 1001):
        data.qpos = middle + half * rng.uniform(-1, 1, robot.n)
        mujoco.mj_kinematics(model, data)
        p = data.site_xpos[site]
        away = np.linalg.norm(p - shoulder)
        if (
            task.reach[0] <= away <= task.reach[1]
            and p[2] >= task.height
            and abs(np.arctan2(p[1], p[0])) <= task.azimuth
        ):
            goals.append(p.copy())
            if len(goals) == count:
                return np.array(goals)
        if tried == 2000 and len(goals) < 2:
            break
    raise UserError(
        f"task.reach {task.reach[0]:g} to {task.reach[1]:g} m, task.height {task.height:g} m: {robot.name} hardly "
        "ever gets there; widen them"
    )


@njit(cache=True)
def observe(
    q: np.ndarray, dq: np.ndarray, ee: np.ndarray, goal: np.ndarray, jacobian: np.ndarray, effort: np.ndarray
) -> np.ndarray:
    """Return the observation (m, 5 n + 12) float32 in SI units; the same on the arm as in simulation.

    q, dq, ee, goal, error, effort, tanh(error / 2 cm), J^T error, tanh(J^T error / 1.5 cm): the last three
    tell a network which joint moves the hand towards the goal, which it would otherwise have to learn; the effort is
    state, because the rate limit lets a torque change by 1 Nm per ms only.

    Args:
        q, dq: (m, n) rad, rad/s.
        ee, goal: (m, 3) m.
        jacobian: (m, 3, n) m/rad.
        effort: (m, n) the last command (tau_J_d) over what an action of 1 asks for.
    """
    m, n = q.shape
    out = np.empty((m, 5 * n + 12), np.float32)
    for i in range(m):
        for j in range(n):
            pull = 0.0
            for k in range(3):
                pull += jacobian[i, k, j] * (goal[i, k] - ee[i, k])
            out[i, j], out[i, n + j], out[i, 2 * n + 9 + j] = q[i, j], dq[i, j], effort[i, j]
            out[i, 3 * n + 12 + j], out[i, 4 * n + 12 + j] = pull, np.tanh(pull / FINE_RAD)
        for k in range(3):
            error = goal[i, k] - ee[i, k]
            out[i, 2 * n + k], out[i, 2 * n + 3 + k], out[i, 2 * n + 6 + k] = ee[i, k], goal[i, k], error
            out[i, 3 * n + 9 + k] = np.tanh(error / FINE_M)
    return out


def observation_scale(robot: Robot, task: Task) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and standard deviation (5 n + 12,) to normalise `observe` by: the task's own scales.

    Statistics of random torques would not do: they whirl the wrist at 10 rad/s, next to which the 0.1 rad/s that
    decide about stopping at a goal vanish.
    """
    n, far = robot.n, task.reach[1]
    centre = np.zeros(5 * n + 12)
    centre[:n] = 0.5 * (robot.q_min + robot.q_max)
    places = [np.full(3, 0.5 * far)] * 3
    scale = [0.3 * (robot.q_max - robot.q_min), np.full(n, 0.5), *places, np.full(n, 0.5)]
    scale += [np.ones(3), np.full(n, 0.2 * far), np.ones(n)]
    return centre, np.concatenate(scale)


class ReachEnv(EnvBase):
    """`nsim` arms reaching for random goals, each with dynamics drawn at every reset.

    Keys: `observation` (nsim, 5 n + 12), `action` (nsim, n) in [-1, 1], `reward` (nsim, 1) under `weights`,
    `reward_terms` (nsim, 3) of r2s/rewards.py, `distance` (nsim, 1) m, `truncated`, `terminated`, `done`.

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
