"""Real2Sim: find friction, inertia, offsets and delay that make the simulated arm do what the recorded one did.

`identify` goes: friction family (compared on motion left out, with family=auto) -> the searches one after the other
-> again, weighed by what was left unexplained -> breakaway -> the joint distribution of what was found. The paper's
algorithm is search=ga on the residual of eq. (8).
"""

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pandas as pd

from r2s.identification.breakaway import Breakaway, breakaway
from r2s.identification.bristles import NAME as PRESLIDING
from r2s.identification.bristles import Bending, bending
from r2s.identification.checks import check_motion
from r2s.identification.dead_zone import stiction
from r2s.identification.family_selection import compare_families, joints_kept
from r2s.identification.problem import (
    Known,
    Problem,
    Report,
    Search,
    answers_early,
    believed,
    optional_friction,
    searched,
)
from r2s.identification.replay_residual import ReplayResidual
from r2s.identification.settings import Settings
from r2s.identification.spare_terms import needed
from r2s.identification.static_friction import StaticFriction
from r2s.identification.term_selection import demanded
from r2s.identification.torque_residual import TorqueResidual
from r2s.identification.uncertainty import Identified, conclude, posterior
from r2s.physics.actuation import EARLY
from r2s.physics.dynamics import HOLDS, Dynamics, of_family
from r2s.physics.friction import FAMILIES
from r2s.physics.robot import SIM_DT, Robot
from r2s.recordings.ramps import Ramps
from r2s.recordings.recording import Recording

STANDSTILL = 0.02  # rad/s: what friction is of a joint that is slower, or stands, its velocity does not tell
REWEIGH = 2  # times that a local search goes on with weights from what is left unexplained
ALIKE = 0.2  # share by which what counts as an independent row may be wrong
CLEAR = 1.5  # of dq_min: joints that are slower may be in the dead zone
Memo = Callable[[str, Callable[[], dict[str, Any]]], dict[str, Any]]


