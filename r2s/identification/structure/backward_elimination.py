"""Backward elimination: remove a term if the model predicts held-out torque equally well without this term.

Models with fewer parameters generalize better. Gravity torque hardly distinguishes link masses from a payload. An arm
with correct published link parameters needs no link terms; an arm without payload needs no payload term.
"""

from collections.abc import Sequence

import numpy as np

from r2s.identification.structure.cross_validation import CrossValidation, clearly_worse, per_joint
from r2s.identification.terms import blocks_of


def eliminate_terms(cv: CrossValidation, terms: Sequence[str], prunable: Sequence[str]) -> dict[str, list[bool]]:
    """Return {"needed": list of bool}: whether each of `terms` remains; only `prunable` terms can be removed.

    The term with the most parameters is tested first. A term is removed unless the model without this term predicts
    clearly worse than the best model so far.
    """
    base = cv.space(terms)
    folds = list(cv.split(base))
    done = 0

    def score(some: Sequence[str]) -> np.ndarray:
        """Return the mean square error (blocks, n) Nm^2 of held-out torque for a model with the terms in `some`."""
        nonlocal done
        space = cv.space(some)
        squares = np.concatenate([fold.score(space, cv.prior) for fold in folds])
        done += 1
        row = {"search": "terms", "evaluations": 0, "cost": float(squares.mean())}
        cv.report(row | {"done": done, "total": 1 + len(prunable)})
        return squares

    kept, full = list(terms), score(terms)
    alike = per_joint(full.mean(0))
    best = full * alike
    for name in sorted(prunable, key=lambda term: -sum(base.size(block) for block in blocks_of(term))):
        some = [term for term in kept if term != name]
        trial = score(some) * alike
        if not clearly_worse((trial - best).sum(1)):
            kept, best = some, min(best, trial, key=np.mean)
    return {"needed": [name in kept for name in terms]}
