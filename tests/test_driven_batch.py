"""Many arms behind the driver in lock-step are the same arms one after the other."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from conftest import conf

from r2s.arm.deploy import DrivenArm
from r2s.arm.driven_batch import DrivenBatch
from r2s.arm.simulated import SimulatedArm
from r2s.learning.evaluate import fixed_episodes
from r2s.physics.dynamics import nominal_dynamics
from r2s.physics.robot import load_robot
from r2s.tasks.episode import rollout
from r2s.tasks.reach import ReachTask

PANDA = load_robot(**conf("robot/panda"))
TASK = ReachTask(**{k: tuple(v) if isinstance(v, list) else v for k, v in conf("task/reach").items()})
NEW = nominal_dynamics(PANDA, **conf("friction/paper"), inertia_scale=conf("inertia/paper")["scale"])
REACH, REST, SILENT, HARD = range(4)


class Mixed:
    """Pulls the hand to its goal; silent or at full torque where the goal's height says so."""

    def action(self, observation):
        """Return actions (B, 7); row by row, so that a batch and one arm get the same to the bit."""
        seen = observation.numpy().astype(np.float64)
        action = np.clip(0.2 * seen[:, 40:47] - 0.05 * seen[:, 7:14], -1.0, 1.0)
        kind = np.round(1e3 * seen[:, 19]).astype(int) % 4
        action[kind == REST] = 0.0
        action[kind == SILENT] = np.nan
        action[kind == HARD] = np.array([1.0, -1.0, 1.0, -1.0, 1.0, -1.0, 1.0])
        return torch.from_numpy(action)


def episodes(task, count):
    """Return starts and goals; the third decimal of a goal's height says what `Mixed` does there."""
    starts, goals = fixed_episodes(PANDA, task, count)
    goals[:, 2] = (np.floor(goals[:, 2] * 250) * 4 + np.arange(count) % 4) / 1e3
    return starts, goals


def both(robot, dynamics, task, count, soft_start_s=0.0):
    """Return episodes and stops in lock-step and one after the other."""
    starts, goals = episodes(task, count)
    together = DrivenBatch(robot, dynamics, task, count, soft_start_s=soft_start_s, nthread=1)
    arm = SimulatedArm(robot, dynamics, position_noise=0.0, velocity_noise=0.0)
    alone = DrivenArm(arm, task, soft_start_s=soft_start_s)
    return [(rollout(Mixed(), arms, task, starts, goals), arms.stops) for arms in (together, alone)]


@pytest.mark.parametrize("soft_start_s", [0.0, 0.3])
def test_lock_step_is_one_after_the_other(soft_start_s):
    """States, commands, rewards and stops, their logs included, are the same to the bit."""
    task = replace(TASK, episode_s=1.4)
    (one, stops), (other, expected) = both(PANDA, replace(NEW, delay=4e-3, lag=1e-3), task, 6, soft_start_s)
    for name in ("q", "dq", "ee", "tau", "distance", "reward"):
        assert np.array_equal(getattr(one, name), getattr(other, name)), name
    assert [str(stop) for stop in stops] == [str(stop) for stop in expected]
    assert len({stop.reason for stop in stops}) >= 1
    assert all(np.array_equal(a.log, b.log) for a, b in zip(stops, expected, strict=True))
    assert np.isinf(one.distance[SILENT, -1])
    assert np.isfinite(one.distance[REACH]).all()
    assert np.abs(one.q[REACH, -1] - one.q[REACH, 0]).max() > 0.05  # it moves


def test_the_reflexes_of_an_arm_stop_it_in_lock_step():
    """An arm whose own limits are narrower than its driver's stops itself, at the same place for the same reason."""
    narrow = replace(PANDA, dq_max=0.4 * PANDA.dq_max)
    task = replace(TASK, episode_s=1.0)
    starts, goals = episodes(task, 4)
    together = DrivenBatch(PANDA, NEW, task, 4, nthread=1)
    together._reflexes.robot = narrow
    arm = SimulatedArm(PANDA, NEW, position_noise=0.0, velocity_noise=0.0)
    arm._reflexes.robot = narrow
    alone = DrivenArm(arm, task)
    one, other = (rollout(Mixed(), arms, task, starts, goals) for arms in (together, alone))
    assert any("velocity" in stop.reason for stop in together.stops)
    assert [str(stop) for stop in together.stops] == [str(stop) for stop in alone.stops]
    for name in ("q", "dq", "ee", "tau", "distance", "reward"):
        assert np.array_equal(getattr(one, name), getattr(other, name)), name
