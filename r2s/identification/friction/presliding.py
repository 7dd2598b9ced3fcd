"""Estimate the presliding distance, over which bristles bend after a joint has reversed its direction.

The torque residual omits samples at which bristles bend, so the torque fit determines all parameters except the
presliding distance. r2s estimates this distance from replays of short windows, which include reversals. But reversals
also contain information on other parameters; for example, only reversals separate offset from asymmetry. The last
steps of the search therefore vary the parameters in WITH and the presliding distance together. r2s uses only the
resulting distance.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from r2s.identification.known import Known, block_of
from r2s.identification.parameters import ParameterSpace, parameter_space
from r2s.identification.posterior import inside_cube, posterior
from r2s.identification.problem import Problem, Report
from r2s.identification.residuals.replay_residual import ReplayResidual
from r2s.identification.residuals.torque_residual import TorqueResidual
from r2s.identification.residuals.windows import cut_windows
from r2s.identification.search.least_squares import LeastSquares
from r2s.identification.search.levenberg_marquardt import normal_equations
from r2s.physics.dynamics import Dynamics
from r2s.recordings.recording import Recording

NAME = "presliding"  # the parameter
WINDOW_S, STRIDE = 0.2, 5  # length (s) and averaging time (ms) of replays; friction reverses within about 50 ms
TRIED = 9  # number of log-spaced distances; within the usual bounds, neighbors differ by a factor of 1.8
STEPS, FTOL = 4, 1e-2  # search for the distance alone: most steps; relative decrease of cost below which it ends
JOINT_STEPS, SMALL = 4, 0.05  # search that also varies WITH: most steps; relative change of the distance that ends it
# parameters whose errors change the estimated distance; viscous friction, inertia and delay change it by 1 % or less
WITH = ("coulomb", "asymmetry", "rise", "offset")
# Least sigma of the log distance. A window's first bristle state comes from smoothed velocity. In tests, estimates of
# known distances therefore erred by up to 1.5 %, although all other parameters had their true values.
MIN_SIGMA = 0.02
RIDGE = 1e-6  # information added to every value on the unit cube, because a distance may have neither prior nor data


def estimate_presliding(
    dynamics: Dynamics,
    recording: Recording,
    torque_data: TorqueResidual,
    known: Known,
    prior: Mapping[str, ArrayLike],
    seed: int,
    nthread: int,
    report: Report,
) -> dict[str, np.ndarray]:
    """Return {"presliding": (n,) rad, "sigma": (n,) standard deviation of the log distance}, estimated from replays.

    Args:
        dynamics: dynamics of the arm fitted to torque. torque_data: torque residual that `dynamics` minimizes.
        known: posterior of the torque fit, used here as the prior of the parameters in WITH.
        prior: prior of all parameters; only the prior of the presliding distance is used.
        seed: seed of the random draws from the posterior. nthread: threads of the physics. report: see `identify`.
    """
    windows = cut_windows(recording, WINDOW_S)
    space = _part(torque_data.space, dynamics, (NAME,))
    data = ReplayResidual(space, recording, windows, stride=STRIDE, batch=space.n + 1, nthread=nthread)
    u = nearest_distance(data)
    problem = Problem.of(data, torque_data.on(space), prior).reweighted(u, fitted=True)
    u = LeastSquares(max_evaluations=STEPS, ftol=FTOL)(problem, u, report)
    data = problem.reweighted(u, fitted=True).data  # type: ignore[assignment]
    names = tuple(name for name in WITH if name in torque_data.space.blocks)
    both = _part(torque_data.space, space.dynamics(space.from_unit(u)), (NAME, *names))
    known = known.where(lambda value: block_of(value) in names)
    if NAME in prior:
        sigma = np.broadcast_to(prior[NAME], space.n)
        known = known.beside(Known(tuple(space.names), np.log(space.start), np.diag(sigma**2), 0.0 * sigma))
    problem = Problem.of(data.on(both), torque_data.on(both), {}, [known])
    at, u = both.where(NAME), problem.start
    for _ in range(JOINT_STEPS):
        step = GaussNewton.at(problem, u)
        change, u = np.abs((step.end - u)[at] * both.width[at]).max(), step.end
        if change <= SMALL:
            break
    steps = posterior(step, step.end, seed).steps[:, at]
    return {NAME: both.from_unit(step.end)[at], "sigma": steps.std(0) * both.width[at]}


def nearest_distance(data: ReplayResidual) -> np.ndarray:
    """Simulate TRIED presliding distances, each in all joints; return the joints' best (n,) on the unit cube.

    If a search started at a distance several times too small, the residual's weights would suppress all reversals.
    """
    u = np.tile(np.linspace(0.0, 1.0, TRIED)[:, None], data.space.n)
    cost = (data(data.space.from_unit(u)) ** 2).reshape(TRIED, -1, data.space.n).sum(1)
    return u[cost.argmin(0), range(data.space.n)]


@dataclass(frozen=True)
class GaussNewton:
    """A Gauss-Newton step from `start` (P,) to `end` (P,); `parts`: residual and Jacobian at `start`.

    `linearize` extrapolates the residual linearly from `start`, so that `posterior` needs no further replays.
    """

    start: np.ndarray
    end: np.ndarray
    parts: list[tuple[np.ndarray, np.ndarray]]
    clusters: np.ndarray

    @staticmethod
    def at(problem: Problem, u: np.ndarray) -> "GaussNewton":
        """Linearize the problem at u (P,); `end` is inside the unit cube, or u if the step would raise the cost."""
        parts = list(problem.linearize(u))
        gradient, hessian = normal_equations(parts)
        hessian += RIDGE * np.eye(len(u))
        end = u + inside_cube(u, -np.linalg.solve(hessian, gradient)[None], hessian)[0]
        return GaussNewton(u, end if problem.cost(end) < problem.cost(u) else u, parts, problem.clusters)

    def linearize(self, u: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Yield residual and Jacobian at u (P,), part by part."""
        for r, j in self.parts:
            yield r + j @ (u - self.start), j


def _part(space: ParameterSpace, dynamics: Dynamics, names: Sequence[str]) -> ParameterSpace:
    """Return a space with only the parameters `names`, the bounds of `space` and the nominal values of `dynamics`."""
    at = {name: space.where(name) for name in names}
    bounds = {name: [space.lower[k], space.upper[k]] for name, k in at.items()}
    return replace(parameter_space(space.robot, dynamics, bounds), fixed=space.fixed)


class Presliding:
    """Deviation of the log presliding distance from the result of `estimate_presliding`, in standard deviations."""

    def __init__(self, presliding: np.ndarray, sigma: np.ndarray):
        self._value, self._sigma = np.log(presliding), np.maximum(sigma, MIN_SIGMA)

    def residual(self, space: ParameterSpace, x: np.ndarray) -> np.ndarray:
        """Return the residual (C, n) of candidates x (C, P)."""
        return (np.log(space.block(x, NAME)) - self._value) / self._sigma
