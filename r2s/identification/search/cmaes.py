"""Covariance matrix adaptation (Hansen and Ostermeier 2001), the `cma` package's, on the unit cube."""

import time
from dataclasses import dataclass

import cma
import numpy as np

from r2s.identification.problem import Problem, Report


@dataclass(frozen=True)
class CovarianceAdaptation:
    """The search.

    Attributes:
        population: candidates of a generation, all simulated at once.
        generations, minutes: bounds, whichever comes first.
        spread: first standard deviation, of the unit cube.
        tolerance: converged once the costs of a generation, and of the best lately, differ by less (relative).
        seed: of every draw.
    """

    population: int = 36
    generations: int = 400
    minutes: float = 10.0
    spread: float = 0.05
    tolerance: float = 1e-6
    seed: int = 0
    local = False

    def __call__(self, problem: Problem, start: np.ndarray, report: Report) -> np.ndarray:
        """Return u (P,) from `start` (P,)."""
        first = float((problem.residual(start[None]) ** 2).sum())
        options = {
            "popsize": self.population,
            "bounds": [0.0, 1.0],
            "seed": self.seed + 1,  # 0 means the clock
            "maxiter": self.generations,
            "tolfun": self.tolerance * first,
            "verbose": -9,
        }
        strategy = cma.CMAEvolutionStrategy(start, self.spread, options)
        began, best, best_u = time.perf_counter(), first, start
        for generation in range(1, self.generations + 1):
            candidates = np.array(strategy.ask())
            costs = (problem.residual(candidates) ** 2).sum(-1)
            strategy.tell(list(candidates), costs.tolist())
            if costs.min() < best:
                best, best_u = float(costs.min()), candidates[costs.argmin()]
            row = {"search": "cmaes", "generation": generation, "evaluations": generation * self.population}
            report(row | {"cost": best, "done": generation, "total": self.generations})
            if strategy.stop() or time.perf_counter() - began > 60 * self.minutes:
                break
        return best_u
