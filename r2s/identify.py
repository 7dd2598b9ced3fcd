"""Real2Sim: find friction, inertia, offsets and delay that make the simulated arm do what the recorded one did.

`identify` goes: friction family (compared on motion left out, with family=auto) -> the searches one after the other
-> again, weighed by what was left unexplained -> breakaway -> the joint distribution of what was found (block
bootstrap). The paper's algorithm is search=ga on the residual of eq. (8). A search is a function on the unit cube; it
knows nothing of arms.
"""

import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, NamedTuple, Protocol

import numpy as np
import pandas as pd

from r2s.breakaway import Breakaway, Ramps, breakaway
from r2s.errors import UserError, choices, nearest
from r2s.friction import BRISTLE, FAMILIES
from r2s.least_squares import minimise
from r2s.parameters import LINK, UNITS, Estimate, ParameterSpace, of_family, parameter_space
from r2s.recording import Recording
from r2s.residual import ReplayResidual, TorqueResidual, cut_windows, replay
from r2s.robot import Robot
from r2s.simulator import Dynamics, Simulator

HORIZONS = (0.1, 0.5, 2.0)  # s, open-loop prediction
DRAWS = 512  # of the joint distribution
SHARPER = 4.0  # a parameter is identifiable when the half width of its interval is this much below its prior's sigma
REWEIGH = 2  # times that a local search goes on with weights from what is left unexplained
SLOWEST = 0.02  # rad/s: below it a joint may be in the dead zone; friction with a memory has none
FAMILY_HZ = 50.0  # rows per second that families are compared on
STEP = 1e-4  # of the unit cube: far above the round-off of a replay, far below its curvature
TERMS = ("viscous", "offset", "inertia_scale", "link", "delay", "lag", "load", "drag_sin", "drag_cos", "gain")
MOVED = 0.02  # rad that a joint must move for its friction to be looked for
Report = Callable[[dict], None]
Memo = Callable[[str, Callable[[], dict[str, Any]]], dict[str, Any]]


