"""Which terms are needed, of those that others may stand in for: without them motion left out is predicted worse.

Gravity pulls at links and at what the hand carries alike. Few numbers that explain it generalise better than many: an
arm whose published links are right needs a payload alone, one without a payload needs its links.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from r2s.identification.family_selection import FAMILY_HZ, left_out
from r2s.identification.problem import Problem, Report, fit_torque, searched
from r2s.identification.problem import parts as parts_of
from r2s.identification.torque_residual import TorqueResidual
from r2s.physics.dynamics import Dynamics
from r2s.physics.robot import Robot
from r2s.recordings.recording import Recording


def needed(
    robot: Robot,
    nominal: Dynamics,
    recording: Recording,
    bounds: Mapping[str, Sequence[ArrayLike]],
    prior: Mapping[str, ArrayLike],
    terms: Sequence[str],
    spare: Sequence[str],
    folds: int,
    how: Mapping[str, Any],
    report: Report,
) -> list[str]:
    """Return `terms` without those of `spare` that motion left out does not need.

    The one of most numbers is left out first, for good if the rest predicts not clearly worse than the best seen: by
    no more than one standard error of the difference over blocks of half a second (Breiman et al. 1984, the
    one-standard-error rule).
    """
    how = dict(how) | {"rate_hz": FAMILY_HZ}
    base = searched(robot, nominal, bounds, terms, recording)
    pairs = [[TorqueResidual(robot, base, part, **how) for part in pair] for pair in left_out(recording, folds)]
    done = 0

    def errors(some: Sequence[str]) -> np.ndarray:
        """Return (blocks, n) mean squares of motion left out."""
        nonlocal done
        space, out = searched(robot, nominal, bounds, some, recording), []
        for fit, test in pairs:
            own = fit.on(space)
            x = space.from_unit(fit_torque(Problem(own, own, prior)))
            error, window = test.on(space).error(x[None])[0] ** 2, test.clusters[:: robot.n]
            out.append(np.stack([error[window == w].mean(0) for w in np.unique(window)]))
        done, squares = done + 1, np.concatenate(out)
        row = {"search": "terms", "evaluations": 0, "cost": float(squares.mean())}
        report(row | {"done": done, "total": 1 + len(spare)})
        return squares

    kept, whole = list(terms), errors(terms)
    best = whole / whole.mean(0)  # joints count alike
    for name in sorted(spare, key=lambda term: -sum(base.size(block) for block in parts_of(term))):
        some = [term for term in kept if term != name]
        trial = errors(some) / whole.mean(0)
        more = (trial - best).sum(1)
        if more.mean() <= more.std() / np.sqrt(len(more)):
            kept, best = some, min(best, trial, key=np.mean)
    return kept
