"""Real2Sim: find friction, inertia scales and offsets that make the simulated arm do what the recorded one did.

The paper's algorithm is search=ga on the residual of eq. (8); search=least_squares polishes on the same residual;
search=ga_least_squares does one after the other. A search is a function on the unit cube; it knows nothing of arms.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Protocol

import numpy as np
import pandas as pd

from r2s.errors import UserError
from r2s.parameters import ParameterSpace, parameter_space
from r2s.recording import Recording
from r2s.residual import ReplayResidual, TorqueResidual, cut_windows, replay
from r2s.robot import Robot
from r2s.simulator import Dynamics, Simulator

HORIZONS = (0.1, 0.5, 2.0)  # s, open-loop prediction


@dataclass(frozen=True)
class SearchResult:
    """Where a search ended: u (P,) on the unit cube, Jacobian (R, P) or None, residual (R,)."""

    u: np.ndarray
    jacobian: np.ndarray | None
    residual: np.ndarray


class Search(Protocol):
    """A search: residual maps (C, P) on the unit cube to (C, R); it minimises the sum of squares of a row.

    `report` gets a dict after every step or generation: search, evaluations, cost, done, total.
    """

    def __call__(
        self, residual: Callable[[np.ndarray], np.ndarray], start: np.ndarray, report: Callable[[dict], None]
    ) -> SearchResult:
        """Search from `start` (P,) on the unit cube."""
        ...


@dataclass(frozen=True)
class Identified:
    """The result: x (P,) in SI units with its 95 % interval, which of it the data could tell, and the search."""

    space: ParameterSpace
    x: np.ndarray
    interval: tuple[np.ndarray, np.ndarray]
    identifiable: np.ndarray
    history: pd.DataFrame

    @property
    def dynamics(self) -> Dynamics:
        """The identified arm."""
        return self.space.dynamics(self.x)


def identify(
    robot: Robot,
    nominal: Dynamics,
    recording: Recording,
    searches: Sequence[Search],
    *,
    bounds: Mapping[str, Sequence[float]],
    prior: Mapping[str, float],
    window_s: float = 0.2,
    stride: int = 5,
    cutoff_hz: float = 10.0,
    breakaway: float | None = 1.5,
    folds: int = 4,
    nthread: int = 0,
    report: Callable[[dict], None] = lambda row: None,
) -> Identified:
    """Run the searches one after the other, each from where the last ended.

    Args:
        robot: the arm.
        nominal: where to start, and what blocks without bounds keep.
        recording: what the arm did; its torque decides the residual (r2s/residual.py).
        searches: at least one.
        bounds: {"phi1": [low, high], ...}, the searched blocks.
        prior: {"inertia_scale": sigma, ...}: standard deviation of what is believed about the nominal value
            (of the logarithm where the scale is logarithmic). It decides where the data cannot.
        window_s, stride: replay windows, s, and every which ms is compared (commanded torque).
        cutoff_hz: zero-phase filter (measured torque).
        breakaway: scan the dead zone's edges up to this, Nm, then run the last search again (commanded torque; a
            link-side sensor does not feel the motor's breakaway). None keeps the nominal edges.
        folds: cross-validation within the recording (measured torque): a joint whose friction and offset predict not
            clearly better than the nominal ones on motion left out keeps the nominal ones. 0: none.
        nthread: 0 is all.
        report: called with a row of history after every step or generation.

    Raises:
        UserError: the recording does not fit the arm.
    """
    if recording.n_joints != robot.n:
        raise UserError(f"the recording has {recording.n_joints} joints, {robot.name} has {robot.n}")
    space = parameter_space(robot, nominal, bounds)
    if unknown := set(prior) - set(space.blocks):
        raise UserError(f"prior: {sorted(unknown)} is not searched; bounds name {', '.join(space.blocks)}")
    data = make_residual(
        robot, space, recording, window_s=window_s, stride=stride, cutoff_hz=cutoff_hz, nthread=nthread
    )
    kept = np.zeros(robot.n, dtype=bool)
    if folds and isinstance(data, TorqueResidual):
        kept = joints_kept(robot, space, recording, searches, prior, folds, cutoff_hz)
    weigh = Weighted(data, prior, kept)
    began, history = time.perf_counter(), []

    def told(row: dict) -> None:
        history.append(row | {"seconds": time.perf_counter() - began})
        report(row)

    u = space.to_unit(space.start)
    for search in searches:
        result = search(weigh, u, told)
        u = result.u
    if breakaway and isinstance(data, ReplayResidual):
        edges = scan_breakaway(
            robot, space.dynamics(space.from_unit(u)), recording, breakaway, window_s, stride, nthread, told
        )
        data.space = space = replace(space, nominal=replace(nominal, breakaway=edges))
    weigh = Weighted(data, prior, kept, fitted=space.from_unit(u))
    if result.jacobian is not None:  # a local search goes on from where it was, weighed by what is left unexplained
        result = searches[-1](weigh, u, lambda row: told(row | {"search": f"{row['search']}, reweighed"}))
        u = result.u
    else:
        result = SearchResult(u, weigh.jacobian(u), weigh(u[None])[0])
    x = space.from_unit(u)
    assert result.jacobian is not None
    interval, identifiable = intervals(space, x, result.jacobian, result.residual, weigh.clusters, weigh.priors)
    identifiable &= ~space.of_joints(kept)
    return Identified(space, x, interval, identifiable, pd.DataFrame(history))


def joints_kept(
    robot: Robot,
    space: ParameterSpace,
    recording: Recording,
    searches: Sequence[Search],
    prior: Mapping[str, float],
    folds: int,
    cutoff_hz: float,
) -> np.ndarray:
    """Return (n,) bool: joints whose refit does not predict left-out motion at least 5 % better (RMSE).

    Published parameters are a strong start on real arms; a refit has to earn its place. Blocks of time (of phase,
    where the motion repeats itself) are left out in turn.
    """
    clock = recording.t % recording.period if recording.period else recording.t
    edges = np.quantile(clock, np.linspace(0, 1, folds + 1))
    squared = np.zeros((2, robot.n))
    for low, high in pairwise(edges):
        out = (clock >= low) & (clock <= high)
        near = (clock > low - 0.1) & (clock < high + 0.1)
        data = TorqueResidual(robot, space, recording.select(~near), cutoff_hz=cutoff_hz)
        test = TorqueResidual(robot, space, recording.select(out), cutoff_hz=cutoff_hz)
        weigh, u = Weighted(data, prior), space.to_unit(space.start)
        for search in searches:
            u = search(weigh, u, lambda row: None).u
        rows = test(np.stack([space.from_unit(u), space.start])).reshape(2, -1, robot.n)
        squared += (rows**2).sum(1)
    return squared[0] >= 0.9 * squared[1]


def scan_breakaway(
    robot: Robot,
    dynamics: Dynamics,
    recording: Recording,
    largest: float,
    window_s: float,
    stride: int,
    nthread: int,
    report: Callable[[dict], None],
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
        report(
            {
                "pass": k + 1,
                "evaluations": data.candidates,
                "done": k + 1,
                "total": passes,
                "search": "breakaway",
            }
        )
    return x.reshape(2, robot.n).T


def make_residual(
    robot: Robot,
    space: ParameterSpace,
    recording: Recording,
    *,
    window_s: float,
    stride: int,
    cutoff_hz: float,
    nthread: int = 0,
) -> ReplayResidual | TorqueResidual:
    """Return the residual that the recording's torque calls for."""
    if recording.torque == "commanded":
        batch = len(space.start) + 1
        return ReplayResidual(robot, space, recording, window_s=window_s, stride=stride, batch=batch, nthread=nthread)
    return TorqueResidual(robot, space, recording, cutoff_hz=cutoff_hz)


