"""Forward selection: add terms that clearly improve the prediction of held-out torque.

Terms are correlated, such as offset with cable drag, or mass with center of mass. A superfluous term therefore
distorts the fitted values of correlated terms, so forward selection adds only terms that improve the prediction.
"""

from collections.abc import Callable, Sequence

import numpy as np

from r2s.identification.parameters import parameter_space
from r2s.identification.problem import Problem, fit_torque, implicit_friction
from r2s.identification.structure.cross_validation import CrossValidation, Fold, per_joint
from r2s.identification.terms import blocks_of, scaled_bounds
from r2s.physics.actuation import EARLY
from r2s.physics.robot import SIM_DT

BLOCKS = 4  # held-out blocks per fold; with several blocks, held-out and fitted motion have similar speeds
CLEARLY = 2.0  # least mean improvement in standard errors, about 95 % confidence


def select_terms(
    cv: CrossValidation, terms: Sequence[str], candidates: Sequence[str], slowest: float
) -> dict[str, list[bool]]:
    """Return {"entered": list of bool}: whether forward selection adds each of the `candidates` to `terms`.

    Each round considers the candidates that lower the mean error over half-second blocks by more than CLEARLY
    standard errors, and adds the one with the smallest error. Without such a candidate, the selection ends. Each fold
    is fitted once without candidates. One Gauss-Newton step from this fit then evaluates a set of candidates, because
    torque is linear in most parameters.
    """
    space, folds = cv.space(terms), []
    for k, fold in enumerate(cv.split(space, blocks=BLOCKS, slowest=slowest)):
        folds.append(_LinearizedFold(cv, fold, candidates))
        cost = float(np.mean(folds[-1].squares([])))
        cv.report({"search": "terms", "evaluations": 0, "cost": cost, "done": k + 1, "total": cv.folds})
    alike = per_joint(np.mean(np.concatenate([f.squares([]) for f in folds]), axis=0))

    def score(chosen: Sequence[str]) -> np.ndarray:
        """Return the squared error (blocks,) of a model with the `chosen` candidates; joints have equal weight."""
        return np.concatenate([f.squares(chosen) for f in folds]) @ alike

    chosen = forward_selection(score, candidates)
    return {"entered": [name in chosen for name in candidates]}


def forward_selection(score: Callable[[Sequence[str]], np.ndarray], candidates: Sequence[str]) -> list[str]:
    """Return the selected candidates, in the order of their selection; see `select_terms`.

    score: function that maps a set of candidates to squared errors (blocks,).
    """
    chosen: list[str] = []
    best = score(chosen)
    while left := [name for name in candidates if name not in chosen]:
        trials = {name: score([*chosen, name]) for name in left}
        clear = [name for name in left if _clearly_better(best - trials[name])]
        if not clear:
            break
        chosen.append(min(clear, key=lambda name: trials[name].mean()))
        best = trials[chosen[-1]]
    return chosen


def _clearly_better(less: np.ndarray) -> bool:
    """Return whether the mean of the error's decrease `less` (blocks,) exceeds CLEARLY standard errors."""
    # without held-out rows, both sides are 0
    return bool(less.mean() > CLEARLY * less.std() / np.sqrt(len(less)))


class _LinearizedFold:
    """Fitted and held-out errors of one fold, linearized in the parameters of the model and of all candidates."""

    def __init__(self, cv: CrossValidation, fold: Fold, candidates: Sequence[str]):
        fit, test = fold
        space = fit.space
        u, problem = fit_torque(Problem.of(fit, fit, cv.prior))
        if fit.commanded and implicit_friction(problem, u, 0.0):
            # a simulator's implicit friction would otherwise look like additional rotor inertia
            test = test.with_lead(EARLY * SIM_DT)
            u, problem = fit_torque(problem.with_torque_data(problem.torque_data.with_lead(EARLY * SIM_DT)))
        problem = problem.reweighted(u, fitted=True)
        fit = problem.torque_data
        names = [block for name in candidates for block in blocks_of(name)]
        found = space.dynamics(space.from_unit(u))
        bounds = scaled_bounds(cv.bounds, space.robot, cv.recording)
        more = parameter_space(space.robot, found, {name: bounds[name] for name in names})
        fit_more = fit.on(more).weighted_like(fit)
        wide = Problem.of(fit_more, fit_more, cv.prior)
        at_test = test.on(space).weighted_like(fit), test.on(more).weighted_like(fit)
        self._own = len(u)
        self._where = {name: [more.where(block) for block in blocks_of(name)] for name in candidates}
        r, own = (np.concatenate(x) for x in zip(*problem.linearize(u), strict=True))
        rows = len(fit.clusters)
        more_rows = np.concatenate([fit_more.jacobian(wide.start), np.zeros((len(r) - rows, len(wide.start)))])
        j = np.concatenate([own, more_rows], 1)
        prior = np.diag(np.concatenate([np.zeros(len(u)), wide.weight]) ** 2)
        self._hessian, self._gradient = j.T @ j + prior, j.T @ r
        self._change = np.concatenate([at_test[0].jacobian(u), at_test[1].jacobian(wide.start)], 1)
        self._left = at_test[0](space.from_unit(u)[None])[0]
        self._joints, self._block = space.n, np.repeat(test.half_second, space.n)

    def squares(self, chosen: Sequence[str]) -> np.ndarray:
        """Return the sum of squared errors (blocks, n) of held-out torque with the `chosen` candidate terms."""
        free = np.concatenate([np.arange(self._own), *(self._own + w for name in chosen for w in self._where[name])])
        step = -np.linalg.solve(self._hessian[np.ix_(free, free)], self._gradient[free])
        r = self._left + self._change[:, free] @ step
        out = np.zeros((self._block.max() + 1, self._joints))
        np.add.at(out, (self._block, np.tile(np.arange(self._joints), len(r) // self._joints)), r**2)
        return out
