"""What a model predicts of motion that it was not fitted to: to choose one by, and to judge it.

Nothing leaks: what is left out are whole blocks of time, or of phase where a motion repeats itself.
"""

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from r2s.identification.parameters import ParameterSpace
from r2s.identification.problem import Problem, Report, fit_torque, searched
from r2s.identification.torque_residual import TorqueResidual
from r2s.physics.dynamics import Dynamics, of_family
from r2s.physics.friction import FAMILIES, Family
from r2s.physics.robot import Robot
from r2s.recordings.recording import Recording

FAMILY_HZ = 50.0  # rows per second that families are compared on
ALIKE = 1.05  # of the least error: hardly told apart. Where friction falls with speed, slides tell by 1.2 and more
GUARD_S = 0.1  # s, rows this close to a block are nearly its own


def left_out(recording: Recording, folds: int, blocks: int = 1) -> list[tuple[Recording, Recording]]:
    """Return (rest, out) for each of the folds: `blocks` blocks are left out, and GUARD_S about them of the rest.

    Blocks are of time, or of phase where the motion repeats itself.
    """
    period = recording.period or np.inf
    clock = recording.t % period if recording.period else recording.t
    edges = list(pairwise(np.quantile(clock, np.linspace(0, 1, folds * blocks + 1))))
    pairs = []
    for k in range(folds):
        out, near = np.zeros((2, len(clock)), dtype=bool)
        for low, high in edges[k::folds]:
            inside = (clock >= low) & (clock <= high)
            out |= inside
            # on a circle: after the last phase comes phase 0; without a period the way round is infinite
            near |= inside | ((low - clock) % period < GUARD_S) | ((clock - high) % period < GUARD_S)
        pairs.append((recording.select(~near), recording.select(out)))
    return pairs


def compare_families(
    robot: Robot,
    nominal: Dynamics,
    recording: Recording,
    bounds: Mapping[str, Sequence[ArrayLike]],
    prior: Mapping[str, ArrayLike],
    terms: Sequence[str],
    folds: int,
    how: Mapping[str, Any],
    report: Report,
    slowest: float = 0.0,
) -> dict[str, Any]:
    """Return {"error": (F,) relative to the best, "best": index}: torque predicted on motion left out.

    A family with more parameters has to predict clearly better. What tells friction that falls with speed from
    friction that does not are slow slides. A filter spreads the stops and turns about them, and errors there, which
    no family explains, cover the difference. So with `slowest`, rad/s, a family that all rows together hardly tell
    from a simpler one gets a second chance on rows of slides that are faster (sliding_motion.py), and "error" has
    theirs. Bristles have other rows than the others: there all rows decide.
    """

    def compared(families: Sequence[Family], how: Mapping[str, Any]) -> tuple[np.ndarray, int]:
        spaces = [searched(robot, of_family(nominal, f.name), bounds, terms, recording) for f in families]
        return _compared(robot, spaces, recording, prior, folds, dict(how) | {"rate_hz": FAMILY_HZ}, report)

    error, best = compared(FAMILIES, how)  # which are in the order of how many parameters they have
    richer = [k for k in range(best + 1, len(FAMILIES)) if error[k] <= ALIKE and not FAMILIES[k].has_memory]
    if slowest and richer and not FAMILIES[best].has_memory:
        close = [best, *richer]
        error[close], chosen = compared([FAMILIES[k] for k in close], dict(how) | {"slowest": slowest})
        best = close[chosen] if error[best] > ALIKE else best
    return {"error": error, "best": best}


def _compared(
    robot: Robot,
    spaces: Sequence[ParameterSpace],
    recording: Recording,
    prior: Mapping[str, ArrayLike],
    folds: int,
    how: Mapping[str, Any],
    report: Report,
) -> tuple[np.ndarray, int]:
    """Return the error (F,) of each space's family relative to the least, and the first that is as good as that.

    A later one has to be better by more than one standard error of the difference over blocks of half a second
    (Breiman et al. 1984, the one-standard-error rule).
    """
    blocks: list[list[np.ndarray]] = [[] for _ in spaces]
    for k, (rest, out) in enumerate(left_out(recording, folds)):
        fit, test = (TorqueResidual(robot, spaces[0], part, **how) for part in (rest, out))
        window = test.clusters[:: robot.n]
        for left, space in zip(blocks, spaces, strict=True):
            own = fit.on(space)
            u = fit_torque(Problem(own, own, prior))
            error = test.seen * test.on(space).error(space.from_unit(u)[None])[0] ** 2
            each = [(error[window == w].sum(0), test.seen[window == w].sum(0)) for w in np.unique(window)]
            left.append(np.stack([total / np.maximum(count, 1) for total, count in each]))
        cost = min(float(np.concatenate(left).mean()) for left in blocks)
        report({"search": "family", "evaluations": 0, "cost": cost, "done": k + 1, "total": folds})
    means = [np.concatenate(left) for left in blocks]  # (blocks, n) of each family
    squares = [(m / means[0].mean(0)).sum(1) for m in means]
    mean = np.array([s.mean() for s in squares])
    least = int(mean.argmin())
    more = [s - squares[least] for s in squares]
    best = next(k for k, m in enumerate(more) if m.mean() <= m.std() / np.sqrt(len(m)))
    return np.sqrt(mean / mean.min()), best


def joints_kept(
    robot: Robot,
    space: ParameterSpace,
    recording: Recording,
    prior: Mapping[str, ArrayLike],
    folds: int,
    how: Mapping[str, Any],
) -> np.ndarray:
    """Return (n,) bool: joints whose refit does not predict left-out motion at least 5 % better (RMSE).

    Published parameters are a strong start on real arms; a refit has to earn its place.
    """
    squared = np.zeros((2, robot.n))
    for rest, out in left_out(recording, folds):
        fit, test = (TorqueResidual(robot, space, part, **how) for part in (rest, out))
        x = space.from_unit(fit_torque(Problem(fit, fit, prior)))
        squared += (test.error(np.stack([x, space.start])) ** 2).sum(1)
    return squared[0] >= 0.9 * squared[1]