class Weighted:
    """The residual a search sees: each joint over its noise, and the prior as rows of its own.

    A joint's noise is the residual's own `scale`, of a `fitted` x (P,) where there is one: against what a model
    cannot explain (a delay, another friction law) a prior has to weigh more than against encoder noise. Friction and
    offset of the joints `kept` (n,) stay nominal.
    """

    def __init__(
        self,
        data: ReplayResidual | TorqueResidual,
        prior: Mapping[str, float],
        kept: np.ndarray | None = None,
        fitted: np.ndarray | None = None,
    ):
        self._data, space = data, data.space
        start = space.start
        rows = len(data.clusters) // space.n
        scale = data.scale(start, False) if fitted is None else data.scale(fitted, True)
        self._scale = np.tile(scale, rows)
        self._start = space.to_unit(start)
        sigma = np.repeat([prior.get(block, np.inf) for block in space.blocks], space.n)
        if kept is not None:
            sigma[space.of_joints(kept)] = 1e-4
        self._believed = np.flatnonzero(np.isfinite(sigma))
        self._prior = (space.spread / sigma)[self._believed]
        self.priors = len(self._believed)
        blocks = data.clusters.max() + 1 + np.arange(len(self._believed))
        self.clusters = np.concatenate([data.clusters, blocks])

    def __call__(self, u: np.ndarray) -> np.ndarray:
        """Return (C, R + priors) for u (C, P) on the unit cube."""
        data = self._data(self._data.space.from_unit(u)) / self._scale
        return np.concatenate([data, (u - self._start)[:, self._believed] * self._prior], axis=1)

    def jacobian(self, u: np.ndarray, step: float = 1e-4) -> np.ndarray:
        """Return (R + priors, P) at u (P,)."""
        h = np.where(u > 0.5, -step, step)
        r = self(np.concatenate([u[None], u + np.diag(h)]))
        return ((r[1:] - r[0]) / h[:, None]).T


def intervals(
    space: ParameterSpace,
    x: np.ndarray,
    jacobian: np.ndarray,
    residual: np.ndarray,
    clusters: np.ndarray,
    priors: int,
) -> tuple[tuple[np.ndarray, np.ndarray], np.ndarray]:
    """Return ((low, high), identifiable) of x (P,), 95 %, linearised about the result.

    Errors within a window are correlated, so the covariance is the cluster sandwich
    H^-1 (sum_w g_w g_w^T) H^-1 with H = J^T J and g_w = J_w^T r_w (Liang and Zeger 1986). It is empty where a
    residual does not depend on a parameter, so it counts no less than the model's own: data rows of the residual's
    variance, and the last `priors` rows of variance 1. A parameter counts as identifiable when its interval is
    shorter than half of its value, or a tenth of its bounds.
    """
    rows = len(residual) - priors
    data, prior = jacobian[:rows], jacobian[rows:]
    believed = prior.T @ prior + 1e-9 * np.eye(len(x))  # knowing nothing is a very wide prior
    inverse = np.linalg.inv(data.T @ data + believed)
    own = inverse @ (np.mean(residual[:rows] ** 2) * data.T @ data + believed) @ inverse
    score = np.zeros((int(clusters.max()) + 1, len(x)))
    np.add.at(score, clusters, jacobian * residual[:, None])
    variance = np.maximum(np.diag(inverse @ (score.T @ score) @ inverse), np.diag(own))
    half_unit = 1.96 * np.sqrt(variance)
    u = space.to_unit(x)
    low, high = space.from_unit(u - half_unit), space.from_unit(u + half_unit)
    width = high - low
    return (low, high), (width < 0.5 * np.abs(x)) | (width < 0.1 * (space.upper - space.lower))


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
        error = torque.predict(dynamics) - torque.motion.tau
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
