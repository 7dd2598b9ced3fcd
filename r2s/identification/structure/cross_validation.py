"""Cross-validate within a recording: hold out blocks of time or, for a repeated motion, blocks of phase."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from r2s.identification.parameters import ParameterSpace
from r2s.identification.problem import Problem, Report, fit_torque
from r2s.identification.residuals.torque_residual import TorqueResidual
from r2s.identification.stated import Stated
from r2s.identification.terms import search_space
from r2s.physics.dynamics import Dynamics
from r2s.physics.robot import Robot
from r2s.recordings.recording import Recording

RATE_HZ = 50.0  # rows per second for comparing model structures: half as many as in a fit
GUARD_S = 0.1  # s, gap between fitted rows and a held-out block, as the low-pass spreads motion over this time


def held_out(recording: Recording, folds: int, blocks: int = 1) -> list[tuple[Recording, Recording]]:
    """Return (fitted part, held-out part) of each fold; a fold holds out `blocks` blocks, with gaps of GUARD_S."""
    period = recording.period or np.inf
    clock = recording.t % period if recording.period else recording.t
    edges = list(pairwise(np.quantile(clock, np.linspace(0, 1, folds * blocks + 1))))
    pairs = []
    for k in range(folds):
        out, near = np.zeros((2, len(clock)), dtype=bool)
        for low, high in edges[k::folds]:
            inside = (clock >= low) & (clock <= high)
            out |= inside
            # distance in phase, which is periodic; without a period this is the distance in time
            near |= inside | ((low - clock) % period < GUARD_S) | ((clock - high) % period < GUARD_S)
        pairs.append((recording.select(~near), recording.select(out)))
    return pairs


class Fold(NamedTuple):
    """Torque residuals of the fitted motion and of the held-out motion in one fold of the cross-validation."""

    fit: TorqueResidual
    test: TorqueResidual

    def score(self, space: ParameterSpace, prior: Mapping[str, ArrayLike]) -> np.ndarray:
        """Fit parameters; return the mean square error (blocks, n) Nm^2 of held-out torque per half-second block."""
        own, test = self.fit.on(space), self.test
        u, _ = fit_torque(Problem.of(own, own, prior))
        square = test.seen * test.error(space.dynamics(space.from_unit(u)[None]).one(0)) ** 2
        block = test.half_second
        sums = [(square[block == b].sum(0), test.seen[block == b].sum(0)) for b in np.unique(block)]
        return np.stack([total / np.maximum(count, 1) for total, count in sums])


@dataclass(frozen=True, eq=False)
class CrossValidation:
    """Data and settings of the cross-validation that selects the friction family and the terms.

    Attributes:
        robot: the arm. nominal: dynamics at which every fit starts.
        recording: training motion.
        bounds, prior: bounds and prior of the parameters, see `search_space` and `Problem.of`.
        folds: number of folds.
        cutoff_hz: cutoff of the zero-phase filter.
        report: function that receives progress rows. stated: the user's values, of which only fixed values are used.
    """

    robot: Robot
    nominal: Dynamics
    recording: Recording
    bounds: Mapping[str, Sequence[ArrayLike]]
    prior: Mapping[str, ArrayLike]
    folds: int
    cutoff_hz: float
    report: Report
    stated: Stated = field(default_factory=dict)

    def space(self, terms: Sequence[str], nominal: Dynamics | None = None) -> ParameterSpace:
        """Return the parameter space of `terms` and of the friction family of `nominal` (default: self.nominal)."""
        return search_space(self.robot, nominal or self.nominal, self.bounds, terms, self.recording, self.stated)

    def split(self, space: ParameterSpace, *, blocks: int = 1, slowest: float = 0.0) -> Iterator[Fold]:
        """Yield all folds. blocks: see `held_out`. slowest: see `TorqueResidual`."""
        for pair in held_out(self.recording, self.folds, blocks):
            fit, test = (
                TorqueResidual(space, part, cutoff_hz=self.cutoff_hz, rate_hz=RATE_HZ, slowest=slowest)
                for part in pair
            )
            yield Fold(fit, test)


def per_joint(squares: np.ndarray) -> np.ndarray:
    """Return the joints' weights (n,) 1 / `squares`, so that all joints contribute equally to a squared error.

    squares: (n,) mean square errors; 0 marks a joint without held-out rows, whose weight is 0.
    """
    return np.divide(1.0, squares, out=np.zeros_like(squares), where=squares > 0)


def clearly_worse(more: np.ndarray) -> bool:
    """Return whether the mean of the error increases `more` (blocks,) exceeds the standard error of this mean.

    The one-standard-error rule is from Breiman et al., Classification and Regression Trees, 1984.
    """
    return bool(more.mean() > more.std() / np.sqrt(len(more)))
