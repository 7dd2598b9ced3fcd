"""Select the friction family with the fewest parameters that predicts held-out torque best or nearly best."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from r2s.errors import UserError
from r2s.identification.structure.cross_validation import CrossValidation, clearly_worse, per_joint
from r2s.physics.dynamics import with_family
from r2s.physics.friction import COULOMB, FAMILIES, STRIBECK, Family

# In windows of motion, r2s selects Stribeck friction only if the torque error of Coulomb friction is more than this
# multiple of its own. On simulated arms, the multiple was 1.00 to 1.20 with Coulomb friction, 1.86 to 6.8 with
# Stribeck friction (independent_arms.py, seeds 1 to 31).
CLOSE = 1.45


def compare_families(cv: CrossValidation, terms: Sequence[str], slowest: float = 0.0) -> dict[str, Any]:
    """Return {"error": (F,) held-out torque error relative to the least one, "best": index} for F friction families.

    r2s selects a family with more parameters only if it predicts torque clearly better. Rows of slow motion show
    whether friction falls with velocity, but the low-pass mixes friction at rest into these rows. If `slowest` > 0
    (rad/s) and the best family has no memory, r2s therefore compares the families without memory again. The second
    comparison uses windows in which a joint is faster than `slowest` (modulating_functions.py), and CLOSE. Its
    results replace those of the first comparison. Each comparison divides the errors by the least one.

    Raises:
        UserError: the recording is too short to hold out motion.
    """
    found = _compare(cv, FAMILIES, terms)  # FAMILIES are in order of their number of parameters
    if found is None:
        raise UserError("friction.family=auto: the recording is too short for held-out motion; name a family")
    error, best = found
    if slowest and not FAMILIES[best].has_memory:
        plain = [k for k, family in enumerate(FAMILIES) if not family.has_memory]
        again = _compare(cv, [FAMILIES[k] for k in plain], terms, slowest)
        if again is not None:
            error[plain], best = again[0], plain[again[1]]
    return {"error": error, "best": best}


def _compare(
    cv: CrossValidation, families: Sequence[Family], terms: Sequence[str], slowest: float = 0.0
) -> tuple[np.ndarray, int] | None:
    """Return families' torque errors (F,) relative to the least, and the chosen index; None without held-out data."""
    spaces = [cv.space(terms, with_family(cv.nominal, f.name)) for f in families]
    scores: list[list[np.ndarray]] = [[] for _ in spaces]
    for k, fold in enumerate(cv.split(spaces[0], slowest=slowest)):
        for own, space in zip(scores, spaces, strict=True):
            own.append(fold.score(space, cv.prior))
        cost = min(float(np.concatenate(own).mean()) for own in scores)
        cv.report({"search": "family", "evaluations": 0, "cost": cost, "done": k + 1, "total": cv.folds})
    means = [np.concatenate(own) for own in scores]  # (blocks, n) of each family
    alike = per_joint(np.min([m.mean(0) for m in means], axis=0))
    if not alike.any():
        return None
    return simplest(families, np.array([m @ alike for m in means]), CLOSE if slowest else 1.0)


def simplest(families: Sequence[Family], squares: np.ndarray, close: float) -> tuple[np.ndarray, int]:
    """Return torque errors (F,) relative to the least, and the index of the simplest family that is good enough.

    The simplest family is the first one whose squared error is not clearly above that of the best family. If
    Stribeck friction is best, but the error of Coulomb friction is at most `close` times as large, the best family
    is Coulomb friction.

    Args:
        families: F friction families, in order of their number of parameters.
        squares: (F, blocks), squared errors of held-out torque.
        close: at least 1.
    """
    mean = squares.mean(1)
    error, best = np.sqrt(mean / mean.min()), int(mean.argmin())
    if families[best] is STRIBECK and COULOMB in families and error[families.index(COULOMB)] <= close:
        best = families.index(COULOMB)
    return error, next(k for k, s in enumerate(squares) if not clearly_worse(s - squares[best]))
