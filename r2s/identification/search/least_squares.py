"""Least squares as a search, on replays or on the level of torque (levenberg_marquardt.py does the work)."""

from dataclasses import dataclass

import numpy as np

from r2s.identification.levenberg_marquardt import minimise
from r2s.identification.problem import Problem, Report

ROUNDS = 4  # the first weights are those of a nominal arm, and say little


@dataclass(frozen=True)
class LeastSquares:
    """The search.

    Attributes:
        max_evaluations: Jacobians at most. ftol: relative gain that ends it. minutes: of wall clock at most.
        level: "residual", or "torque" for the residual on the level of torque: a linear-regressor start in seconds.
    """

    max_evaluations: int = 40
    ftol: float = 1e-4
    minutes: float = 10.0
    level: str = "residual"
    local = True

    def __call__(self, problem: Problem, start: np.ndarray, report: Report) -> np.ndarray:
        """Return u (P,) from `start` (P,)."""
        how = (self.max_evaluations, self.ftol, self.minutes, report)
        if self.level == "torque":
            for _ in range(ROUNDS):  # each with weights from what the one before could not explain
                start = minimise(problem.quick, problem.quick_jacobian, start, *how, "torque")
                problem.quick_data.adapt(problem.space.from_unit(start), fitted=True)
            return start
        return minimise(problem.residual, lambda u: problem.jacobian(u)[1], start, *how)
