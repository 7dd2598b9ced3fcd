"""The result of an identification, and how sure it is."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from scipy.stats import t as student

from r2s.identification.breakaway import Breakaway
from r2s.identification.parameters import Estimate, ParameterSpace
from r2s.identification.problem import Problem
from r2s.identification.repeatability import certainty
from r2s.physics.dynamics import Dynamics

MOST_EDGE = 10.0  # Nm, bound of an edge of the dead zone
DRAWS = 512  # of the joint distribution
LEAST_LEFT = 0.1  # of what is known of a direction, by all other windows
UNSEEN = 0.9  # of its prior's deviation: a value with so much left is hardly seen
SHARPER = 4.0  # a parameter is identifiable when the half width of its interval is this much below its prior's sigma


@dataclass(frozen=True)
class Identified:
    """The result.

    Attributes:
        space, found: what was searched, and what was found (r2s/identification/parameters.py).
        history: a row per step or generation of each search.
        families: {"sigmoid": error on motion left out, ...} where the family was chosen, relative to the best.
        null_directions: combinations of parameters that only the prior decides: (share of the prior's sigma left,
            {name: part}), widest first.
        unseen: names that keep their nominal value, because the data hardly say anything of them.
        edges: what ramps said of the breakaway, where there were any.
        refused: whether replays were refused, because they disagreed with the torque of joints that move.
    """

    space: ParameterSpace
    found: Estimate
    history: pd.DataFrame
    families: dict[str, float]
    null_directions: list[tuple[float, dict[str, float]]]
    unseen: list[str]
    edges: Breakaway | None = None
    refused: bool = False

    @property
    def x(self) -> np.ndarray:
        """(P,) the values found, SI units."""
        return self.found.x

    @property
    def dynamics(self) -> Dynamics:
        """The identified arm."""
        return self.space.dynamics(self.found.x)

    @property
    def saved(self) -> tuple[ParameterSpace, Estimate]:
        """What goes into parameters.yaml: the result, with ramped edges of the dead zone as blocks of their own.

        Their interval is Student's (r2s/identification/repeatability.py), with what the offset adds. An edge that no
        ramp got to lies somewhere from the command that the joint was held against to the bound; it is not
        identifiable, and has one value in all draws.
        """
        if self.edges is None:
            return self.space, self.found
        f, n = self.found, self.space.n
        x = self.dynamics.breakaway
        sigma, freedom = certainty(self.edges, self.space.robot.tau_max)
        got, scale = np.isfinite(sigma), np.nan_to_num(sigma)
        edges = self.space.dynamics(f.samples).breakaway
        moves = 0.5 * np.ptp(np.quantile(edges, [0.025, 0.975], axis=0), axis=0)  # with the offset
        most = student.ppf(0.975, freedom)
        # the far tails of few degrees of freedom are no belief in an arm: nobody should train on them
        drawn = np.clip(np.random.default_rng(0).standard_t(freedom, edges.shape), -2 * most, 2 * most)
        edges = np.where(got, edges + scale * drawn, x)
        edges = np.stack([np.minimum(edges[..., 0], 0.0), np.maximum(edges[..., 1], 0.0)], -1)
        half = np.hypot(most * scale, moves)
        held = self.edges.tried + self.dynamics.offset[:, None]
        low, high = np.where(got, x - half, held), np.where(got, x + half, held)
        low[:, 0], high[:, 0] = np.where(got[:, 0], low[:, 0], -MOST_EDGE), np.minimum(high[:, 0], 0.0)
        high[:, 1], low[:, 1] = np.where(got[:, 1], high[:, 1], MOST_EDGE), np.maximum(low[:, 1], 0.0)
        zone = 0.5 * np.ptp(x, axis=1)[:, None]  # half of it is what there is to tell
        columns = [[a[..., 0], a[..., 1]] for a in (x, low, high, got & (half < zone / SHARPER), edges)]
        own = f.x, f.low, f.high, f.identifiable, f.samples
        limit = np.full(n, MOST_EDGE)
        space = replace(
            self.space,
            blocks=(*self.space.blocks, "breakaway_negative", "breakaway_positive"),
            lower=np.concatenate([self.space.lower, -limit, 0 * limit]),
            upper=np.concatenate([self.space.upper, 0 * limit, limit]),
            break_command=None,
        )
        return space, Estimate(*(np.concatenate([a, *b], -1) for a, b in zip(own, columns, strict=True)))


class Posterior(NamedTuple):
    """u (P,) the result on the unit cube, draws about it as steps (S, P), and the data's information (P, P)."""

    u: np.ndarray
    steps: np.ndarray
    information: np.ndarray


