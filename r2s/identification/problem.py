"""The least-squares problem of an identification on the unit cube, and the interface of searches that solve it."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from r2s.identification.parameters import ParameterSpace
from r2s.identification.residuals.replay_residual import ReplayResidual
from r2s.identification.residuals.torque_residual import STEP, TorqueResidual
from r2s.identification.search.levenberg_marquardt import minimize
from r2s.physics.actuation import EARLY
from r2s.physics.robot import SIM_DT

UNIFORM = 12**-0.5  # standard deviation of a uniform distribution over its width
FIXED = 1e-4  # prior sigma of a fixed value, relative to the width of its bounds
# r2s concludes that a minimum is wrong if another minimum lowers a joint's RMS error by more than this factor. In
# trials with the 2- and 3-joint arms of benchmarks/scaling.py, with values drawn from the priors, this factor was 1.9
# to 36 in wrong minima. On a physical Panda, the fit from narrow priors predicts better; the factor is 1.0 to 1.2.
CLEARLY = 2.0
TAIL = 25.0  # Student's t, the prior for link-side torque, has TAIL - 1 degrees of freedom
# effect of implicit friction: least size in standard deviations; range of actual size / expected size
SIGNIFICANT, EXPECTED = 3.0, (0.5, 2.0)
ALIKE = 0.2  # relative uncertainty of the number of independent rows, and therefore of a sum of squares
ROUNDS, MOTOR_ROUNDS = 2, 4  # reweighted fits; more for motor torque, as nominal friction may err by tens of Nm
FIT_STEPS, FIT_FTOL = 12, 1e-3  # most Jacobians in a fit; relative decrease of cost per step below which a fit ends
Report = Callable[[dict], None]


class ExtraResidual(Protocol):
    """Residual rows from sources other than the data: ramps, presliding replays, or prior knowledge (`Known`)."""

    def residual(self, space: ParameterSpace, x: np.ndarray) -> np.ndarray:
        """Return the residual (C, K) in standard deviations: K values for each of the C candidates x (C, P)."""
        ...


@dataclass(frozen=True, eq=False)
class Problem:
    """A least-squares problem on the unit cube, with rows of data, prior and extra residuals in standard deviations.

    Attributes:
        data: the replay residual or the torque residual to minimize.
        torque_data: the torque residual, which a fast first search minimizes; can be the same object as `data`.
        sigma: (P,) prior standard deviation about the nominal value, or about its logarithm for logarithmic
            coordinates; inf means a flat prior.
        extra: further residual rows, see `ExtraResidual`.
    """

    data: ReplayResidual | TorqueResidual
    torque_data: TorqueResidual
    sigma: np.ndarray
    extra: tuple[ExtraResidual, ...] = ()

    @classmethod
    def of(
        cls,
        data: ReplayResidual | TorqueResidual,
        torque_data: TorqueResidual,
        prior: Mapping[str, ArrayLike],
        extra: Sequence[ExtraResidual] = (),
    ) -> "Problem":
        """Return the problem with a prior {"offset": sigma or (n,), ...} in SI units, flat for other parameters."""
        return cls(data, torque_data, data.space.expand(prior, np.inf).astype(float), tuple(extra))

    @property
    def space(self) -> ParameterSpace:
        """The space of the estimated parameters."""
        return self.data.space

    @cached_property
    def start(self) -> np.ndarray:
        """(P,) the nominal values on the unit cube."""
        return self.space.to_unit(self.space.start)

    @property
    def clusters(self) -> np.ndarray:
        """(R,) block of each data row; errors in different blocks are treated as independent."""
        return self.data.clusters

    @property
    def uses_replays(self) -> bool:
        """Whether `data` is a replay residual."""
        return self.data is not self.torque_data

    @property
    def on_torque(self) -> "Problem":
        """The problem with `data` replaced by the torque residual."""
        return replace(self, data=self.torque_data)

    @property
    def at_link(self) -> bool:
        """Whether link-side sensors measured the recorded torque."""
        return not (self.torque_data.commanded or self.torque_data.at_motor)

    @property
    def prior_width(self) -> np.ndarray:
        """(P,) the prior's standard deviation on the unit cube, for comparison with the posterior standard deviation.

        For flat priors, `prior_width` is the standard deviation among arms (`ParameterSpace.usual`). `prior_width` is
        at most UNIFORM, the standard deviation of a uniform distribution over the bounds.
        """
        stated = np.where(np.isinf(self.sigma), self.space.usual, self.sigma)
        return np.minimum(stated / self.space.width, UNIFORM)

    @property
    def weight(self) -> np.ndarray:
        """(P,) derivative of each value's prior residual with respect to the value's coordinate on the unit cube."""
        return self.space.width / self.sigma

    @property
    def is_fixed(self) -> np.ndarray:
        """(P,) whether `fixed` set a value's prior; tested by equality, because a user may set narrower priors."""
        return self.sigma == FIXED * self.space.width

    def fixed(self, at: np.ndarray) -> "Problem":
        """Return the problem with the values at indices `at` fixed at nominal by a very narrow prior."""
        sigma = self.sigma.copy()
        sigma[at] = FIXED * self.space.width[at]
        return replace(self, sigma=sigma)

    def with_usual_prior(self) -> "Problem":
        """Return the problem with priors at least as wide as `ParameterSpace.usual`, except those of fixed values."""
        usual = np.where(np.isinf(self.space.usual), self.sigma, self.space.usual)
        own = np.isinf(self.sigma) | self.is_fixed
        return replace(self, sigma=np.where(own, self.sigma, np.maximum(self.sigma, usual)))

    def without_prior(self, names: Sequence[str]) -> "Problem":
        """Return the problem with flat priors for the values `names`, whose priors are extra residuals."""
        return replace(self, sigma=np.where(np.isin(self.space.names, names), np.inf, self.sigma))

    def with_torque_data(self, torque_data: TorqueResidual) -> "Problem":
        """Return the problem with a new torque residual, which also replaces `data` unless `data` is from replays."""
        return replace(self, data=self.data if self.uses_replays else torque_data, torque_data=torque_data)

    def torque_reweighted(self, u: np.ndarray) -> "Problem":
        """Return the problem with its torque residual reweighted at the solution u (P,) of a torque fit."""
        return self.with_torque_data(self.torque_data.reweighted(self.space.from_unit(u), fitted=True))

    def reweighted(self, u: np.ndarray, fitted: bool) -> "Problem":
        """Return the problem after reweighting its residuals at the unit-cube parameters u (P,).

        See `TorqueResidual.reweighted`.
        """
        x = self.space.from_unit(u)
        out = self.with_torque_data(self.torque_data.reweighted(x, fitted))
        return replace(out, data=self.data.reweighted(x, fitted)) if self.uses_replays else out

    def cost(self, u: np.ndarray) -> float:
        """Return the sum of all squared residuals at the parameters u (P,), scaled to [0, 1]."""
        return float((self.residual(u[None]) ** 2).sum())

    def prior_cost(self, u: np.ndarray) -> float:
        """Return the sum of squares of the prior and extra rows at u (P,)."""
        return float((self._prior(u[None]) ** 2).sum())

    def residual(self, u: np.ndarray) -> np.ndarray:
        """Return residuals (C, R + B), in standard deviations, of u (C, P): data rows, then prior and extra rows."""
        return np.concatenate([self.data(self.space.from_unit(u)), self._prior(u)], axis=1)

    def linearize(self, u: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Yield residual and Jacobian (rows, P) at u (P,) in parts: data rows first, then prior and extra rows."""
        if self.uses_replays:
            yield _differences(self.residual, u)
        else:
            yield from self.torque_data.linearize(u)
            yield self.prior_rows(u)

    def prior_rows(self, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the residual (B,) of prior and extra rows, and the Jacobian (B, P), at u (P,)."""
        return _differences(self._prior, u)

    def prior_information(self, u: np.ndarray) -> np.ndarray:
        """Return the information J^T J (P, P) of the prior and extra rows, whose Jacobian at u (P,) is J."""
        j = self.prior_rows(u)[1]
        return j.T @ j

    def _prior(self, u: np.ndarray) -> np.ndarray:
        prior, x = (u - self.start) * self.weight, self.space.from_unit(u)
        if self.at_link:
            # heavy tails as in Student's t (Lange et al., J. Am. Stat. Assoc. 84(408), 1989): near the nominal value,
            # the prior is normal; far from the nominal value, data outweigh a narrow prior
            heavy = np.sign(prior) * np.sqrt(TAIL * np.log1p(prior**2 / TAIL))
            prior = np.where(self.is_fixed, prior, heavy)
        return np.concatenate([prior, *(extra.residual(self.space, x) for extra in self.extra)], axis=1)


def _differences(residual: Callable[[np.ndarray], np.ndarray], u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a residual (R,) and its Jacobian (R, P) at u (P,) by finite differences towards the cube's center."""
    h = np.where(u > 0.5, -STEP, STEP)
    r = residual(np.concatenate([u[None], u + np.diag(h)]))
    return r[0], ((r[1:] - r[0]) / h[:, None]).T


Solve = Callable[[Problem, np.ndarray], np.ndarray]  # returns the minimum (P,) of a problem near a vector (P,)


class Search(Protocol):
    """A search, which minimizes the sum of squares of `Problem.residual` from `start` (P,).

    After every step or generation, a search calls `report` with {search, evaluations, cost, done, total}. A local
    search (local = True) improves `start`, so a local search can refine the result of an earlier search.
    """

    local: bool

    def __call__(self, problem: Problem, start: np.ndarray, report: Report) -> np.ndarray:
        """Return the solution u (P,) on the unit cube."""
        ...


def fits_torque(search: Search) -> bool:
    """Return whether a search minimizes the torque residual and needs no replays."""
    return getattr(search, "level", "") == "torque"


def fit_torque(problem: Problem) -> tuple[np.ndarray, Problem]:
    """Fit a torque problem, starting at its nominal values; see `reweighted_fit` for the result."""
    rounds = MOTOR_ROUNDS if problem.torque_data.at_motor else ROUNDS

    def solve(own: Problem, u: np.ndarray) -> np.ndarray:
        return minimize(own.residual, own.linearize, u, FIT_STEPS, FIT_FTOL)

    return reweighted_fit(problem, problem.start, rounds, solve)


def reweighted_fit(problem: Problem, start: np.ndarray, rounds: int, solve: Solve) -> tuple[np.ndarray, Problem]:
    """Fit a torque problem `rounds` times; after the first fit, each fit takes weights from the previous solution.

    The first fit starts at `start` (P,). Return the last solution u (P,), and the problem with the last weights.

    If true values are far outside of narrow priors, a fit to link-side torque has several minima. With the first
    weights, which come from the nominal arm, a fit may leave cable torque near zero and distort friction. If `start`
    is nominal, a second fit therefore begins with priors at least as wide as the scatter among arms and ends with the
    problem's priors. r2s uses the second fit if it is more likely than the first and clearly lowers the error of a
    joint. Both conditions are necessary: unmodeled effects may make the second fit more likely, but hardly lower its
    error.
    """
    u, last = _rounds(problem, start, rounds, solve)
    wide = problem.with_usual_prior() if problem.at_link and np.array_equal(start, problem.start) else problem
    if np.array_equal(wide.sigma, problem.sigma):
        return u, last
    v, other = _rounds(wide, start, rounds, solve)
    other = replace(other, sigma=problem.sigma).reweighted(v, fitted=True)
    v, other = _rounds(other, v, rounds, solve)
    return (v, other) if _clearly_likelier(other, v, last, u) else (u, last)


def _rounds(problem: Problem, u: np.ndarray, rounds: int, solve: Solve) -> tuple[np.ndarray, Problem]:
    """Fit `rounds` times as in `reweighted_fit`, first from u (P,); return the last solution and the last problem."""
    for k in range(rounds):
        u = solve(problem, u)
        if k < rounds - 1:
            problem = problem.reweighted(u, fitted=True)
    return u, problem


def _clearly_likelier(one: Problem, u: np.ndarray, other: Problem, v: np.ndarray) -> bool:
    """Return whether u (P,) has a larger posterior density than v (P,), and a clearly smaller error in some joint.

    The two solutions u and v have different torque noise sigma. A joint's log likelihood is -N log sigma, with N
    independent rows and torque noise sigma. Because a wrong model lengthens the correlation of errors, the shorter
    correlation length of the two solutions determines N.
    """
    (length, sigma), (longer, larger) = (
        p.torque_data.noise_at(p.space.from_unit(x)) for p, x in ((one, u), (other, v))
    )
    rows = one.torque_data.seen.sum(0) / np.minimum(length, longer)
    odds = float(rows @ np.log(larger / sigma)) + 0.5 * (other.prior_cost(v) - one.prior_cost(u))
    return odds > 0 and bool((larger > CLEARLY * sigma).any())


def worse_on_torque(problem: Problem, u: np.ndarray, v: np.ndarray) -> bool:
    """Return whether values v (P,) explain the torque clearly worse than values u (P,) that were fitted to torque.

    Even if v is correct, its estimation error raises the sum of squares by about P, the number of values. The sum of
    squares has the relative uncertainty ALIKE, because the number of independent rows is uncertain.
    """
    fitted = problem.on_torque.cost(u)
    rise = problem.on_torque.cost(v) - fitted
    return bool(rise > max(len(u), ALIKE * fitted))


def search_lag(at: np.ndarray, search: Search, problem: Problem, start: np.ndarray, report: Report) -> np.ndarray:
    """Return the solution u (P,) of a local search, with the lag u[at] estimated only if the data require a lag.

    If torque changes slowly, a short lag acts like a delay. The data require a lag if it lowers the cost by more than
    the logarithm of the number of rows (Schwarz, Annals of Statistics 6(2), 1978). The comparison of costs omits the
    block that favors the lag most, because the rows of a block are correlated.
    """
    having, fixed = problem.residual(start[None])[0] ** 2, problem.fixed(at)
    u = start.copy()
    u[at] = problem.start[at]
    u = search(fixed, u, report)
    if fits_torque(search):
        fixed = fixed.torque_reweighted(u)
    u[at] = problem.start[at]  # `reweight` recognizes a fixed lag by equality with the start value
    fixed_squares, rows = fixed.residual(u[None])[0] ** 2, len(problem.clusters)
    most = np.bincount(problem.clusters, (fixed_squares - having)[:rows]).max()
    needed = fixed_squares.sum() - having.sum() - most > np.log(rows)
    return search(replace(fixed, sigma=problem.sigma), start, report) if needed else u


def implicit_friction(problem: Problem, u: np.ndarray, significant: float = SIGNIFICANT) -> bool:
    """Return whether the recording comes from a simulator with implicit friction, given a torque fit u (P,).

    Where friction rises with speed, implicit integration uses the friction at the velocity half a step later; a
    physical arm does not. The effect of implicit friction must exceed `significant` standard deviations and have
    about the expected size. A rotor inertia that the model lacks has a similar effect, but one a hundred times as
    large.
    """
    problem = problem.on_torque
    r = problem.residual(u[None])[0]
    ahead = problem.with_torque_data(problem.torque_data.with_lead(EARLY * SIM_DT))
    moved = ahead.residual(u[None])[0] - r
    row, products, hessian = 0, 0.0, 0.0
    for own, j in problem.linearize(u):
        both = np.stack([own, moved[row : row + len(own)]], 1)
        row, products, hessian = row + len(own), products + j.T @ both, hessian + j.T @ j
    gradient, slope = np.asarray(products).T
    best = np.linalg.lstsq(hessian, slope, rcond=None)[0]
    size = moved @ moved - best @ slope  # squared effect of implicit friction that no parameter explains
    share = -(moved @ r - best @ gradient) / size
    return bool(EXPECTED[0] < share < EXPECTED[1] and share * np.sqrt(size) > significant)
