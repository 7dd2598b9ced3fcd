"""Solve bounded least squares on the unit cube by Levenberg-Marquardt, with several damping factors tried in a batch.

scipy's trust-region solver would be slower, because it tries one step at a time. At every step, it decomposes the
whole Jacobian (14,000 rows, 110 columns) by SVD, which takes longer than the simulation.
"""

import time
from collections.abc import Callable, Iterable

import numpy as np

DAMPING = 1e-3  # first damping factor, relative to the diagonal of J^T J (Marquardt's scaling)
LEAST_DAMPING, MOST_DAMPING = 1e-9, 1e6  # at the lower limit, a step is Gauss-Newton; at the upper limit, almost 0
TRIALS = np.array([1e-2, 1e-1, 1.0, 10.0])  # damping factors tried at once, relative to the last successful factor
RETRIES = 3  # batches of trials per Jacobian


def minimize(
    residual: Callable[[np.ndarray], np.ndarray],
    linearize: Callable[[np.ndarray], Iterable[tuple[np.ndarray, np.ndarray]]],
    start: np.ndarray,
    max_evaluations: int,
    ftol: float,
    minutes: float = np.inf,
    report: Callable[[dict], None] = lambda row: None,
    name: str = "least_squares",
) -> np.ndarray:
    """Return a local minimum u (P,) of the sum of squares in the unit cube, near `start` (P,).

    Args:
        residual: maps (C, P) to (C, R). linearize: maps (P,) to parts of residual (r,) and Jacobian (r, P).
        start, max_evaluations, ftol, minutes: see least_squares.py. name: name of this search for `report`.
        report: function that receives a row of progress after every step.
    """
    u, damping, began = np.clip(start, 0.0, 1.0), DAMPING, time.perf_counter()
    r = residual(u[None])[0]
    cost, tried = float(r @ r), 1
    for k in range(max_evaluations):
        gradient, hessian = normal_equations(linearize(u))
        tried += len(u) + 1
        free = ~(((u <= 0.0) & (gradient > 0.0)) | ((u >= 1.0) & (gradient < 0.0)))
        before = cost
        for _ in range(RETRIES):
            trials = np.stack([_step(u, gradient, hessian, free, f * damping) for f in TRIALS])
            rows = residual(trials)
            costs = (rows**2).sum(1)
            tried += len(trials)
            best = int(costs.argmin())
            if costs[best] < cost:
                u, r, cost, damping = trials[best], rows[best], float(costs[best]), TRIALS[best] * damping
                break
            damping *= 100.0 * TRIALS[-1]
        damping = min(max(damping, LEAST_DAMPING), MOST_DAMPING)
        report({"search": name, "evaluations": tried, "cost": cost, "done": k + 1, "total": max_evaluations})
        if before - cost < ftol * before or time.perf_counter() - began > 60 * minutes:
            break
    return u


def normal_equations(parts: Iterable[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    """Return the sums of J^T r (P,) and J^T J (P, P) over all `parts` (residual r, Jacobian J)."""
    gradient, hessian = 0.0, 0.0
    for r, j in parts:
        gradient, hessian = gradient + j.T @ r, hessian + j.T @ j
    return gradient, hessian  # type: ignore[return-value]


def _step(u: np.ndarray, gradient: np.ndarray, hessian: np.ndarray, free: np.ndarray, damping: float) -> np.ndarray:
    """Take a damped Gauss-Newton step from u (P,) in the `free` coordinates; return u clipped to the unit cube."""
    h = hessian[np.ix_(free, free)]
    diagonal = np.diag(h)
    h = h + np.diag(damping * diagonal + 1e-12 * max(diagonal.max(initial=0.0), 1e-30))
    out = u.copy()
    out[free] -= np.linalg.solve(h, gradient[free])
    return np.clip(out, 0.0, 1.0)