class Problem:
    """What a search sees: residuals on the unit cube, with what was believed before as rows of its own.

    Args:
        data: the residual that decides. quick: one on the level of torque, for a fast start; may be the same.
        prior: {"offset": sigma, ...}, standard deviation of the belief in the nominal value (of its logarithm where
            the scale is logarithmic). Blocks that are not named are uniform in their bounds.
        kept: (n,) bool, joints whose friction and offset stay nominal.
    """

    def __init__(
        self,
        data: ReplayResidual | TorqueResidual,
        quick: TorqueResidual,
        prior: Mapping[str, float],
        kept: np.ndarray | None = None,
    ):
        self.data, self.quick_data, self.space = data, quick, data.space
        space = data.space
        self.start = space.to_unit(space.start)
        uniform = space.spread / np.sqrt(12)
        self.sigma = np.minimum(space.spread_out(prior, np.inf), uniform)
        if kept is not None:
            self.sigma[space.of_joints(kept)] = 1e-4
        self.weight = space.spread / self.sigma
        self.clusters = data.clusters

    def residual(self, u: np.ndarray) -> np.ndarray:
        """Return (C, R + P) for u (C, P) on the unit cube: data, then prior, in standard deviations."""
        return self._with_prior(self.data, u)

    def quick(self, u: np.ndarray) -> np.ndarray:
        """Return `residual` on the level of torque."""
        return self._with_prior(self.quick_data, u)

    def quick_jacobian(self, u: np.ndarray) -> np.ndarray:
        """Return (R + P, P), the Jacobian of `quick` at u (P,)."""
        h = np.where(u > 0.5, -STEP, STEP)
        change = self.quick_data.change(self.space.from_unit(u), self.space.from_unit(u + h))
        return np.concatenate([change / h, np.diag(self.weight)])

    def _with_prior(self, data: ReplayResidual | TorqueResidual, u: np.ndarray) -> np.ndarray:
        return np.concatenate([data(self.space.from_unit(u)), (u - self.start) * self.weight], axis=1)

    def adapt(self, u: np.ndarray, fitted: bool) -> None:
        """Let the residuals find their weights about u (P,)."""
        for data in {id(d): d for d in (self.data, self.quick_data)}.values():
            data.adapt(self.space.from_unit(u), fitted)

    def jacobian(self, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the residual (R + P,) and its Jacobian (R + P, P) at u (P,)."""
        if self.data is self.quick_data:
            return self.quick(u[None])[0], self.quick_jacobian(u)
        h = np.where(u > 0.5, -STEP, STEP)  # always into the cube
        r = self.residual(np.concatenate([u[None], u + np.diag(h)]))
        return r[0], ((r[1:] - r[0]) / h[:, None]).T


class Posterior(NamedTuple):
    """u (P,) the result on the unit cube, draws about it as steps (S, P), and the data's information (P, P)."""

    u: np.ndarray
    steps: np.ndarray
    information: np.ndarray


class Search(Protocol):
    """A search minimises the sum of squares of a Problem's residual from `start` (P,) and returns where it ended.

    `report` gets a dict after every step or generation: search, evaluations, cost, done, total. `local` says whether
    it goes on from its start, so that it can polish.
    """

    local: bool

    def __call__(self, problem: Problem, start: np.ndarray, report: Report) -> np.ndarray:
        """Return u (P,) on the unit cube."""
        ...


@dataclass(frozen=True)
class Identified:
    """The result.

    Attributes:
        space, found: what was searched, and what was found (r2s/parameters.py).
        history: a row per step or generation of each search.
        families: {"sigmoid": error on motion left out, ...} where the family was chosen, relative to the best.
        null_directions: combinations of parameters that only the prior decides: (share of the prior's sigma left,
            {name: part}), widest first.
        unseen: names that keep their nominal value, because the data hardly say anything of them.
        break_spread: (n, 2) Nm, repeatability of the breakaway, where it was measured.
    """

    space: ParameterSpace
    found: Estimate
    history: pd.DataFrame
    families: dict[str, float]
    null_directions: list[tuple[float, dict[str, float]]]
    unseen: list[str]
    break_spread: np.ndarray | None = None

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
        """What goes into parameters.yaml: the result, with measured edges of the dead zone as blocks of their own."""
        if self.break_spread is None:
            return self.space, self.found
        d, f = self.dynamics, self.found
        edges = self.space.dynamics(f.samples).breakaway
        spread = np.nan_to_num(self.break_spread, nan=0.0)
        rng = np.random.default_rng(0)
        edges = edges + spread * rng.standard_normal(edges.shape)
        edges = np.stack([np.minimum(edges[..., 0], 0.0), np.maximum(edges[..., 1], 0.0)], -1)
        samples = np.concatenate([f.samples, edges[..., 0], edges[..., 1]], -1)
        x = np.concatenate([f.x, d.breakaway[:, 0], d.breakaway[:, 1]])
        half = 1.96 * np.concatenate([spread[:, 0], spread[:, 1]])
        n, p = self.space.n, len(f.x)
        low, high = np.concatenate([f.low, x[p:] - half]), np.concatenate([f.high, x[p:] + half])
        known = np.concatenate([f.identifiable, np.ones(2 * n, dtype=bool)])
        limit = np.full(n, 10.0)
        space = replace(
            self.space,
            blocks=(*self.space.blocks, "breakaway_negative", "breakaway_positive"),
            lower=np.concatenate([self.space.lower, -limit, 0 * limit]),
            upper=np.concatenate([self.space.upper, 0 * limit, limit]),
            break_command=None,
        )
        return space, Estimate(x, low, high, known, samples)


def identify(
    robot: Robot,
    nominal: Dynamics,
    recording: Recording,
    searches: Sequence[Search],
    *,
    bounds: Mapping[str, Sequence[float]],
    prior: Mapping[str, float],
    terms: Sequence[str],
    family: str = "sigmoid",
    ramps: Ramps | None = None,
    window_s: float = 0.2,
    stride: int = 5,
    cutoff_hz: float = 10.0,
    breakaway_max: float | None = 1.5,
    folds: int = 4,
    keep_nominal: bool = False,
    seed: int = 0,
    nthread: int = 0,
    report: Report = lambda row: None,
    memo: Memo = lambda name, make: make(),
) -> Identified:
    """Run the searches one after the other, each from where the last ended, and say how sure the result is.

    Args:
        robot: the arm.
        nominal: where to start, and what blocks without bounds keep.
        recording: what the arm did; its torque decides the residual (r2s/residual.py).
        searches: at least one.
        bounds: {"phi1": [low, high], ...}, of whatever may be searched.
        prior: {"inertia_scale": sigma, ...}, see `Problem`.
        terms: what is searched beside friction: offset, inertia_scale or link, delay, lag, load, drag_sin,
            drag_cos, gain.
        family: of the friction; auto fits each and keeps the one that predicts motion left out best.
        ramps: of the breakaway protocol; without them the dead zone's edges are looked for in the recording.
        window_s, stride: replay windows, s, and every which ms is compared (commanded torque).
        cutoff_hz: zero-phase filter of the torque.
        breakaway_max: scan the edges up to this, Nm, where there are no ramps (commanded torque; a link-side sensor
            does not feel the motor's breakaway). None keeps the nominal edges.
        folds: of the cross-validation within the recording.
        keep_nominal: a joint whose refit predicts motion left out not clearly better than the nominal one keeps that.
        seed: of the bootstrap.
        nthread: 0 is all.
        report: called with a row of history after every step or generation.
        memo: called with the name of a step and a function that does it, returns its result; it may remember.

    Raises:
        UserError: the recording does not fit the arm or hardly moves, or a term that does not exist.
    """
    check_recording(robot, recording)
    check_choices(family, terms)
    names = [f.name for f in FAMILIES]
    if folds < 2 and (family == "auto" or keep_nominal):
        raise UserError(f"identify.folds: {folds} is too few to leave motion out; at least 2 are needed")
    _check_names(bounds, prior)
    began, history = time.perf_counter(), []

    def told(row: dict) -> None:
        history.append(row | {"seconds": time.perf_counter() - began})
        report(row)

    def step(name: str, make: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        """Do a step, or remember it together with its rows of history."""
        before = len(history)
        done = memo(name, lambda: make() | {"history": json.dumps(history[before:])})
        if len(history) == before:
            history.extend(json.loads(str(done["history"])))
        return done

    how = {"cutoff_hz": cutoff_hz}
    families: dict[str, float] = {}
    if family == "auto":
        chosen = step(
            "family", lambda: compare_families(robot, nominal, recording, bounds, prior, terms, folds, how, told)
        )
        families = dict(zip(names, np.asarray(chosen["error"]).tolist(), strict=True))
        family = names[int(chosen["best"])]
    nominal = of_family(nominal, family)
    edges = None
    if ramps is not None:
        edges = breakaway(ramps)
    space = searched(robot, nominal, bounds, terms, recording)
    quick = TorqueResidual(robot, space, recording, **how)
    data: ReplayResidual | TorqueResidual = quick
    if recording.torque == "commanded":
        batch = min(len(space.start) + 1, 64)
        slowest = 0.0 if nominal.family == BRISTLE else SLOWEST
        data = ReplayResidual(
            *(robot, space, recording),
            window_s=window_s,
            stride=stride,
            slowest=slowest,
            batch=batch,
            nthread=nthread,
        )
    kept = np.zeros(robot.n, dtype=bool)
    if keep_nominal:
        kept = step("kept", lambda: {"kept": joints_kept(robot, space, recording, prior, folds, how)})["kept"]
    problem = Problem(data, quick, prior, np.asarray(kept, dtype=bool))
    u = problem.start
    for k, search in enumerate(searches):
        u = np.asarray(step(f"search {k + 1}", lambda s=search, u=u: {"u": s(problem, u, told)})["u"])  # type: ignore[misc]
        problem.adapt(u, fitted=True)
    if edges is not None:
        # only now: a dead zone makes the error jump where a joint is held or let go, and a search from afar stick
        space = replace(space, break_command=_reached(edges, nominal))
        data.space = quick.space = problem.space = space
        problem.adapt(u, fitted=True)
    last = searches[-1]
    if last.local:  # a local search goes on from where it was, weighed by what is left unexplained

        def again(row: dict) -> None:
            told(row | {"search": f"{row['search']}, reweighed"})

        for k in range(REWEIGH):
            u = np.asarray(step(f"reweighed {k + 1}", lambda u=u: {"u": last(problem, u, again)})["u"])  # type: ignore[misc]
            problem.adapt(u, fitted=True)
    dynamics = space.dynamics(space.from_unit(u))
    if ramps is not None:
        edges = breakaway(ramps, delay=float(dynamics.delay), lag=float(dynamics.lag))
        space = replace(space, break_command=_reached(edges, nominal))
    elif breakaway_max and recording.torque == "commanded":
        found = step(
            "breakaway",
            lambda: {
                "edges": scan_breakaway(robot, dynamics, recording, breakaway_max, window_s, stride, nthread, told)
            },
        )
        space = replace(space, nominal=replace(nominal, breakaway=np.asarray(found["edges"])))
    data.space = quick.space = problem.space = space
    sure = step("bootstrap", lambda: posterior(problem, u, seed)._asdict())
    return conclude(problem, sure, pd.DataFrame(history), families, None if edges is None else edges.spread)


def _reached(edges: Breakaway, nominal: Dynamics) -> np.ndarray:
    """Return (n, 2) Nm, the commands at which joints let go; nominal where no ramp got that far."""
    return np.where(np.isnan(edges.command), nominal.breakaway, edges.command)


def check_choices(family: str, terms: Sequence[str]) -> None:
    """Raise UserError if there is no such friction family, or no such term to search."""
    for what, seen, known in (
        ("friction.family: no family", [family], [*(f.name for f in FAMILIES), "auto"]),
        ("identify.terms: unknown term", terms, TERMS),
    ):
        for name in seen:
            if name not in known:
                raise UserError(f"{what} '{name}'; allowed: {choices(known)}{nearest(str(name), known)}")


def check_recording(robot: Robot, recording: Recording) -> None:
    """Raise UserError if the recording is not of this arm, leaves its limits or hardly moves."""
    if recording.n_joints != robot.n:
        raise UserError(f"the recording has {recording.n_joints} joints, {robot.name} has {robot.n}")
    margin = 0.05  # rad: logs of arms that touch their limits are not unheard of
    out = np.maximum(robot.q_min - margin - recording.q.min(0), recording.q.max(0) - robot.q_max - margin)
    if out.max() > 0:
        j = int(out.argmax())
        worst = recording.q[:, j].min() if recording.q[:, j].min() < robot.q_min[j] else recording.q[:, j].max()
        raise UserError(
            f"the recording: joint {j + 1} is at {worst:.3f} rad, {robot.name} allows {robot.q_min[j]:g} to "
            f"{robot.q_max[j]:g}; is it another arm, another joint order, or degrees?"
        )
    moved = np.ptp(recording.q, axis=0)
    if moved.max() < MOVED or recording.duration < 1.0:
        raise UserError(
            f"the recording has not enough motion to identify anything: {recording.duration:.2f} s in which the "
            f"joint that moves most moves {moved.max():.4f} rad; at least 1 s and {MOVED:g} rad are needed"
        )


def _check_names(bounds: Mapping[str, Sequence[float]], prior: Mapping[str, float]) -> None:
    """Raise UserError if either names what does not exist (both may name what is not searched), or no deviation."""
    for where, given in (("bounds", bounds), ("prior", prior)):
        for name in given:
            if name not in UNITS:
                raise UserError(
                    f"{where}: unknown parameter '{name}'; allowed: {choices(UNITS)}{nearest(name, UNITS)}"
                )
    for name, sigma in prior.items():
        if not sigma > 0:
            raise UserError(f"prior.{name}: {sigma} is not a positive standard deviation")


def searched(
    robot: Robot,
    nominal: Dynamics,
    bounds: Mapping[str, Sequence[float]],
    terms: Sequence[str],
    recording: Recording,
    break_command: np.ndarray | None = None,
) -> ParameterSpace:
    """Return the space of the family's parameters and `terms`; `link` stands for its ten blocks.

    Delay and lag lie between a command and the motion, a gain error in the torque sensor: each is searched where
    it is.

    Raises:
        UserError: a term without bounds.
    """
    names = [name for name in nominal.family.names if name in bounds]
    if nominal.family.name == "sigmoid" and "viscous" not in terms:
        names = [name for name in names if name != "viscous"]
    for term in terms:
        elsewhere = ("gain",) if recording.torque == "commanded" else ("delay", "lag")
        if term == "viscous" or term in elsewhere:
            continue
        names += LINK if term == "link" else [term]
    if missing := [name for name in names if name not in bounds]:
        raise UserError(f"identify.bounds: none for {choices(missing)}")
    return parameter_space(robot, nominal, {name: bounds[name] for name in names}, break_command)


def fit_torque(problem: Problem, rounds: int = 2) -> np.ndarray:
    """Return u (P,) by least squares on the level of torque, weighed again after every round."""
    u = problem.start
    for k in range(rounds):
        u = minimise(problem.quick, problem.quick_jacobian, u, 12, 1e-3)
        if k < rounds - 1:
            problem.quick_data.adapt(problem.space.from_unit(u), fitted=True)
    return u


def left_out(recording: Recording, folds: int) -> list[tuple[Recording, Recording]]:
    """Return (rest, block) for blocks of time, or of phase where the motion repeats itself; 0.1 s apart."""
    clock = recording.t % recording.period if recording.period else recording.t
    edges = np.quantile(clock, np.linspace(0, 1, folds + 1))
    pairs = []
    for low, high in pairwise(edges):
        out = (clock >= low) & (clock <= high)
        near = (clock > low - 0.1) & (clock < high + 0.1)
        pairs.append((recording.select(~near), recording.select(out)))
    return pairs


def compare_families(
    robot: Robot,
    nominal: Dynamics,
    recording: Recording,
    bounds: Mapping[str, Sequence[float]],
    prior: Mapping[str, float],
    terms: Sequence[str],
    folds: int,
    how: Mapping[str, Any],
    report: Report,
) -> dict[str, Any]:
    """Return {"error": (F,) relative to the best, "best": index}: torque predicted on motion left out.

    A family with more parameters has to predict clearly better: by more than one standard error of the difference
    over blocks of half a second (Breiman et al. 1984, the one-standard-error rule).
    """
    squares: list[np.ndarray] = []
    scale: np.ndarray | None = None
    how = dict(how) | {"rate_hz": FAMILY_HZ}
    for k, f in enumerate(FAMILIES):
        own = of_family(nominal, f.name)
        blocks = []
        for rest, out in left_out(recording, folds):
            space = searched(robot, own, bounds, terms, recording)
            fit = TorqueResidual(robot, space, rest, **how)
            u = fit_torque(Problem(fit, fit, prior))
            test = TorqueResidual(robot, space, out, **how)
            error = test.error(space.from_unit(u)[None])[0] ** 2
            window = test.clusters[:: robot.n]
            blocks.append(np.stack([error[window == w].mean(0) for w in np.unique(window)]))
        mean = np.concatenate(blocks)
        scale = mean.mean(0) if scale is None else scale
        squares.append((mean / scale).sum(1))
        report(
            {
                "search": f"family {f.name}",
                "evaluations": 0,
                "cost": squares[-1].mean(),
                "done": k + 1,
                "total": len(FAMILIES),
            }
        )
    means = np.array([s.mean() for s in squares])
    best = int(means.argmin())
    for k in np.argsort([len(f.names) for f in FAMILIES], kind="stable"):
        more = squares[k] - squares[best]
        if means[k] <= means[best] + more.std() / np.sqrt(len(more)):
            best = int(k)
            break
    return {"error": np.sqrt(means / means.min()), "best": best}


def joints_kept(
    robot: Robot,
    space: ParameterSpace,
    recording: Recording,
    prior: Mapping[str, float],
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


def scan_breakaway(
    robot: Robot,
    dynamics: Dynamics,
    recording: Recording,
    largest: float,
    window_s: float,
    stride: int,
    nthread: int,
    report: Report,
) -> np.ndarray:
    """Return the edges (n, 2) Nm of the dead zone that replay the recording best, everything else as in `dynamics`.

    The error jumps where a joint is held or let go one step sooner, so there is no gradient: each edge is scanned
    over [0, largest], all edges at once and each judged by its own joint, then again about the best, ever finer.
    The coarse scan is done twice, because an edge looks different while the others are wrong.
    """
    space = parameter_space(
        robot, dynamics, {"breakaway_negative": [-largest, 0.0], "breakaway_positive": [0.0, largest]}
    )
    data = ReplayResidual(
        robot, space, recording, window_s=window_s, stride=stride, slowest=0.0, limit=50, nthread=nthread
    )
    x, step, coarse, passes = space.start, largest / 12, 2, 6
    sign = np.repeat([-1.0, 1.0], robot.n)
    joint = np.tile(np.arange(robot.n), 2)
    for k in range(passes):
        offsets = np.linspace(0, largest, 13) if k < coarse else step * np.arange(-2, 3)
        base = np.zeros_like(x) if k < coarse else x
        trials = np.clip(base[:, None] + sign[:, None] * offsets, space.lower[:, None], space.upper[:, None])
        candidates = np.repeat(x[None], trials.size, axis=0).reshape(*trials.shape, -1)
        candidates[np.arange(len(x)), :, np.arange(len(x))] = trials
        cost = data.joint_error(candidates.reshape(-1, len(x))).reshape(*trials.shape, robot.n)
        own = np.take_along_axis(cost, joint[:, None, None], axis=2)[..., 0]
        x = trials[np.arange(len(x)), own.argmin(1)]
        step /= 1 if k < coarse else 2.5
        row = {"pass": k + 1, "evaluations": data.candidates, "done": k + 1, "total": passes}
        report(row | {"search": "breakaway"})
    return x.reshape(2, robot.n).T


def posterior(problem: Problem, u: np.ndarray, seed: int) -> Posterior:
    """Return draws of the joint distribution about the result u (P,), by a linearised block bootstrap.

    Errors within a window are correlated, so windows are drawn with replacement (Kuensch 1989), and the belief is
    drawn from its prior each time; each draw is one Gauss-Newton step from u. Where the data say nothing a draw is
    one of the prior's. A bootstrap of few windows is too narrow where single windows decide, so the spread is not
    let below what the residual's own variance gives.
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
    belief = np.diag(problem.weight**2)
    pull = problem.weight**2 * (u - problem.start)
    factor = max(1.0, float(np.sqrt(np.mean(r**2))))
    steps = np.empty((DRAWS, p))
    for k in range(DRAWS):
        times = rng.multinomial(count, np.full(count, 1 / count)).astype(float)
        believed = pull - problem.weight * rng.standard_normal(p)
        h = np.tensordot(times, gram, 1) + belief
        steps[k] = -np.linalg.solve(h, times @ score + believed)
    information = gram.sum(0)
    covariance = np.linalg.inv(information + belief)
    own = np.sqrt(np.diag(covariance @ (factor**2 * information + belief) @ covariance))
    seen = steps.std(0)
    steps = (steps - steps.mean(0)) * np.maximum(1.0, own / np.maximum(seen, 1e-12))
    return Posterior(u, steps, information)


def conclude(
    problem: Problem,
    sure: Mapping[str, Any],
    history: pd.DataFrame,
    families: dict[str, float],
    break_spread: np.ndarray | None,
) -> Identified:
    """Return the result: what hardly any data spoke of goes back to nominal, and is named."""
    space, u = problem.space, np.asarray(sure["u"], dtype=float)
    steps, information = np.asarray(sure["steps"]), np.asarray(sure["information"])
    prior = problem.sigma / space.spread  # on the unit cube
    share = steps.std(0) / prior
    unseen = share > 0.9
    u = np.where(unseen, problem.start, u)
    samples = space.from_unit(u + steps)
    low, high = (space.from_unit(u + np.quantile(steps, s, axis=0)) for s in (0.025, 0.975))
    half = 0.5 * (np.quantile(steps, 0.975, axis=0) - np.quantile(steps, 0.025, axis=0))
    identifiable = half < prior / SHARPER
    # in units of the prior, I + prior H prior: a direction that the data do not see keeps an eigenvalue of 1
    gained, directions = np.linalg.eigh(np.eye(len(u)) + prior[:, None] * information * prior)
    null = []
    for g, v in zip(gained, directions.T, strict=True):
        if g < 4.0:  # half of the prior's sigma is left, or more
            parts = sorted(zip(space.names, v.tolist(), strict=True), key=lambda p: -abs(p[1]))
            null.append((float(g**-0.5), {name: round(part, 2) for name, part in parts[:6] if abs(part) > 0.2}))
    names = [name for name, gone in zip(space.names, unseen, strict=True) if gone]
    found = Estimate(space.from_unit(u), low, high, identifiable, samples)
    return Identified(space, found, history, families, null, names, break_spread)


def prediction_errors(
    robot: Robot,
    nominal: Dynamics,
    identified: Dynamics,
    recording: Recording,
    *,
    window_s: float,
    cutoff_hz: float,
    nthread: int = 0,
) -> dict:
    """Return one side of summary.json: torque RMSE per joint and, for commanded torque, open-loop errors.

    position_rmse_mrad is over replays of `window_s`; ee_error_mm is the mean end-effector distance after 0.1, 0.5
    and 2 s open loop (horizons that no trajectory reaches are left out).
    """
    space = parameter_space(robot, nominal, {"offset": [-1.0, 1.0]})
    torque = TorqueResidual(robot, space, recording, cutoff_hz=cutoff_hz)
    out: dict = {"rows": len(recording.t), "seconds": recording.duration}
    for name, dynamics in (("", identified), ("nominal_", nominal)):
        error = torque.off(dynamics)
        out[f"{name}torque_rmse_Nm"] = np.sqrt((error**2).mean(0)).tolist()
    if recording.torque == "measured":
        return out
    windows = cut_windows(recording, window_s)
    for name, dynamics in (("", identified), ("nominal_", nominal)):
        error = replay(robot, dynamics, windows, nthread) - windows.q
        out[f"{name}position_rmse_mrad"] = (1e3 * np.sqrt((error**2).mean((0, 1)))).tolist()
        out[f"{name}ee_error_mm"] = _open_loop_ee(robot, dynamics, recording, nthread)
    return out


def _open_loop_ee(robot: Robot, dynamics: Dynamics, recording: Recording, nthread: int) -> dict[str, float]:
    """Return {"0.1": mm, ...}: mean distance between simulated and recorded end effector after each horizon."""
    errors = {}
    for horizon in HORIZONS:
        try:
            windows = cut_windows(recording, horizon, limit=100)
        except UserError:
            continue
        sim = Simulator(robot, dynamics, len(windows.q0), nthread)
        q = replay(robot, dynamics, windows, nthread)[:, -1]
        places = []
        for state in (q, windows.q[:, -1]):
            sim.reset(state, np.zeros_like(state))
            places.append(sim.ee.copy())
        errors[f"{horizon:g}"] = float(1e3 * np.linalg.norm(places[0] - places[1], axis=-1).mean())
    return errors
