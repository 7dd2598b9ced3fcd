"""Episodes of a policy, and how well they reached: one rollout and one set of measures for simulators and arms."""

from collections.abc import Callable
from dataclasses import replace
from typing import Protocol

import numpy as np
import torch

from r2s.physics.contacts import touching
from r2s.physics.robot import Robot
from r2s.tasks.task import Episodes, State, Task, observed

HOLD_S = 0.5  # s, at the end of an episode: reached means reached and held
REST = 0.05  # rad/s, below which a joint rests


class Acts(Protocol):
    """What reaches: a policy, or the model-based reference (both in r2s/learning)."""

    def action(self, observation: torch.Tensor) -> torch.Tensor:
        """Return actions (B, n) in [-1, 1] for observations (B, d)."""
        ...


class Arms(Protocol):
    """What episodes run on, one control period at a time: a batch, one arm in an engine, or the arm itself.

    Attributes:
        robot: what each of them is. width: how many episodes run at once; fewer than all run one after the other.
        speeds: (width, T, n) rad/s after each control step of the episodes that have ended, without the noise that an
            arm's own have; None where they have none.
    """

    @property
    def robot(self) -> Robot: ...  # noqa: D102 (said above)
    @property
    def width(self) -> int: ...  # noqa: D102
    @property
    def speeds(self) -> np.ndarray | None: ...  # noqa: D102

    def place(self, starts: np.ndarray, first: int) -> State:
        """Begin the episodes first, first + 1, ... at rest at starts (width, n) rad."""
        ...

    def step(self, target: np.ndarray) -> State:
        """Go on for one control period with the target torques (width, n) Nm; an arm that has stopped stays."""
        ...

    def end(self) -> np.ndarray:
        """End the episodes; return (width,), which of them were stopped before."""
        ...


