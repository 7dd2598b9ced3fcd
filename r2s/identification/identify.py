"""Real2Sim: estimate the parameters with which the simulated arm reproduces a recording.

`identify` runs STEPS in order. Each step computes a new `State` from the previous `State`. search=ga on the replay
residual corresponds to the paper's algorithm, eq. (8).
"""

import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from r2s.identification.checks import check_motion
from r2s.identification.friction.breakaway import Breakaway, Slide, estimate_breakaway
from r2s.identification.friction.presliding import NAME as PRESLIDING
from r2s.identification.friction.presliding import Presliding, estimate_presliding
from r2s.identification.friction.static_friction import StaticFriction
from r2s.identification.friction.stiction import choose_stiction
from r2s.identification.known import Known
from r2s.identification.parameters import ParameterSpace
from r2s.identification.posterior import posterior
from r2s.identification.prediction import REPLAYED_S
from r2s.identification.problem import (
    Problem,
    Report,
    Search,
    fit_torque,
    fits_torque,
    implicit_friction,
    search_lag,
    worse_on_torque,
)
from r2s.identification.residuals.replay_residual import ReplayResidual
from r2s.identification.residuals.torque_residual import TorqueResidual
from r2s.identification.residuals.windows import SCATTER, cut_windows
from r2s.identification.result import IdentificationResult, conclude
from r2s.identification.settings import Settings
from r2s.identification.stated import check_stated, stated_prior
from r2s.identification.structure.backward_elimination import eliminate_terms
from r2s.identification.structure.cross_validation import CrossValidation
from r2s.identification.structure.family_selection import compare_families
from r2s.identification.structure.forward_selection import select_terms
from r2s.identification.structure.late_signals import DELAY, late_signals
from r2s.identification.terms import add_terms, optional_friction, scaled_prior, search_space
from r2s.physics.actuation import EARLY
from r2s.physics.dynamics import STICTION_MODELS, Dynamics, with_family
from r2s.physics.friction import FAMILIES
from r2s.physics.robot import SIM_DT, Robot
from r2s.recordings.parts import give_back, spread
from r2s.recordings.ramps import Ramps
from r2s.recordings.recording import Recording

STANDSTILL = 0.02  # rad/s; for commanded torque, friction below this speed is not a function of velocity
CLEAR = 1.5  # a replayed joint slower than this multiple of dq_min may stick
MAX_BATCH = 64  # candidates replayed at once
SELECTED_S = 240.0  # s; the selection of friction family and terms uses at most this much of a recording
REWEIGHTS = 2  # further fits of a local search, each with weights from the residual of the previous fit
Memo = Callable[[str, Callable[[], dict[str, Any]]], dict[str, Any]]


