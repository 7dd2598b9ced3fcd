"""Friction family, chosen by the prediction of held-out torque."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from r2s.identification.structure.cross_validation import CrossValidation, clearly_worse
from r2s.physics.dynamics import with_family
from r2s.physics.friction import FAMILIES, Family

CLOSE = 1.05  # error over the least one; Stribeck arms show ratios of 1.2 and more on rows of slow sliding


def compare_families(cv: CrossValidation, terms: Sequence[str], slowest: float = 0.0) -> dict[str, Any]:
    """Return {"error": (F,) relative to the least, "best": index}: error of held-out torque by friction family.

    A family with more parameters has to predict clearly better. Slow sliding shows whether friction falls with
    velocity, but a filter spreads stops and reversals over slow rows, and no family explains those. So with
    `slowest`, rad/s, a richer family that is CLOSE is compared again on windows of faster sliding
    (modulating_functions.py), which give "error". Families with memory need other windows: no second comparison.
    """
    error, best = _compare(cv, FAMILIES, terms, 0.0)  # FAMILIES are in order of their number of parameters
    richer = [k for k in range(best + 1, len(FAMILIES)) if error[k] <= CLOSE and not FAMILIES[k].has_memory]
    if slowest and richer and not FAMILIES[best].has_memory:
        close = [best, *richer]
        error[close], chosen = _compare(cv, [FAMILIES[k] for k in close], terms, slowest)
        best = close[chosen] if error[best] > CLOSE else best
    return {"error": error, "best": best}


def _compare(
    cv: CrossValidation, families: Sequence[Family], terms: Sequence[str], slowest: float
) -> tuple[np.ndarray, int]:
    """Return the error (F,) relative to the least, and the first family that is not clearly worse than that."""
    spaces = [cv.space(terms, with_family(cv.nominal, f.name)) for f in families]
    scores: list[list[np.ndarray]] = [[] for _ in spaces]
    for k, fold in enumerate(cv.split(spaces[0], slowest=slowest)):
        for own, space in zip(scores, spaces, strict=True):
            own.append(fold.score(space, cv.prior))
        cost = min(float(np.concatenate(own).mean()) for own in scores)
        cv.report({"search": "family", "evaluations": 0, "cost": cost, "done": k + 1, "total": cv.folds})
    means = [np.concatenate(own) for own in scores]  # (blocks, n) of each family
    squares = [(m / means[0].mean(0)).sum(1) for m in means]  # joints count alike
    mean = np.array([s.mean() for s in squares])
    least = squares[int(mean.argmin())]
    best = next(k for k, s in enumerate(squares) if not clearly_worse(s - least))
    return np.sqrt(mean / mean.min()), best
