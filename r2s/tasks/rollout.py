"""Run policies in simulators and on arms (`rollout`), and compute the measures of `task=reach`."""

from collections.abc import Callable
from dataclasses import fields, replace
from typing import Protocol

import numpy as np
import torch

from r2s.physics.collision import CollisionCheck
from r2s.physics.robot import Robot
from r2s.tasks.task import Episodes, State, Task, observe

HOLD_S = 0.5  # s, time at the end of an episode in which the end effector must stay near the goal to succeed
REST = 0.05  # rad/s, speed below which a joint is at rest


class PolicyLike(Protocol):
    """Interface of policies and of the model-based controllers in r2s/learning/model_based.py."""

    def action(self, observation: torch.Tensor) -> torch.Tensor:
        """Return actions (B, a) in [-1, 1] for observations (B, d)."""
        ...


class Arms(Protocol):
    """Arms that run episodes, one control period at a time: a simulated batch, one arm in an engine, or a real arm.

    Attributes:
        robot: model of each arm. width: number of episodes that run at the same time.
        speeds: (width, T, n) rad/s, joint speeds after each control step of the finished episodes, smoothed to remove
            measurement noise; None if the measured speeds have no noise.
    """

    @property
    def robot(self) -> Robot: ...  # noqa: D102 (see the class)
    @property
    def width(self) -> int: ...  # noqa: D102
    @property
    def speeds(self) -> np.ndarray | None: ...  # noqa: D102

    def place(self, starts: np.ndarray, first: int) -> State:
        """Start the episodes `first`, `first` + 1, ... at rest in `starts` (width, n) rad; return the state."""
        ...

    def step(self, command: np.ndarray) -> State:
        """Run one control period with the controller's commands (width, c); stopped arms do not move again."""
        ...

    def end(self) -> np.ndarray:
        """End the episodes; return (width,) bool: whether each arm stopped early."""
        ...


