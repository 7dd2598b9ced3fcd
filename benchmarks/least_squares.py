"""Our least squares beside MuJoCo's, `mujoco.minimize.least_squares`, on the problems that an identification solves.

`python benchmarks/least_squares.py [SEEDS] [SECONDS]` records SECONDS (10) of the simulated Panda of known_truth.py
per seed (4) and identifies it with search=replays. Each least-squares problem on the way is solved by both, from the
same start, with the same Jacobian, until a step gains less than the same share of the cost. Then each identifies the
arm alone. Writes docs/least_squares.md.
"""

import contextlib
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial

import numpy as np
import pandas as pd
from common import MACHINE, OLD, ROBOT, ROOT, fourier, how, markdown, poses_about, ramp, record, searches
from known_truth import NOISE, TERMS, TRUTH
from mujoco.minimize import IterLog, least_squares

from r2s.arm.simulated import SimulatedArm
from r2s.identification.identify import identify
from r2s.identification.levenberg_marquardt import minimise
from r2s.identification.prediction import prediction_errors
from r2s.identification.problem import Problem, Report

OURS = "ours"
MUJOCOS = {  # options; the last come nearest to ours: damping relative to the diagonal of J^T J, in large steps
    "mujoco": {},
    "mujoco, x_scale=jac": {"x_scale": "jac"},
    "mujoco, x_scale=jac, mu_factor=10": {"x_scale": "jac", "mu_factor": 10.0},
}


class EnoughError(Exception):
    """A step gained less than asked for."""


class Counted:
    """A residual (C, P) -> (C, R) and its Jacobian (P,) -> (R, P) that count their calls and keep the best u (P,)."""

    def __init__(self, residual: Callable, jacobian: Callable):
        self._residual, self._jacobian = residual, jacobian
        self.candidates, self.jacobians, self.cost, self.u = 0, 0, np.inf, np.empty(0)

    def residual(self, u: np.ndarray) -> np.ndarray:
        """Return (C, R) for u (C, P)."""
        self.candidates += len(u)
        rows = self._residual(u)
        costs = (rows**2).sum(1)
        if costs.min() < self.cost:
            self.cost, self.u = float(costs.min()), u[costs.argmin()].copy()
        return rows

    def jacobian(self, u: np.ndarray) -> np.ndarray:
        """Return (R, P) at u (P,)."""
        self.jacobians += 1
        return self._jacobian(u)


DECISION = (  # of the day on which this was first run; read it again beside new tables
    "Ours. With its default options MuJoCo's takes up to five times as many candidates. With the two options it",
    "takes fewer, and in all less time, but on one arm's first replay problem it stopped 280 above the least",
    "cost, and the worst arm's friction and offsets came out worse. The tables were made on a machine that did",
    "other work beside: the seconds are rough, costs and counts are not.",
)


def ours(problem: Counted, start: np.ndarray, jacobians: int, ftol: float) -> None:
    """Solve by our solver, from `start` (P,), with so many Jacobians at most."""
    minimise(problem.residual, problem.jacobian, start, jacobians, ftol)


def mujocos(problem: Counted, start: np.ndarray, jacobians: int, ftol: float, **options) -> None:
    """Solve by MuJoCo's solver, with `options` of its own.

    Its tolerances, of the step and the gradient, hardly ever end it before ftol does.
    """

    def enough(trace: list[IterLog]) -> None:
        if trace[-1].reduction < ftol * trace[-1].objective:
            raise EnoughError

    with contextlib.suppress(EnoughError):
        least_squares(
            start,
            lambda u: problem.residual(u.T).T,
            bounds=[np.zeros(len(start)), np.ones(len(start))],
            jacobian=lambda u, _: problem.jacobian(u[:, 0]),
            max_iter=jacobians,
            verbose=0,
            iter_callback=enough,
            **options,
        )


SOLVERS = {OURS: ours} | {name: partial(mujocos, **options) for name, options in MUJOCOS.items()}


@dataclass
class Side:
    """A search that solves its problem by every one of `solvers`, side by side, and returns what the first found.

    Attributes:
        solvers: names in SOLVERS. first: whether the first goes first; the clock may favour one that follows another.
        level: "torque" or "residual". max_evaluations: Jacobians at most. ftol: relative gain that ends it.
        rows: of the table, added to.
    """

    solvers: list[str]
    first: bool
    level: str
    max_evaluations: int
    ftol: float
    rows: list[dict] = field(default_factory=list)
    local = True

    def __call__(self, problem: Problem, start: np.ndarray, report: Report) -> np.ndarray:
        """Return u (P,) from `start` (P,)."""
        if self.level == "residual":
            times = len({r["problem"] for r in self.rows if r["problem"].startswith("replays")})
            return self.solve(f"replays, {times + 1}", problem.residual, lambda u: problem.jacobian(u)[1], start)
        for name in ("torque", "torque, weighed again"):
            start = self.solve(name, problem.quick, problem.quick_jacobian, start)
            problem.quick_data.adapt(problem.space.from_unit(start), fitted=True)
        return start

    def solve(self, name: str, residual: Callable, jacobian: Callable, start: np.ndarray) -> np.ndarray:
        """Return u (P,) that the first solver found from `start` (P,)."""
        residual(start[None])  # nothing is loaded or compiled while the clock runs
        found, rows = {}, []
        for solver in self.solvers if self.first else reversed(self.solvers):
            p = Counted(residual, jacobian)
            began = time.perf_counter()
            SOLVERS[solver](p, start, self.max_evaluations, self.ftol)
            seconds = time.perf_counter() - began
            rows.append({"problem": name, "solver": solver, "cost": p.cost, "candidates": p.candidates})
            rows[-1] |= {"jacobians": p.jacobians, "seconds": seconds, "parameters": len(start)}
            found[solver] = p.u
        least = min(row["cost"] for row in rows)
        mine = next(row["seconds"] for row in rows if row["solver"] == self.solvers[0])
        for row in rows:
            row |= {"above": row["cost"] - least, "ratio": row["seconds"] / mine}
            print(row, flush=True)
        self.rows += rows
        return found[self.solvers[0]]


