"""Over what distance friction turns: how soft the bristles are of a friction that has a memory.

Rows on the level of torque wait until bristles are bent, and see nothing of how they bend. Replays of short windows
see it each time that a joint turns, so with everything else as the level of torque has it they say this one value.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike

from r2s.identification.parameters import ParameterSpace, parameter_space
from r2s.identification.problem import Problem, Report
from r2s.identification.replay_residual import ReplayResidual
from r2s.identification.search.least_squares import LeastSquares
from r2s.identification.torque_residual import TorqueResidual
from r2s.identification.uncertainty import posterior
from r2s.physics.dynamics import Dynamics
from r2s.physics.robot import Robot
from r2s.recordings.recording import Recording

NAME = "presliding"  # of the parameter
WINDOW_S, STRIDE = 0.2, 5  # of the replays: a joint turns within some 50 ms
ROUNDS, STEPS = 2, 4  # fits with weights from what the one before left, and steps of each


def bending(
    robot: Robot,
    dynamics: Dynamics,
    recording: Recording,
    quick: TorqueResidual,
    bounds: Mapping[str, Sequence[ArrayLike]],
    prior: Mapping[str, ArrayLike],
    report: Report,
    *,
    seed: int,
    nthread: int,
) -> dict[str, np.ndarray]:
    """Return {"presliding": (n,) rad that replays ask for, "sigma": (n,) standard deviation of its logarithm}.

    Args:
        dynamics: everything else. quick: on the level of torque. bounds, prior: of presliding, as of all others.
        seed: of draws of the joint distribution.
    """
    space = parameter_space(robot, dynamics, {NAME: bounds[NAME]})
    data = ReplayResidual(
        robot, space, recording, window_s=WINDOW_S, stride=STRIDE, batch=robot.n + 1, nthread=nthread
    )
    problem = Problem(data, quick.on(space), prior)
    u, search = problem.start, LeastSquares(max_evaluations=STEPS, ftol=1e-3)
    for _ in range(ROUNDS):
        u = search(problem, u, report)
        problem.adapt(u, fitted=True)
    steps = posterior(problem, u, seed).steps
    return {NAME: space.from_unit(u), "sigma": steps.std(0) * space.spread}


class Bending:
    """What `bending` said, as rows of a fit: the logarithm of presliding, in standard deviations."""

    def __init__(self, presliding: np.ndarray, sigma: np.ndarray):
        self._value, self._sigma = np.log(presliding), np.maximum(sigma, 1e-3)

    def residual(self, space: ParameterSpace, x: np.ndarray) -> np.ndarray:
        """Return (C, n) for x (C, P)."""
        return (np.log(space.block(x, NAME)) - self._value) / self._sigma
