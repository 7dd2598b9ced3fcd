"""A policy in another engine than it was trained in: the same goals, starts and drawn arms, one after the other."""

from collections.abc import Callable

import numpy as np
import torch

from r2s.engines.interface import Engine, Law
from r2s.learning.evaluate import GOAL_SEED
from r2s.physics.actuation import Actuation, Motors
from r2s.physics.dynamics import Dynamics
from r2s.physics.limits import SoftLimits
from r2s.physics.rigid_body import Kinematics
from r2s.physics.robot import Robot
from r2s.tasks import rewards
from r2s.tasks.episode import Acts, Episodes
from r2s.tasks.reach import Task, observe


@torch.no_grad()
def reach(
    policy: Acts,
    make: Callable[[Dynamics], Engine],
    robot: Robot,
    task: Task,
    draw: Callable[[np.random.Generator, int], Dynamics],
    starts: np.ndarray,
    goals: np.ndarray,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Episodes:
    """Run one episode per goal; arm e has the e-th draw, as in `r2s.learning.evaluate.make_evaluation`.

    Args:
        policy: observation -> action.
        make: the engine of an arm with given dynamics.
        robot, task, draw: as trained.
        starts: (E, n) rad. goals: (E, 3) m.
        progress: called after every episode with done, total.
    """
    count, torque, kinematics = len(goals), task.torque(robot), Kinematics(robot)
    drawn = draw(np.random.default_rng(GOAL_SEED), count)
    actuation = Actuation(robot, 1, cutoff_hz=task.cutoff_hz)
    shape = (count, task.steps)
    q, dq, tau = (np.zeros((*shape, robot.n)) for _ in range(3))
    ee, distance, reward = np.zeros((*shape, 3)), np.zeros(shape), np.zeros(shape)
    for e in range(count):
        dynamics = drawn.one(e)
        engine, law = make(dynamics), Law(robot, dynamics, SoftLimits.of(robot, torque))
        motors = Motors(1, robot.n, dynamics.delay, dynamics.lag)
        actuation.reset()
        now = starts[e], np.zeros(robot.n)
        engine.reset(*now)
        place, jacobian = kinematics(now[0])
        distance0 = np.array([max(float(np.linalg.norm(goals[e] - place)), 1e-3)])
        for k in range(task.steps):
            effort = actuation.last / torque
            seen = observe(now[0][None], now[1][None], place[None], goals[e][None], jacobian[None], effort)
            action = policy.action(torch.from_numpy(seen)).numpy().astype(np.float64)
            before = now[1]
            for applied in motors(actuation(np.clip(action, -1.0, 1.0) * torque, task.substeps))[0]:
                now = engine.step(applied + law(*now, applied))
            place, jacobian = kinematics(now[0])
            q[e, k], dq[e, k], ee[e, k], tau[e, k] = *now, place, actuation.last[0]
            distance[e, k] = np.linalg.norm(goals[e] - place)
            ddq = (now[1] - before)[None] * task.ctrl_hz
            reward[e, k] = rewards.terms(distance[e, k : k + 1], distance0, now[1][None], ddq)[0] @ rewards.PAPER
        progress(e + 1, count)
    t = (1 + np.arange(task.steps)) / task.ctrl_hz
    return Episodes(t=t, q=q, dq=dq, ee=ee, goal=goals, tau=tau, distance=distance, reward=reward)
