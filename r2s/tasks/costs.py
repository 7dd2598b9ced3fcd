"""Costs: quantities whose means a training keeps below limits; each cost has an adaptive Lagrange multiplier.

A training maximizes the mean reward r under the constraint c_k <= d_k for each mean cost c_k with limit d_k
(constrained Markov decision process, Altman 1999). With multipliers lambda_k >= 0, the policy maximizes r - sum_k
lambda_k c_k / d_k (Tessler, Mankowitz and Mannor, Reward Constrained Policy Optimization, ICLR 2019). A multiplier
lambda_k changes at a rate proportional to c_k / d_k - 1, so it grows while the cost exceeds its limit. The replay
buffer stores costs without weights; each update multiplies them by the current weights -lambda_k / d_k. Stored costs
therefore remain valid when a multiplier changes. The critics learn the weighted sum of reward and costs. The means of
reward and costs cover all training steps, including exploration.
"""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from r2s.errors import UserError, check_number, choices
from r2s.physics.robot import Robot
from r2s.tasks.press_measures import TOUCH_N
from r2s.tasks.rewards import Reward
from r2s.tasks.task import State

MARGIN_RAD = 0.1  # rad, distance from a position limit at which the safety filter starts to fade the torque
PATIENCE = 50_000  # env steps in which a multiplier grows by 1 if its cost is twice the limit
MOST = 50.0  # largest multiplier; without this bound, a cost limit that no policy can meet would dominate the reward


def excess_force(robot: Robot, task: Any, state: State, goals: np.ndarray) -> np.ndarray:
    """Return (m,) N, max(0, force on the surface - requested force)."""
    exerted = task.forces(state, goals)
    return (exerted[:, 0] - exerted[:, 1]).clip(0.0)


def impact_speed(robot: Robot, task: Any, state: State, goals: np.ndarray) -> np.ndarray:
    """Return (m,) m/s, the speed of the tip into the surface, or 0 without contact."""
    inwards = -(task.tip_velocity(state) * task.normals(goals)).sum(1)
    return np.where(task.forces(state, goals)[:, 0] > TOUCH_N, inwards.clip(0.0), 0.0)


def limit_margin(robot: Robot, task: Any, state: State, goals: np.ndarray) -> np.ndarray:
    """Return (m,) rad, max(0, MARGIN_RAD - smallest distance of a joint from its position limits)."""
    left = np.minimum(state.q - robot.q_min, robot.q_max - state.q)  # a joint without limits has infinite distances
    return (MARGIN_RAD - left.min(1)).clip(0.0)


COSTS: dict[str, Callable[[Robot, Any, State, np.ndarray], np.ndarray]] = {
    "excess_force": excess_force,
    "impact_speed": impact_speed,
    "limit_margin": limit_margin,
}


class ConstrainedReward(Reward):
    """A reward with the terms of `reward`, then one term for each cost, with the weight -multiplier / limit.

    Args:
        reward: the reward to maximize. robot: the arm. limits: {name in COSTS: largest mean cost in the cost's unit}.

    Raises:
        UserError: a cost is unknown, or a limit is not positive.
    """

    def __init__(self, reward: Reward, robot: Robot, limits: Mapping[str, float]):
        for name, limit in limits.items():
            if name not in COSTS:
                raise UserError(f"costs: {name} is not allowed; allowed: {choices(COSTS)}")
            check_number(f"costs.{name}", limit, "(0, inf)")
        self._reward, self._robot, self._names = reward, robot, tuple(limits)
        self._limits = np.array([float(x) for x in limits.values()])

    @property
    def factor(self) -> np.ndarray:
        """(1 + K,): the initial factor of `reward`, then the initial multipliers of the K costs, which are 0."""
        return np.array([self._reward.factor, *np.zeros(len(self._names))])

    def terms(self, task: Any) -> tuple[str, ...]:
        """Return the names of reward terms and costs; raise UserError for a cost that the task cannot compute."""
        for name in self._names:
            if name != "limit_margin" and not task.touches:
                raise UserError(f"costs.{name}: {type(task).__name__} touches nothing; limit_margin is allowed")
            if name == "impact_speed" and not hasattr(task, "normals"):
                raise UserError(
                    f"costs.impact_speed: {type(task).__name__} touches no plane; excess_force is allowed"
                )
        return (*self._reward.terms(task), *self._names)

    def judge(
        self, task: Any, state: State, ddq: np.ndarray, goals: np.ndarray, reference: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the distance (m,) m, and the reward terms followed by the costs, (m, k)."""
        distance, terms = self._reward.judge(task, state, ddq, goals, reference)
        costs = [COSTS[name](self._robot, task, state, goals) for name in self._names]
        return distance, np.column_stack([terms, *costs])

    def weights(self, task: Any, progress: float, factor: Any = None) -> np.ndarray:
        """Return the weights (k,) of reward terms and costs; factor: (1 + K,), last result of `adapt`."""
        factor = self.factor if factor is None else factor
        return np.array([*self._reward.weights(task, progress, factor[0]), *(-factor[1:] / self._limits)])

    def adapt(self, factor: Any, progress: float, seen: np.ndarray, env_steps: int) -> np.ndarray:
        """Return the new `factor`; seen: (k,), means of terms and costs over the last `env_steps` env steps."""
        own = len(seen) - len(self._names)
        beyond = seen[own:] / self._limits - 1.0  # no upper bound, so that rare large costs matter
        multipliers = (factor[1:] + beyond * env_steps / PATIENCE).clip(0.0, MOST)
        return np.array([self._reward.adapt(factor[0], progress, seen[:own], env_steps), *multipliers])