def identify(
    robot: Robot,
    nominal: Dynamics,
    recording: Recording,
    searches: Sequence[Search],
    settings: Settings,
    *,
    ramps: Ramps | None = None,
    seed: int = 0,
    nthread: int = 0,
    report: Report = lambda row: None,
    memo: Memo = lambda name, make: make(),
) -> Identified:
    """Run the searches one after the other, each from where the last ended, and say how sure the result is.

    Args:
        robot: the arm.
        nominal: where to start, and what blocks without bounds keep.
        recording: what the arm did; its torque decides the residual (replay_residual.py or torque_residual.py).
        searches: at least one.
        settings: what is searched, within what, and how the residuals are made.
        ramps: of the breakaway protocol; without them the dead zone's edges are looked for in the recording.
        seed: of the draws of what was found.
        nthread: 0 is all.
        report: called with a row of history after every step or generation.
        memo: called with the name of a step and a function that does it, returns its result; it may remember.

    Raises:
        UserError: the recording does not fit the arm or hardly moves.
    """
    check_motion(robot, recording)
    names = [f.name for f in FAMILIES]
    bounds, family = settings.bounds, settings.family
    prior = believed(settings.prior, robot, recording)
    terms = list(settings.terms)
    folds = settings.folds
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

    how = {"cutoff_hz": settings.cutoff_hz}
    commanded = recording.torque == "commanded"
    slowest = STANDSTILL if commanded else 0.0
    families: dict[str, float] = {}
    if family == "auto":
        given = robot, nominal, recording, bounds, prior, terms, folds, how, told, slowest
        chosen = step("family", lambda: compare_families(*given))
        families = dict(zip(names, np.asarray(chosen["error"]).tolist(), strict=True))
        family = names[int(chosen["best"])]
    nominal = of_family(nominal, family)
    level = how | {"slowest": slowest}
    # a term of friction that the family does not have
    absent = {*optional_friction()} - {*nominal.family.optional}
    if extra := [name for name in settings.extra if name not in absent]:
        base = searched(robot, nominal, bounds, terms, recording)

        def choose() -> dict[str, Any]:
            more = demanded(base, recording, bounds, prior, extra, folds, level, told)
            return {"entered": [name in more for name in extra]}

        entered = np.asarray(step("terms", choose)["entered"], dtype=bool)
        terms = with_terms(terms, [name for name, enters in zip(extra, entered, strict=True) if enters])
    if spare := [name for name in settings.spare if name in terms]:

        def chosen_terms() -> dict[str, Any]:
            left = needed(robot, nominal, recording, bounds, prior, terms, spare, folds, how, told)
            return {"needed": [name in left for name in terms]}

        is_needed = np.asarray(step("spare", chosen_terms)["needed"], dtype=bool)
        terms = [name for name, keep in zip(terms, is_needed, strict=True) if keep]
    space = searched(robot, nominal, bounds, terms, recording)
    quick = TorqueResidual(robot, space, recording, **level)
    data: ReplayResidual | TorqueResidual = quick
    edges = breakaway(ramps) if commanded and ramps is not None else None  # a link-side sensor hides the motor's
    started_on_level, replayed = on_level(searches[0]), not all(map(on_level, searches))
    # how far the bristles are bent where a window starts nobody measured: replays would put right what is right
    if commanded and replayed and not (nominal.family.has_memory and started_on_level):
        data = ReplayResidual(
            *(robot, space, recording),
            window_s=settings.window_s,
            stride=settings.stride,
            slowest=0.0 if nominal.family.has_memory else CLEAR * nominal.dq_min,  # bristles have no dead zone
            edges=None if edges is None else _not_held(edges.command),
            batch=min(len(space.start) + 1, 64),
            nthread=nthread,
        )
    still = None
    if ramps is not None and edges is not None and "rise" in space.blocks:
        still = StaticFriction(robot, ramps, edges)
    beside: list[Known] = [] if still is None else [still]
    falls = None if nominal.family.has_memory else still  # bristles creep, and a slide has none

    kept = np.zeros(robot.n, dtype=bool)
    if settings.keep_nominal:
        kept = step("kept", lambda: {"kept": joints_kept(robot, space, recording, prior, folds, how)})["kept"]
    problem_of = partial(Problem, prior=prior, kept=np.asarray(kept, dtype=bool), beside=beside)
    problem = problem_of(data, quick)
    u = problem.start
    lag = space.where("lag") if "lag" in space.blocks else None
    refused = False

    def ended(name: str, search: Search, u: np.ndarray, report: Report = told) -> np.ndarray:
        u = np.asarray(step(name, lambda: {"u": search(problem, u, report)})["u"])
        if on_level(search):  # it weighs as it goes on; one that is remembered does not
            problem.quick_data.adapt(space.from_unit(u), fitted=True)
        return u

    for k, search in enumerate(searches):
        v = ended(f"search {k + 1}", search, u)
        if commanded and on_level(search) and not k and answers_early(problem, v):
            quick.ahead = EARLY * SIM_DT
            v = ended("search 1, early", search, v)
        if k and started_on_level and data is not quick and worse_on_level(problem, u, v):
            refused, problem, data = True, problem_of(quick, quick), quick
            break
        u = v
        # what a first search leaves is not noise: weights come from what the last one could not explain
        problem.adapt(u, fitted=k == len(searches) - 1 or on_level(search))
    if ramps is not None and falls is not None:  # how the arm slides is known by now, and by that when it let go
        arm = space.dynamics(space.from_unit(u))
        edges = breakaway(ramps, delay=float(arm.delay), lag=float(arm.lag), slide=falls.slide(arm))
        beside[:] = [falls := StaticFriction(robot, ramps, edges)]
        problem = problem_of(data, quick)
    if data is quick and commanded and PRESLIDING in space.blocks:

        def bends() -> dict[str, np.ndarray]:
            arm = space.dynamics(space.from_unit(u))
            return bending(robot, arm, recording, quick, bounds, prior, told, seed=seed, nthread=nthread)

        known = step("bristles", bends)
        beside.append(Bending(known["presliding"], known["sigma"]))
        data = TorqueResidual(robot, space, recording, **level, presliding_rad=known["presliding"])
        data.ahead = quick.ahead
        problem = problem_of(data, data)
    last = searches[-1]
    if last.local:  # a local search goes on from where it was, weighed by what is left unexplained

        def again(row: dict) -> None:
            told(row | {"search": f"{row['search']}, reweighed"})

        for k in range(REWEIGH):
            alone = lag is None or k < REWEIGH - 1
            local = last if alone else partial(without_lag, last)
            u = ended(f"reweighed {k + 1}", local, u, again)  # type: ignore[arg-type]
            problem.adapt(u, fitted=True)
        if lag is not None and np.array_equal(u[lag], problem.start[lag]):
            problem.fix(lag)
    dynamics = space.dynamics(space.from_unit(u))
    if commanded and ramps is not None:
        slide = None if falls is None else falls.slide(dynamics)
        edges = breakaway(ramps, delay=float(dynamics.delay), lag=float(dynamics.lag), slide=slide)
        command = _commands(edges, dynamics)
        dynamics = replace(space, break_command=command).dynamics(space.from_unit(u))
        dynamics = replace(dynamics, breakaway=StaticFriction(robot, ramps, edges).edges(dynamics))
        command = np.where(edges.count > 0, dynamics.breakaway - dynamics.offset[:, None], command)
        space = replace(space, break_command=command)
    if commanded and not nominal.family.has_memory and (ramps is not None or settings.breakaway):
        largest = settings.breakaway if ramps is None else None
        rule_of = partial(stiction, window_s=settings.window_s, stride=settings.stride, nthread=nthread)
        found = step("stiction", lambda: rule_of(robot, dynamics, recording, largest, told))
        rule, dq_min = HOLDS[int(found["hold"])], float(found["dq_min"])
        space = replace(space, nominal=replace(space.nominal, hold=rule, dq_min=dq_min))
        if ramps is None:
            space = replace(space, nominal=replace(space.nominal, breakaway=np.asarray(found["edges"])))
    sure = step("posterior", lambda: posterior(problem, u, seed)._asdict())
    return conclude(problem, space, sure, pd.DataFrame(history), families, edges, refused)


