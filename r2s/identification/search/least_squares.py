"""Search for the least-squares solution on replays or on torque (solver: levenberg_marquardt.py)."""

from dataclasses import dataclass

import numpy as np

from r2s.identification.problem import Problem, Report
from r2s.identification.search.levenberg_marquardt import minimize

ROUNDS = 4  # reweighted fits on torque; the first weights come from the nominal arm's residual


@dataclass(frozen=True)
class LeastSquares:
    """The least-squares search.

    Attributes:
        max_evaluations: most Jacobians. ftol: least relative gain for another step. minutes: time limit.
        level: "residual" to fit the problem's data, or "torque" to fit its torque residual, which takes seconds.
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
        problem = problem.on_torque
        for _ in range(ROUNDS):  # iteratively reweighted
            start = minimize(problem.residual, problem.linearize, start, *limits, "torque")
            problem = problem.reweighted(start, fitted=True)
        return start
