"""Run the paper's genetic algorithm (Alg. 1: select, mutate, update until convergence or G_max) with pymoo's GA.

The first population surrounds the start of the search. With a first population uniform over the bounds and pymoo's
default operators, the population would lose its diversity long before the friction curves are correct.
"""

import time
from dataclasses import dataclass

import numpy as np
from pymoo.algorithms.soo.nonconvex.ga import GA
from pymoo.core.problem import Problem as Objective
from pymoo.core.termination import NoTermination
from pymoo.operators.crossover.sbx import SBX
from pymoo.operators.mutation.pm import PM

from r2s.identification.problem import Problem, Report


@dataclass(frozen=True)
class Genetic:
    """The genetic search.

    Attributes:
        population: number of individuals, all simulated at once.
        generations: largest number of generations, G_max. minutes: time limit.
        spread: standard deviation of the first population about the start, on the unit cube; at most `prior_width`.
        patience, tolerance: the search ends if the best cost improves by less than the share `tolerance` over
            `patience` generations.
        seed: seed of all random draws.
    """

    population: int = 72
    generations: int = 40
    minutes: float = 10.0
    spread: float = 0.12
    patience: int = 15
    tolerance: float = 1e-3
    seed: int = 0
    local = False

    def __call__(self, problem: Problem, start: np.ndarray, report: Report) -> np.ndarray:
        """Return the best u (P,) that a search from `start` (P,) finds."""
        rng = np.random.default_rng(self.seed)
        spread = np.minimum(self.spread, problem.prior_width)
        first = np.clip(start + spread * rng.normal(size=(self.population, len(start))), 0, 1)
        first[0] = start

        class Replay(Objective):
            def __init__(self):
                super().__init__(n_var=len(start), n_obj=1, xl=0.0, xu=1.0)

            def _evaluate(self, x, out, *args, **kwargs):
                out["F"] = (problem.residual(x) ** 2).sum(-1, keepdims=True)

        operators = {"crossover": SBX(eta=10, prob=0.9), "mutation": PM(eta=15), "eliminate_duplicates": True}
        algorithm = GA(pop_size=self.population, sampling=first, **operators)
        algorithm.setup(Replay(), termination=NoTermination(), seed=self.seed)
        began, costs = time.perf_counter(), []
        for generation in range(1, self.generations + 1):
            algorithm.next()
            costs.append(float(algorithm.opt[0].F[0]))
            row = {"search": "ga", "generation": generation, "evaluations": algorithm.evaluator.n_eval}
            report(row | {"cost": costs[-1], "done": generation, "total": self.generations})
            stale = len(costs) > self.patience and costs[-1 - self.patience] - costs[-1] < self.tolerance * costs[-1]
            if stale or time.perf_counter() - began > 60 * self.minutes:
                break
        return np.asarray(algorithm.opt[0].X, dtype=float)