def on_level(search: Search) -> bool:
    """Say whether a search minimises the residual on the level of torque, and needs no replays."""
    return getattr(search, "level", "") == "torque"


def with_terms(terms: Sequence[str], more: Sequence[str]) -> list[str]:
    """Return the terms and `more`; a link has a tensor, so `link` takes the place of `inertia_scale`."""
    return [name for name in terms if not (name == "inertia_scale" and "link" in more)] + list(more)


def worse_on_level(problem: Problem, u: np.ndarray, v: np.ndarray) -> bool:
    """Say whether v (P,) explains torque clearly worse than u (P,), the fit to it.

    Two estimates of the same parameters differ by their errors: the sum of squares then rises by about P. It is in
    units that are no better than how many rows in a row say the same, of which there are a few: ALIKE.
    """
    fitted = (problem.quick(u[None])[0] ** 2).sum()
    rise = (problem.quick(v[None])[0] ** 2).sum() - fitted
    return bool(rise > max(len(u), ALIKE * fitted))


def without_lag(search: Search, problem: Problem, start: np.ndarray, report: Report) -> np.ndarray:
    """Return u (P,) of a local search without a lag, or with one where the data clearly need it.

    A short lag does to slow torques what a delay does, and together they wander. Clearly: the cost falls by more than
    the logarithm of the rows (Schwarz, Annals of Statistics 6(2), 1978), but for the half second that speaks most for
    it: rows of the same half second are not as many as they count.
    """
    lag = problem.space.where("lag")
    before, having = problem.sigma[lag], problem.residual(start[None])[0] ** 2
    problem.fix(lag)
    u = start.copy()
    u[lag] = problem.start[lag]
    u = search(problem, u, report)
    u[lag] = problem.start[lag]  # to the bit: by that it is known to be fixed
    without, rows = problem.residual(u[None])[0] ** 2, len(problem.clusters)
    most = np.bincount(problem.clusters, (without - having)[:rows]).max()
    needed = without.sum() - having.sum() - most > np.log(rows)
    problem.believe(lag, before)
    return search(problem, start, report) if needed else u


def _not_held(command: np.ndarray) -> np.ndarray:
    """Return (n, 2) Nm, the commands at which joints let go; without end where no ramp got that far."""
    return np.where(np.isnan(command), [-np.inf, np.inf], command)


def _commands(edges: Breakaway, dynamics: Dynamics) -> np.ndarray:
    """Return (n, 2) Nm, the commands at which joints let go; NaN, the nominal edge, where no ramp got that far.

    Where the joint was held against more than the nominal edge and offset say, that much is known of the edge.
    """
    beyond = np.abs(edges.tried + dynamics.offset[:, None]) > np.abs(dynamics.breakaway)
    return np.where(np.isnan(edges.command) & beyond & (edges.tried != 0), edges.tried, edges.command)
