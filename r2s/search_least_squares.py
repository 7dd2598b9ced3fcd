"""Bounded least squares on the unit cube: scipy's trust region with a Jacobian from one batch of P + 1 candidates."""

from collections.abc import Callable

import numpy as np
from scipy.optimize import least_squares

from r2s.identify import Search, SearchResult

STEP = 1e-4  # of the unit cube: far above the round-off of a replay, far below its curvature


def least_squares_search(*, max_evaluations: int = 40, ftol: float = 1e-4) -> Search:
    """Return the search. `max_evaluations` counts trust-region steps; `ftol` is the relative gain that ends it."""

    def search(
        residual: Callable[[np.ndarray], np.ndarray], start: np.ndarray, report: Callable[[dict], None]
    ) -> SearchResult:
        steps, best, tried = 0, np.inf, 0
        p = len(start)
        inside = np.clip(start, 1e-3, 1 - 1e-3)  # a start on its bound cannot move

        def fun(u: np.ndarray) -> np.ndarray:
            nonlocal steps, best, tried
            r = residual(u[None])[0]
            steps, tried, best = steps + 1, tried + 1, min(best, float(r @ r))
            row = {"search": "least_squares", "evaluations": tried, "cost": best}
            report(row | {"done": steps, "total": max_evaluations})
            return r

        def jac(u: np.ndarray) -> np.ndarray:
            step = np.where(u > 0.5, -STEP, STEP)  # always into the cube
            nonlocal tried
            tried += p + 1
            r = residual(np.concatenate([u[None], u + np.diag(step)]))
            return ((r[1:] - r[0]) / step[:, None]).T

        solution = least_squares(
            fun,
            inside,
            jac,
            bounds=(np.zeros(p), np.ones(p)),
            max_nfev=max_evaluations,
            ftol=ftol,
            x_scale="jac",
        )
        return SearchResult(solution.x, np.asarray(solution.jac), solution.fun)

    return search
