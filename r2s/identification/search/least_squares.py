"""Fit parameters to replays or to torque by least squares (solver: levenberg_marquardt.py)."""

from dataclasses import dataclass

import numpy as np

from r2s.identification.problem import Problem, Report, reweighted_fit
from r2s.identification.search.levenberg_marquardt import minimize

ROUNDS = 4  # number of reweighted torque fits; the first weights come from the nominal arm's residual


@dataclass(frozen=True)
class LeastSquares:
    """The least-squares search.

    Attributes:
        max_evaluations: largest number of Jacobians. ftol: the search ends when a step lowers the cost by less than
            this share. minutes: time limit.
        level: what to minimize: "residual" for `Problem.data`, "torque" for the torque residual (takes seconds).
    """

    max_evaluations: int = 40
    ftol: float = 1e-4
    minutes: float = 10.0
    level: str = "residual"
    local = True

    def __call__(self, problem: Problem, start: np.ndarray, report: Report) -> np.ndarray:
        """Return the solution u (P,) of a search from `start` (P,)."""
        limits = (self.max_evaluations, self.ftol, self.minutes, report)
        if self.level != "torque":
            return minimize(problem.residual, problem.linearize, start, *limits)

        def solve(own: Problem, u: np.ndarray) -> np.ndarray:
            return minimize(own.residual, own.linearize, u, *limits, "torque")

        return reweighted_fit(problem.on_torque, start, ROUNDS, solve)[0]
