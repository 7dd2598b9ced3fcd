"""A policy on an arm: observe, ask the policy at its own rate, let the driver command at 1 kHz.

The policy is asked within the cycle. One that hangs leaves the arm without commands, and the arm stops itself.
"""

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import torch

from r2s.arm.driver import Driver
from r2s.arm.interface import Arm, ArmState, ArmStopped
from r2s.physics.rigid_body import Kinematics
from r2s.physics.robot import SIM_DT
from r2s.tasks import rewards
from r2s.tasks.episode import Acts, Episodes
from r2s.tasks.reach import Task, observe

LOGGED_S = 1.0  # before a stop, of every cycle


@dataclass
class Timing:
    """How long things took on the clock of this computer, s; in lock-step only what we do ourselves has a meaning.

    Attributes:
        policy: observing and asking the policy, once per control step. driver: working out one command.
        period: from one command to the next.
    """

    policy: list[float] = field(default_factory=list)
    driver: list[float] = field(default_factory=list)
    period: list[float] = field(default_factory=list)

    def table(self) -> list[dict[str, float | str]]:
        """Return one row each: count, median, 99 % and largest, ms."""
        rows: list[dict[str, float | str]] = []
        for name in ("policy", "driver", "period"):
            x = 1e3 * np.array(getattr(self, name) or [np.nan])
            row = {"median_ms": np.median(x), "p99_ms": np.percentile(x, 99), "max_ms": x.max()}
            rows.append({"what": name, "count": len(x)} | {k: float(v) for k, v in row.items()})
        return rows


@dataclass(frozen=True)
class Stop:
    """Why an episode ended early.

    Attributes:
        episode: from 0. when: in it. reason: in the words of the arm or of the driver.
        log: (k, 1 + 4 n), the last second at 1 kHz: t s, q rad, dq rad/s, tau_J_d Nm, and the command Nm thereupon.
    """

    episode: int
    when: str
    reason: str
    log: np.ndarray

    def __str__(self) -> str:
        return f"episode {self.episode + 1}, {self.when}: {self.reason}"


@torch.no_grad()
def reach(
    policy: Acts,
    arm: Arm,
    task: Task,
    starts: np.ndarray,
    goals: np.ndarray,
    progress: Callable[[int, int], None] = lambda done, total: None,
    *,
    soft_start_s: float = 0.0,
) -> tuple[Episodes, list[Stop], Timing]:
    """Run one episode per goal; return them as the arm measured them, why it stopped, where it did, and the timing.

    An episode that the arm stopped keeps its last state: it did not reach.

    Args:
        policy: observation -> torque.
        arm: at 1 kHz.
        task: rates, limits and length.
        starts: (E, n) rad. goals: (E, 3) m.
        progress: called after every episode with done, total.
        soft_start_s: s, over which the torque of an episode fades in; hardware deserves some, the twin needs none.
    """
    robot, count = arm.robot, len(goals)
    kinematics = Kinematics(robot)
    torque = task.torque(robot)
    driver = Driver(robot, torque, cutoff_hz=task.cutoff_hz, period_s=1 / task.ctrl_hz, soft_start_s=soft_start_s)
    timing, clock = Timing(), time.perf_counter
    shape = (count, task.steps)
    q, dq, tau = (np.zeros((*shape, robot.n)) for _ in range(3))
    ee, distance, reward = np.zeros((*shape, 3)), np.zeros(shape), np.zeros(shape)
    stops: list[Stop] = []
    seen: deque[tuple[ArmState, np.ndarray]] = deque(maxlen=round(LOGGED_S / SIM_DT))

    def stop(when: str, reason: object) -> None:
        rows = [np.concatenate([[s.t], s.q, s.dq, s.tau_J_d, command]) for s, command in seen]
        stops.append(Stop(e, when, str(reason), np.array(rows).reshape(-1, 1 + 4 * robot.n)))

    def ask(q: np.ndarray, dq: np.ndarray, place: np.ndarray, jacobian: np.ndarray, goal: np.ndarray) -> np.ndarray:
        effort = driver.effort[None] / torque
        observation = observe(q[None], dq[None], place[None], goal[None], jacobian[None], effort)
        return policy.action(torch.from_numpy(observation))[0].numpy().astype(np.float64)

    def worth(distance: float, distance0: float, dq: np.ndarray, ddq: np.ndarray) -> float:
        terms = rewards.terms(np.array([distance]), np.array([distance0]), dq[None], ddq[None])
        return float(terms[0] @ rewards.PAPER)

    # what is compiled or loaded at its first call must not be so while an arm waits
    ask(starts[0], np.zeros(robot.n), *kinematics(starts[0]), goals[0])
    worth(1.0, 1.0, np.zeros(robot.n), np.zeros(robot.n))
    for e in range(count):
        driver.reset()
        seen.clear()
        stopped = False
        try:
            state = arm.move_to(starts[e])
        except ArmStopped as reason:
            state, stopped = arm.read(), True
            stop("on the way to its start", reason)
        place, jacobian = kinematics(state.q)
        distance0 = max(float(np.linalg.norm(goals[e] - place)), 1e-3)
        before, sent = state.dq, 0.0
        for k in range(task.steps):
            if not stopped:
                asked = clock()
                action = ask(state.q, state.dq, place, jacobian, goals[e])
                timing.policy.append(clock() - asked)
                try:
                    for ms in range(task.substeps):
                        began = clock()
                        wanted = driver(state, action * torque if ms == 0 else None)
                        now = clock()
                        timing.driver.append(now - began)
                        if sent:
                            timing.period.append(now - sent)
                        sent = now
                        seen.append((state, wanted))
                        arm.command(wanted)
                        state = arm.read()
                        if driver.done:
                            raise ArmStopped(driver.stopping)
                except ArmStopped as reason:
                    stop(f"{state.t:.2f} s", reason)
                    stopped = True
                place, jacobian = kinematics(state.q)
            q[e, k], dq[e, k], ee[e, k], tau[e, k] = state.q, state.dq, place, state.tau_J_d
            distance[e, k] = np.linalg.norm(goals[e] - place)
            ddq = (state.dq - before) * task.ctrl_hz
            before = state.dq
            reward[e, k] = worth(distance[e, k], distance0, state.dq, ddq)
        if not stopped and driver.stopping is not None:  # the end came before the arm was at rest
            stop(f"{state.t:.2f} s", driver.stopping)
            stopped = True
        if stopped:
            distance[e, -1] = np.inf  # reached means reached and held by an arm that still runs
        arm.stop()
        progress(e + 1, count)
    t = (1 + np.arange(task.steps)) / task.ctrl_hz
    episodes = Episodes(t=t, q=q, dq=dq, ee=ee, goal=goals, tau=tau, distance=distance, reward=reward)
    return episodes, stops, timing
