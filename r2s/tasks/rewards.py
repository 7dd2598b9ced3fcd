"""The paper's reward, equation (2), and a curriculum that approaches this reward.

A reward is a weighted sum of named terms. The replay buffer stores the terms without weights, and each update applies
the current weights. Stored transitions therefore remain valid when a curriculum changes the weights. r2s adds three
terms to the paper's terms: a bonus for precision, and penalties for motion near the goal and for a high filter rate.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from r2s.compiled import njit
from r2s.errors import UserError, check_number

K1, K2, K3, K4, K5, K6 = 2.0, 0.03, 0.05, 1.15, 0.03, 0.15  # eq. (2)
PRECISION_M = (0.03, 0.01)  # m, tanh scales of the precision bonus
STILL = (0.2, 0.05)  # rad/s, tanh scales of the largest joint speed; joints can turn while the end effector rests
TERMS = ("distance", "smoothness", "precision", "stillness", "filter_penalty")


@njit(cache=True)
def terms(
    distance: np.ndarray, distance0: np.ndarray, dq: np.ndarray, ddq: np.ndarray, limited: np.ndarray
) -> np.ndarray:
    """Return five reward terms (m, 5): the first two add up to the paper's reward; r2s adds the other three.

    Terms, with d = distance / distance0 and the paper's constants k1 to k6: distance = -k1 d;
    smoothness = -k2 sum tanh|dq| - k3 sum tanh|ddq| / |k4 - min(1, d)| - k5 sum tanh|ddq| / (k6 + d);
    precision = 1 - tanh(distance / 3 cm) / 2 - tanh(distance / 1 cm) / 2;
    stillness = -precision (tanh(max|dq| / 0.2 rad/s) / 2 + tanh(max|dq| / 0.05 rad/s) / 2);
    filter_penalty = -limited.

    Args:
        distance, distance0: (m,) m, distance from the goal now and at the start of the episode.
        dq: (m, n) rad/s, joint speeds.
        ddq: (m, n) rad/s^2, joint accelerations, mean over the last control period.
        limited: (m,), share of the last control period's cycles in which the safety filter changed the command.
    """
    out = np.empty((len(distance), 5))
    for i in range(len(distance)):
        d = distance[i] / distance0[i]
        speed, jerkiness, fastest = 0.0, 0.0, 0.0
        for j in range(dq.shape[1]):
            speed += np.tanh(abs(dq[i, j]))
            jerkiness += np.tanh(abs(ddq[i, j]))
            fastest = max(fastest, abs(dq[i, j]))
        near = 1.0 - 0.5 * (np.tanh(distance[i] / PRECISION_M[0]) + np.tanh(distance[i] / PRECISION_M[1]))
        out[i, 0] = -K1 * d
        out[i, 1] = -K2 * speed - K3 * jerkiness / abs(K4 - min(1.0, d)) - K5 * jerkiness / (K6 + d)
        out[i, 2] = near
        out[i, 3] = -0.5 * near * (np.tanh(fastest / STILL[0]) + np.tanh(fastest / STILL[1]))
        out[i, 4] = -limited[i]
    return out


PAPER = np.array([1.0, 1.0, 0.0, 0.0, 0.0])  # weights of the terms in eq. (2)


WEIGHTS = tuple((name, "[0, inf)") for name in TERMS[1:])
PATIENCE = 50_000  # env steps in which the penalty factor grows e-fold while the filter rate is twice its limit
MAX_FACTOR = 2.5  # largest penalty factor; 34 runs of tqc stayed below 2.2; at 4, ddpg and td3 learn not to move


class Reward:
    """Reward with the terms and weights of the task, `reward=task`; subclasses change weights or terms.

    In conf/reward/*.yaml, `_target_` names the class of the reward; the other keys are arguments of this class.

    Attributes:
        factor: number or array, initial value of the argument `factor` of `weights` and `adapt`.
    """

    factor: Any = 1.0

    def terms(self, task: Any) -> tuple[str, ...]:
        """Return the names of the reward terms in the order in which `judge` returns the terms."""
        return task.reward_terms

    def judge(
        self, task: Any, state: Any, ddq: np.ndarray, goals: np.ndarray, reference: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the distance (m,) m and the reward terms (m, k); arguments as in `Task.judge`."""
        return task.judge(state, ddq, goals, reference)

    def weights(self, task: Any, progress: float, factor: Any = 1.0) -> np.ndarray:
        """Return the weights (k,) of the reward terms.

        Args:
            task: task of the training run. progress: used fraction of the budget. factor: last result of `adapt`.
        """
        return task.paper_weights

    def adapt(self, factor: Any, progress: float, seen: np.ndarray, env_steps: int) -> Any:
        """Return the new `factor`; seen: (k,), means of the terms over the last `env_steps` env steps."""
        return factor


@dataclass(frozen=True)
class Curriculum(Reward):
    """A reward whose weights change during a training run.

    The paper's reward alone makes exploration difficult, because its acceleration terms reward early stopping. A
    training run with a curriculum starts with a small smoothness weight and a bonus for precision. The weights then
    change linearly toward those of the paper. With reward=paper, the weights are constant: 1 for distance and
    smoothness, 0 for other terms.

    Attributes:
        smoothness, precision, stillness, filter_penalty: (before, after), weights of the term before and after the
            linear change. anneal: fractions of the budget at which the weights start and stop changing.
        max_filter_rate: intended upper limit of the filter rate in training, including exploration; if None, no
            limit. A factor of 1 to MAX_FACTOR multiplies the curriculum's weight of the filter penalty. Once the
            weights have started to change, the factor grows while the filter rate exceeds `max_filter_rate`, and
            falls while the filter rate is lower. The factor's logarithm integrates the relative excess, filter rate /
            `max_filter_rate` - 1, over env steps, like a Lagrange multiplier (Stooke, Achiam and Abbeel, ICML 2020).
            With a constant factor, the filter rate is 1 to 6 %, depending on seed (benchmarks/results/minutes.md).

    Raises:
        UserError: a value is not a pair of numbers, or a number is outside its range.
    """

    smoothness: Sequence[float]
    precision: Sequence[float]
    stillness: Sequence[float]
    filter_penalty: Sequence[float]
    anneal: Sequence[float]
    max_filter_rate: float | None = None

    def __post_init__(self):
        for name, interval in (*WEIGHTS, ("anneal", "[0, 1]")):
            pair = getattr(self, name)
            if isinstance(pair, str) or not isinstance(pair, Sequence) or len(pair) != 2:
                raise UserError(f"reward.{name}: {pair} is not allowed; two numbers are, before and after")
            for number in pair:
                check_number(f"reward.{name}", number, interval)
        if self.max_filter_rate is not None:
            check_number("reward.max_filter_rate", self.max_filter_rate, "(0, 1]")

    def terms(self, task: Any) -> tuple[str, ...]:
        """Return TERMS; raise UserError if these are not the names of the task's reward terms."""
        if task.reward_terms != TERMS:
            raise UserError(
                f"reward: a curriculum weights {', '.join(TERMS)}; {type(task).__name__} has "
                f"{', '.join(task.reward_terms)}; reward=task is allowed"
            )
        return TERMS

    def weights(self, task: Any, progress: float, factor: float = 1.0) -> np.ndarray:
        """Return the weights (5,) of TERMS; `factor` multiplies the weight of the filter penalty."""
        start, end = self.anneal
        at = float(np.clip((progress - start) / max(end - start, 1e-9), 0.0, 1.0))
        pairs = (getattr(self, name) for name in TERMS[1:])
        moving = [before + at * (after - before) for before, after in pairs]
        moving[-1] *= factor
        return np.array([1.0, *moving])

    def adapt(self, factor: float, progress: float, seen: np.ndarray, env_steps: int) -> float:
        """Return the new factor of the filter penalty's weight; see `Reward.adapt`."""
        if self.max_filter_rate is None or progress < self.anneal[0]:
            return factor
        limited = -seen[TERMS.index("filter_penalty")]
        beyond = min(limited / self.max_filter_rate - 1.0, 1.0)
        return float(np.clip(factor * np.exp(beyond * env_steps / PATIENCE), 1.0, MAX_FACTOR))
