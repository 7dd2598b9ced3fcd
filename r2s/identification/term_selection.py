"""Which terms a model needs beside its own: those without which motion left out is predicted clearly worse.

Terms trade with each other (an offset with cable drag, a mass with a centre), and one that is not there is found all
the same, at the cost of its neighbours. So a term has to earn its place.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from r2s.identification.family_selection import FAMILY_HZ, left_out
from r2s.identification.parameters import ParameterSpace, parameter_space
from r2s.identification.problem import Problem, Report, answers_early, fit_torque, parts
from r2s.identification.torque_residual import TorqueResidual
from r2s.physics.actuation import EARLY
from r2s.physics.robot import SIM_DT
from r2s.recordings.recording import Recording

BLOCKS = 4  # of each fold: what is left out is motion like the rest, fast and slow
CLEARLY = 2.0  # standard errors by which motion left out must be predicted better


def demanded(
    space: ParameterSpace,
    recording: Recording,
    bounds: Mapping[str, Sequence[ArrayLike]],
    prior: Mapping[str, ArrayLike],
    extra: Sequence[str],
    folds: int,
    how: Mapping[str, Any],
    report: Report,
) -> list[str]:
    """Return those of the terms `extra` that motion left out demands beside the blocks of `space`.

    Forward selection: the term that helps most enters if the error falls by more than CLEARLY standard errors of the
    difference over blocks of half a second; then the next. Torque is linear in most of what is searched, so each part
    of the recording is fitted once without extra terms, and each choice of terms is one Gauss-Newton step from there.
    """
    how = dict(how) | {"rate_hz": FAMILY_HZ}
    folds_of = []
    for k, (rest, out) in enumerate(left_out(recording, folds, BLOCKS)):
        folds_of.append(_Fold(space, rest, out, bounds, prior, extra, how))
        cost = float(np.mean(folds_of[-1].squares([])))
        report({"search": "terms", "evaluations": 0, "cost": cost, "done": k + 1, "total": folds})
    usual = np.sqrt(np.mean(np.concatenate([f.squares([]) for f in folds_of]), axis=0))
    chosen: list[str] = []
    best = _per_block(folds_of, chosen, usual)
    while left := [name for name in extra if name not in chosen]:
        trials = [_per_block(folds_of, [*chosen, name], usual) for name in left]
        k = int(np.argmin([t.mean() for t in trials]))
        less = best - trials[k]
        if less.mean() < CLEARLY * less.std() / np.sqrt(len(less)):
            break
        chosen.append(left[k])
        best = trials[k]
    return [name for name in extra if name in chosen]


def _per_block(folds_of: "Sequence[_Fold]", chosen: Sequence[str], usual: np.ndarray) -> np.ndarray:
    """Return (blocks,) the mean square over joints that all count alike."""
    return np.concatenate([f.squares(chosen) for f in folds_of]) @ (1.0 / usual**2)


class _Fold:
    """A fit to a part of a recording, and what each further term would change of it and of what is left out."""

    def __init__(
        self,
        space: ParameterSpace,
        rest: Recording,
        out: Recording,
        bounds: Mapping[str, Sequence[ArrayLike]],
        prior: Mapping[str, ArrayLike],
        extra: Sequence[str],
        how: Mapping[str, Any],
    ):
        fit, test = (TorqueResidual(space.robot, space, part, **how) for part in (rest, out))
        problem = Problem(fit, fit, prior)
        u = fit_torque(problem)
        if fit.commanded and answers_early(problem, u, 0.0):
            # a step that takes friction from its end adds to inertia by how much it rises: that is no rotor
            fit.ahead = test.ahead = EARLY * SIM_DT
            u = fit_torque(problem)
        problem.adapt(u, fitted=True)
        names = [block for name in extra for block in parts(name)]
        found = space.dynamics(space.from_unit(u))
        more = parameter_space(space.robot, found, {name: bounds[name] for name in names})
        wide = Problem(fit.on(more), fit.on(more), prior)
        wide.quick_data.weigh_like(fit)
        at_test = test.on(space), test.on(more)
        for one in at_test:
            one.weigh_like(fit)
        self._own = len(u)
        self._where = {name: [more.where(block) for block in parts(name)] for name in extra}
        rows = len(fit.clusters)
        r = problem.quick(u[None])[0]
        j = np.concatenate([fit.jacobian(u), wide.quick_data.jacobian(wide.start)], 1)
        belief = np.concatenate([problem.weight, wide.weight]) ** 2
        pull = np.concatenate([problem.weight**2 * (u - problem.start), np.zeros(len(wide.start))])
        self._hessian, self._gradient = j.T @ j + np.diag(belief), j.T @ r[:rows] + pull
        self._change = np.concatenate([at_test[0].jacobian(u), at_test[1].jacobian(wide.start)], 1)
        self._left = at_test[0](space.from_unit(u)[None])[0]
        self._joints, self._count = space.n, np.unique(test.clusters, return_inverse=True)[1]

    def squares(self, chosen: Sequence[str]) -> np.ndarray:
        """Return (blocks, n), the sum of squares of what is left out over a block."""
        at = [np.arange(self._own), *(self._own + w for name in chosen for w in self._where[name])]
        free = np.concatenate(at)
        step = -np.linalg.solve(self._hessian[np.ix_(free, free)], self._gradient[free])
        r = self._left + self._change[:, free] @ step
        out = np.zeros((self._count.max() + 1, self._joints))
        np.add.at(out, (self._count, np.tile(np.arange(self._joints), len(r) // self._joints)), r**2)
        return out