def posterior(problem: Problem, u: np.ndarray, seed: int) -> Posterior:
    """Return draws of the joint distribution about the result u (P,): normal, of a covariance from blocks.

    Errors within a window are correlated, so what scatters is a window's whole score, its part of the gradient: the
    covariance is H^-1 (sum of s s^T + belief) H^-1 (White, Econometrica 48(4), 1980; of clusters Liang and Zeger,
    Biometrika 73(1), 1986). Where the data say nothing a draw is one of the prior's. A fit follows each of few
    windows, so what it leaves of one is less than the error, by its share in what is known (CR2 of Bell and
    McCaffrey, Survey Methodology 28(2), 2002). What all scores have in common is no scatter: at a bound it is not 0.
    Few windows are too narrow where single ones decide, so in no direction does the covariance fall below what the
    residual's own variance gives. A bootstrap, which draws windows, would draw some H that hardly know of a value
    that few windows tell, and the tails of that are no belief.
    """
    rng = np.random.default_rng(seed)
    residual, jacobian = problem.jacobian(u)
    rows, p = len(problem.clusters), len(u)
    j, r = jacobian[:rows], residual[:rows]
    count = int(problem.clusters.max()) + 1
    order = np.argsort(problem.clusters, kind="stable")
    edges = np.searchsorted(problem.clusters[order], np.arange(count + 1))
    j, r = j[order], r[order]
    gram = np.stack([j[a:b].T @ j[a:b] for a, b in pairwise(edges)])
    score = np.stack([j[a:b].T @ r[a:b] for a, b in pairwise(edges)])
    rest = jacobian[rows:]
    belief = rest.T @ rest
    told = j.any(1)  # rows that fill a window up have neither a residual nor a slope
    factor = max(1.0, float(np.sqrt(np.mean(r[told] ** 2)))) if told.any() else 1.0
    information = gram.sum(0)
    covariance = np.linalg.inv(information + belief)
    root = np.linalg.cholesky(covariance)
    share, axes = np.linalg.eigh(root.T @ gram @ root)  # of what is known of each direction, a window's
    left = np.maximum(1.0 - share, LEAST_LEFT)[..., None]
    within = axes @ ((axes.swapaxes(1, 2) @ (root.T @ score[..., None])) / np.sqrt(left))
    score = np.linalg.solve(root.T, within[..., 0].T).T
    score -= score.mean(0)
    own, windows = (covariance @ np.linalg.cholesky(m + belief) for m in (factor**2 * information, score.T @ score))
    steps = rng.standard_normal((DRAWS, p)) @ _at_least(own, windows).T
    return Posterior(u, _inside(u, steps, information + belief), information)


def _at_least(least: np.ndarray, root: np.ndarray) -> np.ndarray:
    """Return root (P, P) of a covariance root root^T, more where that is less than least least^T says.

    In directions, not parameter by parameter: what two that trade make together is known far better than either.
    """
    axes, seen, _ = np.linalg.svd(np.linalg.solve(least, root))
    return least @ (axes * np.maximum(seen, 1.0))


