"""Real2Sim: find friction, inertia, offsets and delay that make the simulated arm do what the recorded one did.

`identify` goes: friction family (compared on motion left out, with family=auto) -> the searches one after the other
-> again, weighed by what was left unexplained -> breakaway -> the joint distribution of what was found (block
bootstrap). The paper's algorithm is search=ga on the residual of eq. (8).
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
from r2s.identification.checks import check_recording
from r2s.identification.dead_zone import scan_breakaway
from r2s.identification.family_selection import compare_families, joints_kept
from r2s.identification.problem import NONE, Problem, Report, Search, believed, searched
from r2s.identification.replay_residual import ReplayResidual
from r2s.identification.settings import Settings
from r2s.identification.spare_terms import needed
from r2s.identification.torque_residual import TorqueResidual
from r2s.identification.uncertainty import Identified, conclude, posterior
from r2s.physics.dynamics import Dynamics, of_family
from r2s.physics.friction import FAMILIES
from r2s.physics.robot import Robot
from r2s.recordings.ramps import Ramps
from r2s.recordings.recording import Recording

REWEIGH = 2  # times that a local search goes on with weights from what is left unexplained
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
        seed: of the bootstrap.
        nthread: 0 is all.
        report: called with a row of history after every step or generation.
        memo: called with the name of a step and a function that does it, returns its result; it may remember.

    Raises:
        UserError: the recording does not fit the arm or hardly moves.
    """
    check_recording(robot, recording)
    names = [f.name for f in FAMILIES]
    bounds, terms, family = settings.bounds, settings.terms, settings.family
    prior = believed(settings.prior, robot, recording)
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
    families: dict[str, float] = {}
    if family == "auto":
        chosen = step(
            "family",
            lambda: compare_families(robot, nominal, recording, bounds, prior, terms, folds, how, told),
        )
        families = dict(zip(names, np.asarray(chosen["error"]).tolist(), strict=True))
        family = names[int(chosen["best"])]
    nominal = of_family(nominal, family)
    if spare := [name for name in settings.spare if name in terms]:

        def chosen_terms() -> dict[str, Any]:
            left = needed(robot, nominal, recording, bounds, prior, terms, spare, folds, how, told)
            return {"needed": [name in left for name in terms]}

        is_needed = np.asarray(step("terms", chosen_terms)["needed"], dtype=bool)
        terms = [name for name, keep in zip(terms, is_needed, strict=True) if keep]
    space = searched(robot, nominal, bounds, terms, recording)
    quick = TorqueResidual(robot, space, recording, **how)
    data: ReplayResidual | TorqueResidual = quick
    if recording.torque == "commanded":
        batch = min(len(space.start) + 1, 64)
        slowest = 0.0 if nominal.family.has_memory else CLEAR * nominal.dq_min  # bristles have no dead zone
        data = ReplayResidual(
            *(robot, space, recording),
            window_s=settings.window_s,
            stride=settings.stride,
            slowest=slowest,
            edges=None if ramps is None else _reached(breakaway(ramps), np.array([-np.inf, np.inf])),
            batch=batch,
            nthread=nthread,
        )
    kept = np.zeros(robot.n, dtype=bool)
    if settings.keep_nominal:
        kept = step("kept", lambda: {"kept": joints_kept(robot, space, recording, prior, folds, how)})["kept"]
    problem = Problem(data, quick, prior, np.asarray(kept, dtype=bool))
    u = problem.start
    for k, search in enumerate(searches):
        u = np.asarray(step(f"search {k + 1}", lambda s=search, u=u: {"u": s(problem, u, told)})["u"])  # type: ignore[misc]
        # what a first search leaves is not noise: weights come from what the last one could not explain
        problem.adapt(u, fitted=k == len(searches) - 1)
    last = searches[-1]
    if last.local:  # a local search goes on from where it was, weighed by what is left unexplained

        def again(row: dict) -> None:
            told(row | {"search": f"{row['search']}, reweighed"})

        for k in range(REWEIGH):
            local = partial(without_lag, last) if k == REWEIGH - 1 and "lag" in space.blocks else last
            u = np.asarray(step(f"reweighed {k + 1}", lambda s=local, u=u: {"u": s(problem, u, again)})["u"])  # type: ignore[misc]
            problem.adapt(u, fitted=True)
        if "lag" in space.blocks and u[lag := space.where("lag")] == problem.start[lag]:
            problem.believe(lag, NONE)
    dynamics, edges = space.dynamics(space.from_unit(u)), None
    window_s, stride = settings.window_s, settings.stride
    scan = partial(scan_breakaway, window_s=window_s, stride=stride, nthread=nthread, report=told)
    if ramps is not None:
        edges = breakaway(ramps, delay=float(dynamics.delay), lag=float(dynamics.lag))
        command = _reached(edges, nominal.breakaway)
        if not nominal.family.has_memory:
            dynamics = replace(dynamics, breakaway=command + dynamics.offset[:, None])
            found = step("breakaway", lambda: {"edges": scan(robot, dynamics, recording, None)})
            command = np.asarray(found["edges"]) - dynamics.offset[:, None]
        space = replace(space, break_command=command)
    elif settings.breakaway and recording.torque == "commanded":
        found = step("breakaway", lambda: {"edges": scan(robot, dynamics, recording, settings.breakaway)})
        space = replace(space, nominal=replace(nominal, breakaway=np.asarray(found["edges"])))
    sure = step("bootstrap", lambda: posterior(problem, u, seed)._asdict())
    return conclude(problem, space, sure, pd.DataFrame(history), families, None if edges is None else edges.spread)


def without_lag(search: Search, problem: Problem, start: np.ndarray, report: Report) -> np.ndarray:
    """Return u (P,) of a local search without a lag, or with one where the data clearly need it.

    A short lag does to slow torques what a delay does, and together they wander. Clearly: the cost falls by more than
    the logarithm of the rows (Schwarz, Annals of Statistics 6(2), 1978).
    """
    lag = problem.space.where("lag")
    before, free = problem.sigma[lag], problem.cost(start)
    problem.believe(lag, NONE)
    u = start.copy()
    u[lag] = problem.start[lag]
    u = search(problem, u, report)
    needed = problem.cost(u) - free > np.log(len(problem.clusters))
    problem.believe(lag, before)
    return search(problem, start, report) if needed else u


def _reached(edges: Breakaway, otherwise: np.ndarray) -> np.ndarray:
    """Return (n, 2) Nm, the commands at which joints let go; `otherwise` where no ramp got that far."""
    return np.where(np.isnan(edges.command), otherwise, edges.command)
