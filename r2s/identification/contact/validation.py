"""Compare two normal forces in presses: the prediction of an identified surface, and the force from joint torques."""

from dataclasses import dataclass

import numpy as np

from r2s.identification.contact.problem import ContactProblem

PAUSE_S = 1.0  # s; a longer time without contact separates two presses; a single slide may lose contact for less
GUARD_S = 0.2  # s, time added before and after a press, longer than an averaging window
KNOWN = 0.05  # largest standard error of a measured force / largest force (1 N for a press of 20 N)


@dataclass(frozen=True)
class Press:
    """Normal force at M moments at which joints slide: the surface's prediction and the estimate from joint torques.

    Attributes:
        t: (M,) s, time. force: (M,) N, predicted normal force. seen: (M,) N, normal force from joint torques.
        depth, rate: (M,) m, m/s, penetration depth and its derivative.
        error: (M,) N, standard error of the force `seen`. row_s: s, time between two moments.
    """

    t: np.ndarray
    force: np.ndarray
    seen: np.ndarray
    depth: np.ndarray
    rate: np.ndarray
    error: np.ndarray
    row_s: float

    def summary(self) -> dict[str, float]:
        """Return the entry of summary.json: compared time, s, and force RMSE, N (total, in loading, in unloading)."""
        sides = {"loading": 1.0, "unloading": -1.0}
        errors = {f"{name}_force_rmse_N": self.rmse(side) for name, side in sides.items()}
        return {"seconds": len(self.t) * self.row_s, "force_rmse_N": self.rmse(), **errors}

    def rmse(self, side: float = 0.0) -> float:
        """Return the force RMSE, N, for loading (side 1), unloading (-1) or both (0); nan without such moments."""
        some = self.rate * side > 0 if side else np.ones(len(self.t), dtype=bool)
        return float(np.sqrt(np.mean((self.force - self.seen)[some] ** 2))) if some.any() else float("nan")


def presses(problem: ContactProblem, u: np.ndarray) -> list[np.ndarray]:
    """Return one mask (T,) per press on a surface u (U,), in order of time; masks include GUARD_S at both ends."""
    motion = problem.motion
    at = motion.instants[_depth(problem, u) > 0]
    if not len(at):
        return []
    ends = np.flatnonzero(np.diff(at) > PAUSE_S)
    spans = zip(at[np.append(0, ends + 1)], at[np.append(ends, len(at) - 1)], strict=True)
    return [(motion.t > first - GUARD_S) & (motion.t < last + GUARD_S) for first, last in spans]


def press_errors(problem: ContactProblem, u: np.ndarray, parts: list[np.ndarray]) -> Press:
    """Return predicted and measured forces on a surface u (U,) in presses, given one mask per press (`parts`).

    The function assumes that measured and predicted force have the same direction. A weighted least-squares fit to
    the torques of moving joints determines the ratio of the measured to the predicted force.
    """
    motion = problem.motion
    tau, force, depth, rate = problem.contact(u)
    at = np.searchsorted(motion.instants, motion.t - 1e-6).clip(max=len(motion.instants) - 1)
    force, depth, rate, tau = force[at], depth[at], rate[at], motion.filtered(tau)
    error = problem.error + problem.directions @ problem.best_arm(u)
    weight = np.where(problem.rows, 1 / np.where(problem.rows, problem.sigma, 1.0) ** 2, 0.0)
    known = (weight * tau**2).sum(1)
    inside = np.any(parts, axis=0) if parts else np.zeros(len(force), dtype=bool)
    largest = force[inside].max(initial=0.0)
    some = inside & (force > 0) & (force < KNOWN * largest * np.sqrt(known))
    factor = (weight * tau * error).sum(1)[some] / known[some]
    seen, spread = factor * force[some], force[some] / np.sqrt(known[some])
    return Press(motion.t[some], force[some], seen, depth[some], rate[some], spread, problem.torque.row_s)


def _depth(problem: ContactProblem, u: np.ndarray) -> np.ndarray:
    return problem.contact(u)[2]
