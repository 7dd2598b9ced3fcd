"""A policy on an arm: observe, ask the policy at its own rate, condition its torque, command at 1 kHz."""

from collections.abc import Callable

import mujoco
import numpy as np
import torch

from r2s import rewards
from r2s.actuation import Actuation, SoftLimits
from r2s.arm.interface import Arm, ArmStopped
from r2s.env import Task, observe
from r2s.evaluate import Episodes
from r2s.networks import Policy
from r2s.robot import SIM_DT


class Kinematics:
    """Where the arm's hand is, from joint angles and the nominal geometry: what a real arm knows, too."""

    def __init__(self, robot):
        self._model = robot.model(gravity=False)
        self._data = mujoco.MjData(self._model)
        self._site = self._model.site(robot.ee_site).id

    def __call__(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return ee (3,) m and its Jacobian (3, n) m/rad at q (n,) rad."""
        self._data.qpos = q
        mujoco.mj_kinematics(self._model, self._data)
        ee = self._data.site_xpos[self._site].copy()
        return ee, np.cross(self._data.xaxis, ee - self._data.xanchor).T


@torch.no_grad()
def reach(
    policy: Policy,
    arm: Arm,
    task: Task,
    starts: np.ndarray,
    goals: np.ndarray,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> tuple[Episodes, list[str]]:
    """Run one episode per goal; return them as measured by the arm, and why an arm stopped, where it did.

    An episode that the arm stopped keeps its last state: it did not reach.

    Args:
        policy: observation -> torque.
        arm: at 1 kHz.
        task: rates, limits and length.
        starts: (E, n) rad. goals: (E, 3) m.
        progress: called after every episode with done, total.
    """
    robot, count = arm.robot, len(goals)
    kinematics = Kinematics(robot)
    actuation = Actuation(robot, 1, cutoff_hz=task.cutoff_hz)
    torque = task.torque(robot)
    soft, step = SoftLimits.of(robot, torque), robot.dtau_max * SIM_DT
    shape = (count, task.steps)
    q, dq, tau = (np.zeros((*shape, robot.n)) for _ in range(3))
    ee, distance, reward, stops = np.zeros((*shape, 3)), np.zeros(shape), np.zeros(shape), []
    for e in range(count):
        state = arm.move_to(starts[e])
        actuation.reset()
        sent = np.zeros(robot.n)
        place, jacobian = kinematics(state.q)
        distance0 = max(float(np.linalg.norm(goals[e] - place)), 1e-3)
        before, stopped = state.dq, False
        for k in range(task.steps):
            if not stopped:
                seen = observe(
                    state.q[None],
                    state.dq[None],
                    place[None],
                    goals[e][None],
                    jacobian[None],
                    actuation.last / torque,
                )
                action = policy.action(torch.from_numpy(seen)).numpy().astype(np.float64)
                try:
                    for _ in range(task.substeps):
                        wanted = actuation(action * torque, 1)[0, 0] + soft(state.q, state.dq)
                        wanted = np.clip(wanted, -robot.tau_max, robot.tau_max)
                        sent = sent + np.clip(wanted - sent, -step, step)  # the rate limit comes last
                        arm.command(sent)
                        state = arm.read()
                except ArmStopped as stop:
                    stops.append(f"episode {e + 1}, {state.t:.2f} s: {stop}")
                    stopped = True
                place, jacobian = kinematics(state.q)
            q[e, k], dq[e, k], ee[e, k], tau[e, k] = state.q, state.dq, place, sent
            distance[e, k] = np.linalg.norm(goals[e] - place)
            ddq = (state.dq - before) * task.ctrl_hz
            before = state.dq
            d = distance[e, k : k + 1]
            reward[e, k] = rewards.terms(d, np.array([distance0]), state.dq[None], ddq[None])[0] @ rewards.PAPER
        if stopped:
            distance[e, -1] = np.inf  # reached means reached and held by an arm that still runs
        arm.stop()
        progress(e + 1, count)
    t = (1 + np.arange(task.steps)) / task.ctrl_hz
    return Episodes(t=t, q=q, dq=dq, ee=ee, goal=goals, tau=tau, distance=distance, reward=reward), stops