class History:
    """Progress rows of an identification, stored with each step's arrays so that an interrupted run can resume."""

    def __init__(self, report: Report, memo: Memo):
        self.rows: list[dict] = []
        self._report, self._memo, self._began = report, memo, time.perf_counter()

    def add(self, row: dict) -> None:
        """Append a progress row, with the seconds since the start, and report the row."""
        self.rows.append(row | {"seconds": time.perf_counter() - self._began})
        self._report(row)

    def step(self, name: str, make: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        """Return the arrays that an interrupted run stored under `name`, else the arrays that `make` computes."""
        before = len(self.rows)
        done = self._memo(name, lambda: make() | {"history": json.dumps(self.rows[before:])})
        if len(self.rows) == before:
            self.rows.extend(json.loads(str(done["history"])))
        return done


@dataclass(frozen=True, eq=False)
class State:
    """Intermediate result of an identification: every step reads a `State` and returns a new `State`.

    Attributes:
        robot, nominal, recording, searches, settings, ramps: see `identify`. `select_family` sets nominal.family.
        prior: {parameter: prior standard deviation in SI units}. terms: model terms to estimate besides friction.
        unpruned: terms before the removal by `prune_terms`; () if `prune_terms` removed no term.
        families: {friction family: relative error of held-out torque}; empty if the user chose the family.
        space: the parameter space; `fit_breakaway` adds breakaway commands, `fit_stiction` the stiction model.
        problem, u: the least-squares problem and its solution (P,) on the unit cube.
        edges: breakaway commands estimated from ramps. static_friction: residual of friction at the onset of
            sliding, only for friction families with a Stribeck effect.
        refused: whether `fit` discarded the replay fit. dynamics: the fitted arm, with breakaway torques.
    """

    robot: Robot
    nominal: Dynamics
    recording: Recording
    searches: Sequence[Search]
    settings: Settings
    ramps: Ramps | None
    prior: dict[str, ArrayLike]
    history: History
    terms: Sequence[str] = ()
    unpruned: Sequence[str] = ()
    families: dict[str, float] = field(default_factory=dict)
    space: ParameterSpace = None  # type: ignore[assignment] # `formulate` sets these three
    problem: Problem = None  # type: ignore[assignment]
    u: np.ndarray = None  # type: ignore[assignment]
    edges: Breakaway | None = None
    static_friction: StaticFriction | None = None
    refused: bool = False
    dynamics: Dynamics = None  # type: ignore[assignment] # `fit_breakaway` sets it

    @property
    def commanded(self) -> bool:
        """Whether the recorded torque is the command; replays, delay and breakaway torques require commands."""
        return self.recording.torque == "commanded"

    @property
    def slowest(self) -> float:
        """Speed in rad/s that a joint must exceed in every row of the torque residual."""
        return STANDSTILL if self.commanded else 0.0

    @property
    def cross_validation(self) -> CrossValidation:
        """The cross-validation that selects the friction family and the terms."""
        s, data = self.settings, (self.robot, self.nominal, spread(self.recording, SELECTED_S))
        return CrossValidation(*data, s.bounds, self.prior, s.folds, s.cutoff_hz, self.history.add, s.stated)

    def fitted(self) -> Dynamics:
        """Return the dynamics of the fitted arm."""
        return self.space.dynamics(self.space.from_unit(self.u))

    def slide(self, arm: Dynamics) -> Slide | None:
        """Predict motion after breakaway; None without ramps, without Stribeck effect, or for bristle friction."""
        if self.static_friction is None or self.nominal.family.has_memory:
            return None
        return self.static_friction.slide(arm)


def identify(
    robot: Robot,
    nominal: Dynamics,
    recording: Recording,
    searches: Sequence[Search],
    settings: Settings,
    *,
    ramps: Ramps | None = None,
    report: Report = lambda row: None,
    memo: Memo = lambda name, make: make(),
) -> IdentificationResult:
    """Estimate the parameters of an arm and their 95 % intervals.

    Args:
        robot: the arm. nominal: dynamics at which searches start; parameters that are not estimated stay nominal.
        recording: the training motion; only commanded torque allows replay residuals.
        searches: one or more searches; each starts at the solution of the previous one.
        settings: options of the identification, see settings.py.
        ramps: recorded ramps; without ramps, replays of `recording` determine the breakaway torques.
        report: function that is called with a row of progress after every step or generation.
        memo: function memo(name, make) that returns the arrays stored under `name`, else the result of make().

    Raises:
        UserError: the recording does not fit the arm or contains too little motion, or a stated value is wrong.
    """
    check_motion(robot, recording)
    check_stated(settings.stated, robot.n)
    prior, history = scaled_prior(settings.prior, robot, recording, nominal), History(report, memo)
    s = State(robot, nominal, recording, searches, settings, ramps, prior, history, settings.terms)
    for step in STEPS:
        give_back(recording)
        s = step(s)
    sure = history.step("posterior", lambda: posterior(s.problem, s.u, settings.seed)._asdict())
    full = {} if s.commanded else history.step("draws of all terms", lambda: draw_full_model(s))
    story = {"families": s.families, "edges": s.edges, "refused": s.refused}
    return conclude(s.problem, s.space, sure, full, history=pd.DataFrame(history.rows), **story)


def select_family(s: State) -> State:
    """Set the user's friction family or, for family=auto, the family that cross-validation selects."""
    family, families = s.settings.family, {}
    if family == "auto":
        found = s.history.step("family", lambda: compare_families(s.cross_validation, s.terms, s.slowest))
        names = [f.name for f in FAMILIES]
        families = dict(zip(names, np.asarray(found["error"]).tolist(), strict=True))
        family = names[int(found["best"])]
    return replace(s, nominal=with_family(s.nominal, family), families=families)


def settle_lateness(s: State) -> State:
    """Decide whether to correct late link-side torque and dq; for uncorrected torque, set `signal_delay` to 0."""
    nominal = replace(s.nominal, late_alike=False)
    if s.recording.torque != "measured" or DELAY in s.settings.stated:
        return replace(s, nominal=nominal)
    found = s.history.step("lateness", lambda: late_signals(s.cross_validation, s.terms))
    if found["delayed"]:
        return replace(s, nominal=nominal)
    nominal = replace(nominal, signal_delay=0.0, late_alike=bool(found["alike"]))
    return replace(s, nominal=nominal, terms=[name for name in s.terms if name != DELAY])


def add_candidate_terms(s: State) -> State:
    """Add the candidate terms that improve the prediction of held-out torque."""
    absent = {*optional_friction()} - {*s.nominal.family.optional}  # friction terms that the friction family lacks
    candidates = [name for name in s.settings.candidate_terms if name not in absent]
    if not candidates:
        return s
    given = s.cross_validation, s.terms, candidates, s.slowest
    entered = s.history.step("candidate terms", lambda: select_terms(*given))["entered"]
    return replace(s, terms=add_terms(s.terms, [name for name, e in zip(candidates, entered, strict=True) if e]))


def prune_terms(s: State) -> State:
    """Remove the prunable terms that are not necessary to predict held-out torque."""
    prunable = [name for name in s.settings.prunable_terms if name in s.terms]
    if not prunable:
        return s
    given = s.cross_validation, s.terms, prunable
    needed = s.history.step("prunable terms", lambda: eliminate_terms(*given))["needed"]
    kept = [name for name, keep in zip(s.terms, needed, strict=True) if keep]
    return replace(s, terms=kept, unpruned=s.terms if len(kept) < len(s.terms) else ())


def draw_full_model(s: State) -> dict[str, np.ndarray]:
    """Return unit-cube draws (S, P) of the selected model's values, from a posterior with all terms and wide priors.

    A selected model has too narrow intervals (Leeb and Poetscher, Econometric Theory 21(1), 2005). Its parameters
    compensate for the removed parameters: for example, a payload compensates for the error of a link's mass. The main
    fit's priors serve prediction; priors narrower than the scatter among arms narrow the intervals further. For the
    result's intervals, draws of full and selected model have equal weight (Hoeting et al., Stat. Sci. 14(4), 1999).
    """
    full = formulate(replace(s, terms=s.unpruned or s.terms))
    u, problem = fit_torque(full.problem.with_usual_prior())
    draws = u + posterior(problem.reweighted(u, fitted=True), u, s.settings.seed).steps
    return {"draws": draws[:, [full.space.names.index(name) for name in s.space.names]]}


def formulate(s: State) -> State:
    """Set up the parameter space, the residuals and the least-squares problem."""
    how, memory = s.settings, s.nominal.family.has_memory
    settled = [DELAY] if DELAY in how.terms and DELAY not in s.terms else []  # DELAY stays 0, see `settle_lateness`
    space = search_space(s.robot, s.nominal, how.bounds, [*s.terms, *settled], s.recording, how.stated)
    s = s if s.recording.period else replace(s, recording=s.recording.in_phase())  # `blocks_of` needs the period
    torque_data = TorqueResidual(space, s.recording, cutoff_hz=how.cutoff_hz, slowest=s.slowest)
    data: ReplayResidual | TorqueResidual = torque_data
    edges = estimate_breakaway(s.ramps) if s.commanded and s.ramps is not None else None
    # for a family with memory, replays start from unknown bristle deflections and would worsen a good torque fit
    if s.commanded and not all(map(fits_torque, s.searches)) and not (memory and fits_torque(s.searches[0])):
        slowest = 0.0 if memory else CLEAR * s.nominal.dq_min  # bristle friction has no dead zone
        released = None
        if edges is not None:
            scattered = edges.command + SCATTER * s.robot.tau_max.max() * np.array([-1.0, 1.0])
            released = np.where(np.isnan(scattered), [-np.inf, np.inf], scattered)
        replayed = spread(s.recording, REPLAYED_S)
        windows = cut_windows(replayed, how.window_s, slowest=slowest, edges=released)
        batch = min(len(space.start) + 1, MAX_BATCH)
        data = ReplayResidual(space, replayed, windows, stride=how.stride, batch=batch, nthread=how.nthread)
    static = None
    if s.ramps is not None and edges is not None and "rise" in space.blocks:
        static = StaticFriction(s.robot, s.ramps, edges)
    known = known_values(space, how, s.prior)
    problem = Problem.of(data, torque_data, s.prior, [x for x in (static, known) if x is not None])
    problem = problem if known is None else problem.without_prior(known.names)
    problem = problem.fixed(space.where(DELAY)) if settled else problem
    return replace(s, space=space, problem=problem, u=problem.start, edges=edges, static_friction=static)


def known_values(space: ParameterSpace, how: Settings, prior: Mapping[str, ArrayLike]) -> Known | None:
    """Return the user's prior, completed by the prior from an earlier identification; None if both are missing."""
    stated = stated_prior(space, how.stated, prior)
    if how.known is None:
        return stated
    known = how.known.where(lambda name: name in space.names and name not in space.fixed).beside(stated)
    return known if known.names else None


def fit(s: State) -> State:
    """Run the searches in order; discard a replay fit that explains torque clearly worse than the torque fit."""
    problem, u = s.problem, s.u
    for k, search in enumerate(s.searches):
        v, problem = _run(s, f"search {k + 1}", search, problem, u)
        if s.commanded and fits_torque(search) and not k and implicit_friction(problem, v):
            problem = problem.with_torque_data(problem.torque_data.with_lead(EARLY * SIM_DT))
            v, problem = _run(s, "search 1, implicit friction", search, problem, v)
        if k and fits_torque(s.searches[0]) and problem.uses_replays and worse_on_torque(problem, u, v):
            return replace(s, problem=replace(problem, data=problem.torque_data), u=u, refused=True)
        u = v
        # fitted=True only after a torque search or the last search: residuals of earlier replays contain model error
        problem = problem.reweighted(u, fitted=k == len(s.searches) - 1 or fits_torque(search))
    return replace(s, problem=problem, u=u)


def reread_ramps(s: State) -> State:
    """Estimate the breakaway commands again, now with the fitted delay, lag and motion after breakaway."""
    arm = s.fitted()
    if s.ramps is None or (slide := s.slide(arm)) is None:
        return s
    edges = estimate_breakaway(s.ramps, delay=float(arm.delay), lag=float(arm.lag), slide=slide)
    static = StaticFriction(s.robot, s.ramps, edges)
    extra = (static, *(x for x in s.problem.extra if not isinstance(x, StaticFriction)))
    return replace(s, problem=replace(s.problem, extra=extra), edges=edges, static_friction=static)


def fit_presliding(s: State) -> State:
    """Estimate the presliding distance from replays, after a torque fit of a friction family with memory."""
    if s.problem.uses_replays or not s.commanded or PRESLIDING not in s.space.blocks:
        return s
    how, torque_data = s.settings, s.problem.torque_data

    def estimate() -> dict[str, np.ndarray]:
        draws = s.u + posterior(s.problem, s.u, how.seed).steps
        known = Known.of(s.space, s.space.from_unit(s.u), s.space.from_unit(draws))
        given = s.fitted(), spread(s.recording, REPLAYED_S), torque_data, known, s.prior
        return estimate_presliding(*given, how.seed, how.nthread, s.history.add)

    found = s.history.step("presliding", estimate)
    data = torque_data.on(s.space).with_presliding(s.recording, found["presliding"])
    extra = (*s.problem.extra, Presliding(found["presliding"], found["sigma"]))
    x, u, at = s.space.start.copy(), s.u.copy(), s.space.where(PRESLIDING)
    x[at] = found["presliding"]
    u[at] = np.clip(s.space.to_unit(x)[at], 0.0, 1.0)
    problem = replace(s.problem, data=data, torque_data=data, extra=extra)
    problem = problem.without_prior([s.space.names[k] for k in at])  # `Presliding` contains this prior
    return replace(s, problem=problem.reweighted(u, fitted=True), u=u)


def reweight(s: State) -> State:
    """If the last search is local, repeat it with weights from the residual; decide whether to estimate a lag."""
    search = s.searches[-1]
    if not search.local:
        return s
    problem, u = s.problem, s.u
    lag = s.space.where("lag") if "lag" in s.space.blocks else None

    def report(row: dict) -> None:
        s.history.add(row | {"search": f"{row['search']}, reweighted"})

    for k in range(REWEIGHTS):
        local = search if lag is None or k < REWEIGHTS - 1 else partial(search_lag, lag, search)
        u, problem = _run(s, f"reweighted {k + 1}", local, problem, u, report)  # type: ignore[arg-type]
        problem = problem.reweighted(u, fitted=True)
    if lag is not None and np.array_equal(u[lag], problem.start[lag]):
        problem = problem.fixed(lag)
    return replace(s, problem=problem, u=u)


def fit_breakaway(s: State) -> State:
    """Compute breakaway torques: breakaway commands plus offset, drag and gravity error of the fitted arm."""
    arm, space = s.fitted(), s.space
    if not s.commanded or s.ramps is None:
        return replace(s, dynamics=arm)
    edges = estimate_breakaway(s.ramps, delay=float(arm.delay), lag=float(arm.lag), slide=s.slide(arm))
    # if no ramp moved a joint, the joint's breakaway torque is at least its largest ramp command plus the offset
    beyond = np.abs(edges.held + arm.offset[:, None]) > np.abs(arm.breakaway)
    command = np.where(np.isnan(edges.command) & beyond & (edges.held != 0), edges.held, edges.command)
    arm = replace(space, breakaway_command=command).dynamics(space.from_unit(s.u))
    breakaway = StaticFriction(s.robot, s.ramps, edges).breakaway(arm)
    # a direction may lack a usable ramp, for example if the joint slid before its command rose. Stiction is similar
    # in both directions, so r2s uses the opposite direction's value
    blind = (edges.count == 0) & (edges.held == 0) & (edges.count[:, ::-1] > 0)
    breakaway = np.where(blind, -breakaway[:, ::-1], breakaway)
    command = np.where((edges.count > 0) | blind, breakaway - arm.offset[:, None], command)
    arm = replace(arm, breakaway=breakaway)
    return replace(s, edges=edges, space=replace(space, breakaway_command=command), dynamics=arm)


def fit_stiction(s: State) -> State:
    """Choose the stiction model and, if no ramps were recorded, scan for the breakaway torques."""
    how, ramped = s.settings, s.ramps is not None
    if not s.commanded or s.nominal.family.has_memory or not (ramped or how.breakaway):
        return s
    given = s.robot, s.dynamics, spread(s.recording, REPLAYED_S), None if ramped else how.breakaway, s.history.add
    rest: dict[str, Any] = {"window_s": how.window_s, "stride": how.stride, "nthread": how.nthread}
    found = s.history.step("stiction", lambda: choose_stiction(*given, **rest))
    own: dict[str, Any] = {"stiction_model": STICTION_MODELS[int(found["model"])], "dq_min": float(found["dq_min"])}
    own |= {} if ramped else {"breakaway": np.asarray(found["breakaway"])}
    return replace(s, space=replace(s.space, nominal=replace(s.space.nominal, **own)))


STEPS: tuple[Callable[[State], State], ...] = (
    *(select_family, settle_lateness, add_candidate_terms, prune_terms, formulate, fit),
    *(reread_ramps, fit_presliding, reweight, fit_breakaway, fit_stiction),
)


def _run(
    s: State, name: str, search: Search, problem: Problem, u: np.ndarray, report: Report | None = None
) -> tuple[np.ndarray, Problem]:
    """Return the solution of a search, and the problem, which is reweighted if the search fits torque."""
    v = np.asarray(s.history.step(name, lambda: {"u": search(problem, u, report or s.history.add)})["u"])
    return v, problem.torque_reweighted(v) if fits_torque(search) else problem
