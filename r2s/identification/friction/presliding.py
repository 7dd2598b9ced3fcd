"""Estimate the presliding distance, over which the bristles of friction with memory bend after a reversal.

The torque residual omits samples at which bristles bend. Replays of short windows include reversals, after which
bristles bend, so replays determine the presliding distance. The torque fit determines all other parameters.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike

from r2s.identification.parameters import ParameterSpace, parameter_space
from r2s.identification.posterior import posterior
from r2s.identification.problem import Problem, Report
from r2s.identification.residuals.replay_residual import ReplayResidual
from r2s.identification.residuals.torque_residual import TorqueResidual
from r2s.identification.residuals.windows import cut_windows
from r2s.identification.search.least_squares import LeastSquares
from r2s.physics.dynamics import Dynamics
from r2s.recordings.recording import Recording

NAME = "presliding"  # the parameter
WINDOW_S, STRIDE = 0.2, 5  # s; ms; for the replays, because friction reverses within about 50 ms
# reweighted fits; per fit, most steps and least relative gain. A first fit with weights from the residual would give
# little weight to reversals if the true distance is several times the nominal one
ROUNDS, STEPS, FTOL = 2, 4, 1e-3
MIN_SIGMA = 1e-3  # lower limit of the logarithm's standard deviation


def estimate_presliding(
    dynamics: Dynamics,
    recording: Recording,
    torque_data: TorqueResidual,
    bounds: Mapping[str, Sequence[ArrayLike]],
    prior: Mapping[str, ArrayLike],
    *,
    report: Report,
    seed: int,
    nthread: int,
) -> dict[str, np.ndarray]:
    """Return {"presliding": (n,) rad, "sigma": (n,) standard deviation of its logarithm}, estimated from replays.

    Args:
        dynamics: dynamics of the arm fitted to torque. torque_data: torque residual that `dynamics` minimizes.
        bounds, prior: bounds and prior of all parameters; only those of the presliding distance are used.
        seed: seed of the random draws from the posterior.
    """
    robot = torque_data.space.robot
    space = parameter_space(robot, dynamics, {NAME: bounds[NAME]})
    windows = cut_windows(recording, WINDOW_S)
    data = ReplayResidual(space, recording, windows, stride=STRIDE, batch=robot.n + 1, nthread=nthread)
    problem = Problem.of(data, torque_data.on(space), prior)
    u, search = problem.start, LeastSquares(max_evaluations=STEPS, ftol=FTOL)
    for _ in range(ROUNDS):
        u = search(problem, u, report)
        problem = problem.reweighted(u, fitted=True)
    steps = posterior(problem, u, seed).steps
    return {NAME: space.from_unit(u), "sigma": steps.std(0) * space.width}


class Presliding:
    """Residual of the log presliding distance about the result of `estimate_presliding`, in standard deviations."""

    def __init__(self, presliding: np.ndarray, sigma: np.ndarray):
        self._value, self._sigma = np.log(presliding), np.maximum(sigma, MIN_SIGMA)

    def residual(self, space: ParameterSpace, x: np.ndarray) -> np.ndarray:
        """Return the residual (C, n) of candidates x (C, P)."""
        return (np.log(space.block(x, NAME)) - self._value) / self._sigma