@torch.no_grad()
def rollout(
    policy: Acts,
    arms: Arms,
    task: Task,
    starts: np.ndarray,
    goals: np.ndarray,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Episodes:
    """Run one episode per goal.

    An episode that was stopped, or in which the arm touches itself or the table (r2s/physics/contacts.py, looked at
    after every control step), keeps its last state and did not reach: its last distance is infinite.

    Args:
        policy: observation -> action.
        arms: what moves. task: what is asked of them.
        starts: (E, n) rad. goals: (E, ...), as `task.goals` has them; E a multiple of the arms' width.
        progress: called whenever episodes end, with done, total.
    """
    robot, count, width = arms.robot, len(goals), arms.width
    torque, weights = task.torque(robot), task.paper_weights
    shape = (count, task.steps)
    q, dq, tau = (np.zeros((*shape, robot.n)) for _ in range(3))
    ee, limited = np.zeros((*shape, 3)), np.zeros(count)
    distance, reward, smooth = (np.zeros(shape) for _ in range(3))
    touches, collision = touching(robot, table=None), [""] * count

    def ask(state: State, goals: np.ndarray) -> np.ndarray:
        observation = torch.from_numpy(observed(task, state, goals, torque))
        return policy.action(observation).numpy().astype(np.float64)

    # what is compiled or loaded at its first call must not be so while an arm waits
    still = State.still(robot)
    task.target(ask(still, goals[:1]), still, goals[:1], torque)
    task.judge(still, still.dq, goals[:1], task.reference(still, goals[:1]))
    for first in range(0, count, width):
        now = slice(first, first + width)
        state = arms.place(starts[now], first)
        reference, before = task.reference(state, goals[now]), state.dq.copy()
        over = np.zeros(width, dtype=bool)  # it has touched something
        for k in range(task.steps):
            if not (state.stopped | over).all():
                state = arms.step(task.target(ask(state, goals[now]), state.seen(), goals[now], torque))
            if over.any():
                state = _kept(state, over, q[now, k - 1], dq[now, k - 1], ee[now, k - 1], tau[now, k - 1])
            ddq = (state.dq - before) * task.ctrl_hz
            distance[now, k], terms = task.judge(state, ddq, goals[now], reference)
            reward[now, k] = terms @ weights
            limited[now] += state.limited / task.steps
            q[now, k], dq[now, k], ee[now, k], tau[now, k] = state.q, state.dq, state.ee, state.tau
            before = dq[now, k]
            hit = np.where(over | state.stopped, -1, touches.first(state.q))
            for i in np.flatnonzero(hit >= 0):
                collision[first + i] = f"{(1 + k) / task.ctrl_hz:.2f} s: {touches.names[hit[i]]}"
            over |= hit >= 0
        stopped = arms.end() | over
        smooth[now] = reward[now]
        if arms.speeds is not None:
            rate = np.diff(arms.speeds, axis=1, prepend=0.0) * task.ctrl_hz
            for k in range(task.steps):
                t_then = np.full(width, (k + 1) / task.ctrl_hz)
                then = replace(state, t=t_then, q=q[now, k], dq=arms.speeds[:, k], ee=ee[now, k], tau=tau[now, k])
                smooth[now, k] = task.judge(then, rate[:, k], goals[now], reference)[1] @ weights
        distance[now, -1][stopped] = np.inf  # reached means reached and held by an arm that still runs
        progress(min(first + width, count), count)
    t = (1 + np.arange(task.steps)) / task.ctrl_hz
    q_left = np.minimum(q - robot.q_min, robot.q_max - q).min((1, 2))
    return Episodes(
        t=t, q=q, dq=dq, ee=ee, goal=task.places(goals), tau=tau, distance=distance, reward=reward,
        reward_smooth=smooth, q_left=q_left, limited=limited, collision=np.array(collision),
    )  # fmt: skip


def _kept(state: State, over: np.ndarray, *last: np.ndarray) -> State:
    """Return the state in which arms whose episode is `over` (m,) have stayed as they were: q, dq, ee and tau."""
    names, here = ("q", "dq", "ee", "tau"), over[:, None]
    kept = {name: np.where(here, then, getattr(state, name)) for name, then in zip(names, last, strict=True)}
    return replace(state, limited=np.where(over, 0.0, state.limited), **kept)


def measures(episodes: Episodes) -> dict[str, float]:
    """Return one row of evaluations.csv.

    success_x: share of episodes within x of the goal for the whole last 0.5 s. distance_median_m: median over goals
    of the mean distance in that time. return_paper: mean sum of eq. (2); return_smooth: without the noise of measured
    speeds, which eq. (2) takes for accelerations. time_to_reach_s: median time after which the
    hand stays within 2 cm, of the episodes that got there. overshoot_m: how far out of 2 cm it came again after it
    had first been within, mean of those that had. rest: share of episodes in which every joint is slower than REST
    for the whole last 0.5 s: a hand can lie on a joint's axis. q_left_rad: how close joints come to position limits,
    the 5 % quantile over episodes. limited: share of the cycles in which the driver's law changed what was asked for.
    collision: share of episodes that ended because the arm touched itself or the table.
    """
    step = episodes.t[1] - episodes.t[0]
    hold = round(HOLD_S / step)
    last = episodes.distance[:, -hold:]
    away = episodes.distance > 0.02
    steps = episodes.distance.shape[1]
    since = np.where(away.any(1), steps - np.argmax(away[:, ::-1], axis=1), 0)
    there = since < steps
    first = np.argmin(away, axis=1)
    later = [
        max(0.0, row[k:-1].max(initial=0.0) - 0.02)
        for row, k, out in zip(episodes.distance, first, away, strict=True)
        if not out.all()
    ]
    return {
        "success_5cm": float((last.max(1) < 0.05).mean()),
        "success_2cm": float((last.max(1) < 0.02).mean()),
        "success_1cm": float((last.max(1) < 0.01).mean()),
        "success_5mm": float((last.max(1) < 0.005).mean()),
        "distance_median_m": float(np.median(last.mean(1))),
        "return_paper": float(episodes.reward.sum(1).mean()),
        "return_smooth": float(episodes.reward_smooth.sum(1).mean()),
        "time_to_reach_s": float(np.median(since[there]) * step) if there.any() else float("nan"),
        "overshoot_m": float(np.mean(later)) if later else float("nan"),
        "rest": float((np.abs(episodes.dq[:, -hold:]).max((1, 2)) < REST).mean()),
        "q_left_rad": float(np.quantile(episodes.q_left, 0.05)),
        "limited": float(episodes.limited.mean()),
        "collision": float((episodes.collision != "").mean()),
    }


def gap(one: Episodes, other: Episodes) -> dict[str, float]:
    """Return how far apart one policy came out on the same goals: RMSE of the hand's path, mm, and of torques, Nm."""
    path = np.linalg.norm(one.ee - other.ee, axis=-1)
    return {
        "ee_path_rmse_mm": float(1e3 * np.sqrt((path**2).mean())),
        "tau_rmse_Nm": float(np.sqrt(((one.tau - other.tau) ** 2).mean())),
    }