@torch.no_grad()
def rollout(
    policy: PolicyLike,
    arms: Arms,
    task: Task,
    starts: np.ndarray,
    goals: np.ndarray,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Episodes:
    """Run one episode for each goal, and return the `Episodes`.

    An episode ends early if the arm stops, or if it has a contact with itself or the table that `task.may_touch` does
    not allow (r2s/physics/collision.py). `rollout` checks contacts after every control step. After an early end, the
    record repeats the last state, and its last distance is infinite.

    Args:
        policy: maps observations to actions. arms: simulated or real arms. task: the task with its controller.
        starts: (E, n) rad, start postures of E episodes. goals: (E, ...), as in `Task.goals`; E is a multiple of
            `arms.width`.
        progress: callback, called with the numbers of finished episodes and of all episodes.
    """
    robot, count, shape = arms.robot, len(goals), (len(goals), task.steps)
    torque, controller = task.torque_limit(robot), task.control(robot)

    def act(state: State, goals: np.ndarray) -> np.ndarray:
        observation = torch.from_numpy(observe(task, controller, state, goals, torque))
        action = policy.action(observation).numpy().astype(np.float64)
        return controller.command(action, task, state.t, goals)

    # compile and load everything once before an arm moves
    home = State.at_home(robot)
    act(home, goals[:1])
    task.judge(home, home.dq, goals[:1], task.distance_scale(home, goals[:1]))
    q, dq, tau = (np.zeros((*shape, robot.n)) for _ in range(3))
    distance, reward, reward_smooth = (np.zeros(shape) for _ in range(3))
    out = Episodes(
        t=(1 + np.arange(task.steps)) / task.ctrl_hz, q=q, dq=dq, ee=np.zeros((*shape, 3)), tau=tau,
        goal=task.goal_positions(goals), distance=distance, reward=reward, reward_smooth=reward_smooth,
        q_left=np.zeros(count), limited=np.zeros(count), collision=np.full(count, "", dtype=object),
        force=np.zeros((*shape, 2)) if task.touches else None,
        box=np.zeros((*shape, 11)) if task.moves_box else None,
    )  # fmt: skip
    contacts = CollisionCheck(robot, table=None, may_touch=task.may_touch)
    for first in range(0, count, arms.width):
        now = slice(first, first + arms.width)
        _run(act, arms, task, arms.place(starts[now], first), goals[now], now, contacts, out)
        progress(min(first + arms.width, count), count)
    q_left = np.minimum(q - robot.q_min, robot.q_max - q).min((1, 2))
    return replace(out, q_left=q_left, collision=np.array(out.collision.tolist()))


def _run(
    act: Callable[[State, np.ndarray], np.ndarray],
    arms: Arms,
    task: Task,
    state: State,
    goals: np.ndarray,
    now: slice,
    contacts: CollisionCheck,
    out: Episodes,
) -> None:
    """Run the episodes with the indices `now` from the initial state `state`, and write the results into `out`."""
    weights, scale, before = task.paper_weights, task.distance_scale(state, goals), state.dq.copy()
    over = np.zeros(arms.width, dtype=bool)  # whether a contact has ended the episode
    for k in range(task.steps):
        if not (state.stopped | over).all():
            state = arms.step(act(state, goals))
        if over.any():
            state = _kept(state, over, *(x[now, k - 1] for x in (out.q, out.dq, out.ee, out.tau)))
        ddq = (state.dq - before) * task.ctrl_hz
        out.distance[now, k], terms = task.judge(state, ddq, goals, scale)
        out.reward[now, k] = terms @ weights
        out.limited[now] += state.limited / task.steps
        out.q[now, k], out.dq[now, k], out.ee[now, k], out.tau[now, k] = state.q, state.dq, state.ee, state.tau
        if out.force is not None:
            out.force[now, k] = task.forces(state, goals)
        if out.box is not None:
            out.box[now, k] = task.boxes(state, goals)
        before = out.dq[now, k]
        hit = np.where(over | state.stopped, -1, contacts.first_contact(state.q))
        for i in np.flatnonzero(hit >= 0):
            out.collision[now.start + i] = f"{(1 + k) / task.ctrl_hz:.2f} s: {contacts.names[hit[i]]}"
        over |= hit >= 0
    stopped = arms.end() | over
    out.reward_smooth[now] = out.reward[now]
    if arms.speeds is not None and not task.touches:
        rate = np.diff(arms.speeds, axis=1, prepend=0.0) * task.ctrl_hz
        for k in range(task.steps):
            t, q, ee, tau = (
                np.full(arms.width, (k + 1) / task.ctrl_hz),
                *(x[now, k] for x in (out.q, out.ee, out.tau)),
            )
            then = replace(state, t=t, q=q, dq=arms.speeds[:, k], ee=ee, tau=tau)
            out.reward_smooth[now, k] = task.judge(then, rate[:, k], goals, scale)[1] @ weights
    out.distance[now, -1][stopped] = np.inf  # an arm that stopped cannot succeed


def _kept(state: State, over: np.ndarray, *last: np.ndarray) -> State:
    """Return `state`, with q, dq, ee and tau from `last` for arms whose episode has ended (`over`, (m,) bool)."""
    names, here = ("q", "dq", "ee", "tau"), over[:, None]
    kept = {name: np.where(here, then, getattr(state, name)) for name, then in zip(names, last, strict=True)}
    return replace(state, limited=np.where(over, 0.0, state.limited), **kept)


def measures(episodes: Episodes) -> dict[str, float]:
    """Return the measures of `task=reach`, one row of evaluations.csv.

    success_x: share of episodes within x of the goal throughout the last 0.5 s. distance_median_m: mean distance in
    the last 0.5 s, median over goals. return_paper: sum of the paper's reward in an episode, mean over episodes.
    return_smooth: return_paper from smoothed speeds, because speed noise appears as acceleration in the reward.
    time_to_reach_s: time after which the end effector stays within 2 cm, median over the episodes that end within 2
    cm. overshoot_m: largest distance beyond 2 cm after the end effector has first come within 2 cm, mean over the
    episodes that come within 2 cm. rest: share of episodes without a stop in which every joint is slower than REST
    throughout the last 0.5 s; joints can move while the end effector is at rest. q_left_rad: smallest distance of a
    joint from its position limits, 5 % quantile over episodes. limited: mean filter rate. collision: share of
    episodes that a contact ended.
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
        "rest": float(((np.abs(episodes.dq[:, -hold:]).max((1, 2)) < REST) & np.isfinite(last[:, -1])).mean()),
        "q_left_rad": float(np.quantile(episodes.q_left, 0.05)),
        "limited": float(episodes.limited.mean()),
        "collision": float((episodes.collision != "").mean()),
    }


def gap(one: Episodes, other: Episodes) -> dict[str, float]:
    """Return the gap between episodes with equal goals: RMSE of the end-effector path, mm, and of torques, Nm."""
    path = np.linalg.norm(one.ee - other.ee, axis=-1)
    return {
        "ee_path_rmse_mm": float(1e3 * np.sqrt((path**2).mean())),
        "tau_rmse_Nm": float(np.sqrt(((one.tau - other.tau) ** 2).mean())),
    }


def select_episodes(episodes: Episodes, which: slice | np.ndarray) -> Episodes:
    """Return the episodes with the indices `which`."""
    arrays = {f.name: getattr(episodes, f.name) for f in fields(episodes) if f.name != "t"}
    chosen = {name: a[which] for name, a in arrays.items() if a is not None}
    return replace(episodes, **chosen)


def episode_measures(task: Task, episodes: Episodes, predicted: Episodes | None = None) -> list[dict[str, float]]:
    """Return one row per episode: measures, `gap` to the predicted episode, and whether the arm stopped.

    If the arm stopped in an episode, the columns of `gap` are nan.
    """
    rows = []
    for k in range(len(episodes.goal)):
        one = select_episodes(episodes, slice(k, k + 1))
        stopped = not np.isfinite(one.distance).all()
        row = task.measures(one) | {"arm_stopped": float(stopped)}
        if predicted is not None:
            apart = gap(one, select_episodes(predicted, slice(k, k + 1)))
            row |= dict.fromkeys(apart, np.nan) if stopped else apart
        rows.append(row)
    return rows