def _inside(u: np.ndarray, steps: np.ndarray, h: np.ndarray) -> np.ndarray:
    """Return steps (S, P) that end in the cube: values that would leave it stop there, and the others make up for it.

    h (P, P) is half the Hessian of the sum of squares. Where an offset trades with an asymmetry that is at its bound,
    to stop one of them alone would change what they make together. One at a time, the farthest first: of two that
    trade and are both out, the other comes back by itself.
    """
    steps = steps.copy()
    for step in steps:
        stopped = np.zeros(len(u), dtype=bool)
        for _ in range(len(u)):
            out = np.abs(u + step - 0.5) - 0.5
            k = int(out.argmax())
            if out[k] < 1e-12:
                break
            stopped[k] = True
            free = ~stopped
            change = np.clip(u[k] + step[k], 0.0, 1.0) - u[k] - step[k]
            step[k] += change
            step[free] -= np.linalg.solve(h[np.ix_(free, free)], h[free, k] * change)
    return np.clip(u + steps, 0.0, 1.0) - u


def conclude(
    problem: Problem,
    space: ParameterSpace,
    sure: Mapping[str, Any],
    history: pd.DataFrame,
    families: dict[str, float],
    edges: Breakaway | None,
    refused: bool,
) -> Identified:
    """Return the result: what hardly any data spoke of goes back to nominal, and is named.

    `space` is the problem's, with the dead zone that was found since.
    """
    u = np.array(sure["u"], dtype=float)
    steps, information = np.asarray(sure["steps"]), np.asarray(sure["information"])
    prior = problem.sigma / space.spread  # on the unit cube
    share = steps.std(0) / prior
    u, unseen = _settled(u, problem.start, information + problem.known(u), share)
    samples = space.from_unit(u + steps)
    low, high = (space.from_unit(u + np.quantile(steps, s, axis=0)) for s in (0.025, 0.975))
    half = 0.5 * (np.quantile(steps, 0.975, axis=0) - np.quantile(steps, 0.025, axis=0))
    identifiable = half < prior / SHARPER
    # in units of the prior: a direction of which nothing else says anything keeps an eigenvalue of 1
    gained, directions = np.linalg.eigh(prior[:, None] * (information + problem.known(u)) * prior)
    null = []
    for g, v in zip(gained, directions.T, strict=True):
        if g < 4.0:  # half of the prior's sigma is left, or more
            parts = sorted(zip(space.names, v.tolist(), strict=True), key=lambda p: -abs(p[1]))
            null.append((float(g**-0.5), {name: round(part, 2) for name, part in parts[:6] if abs(part) > 0.2}))
    names = [name for name, gone in zip(space.names, unseen, strict=True) if gone]
    found = Estimate(space.from_unit(u), low, high, identifiable, samples)
    return Identified(space, found, history, families, null, names, edges, refused)


def _settled(u: np.ndarray, start: np.ndarray, h: np.ndarray, share: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return u (P,) with as many unseen values at `start` as cost nothing, and which (P,) bool those are.

    A value may be unseen by itself and seen together with others, as the masses of two links in a row are: a value
    goes back only if the others, moved to where that is best, explain the data and the belief as well as before: the
    sum of squares may rise by 1 in all.

    Args:
        u, start: (P,) result and nominal, on the unit cube. h: (P, P), half the Hessian of the sum of squares at u.
        share: (P,) of its prior's deviation that each value's has left.
    """
    best, unseen = u, np.zeros(len(u), dtype=bool)
    for k in np.argsort(-share, kind="stable")[: int((share > UNSEEN).sum())]:
        some = unseen.copy()
        some[k] = True
        step = np.where(some, start - u, 0.0)
        step[~some] = -np.linalg.solve(h[np.ix_(~some, ~some)], h[np.ix_(~some, some)] @ step[some])
        if step @ h @ step <= 1.0:
            best, unseen = u + step, some
    return np.clip(best, 0.0, 1.0), unseen