def identified(seed: int, seconds: float, solvers: list[str]) -> tuple[list[dict], dict]:
    """Identify by the first of `solvers`; return rows of its problems, and how near it came to the truth."""
    motions = [
        record(SimulatedArm(ROBOT, TRUTH, **NOISE, seed=seed), fourier(ROBOT, duration=seconds, seed=s))
        for s in (2 * seed, 2 * seed + 1)
    ]
    ramps = ramp(SimulatedArm(ROBOT, TRUTH, **NOISE, seed=seed), poses_about(ROBOT, 1))
    rows: list[dict] = []
    staged = [Side(solvers, seed % 2 == 0, s.level, s.max_evaluations, s.ftol, rows) for s in searches("replays")]
    d = identify(ROBOT, OLD, motions[0], staged, how(family="sigmoid", terms=TERMS, extra=[]), ramps=ramps).dynamics
    fastest = np.quantile(np.abs(motions[0].dq), 0.98, axis=0)
    speeds = np.linspace(-1, 1, 201)[:, None] * fastest
    curve = np.abs(d.friction(speeds) - TRUTH.friction(speeds)).max(0) / TRUTH.family.level(TRUTH.phi, fastest)
    ahead = prediction_errors(ROBOT, OLD, d, motions[1], window_s=0.2, cutoff_hz=10.0)["ee_error_mm"]
    end = {"solver": solvers[0], "curve": 100 * curve.max(), "offset": np.abs(d.offset - TRUTH.offset).max()}
    end |= {"ahead": ahead["0.5"], **{k: sum(r[k] for r in rows) for k in ("jacobians", "candidates", "seconds")}}
    print(end, flush=True)
    return [row | {"seed": seed} for row in rows], end | {"seed": seed}


def by_problem(rows: pd.DataFrame) -> pd.DataFrame:
    """Return one line of strings per problem and solver: medians over the seeds, and the worst cost."""
    lines = []
    for (problem, solver), part in rows.groupby(["problem", "solver"], sort=False):
        line = {"problem": problem, "solver": solver, "cost": f"{part['cost'].median():.1f}"}
        line |= {"above the least, median": f"{part['above'].median():.2g}", "worst": f"{part['above'].max():.2g}"}
        line |= {name: f"{part[name].median():g}" for name in ("jacobians", "candidates")}
        line |= {"seconds": f"{part['seconds'].median():.2f}", "time over ours": f"{part['ratio'].median():.2f}"}
        lines.append(line)
    return pd.DataFrame(lines).set_index("problem")


def by_solver(ends: pd.DataFrame) -> pd.DataFrame:
    """Return one line of strings per solver that did a whole identification: medians, and the worst in brackets."""
    shown = {"curve": "friction curve, worst joint, %", "offset": "offset, worst joint, mNm"}
    shown |= {"ahead": "end effector after 0.5 s, mm", "jacobians": "jacobians", "candidates": "candidates"}
    shown |= {"seconds": "seconds"}
    ours = ends[ends["solver"] == OURS].set_index("seed")["seconds"]
    lines = []
    for solver, part in ends.assign(offset=1e3 * ends["offset"]).groupby("solver", sort=False):
        line = {"solver": solver} | {t: f"{part[k].median():.3g} ({part[k].max():.3g})" for k, t in shown.items()}
        line["time over ours"] = f"{(part.set_index('seed')['seconds'] / ours).median():.2f}"
        lines.append(line)
    return pd.DataFrame(lines).set_index("solver").sort_index(key=lambda names: names != OURS)


def main() -> None:
    """Solve and write the page."""
    seeds, seconds = int((sys.argv[1:] or ["4"])[0]), float((sys.argv[2:] or ["10"])[0])
    rows = pd.DataFrame([row for seed in range(seeds) for row in identified(seed, seconds, list(SOLVERS))[0]])
    whole = [OURS, list(MUJOCOS)[-1]]
    ends = [identified(k, seconds, [s])[1] for k in range(seeds) for s in (whole if k % 2 else reversed(whole))]
    lines = [
        "# Least squares: ours and MuJoCo's",
        "",
        f"`python benchmarks/least_squares.py {seeds} {seconds:g}` on {MACHINE}.",
        f"{seeds} simulated arms of known truth, {seconds:g} s of motion, {rows['parameters'].max()} parameters.",
        "",
        "## The same problems",
        "",
        "Identification (search=replays) solves some least-squares problems on its way. Every solver gets each",
        "of them: the same start, the same Jacobian, the same bound on Jacobians. It ends where a step gains less",
        "than the same share of the cost. The identification goes on from ours. Medians over the arms.",
        "",
        "Costs are sums of squares in standard deviations: moving one parameter by one standard deviation from the",
        "best adds 1. *Candidates* are evaluations outside of Jacobians.",
        "",
        markdown(by_problem(rows)),
        "",
        "## The whole identification",
        "",
        "Every problem is solved by one solver alone, so each goes on from its own answer. Friction and offsets are",
        "compared with the truth; the end effector's error is on motion that was not fitted. Medians over the arms,",
        "the worst in brackets.",
        "",
        markdown(by_solver(pd.DataFrame(ends))),
        "",
        "## Which stays",
        "",
        *DECISION,
    ]
    (ROOT / "docs" / "least_squares.md").write_text("\n".join(lines) + "\n")
    print("written: docs/least_squares.md")


if __name__ == "__main__":
    main()
