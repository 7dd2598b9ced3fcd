"""The result of an identification: values, intervals, and the parameters that the data do not determine."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd
from scipy.stats import t as student

from r2s.identification.friction.breakaway import Breakaway
from r2s.identification.friction.repeatability import certainty
from r2s.identification.parameters import OF_LINKS, WHOLE_ARM, ParameterEstimate, ParameterSpace, units
from r2s.identification.problem import Problem
from r2s.physics.dynamics import Dynamics

EDGE = 5e-4  # a value closer to a bound than this share of its range is at the bound
RIDGE = 1e-6  # information added to every value on the unit cube, because some values have neither prior nor data
UNSEEN = 0.9  # ratio of posterior to prior sigma, above which the data hardly determine a value
SHARPER = 4.0  # a value is identifiable if half its 95 % interval is less than the prior's sigma / SHARPER
NULL_SHARE = 0.5  # ratio of posterior to prior sigma, above which the prior determines a direction
LISTED_PARTS, LEAST_PART = 6, 0.2  # most values listed per null direction; least component of a listed value


@dataclass(frozen=True)
class IdentificationResult:
    """Result of an identification.

    Attributes:
        space: the parameter space. found: estimated values and intervals of the parameters.
        history: one row for each step or generation of a search.
        families: {friction family: error of held-out torque relative to the best family's}; {} if the user chose the
            family.
        null_directions: parameter combinations that the prior determines, as pairs (ratio of posterior to prior
            sigma, {name: component}); ratios exceed NULL_SHARE, largest first.
        unseen: names of the parameters that r2s left at nominal values, because the data hardly determine them.
        edges: breakaway commands estimated from ramps; None if no ramps were recorded.
        refused: whether r2s discarded the replay fit, which explained torque clearly worse than the torque fit.
        prior_rows: residual (B,) and Jacobian (B, P) on the unit cube, see `Problem.prior_rows`.
    """

    space: ParameterSpace
    found: ParameterEstimate
    history: pd.DataFrame
    families: dict[str, float]
    null_directions: list[tuple[float, dict[str, float]]]
    unseen: list[str]
    edges: Breakaway | None = None
    refused: bool = False
    prior_rows: tuple[np.ndarray, np.ndarray] = (np.zeros(0), np.zeros((0, 0)))

    @property
    def x(self) -> np.ndarray:
        """(P,) the identified values in SI units."""
        return self.found.x

    @property
    def dynamics(self) -> Dynamics:
        """The identified arm."""
        return self.space.dynamics(self.found.x)

    @property
    def at_bounds(self) -> list[str]:
        """One message for each value at a nonzero search bound, because the bound may be too narrow."""
        s, u, unit, lines = self.space, self.space.to_unit(self.found.x), units(), []
        for block in s.blocks:
            for k, at in enumerate(s.where(block)):
                side, edge = ("upper", s.upper[at]) if u[at] > 0.5 else ("lower", s.lower[at])
                if EDGE < u[at] < 1.0 - EDGE or edge == 0.0 or s.names[at] in (*self.unseen, *s.fixed):
                    continue
                joint = "" if block in WHOLE_ARM else f" of {'link' if block in OF_LINKS else 'joint'} {k + 1}"
                lines.append(
                    f"identify.bounds.{block}: {block}{joint} is {self.x[at]:.4g} {unit[block]}, its {side} bound; "
                    "the data may want more, so widen it"
                )
        return lines

    @property
    def note(self) -> dict[str, Any]:
        """Entries of parameters.yaml about the identification itself, such as the values that stayed nominal."""
        null = [{"share_of_prior_left": round(s, 2), **parts} for s, parts in self.null_directions]
        out = {"unseen_and_left_nominal": self.unseen, "decided_by_the_prior": null}
        out |= {"families_compared": self.families, "replays_refused": self.refused}
        out |= {"at_bounds": self.at_bounds} if self.at_bounds else {}
        out |= {"fixed_by_the_user": sorted(self.space.fixed)} if self.space.fixed else {}
        unknown = self.edges.unknown if self.edges is not None else {}
        return out | ({"breakaway_unknown": unknown} if unknown else {})

    @property
    def saved(self) -> tuple[ParameterSpace, ParameterEstimate]:
        """Parameter space and estimate for parameters.yaml, with breakaway torques if ramps were recorded.

        The interval of a breakaway torque combines Student's t (friction/repeatability.py) with the uncertainty of
        the offset. If no ramp moved a joint, the breakaway torque is not identifiable. Its interval then extends from
        the largest torque without motion to the bound, and all posterior draws equal the estimate.
        """
        if self.edges is None:
            return self.space, self.found
        f = self.found
        x = self.dynamics.breakaway
        sigma, freedom = certainty(self.edges, self.space.robot.tau_max)
        got, scale = np.isfinite(sigma), np.nan_to_num(sigma)
        edges = self.space.dynamics(f.samples).breakaway
        moves = 0.5 * np.ptp(np.quantile(edges, [0.025, 0.975], axis=0), axis=0)  # half-width due to the offset
        most = student.ppf(0.975, freedom)
        # policies train on these draws; for few degrees of freedom, the far tails of Student's t are unrealistic
        drawn = np.clip(np.random.default_rng(0).standard_t(freedom, edges.shape), -2 * most, 2 * most)
        edges = np.where(got, edges + scale * drawn, x)
        edges = np.stack([np.minimum(edges[..., 0], 0.0), np.maximum(edges[..., 1], 0.0)], -1)
        half = np.hypot(most * scale, moves)
        held = self.edges.held + self.dynamics.offset[:, None]
        low, high = np.where(got, x - half, np.minimum(held, x)), np.where(got, x + half, np.maximum(held, x))
        limit = np.maximum(self.space.robot.tau_max, np.abs([x, low, high]).max((0, 2)))
        low[:, 0], high[:, 0] = np.where(got[:, 0], low[:, 0], -limit), np.minimum(high[:, 0], 0.0)
        high[:, 1], low[:, 1] = np.where(got[:, 1], high[:, 1], limit), np.maximum(low[:, 1], 0.0)
        zone = 0.5 * np.ptp(x, axis=1)[:, None]  # half the dead zone, in place of a prior's sigma
        columns = [[a[..., 0], a[..., 1]] for a in (x, low, high, got & (half < zone / SHARPER), edges)]
        own = f.x, f.low, f.high, f.identifiable, f.samples
        space = replace(
            self.space,
            blocks=(*self.space.blocks, "breakaway_negative", "breakaway_positive"),
            lower=np.concatenate([self.space.lower, -limit, 0 * limit]),
            upper=np.concatenate([self.space.upper, 0 * limit, limit]),
            breakaway_command=None,
        )
        return space, ParameterEstimate(*(np.concatenate([a, *b], -1) for a, b in zip(own, columns, strict=True)))


def conclude(
    problem: Problem,
    space: ParameterSpace,
    sure: Mapping[str, Any],
    full: Mapping[str, Any] | None = None,
    **story: Any,
) -> IdentificationResult:
    """Reset to nominal the values that the data hardly determine, and return the result of the identification.

    Args:
        problem: the solved problem.
        space: the parameter space, with the breakaway torques and the stiction model estimated after the fit.
        sure: the posterior, as a dict with the fields of `Posterior`.
        full: {"draws": (S, P)}, posterior draws of a second model; each draw has the same weight as a draw of `sure`.
        story: further fields of `IdentificationResult`: history, families, edges, refused.
    """
    u = np.array(sure["u"], dtype=float)
    steps, information = np.asarray(sure["steps"]), np.asarray(sure["information"])
    prior, h = problem.prior_width, information + problem.prior_information(u)
    u, unseen = _settle(u, problem.start, h + RIDGE * np.eye(len(u)), steps.std(0) / prior)
    steps = np.clip(u + steps, 0.0, 1.0) - u
    both = np.concatenate([steps, full["draws"] - u]) if full else steps
    # the interval is u + low to u - high; low and high are at most 0
    low, high = (np.minimum(0.0, np.quantile(sign * both, 0.025, axis=0)) for sign in (1.0, -1.0))
    inside = (u > EDGE) & (u < 1.0 - EDGE)  # at a bound, the interval is cut off on one side
    seen = inside & (-0.5 * (low + high) < prior / SHARPER)
    ends = space.from_unit(u + low), space.from_unit(u - high)
    found = ParameterEstimate(space.from_unit(u), *ends, seen, space.from_unit(u + steps))
    # in units of the prior's sigma, the information along a direction without data has the eigenvalue 1
    h = h + np.diag(np.where(np.isinf(problem.sigma), prior**-2.0, 0.0))
    free = [k for k, name in enumerate(space.names) if name not in space.fixed]
    searched = [space.names[k] for k in free]
    gained, directions = np.linalg.eigh((prior[:, None] * h * prior)[np.ix_(free, free)])
    null = []
    for g, v in zip(gained, directions.T, strict=True):
        if g < NULL_SHARE**-2:
            parts = sorted(zip(searched, v.tolist(), strict=True), key=lambda p: -abs(p[1]))[:LISTED_PARTS]
            shown = {name: round(part, 2) for name, part in parts if abs(part) > LEAST_PART}
            null.append((min(float(g**-0.5), 1.0), shown))
    names = [name for name, gone in zip(space.names, unseen, strict=True) if gone and name not in space.fixed]
    story |= {"unseen": names, "prior_rows": problem.prior_rows(u)}
    return IdentificationResult(space, found, null_directions=null, **story)


def _settle(u: np.ndarray, start: np.ndarray, h: np.ndarray, share: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Reset poorly determined values of u (P,) to `start`; return the new u, and a mask (P,) of the reset values.

    Data may determine only a combination of values, such as the summed mass of two consecutive links. r2s therefore
    resets a value only if, after a refit of the remaining values, all resets together raise the sum of squares by at
    most 1.

    Args:
        u, start: (P,) fitted and nominal values on the unit cube. h: (P, P), half the Hessian of the sum of squares.
        share: (P,) ratio of posterior to prior sigma.
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
