"""Decide whether an identification corrects the lateness of link-side torque and of the logged dq.

The log alone determines the lateness of dq relative to q (r2s/recordings/lateness.py); the lateness of torque needs a
fit. If an arm filters torque and dq alike, both are equally late and need no correction, because inertial torque and
friction then refer to the same time. Correcting only dq would increase the error. On a physical Panda, dq is 5.3 ms
late and torque about 2 ± 0.5 ms. Correcting only the Panda's dq raised the error on held-out motion of the training
data; the residual of the fit did not reveal this increase.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from r2s.identification.posterior import posterior
from r2s.identification.problem import FIT_FTOL, FIT_STEPS, Problem, fit_torque
from r2s.identification.residuals.torque_residual import TorqueResidual
from r2s.identification.search.levenberg_marquardt import minimize
from r2s.identification.structure.cross_validation import RATE_HZ, CrossValidation, clearly_worse
from r2s.recordings.lateness import LATE_S, lateness

DELAY = "signal_delay"
# a delay above this many standard deviations is clear; 3 plus a third, as model error made 95 % intervals cover 85 %
SURE = 4.0
UNCLEAR = 2.0  # largest plausible delay minus estimated delay, in standard deviations
BLOCKS = 4  # held-out blocks per fold; with several blocks, held-out and fitted motion have similar speeds


def late_signals(cv: CrossValidation, terms: Sequence[str]) -> dict[str, bool]:
    """Return {"delayed": whether to estimate the delay of torque, "alike": whether torque and dq are equally late}.

    If dq is on time or has an unknown lateness, r2s estimates the delay of torque, because a delay fixed at 0 would
    have no uncertainty. r2s fixes this delay only if it is clearly below LATE_S. If dq is late, r2s first fits torque
    with corrected dq. If this fit shows a clear delay of torque, r2s corrects both torque and dq; otherwise, r2s
    corrects only dq. If correcting only dq hardly lowers the error of held-out torque (by one standard error or
    less), r2s treats torque and dq as equally late. With fewer than 2 folds, r2s skips this comparison.
    """
    on_time = not np.nan_to_num(lateness(cv.recording, cv.cutoff_hz).sure).any()
    if DELAY in terms:
        late, sigma = torque_delay(cv, terms)
        delayed = late + UNCLEAR * sigma > LATE_S if on_time else late > max(SURE * sigma, LATE_S)
        if delayed:
            return {"delayed": True, "alike": False}
    if cv.folds < 2 or on_time:
        return {"delayed": False, "alike": False}
    squares, rest = [], [term for term in terms if term != DELAY]
    for alike in (True, False):
        space = cv.space(rest, replace(cv.nominal, late_alike=alike))
        squares.append(np.concatenate([fold.score(space, cv.prior) for fold in cv.split(space, blocks=BLOCKS)]))
        row = {"search": "lateness", "evaluations": 0, "cost": float(squares[-1].mean())}
        cv.report(row | {"done": len(squares), "total": 2})
    logged, corrected = (square / squares[0].mean(0) for square in squares)  # joints have equal weight
    return {"delayed": False, "alike": not clearly_worse((logged - corrected).sum(1))}


def torque_delay(cv: CrossValidation, terms: Sequence[str]) -> tuple[float, float]:
    """Fit `terms`, which include the delay of torque; return the delay's absolute value and standard deviation, s."""
    space = cv.space(terms)
    recording = cv.recording if cv.recording.period else cv.recording.in_phase()  # repetitions share blocks
    data = TorqueResidual(space, recording, cutoff_hz=cv.cutoff_hz, rate_hz=RATE_HZ)
    u, problem = fit_torque(Problem.of(data, data, cv.prior))
    problem = problem.reweighted(u, fitted=True)
    u = minimize(problem.residual, problem.linearize, u, FIT_STEPS, FIT_FTOL)
    (at,) = space.where(DELAY)
    sigma = posterior(problem, u, seed=0).steps.std(0)[at]
    return float(np.abs(space.from_unit(u)[at])), float(sigma * space.width[at])
