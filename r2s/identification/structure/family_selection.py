"""Select the friction family with the fewest parameters that predicts held-out torque best or nearly best."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from r2s.errors import UserError
from r2s.identification.structure.cross_validation import CrossValidation, clearly_worse, per_joint
from r2s.physics.dynamics import with_family
from r2s.physics.friction import FAMILIES, Family

# r2s selects a simpler family if its torque error in windows of motion is at most this multiple of the least error.
# On simulated arms, the multiple was 1.00 to 1.20 with Coulomb friction, 1.86 to 6.8 with falling friction
# (independent_arms.py, seeds 1 to 31).
CLOSE = 1.45


def compare_families(cv: CrossValidation, terms: Sequence[str], slowest: float = 0.0) -> dict[str, Any]:
    """Return {"error": (F,) held-out torque error relative to the least one, "best": index} for F friction families.

    r2s selects a family with more parameters only if it predicts torque clearly better. Rows of slow motion show
    whether friction falls with velocity, but the low-pass mixes friction at rest into these rows. If `slowest` > 0
    (rad/s) and the best family has no memory, r2s therefore compares the families without memory again. The second
    comparison uses windows in which a joint is faster than `slowest` (modulating_functions.py). Its errors and best
    family replace those of the first; each comparison divides by its least error.

    Raises:
        UserError: the recording is too short to hold out motion.
    """
    found = _compare(cv, FAMILIES, terms)  # FAMILIES are in order of their number of parameters
    if found is None:
        raise UserError("friction.family=auto: the recording is too short for held-out motion; name a family")
    error, best = found
    if slowest and not FAMILIES[best].has_memory:
        plain = [k for k, family in enumerate(FAMILIES) if not family.has_memory]
        again = _compare(cv, [FAMILIES[k] for k in plain], terms, slowest, CLOSE)
        if again is not None:
            error[plain], best = again[0], plain[again[1]]
    return {"error": error, "best": best}


def _compare(
    cv: CrossValidation, families: Sequence[Family], terms: Sequence[str], slowest: float = 0.0, close: float = 1.0
) -> tuple[np.ndarray, int] | None:
    """Return families' torque errors (F,) relative to the least, and the chosen index; None without held-out data.

    r2s selects the first family whose relative error is at most `close` or not clearly above that of the best family.
    """
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
    squares = [m @ alike for m in means]
    mean = np.array([s.mean() for s in squares])
    error, least = np.sqrt(mean / mean.min()), squares[int(mean.argmin())]
    best = next(k for k, s in enumerate(squares) if error[k] <= close or not clearly_worse(s - least))
    return error, best
