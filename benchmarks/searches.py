"""Compare ga, least_squares and staged at equal time: error on held-out motion over time, one figure.

`python benchmarks/searches.py [SECONDS]` gives each search the same time and the same 20 s at 1 kHz of a simulated
Panda with sensor noise, whose true values are those of the paper's NEW columns, nominal ones of the OLD columns.
Writes searches.md and searches.png of benchmarks/results.
"""

import sys
import time
from dataclasses import dataclass, field

import matplotlib
import numpy as np
from common import (
    NEW,
    OLD,
    RESULTS,
    ROBOT,
    fourier,
    identify_settings,
    markdown_rows,
    record,
    replace,
    searches,
    simulated_arm,
    write_page,
)

from r2s.arm.interface import ArmStopped
from r2s.identification.identify import CLEAR
from r2s.identification.problem import Problem
from r2s.identification.residuals.replay_residual import ReplayResidual
from r2s.identification.residuals.torque_residual import TorqueResidual
from r2s.identification.residuals.windows import cut_windows
from r2s.identification.terms import search_space

matplotlib.use("Agg")
import matplotlib.pyplot as plt

SHOWN = 40  # points of each curve
TRUTH = replace(NEW, delay=3e-3)
TERMS = ["offset", "inertia_scale", "delay", "lag"]


def record_excitation(excitation: int):
    """Return a recording of the true arm; if the arm stops itself, of another excitation."""
    try:
        return record(simulated_arm(TRUTH, 0), fourier(ROBOT, duration=20.0, seed=excitation))
    except ArmStopped as stop:
        print(f"excitation {excitation}: {stop}; taking {excitation + 1000}", flush=True)
        return record_excitation(excitation + 1000)


@dataclass
class Log:
    """Times and values of each new best candidate; costs with different weights do not compare."""

    began: float = field(default_factory=time.perf_counter)
    best: dict = field(default_factory=dict)  # least cost per residual
    trail: list = field(default_factory=list)  # (s, u (P,))


@dataclass(frozen=True, eq=False)
class TimedProblem(Problem):
    """A problem that logs the time of each new best candidate."""

    log: Log = field(default_factory=Log)

    def residual(self, u):
        """Return the residual, as `Problem` does."""
        rows = super().residual(u)
        cost = (rows**2).sum(1)
        if cost.min() < self.log.best.get(self.data, np.inf):
            self.log.best[self.data] = cost.min()
            self.log.trail.append((time.perf_counter() - self.log.began, u[cost.argmin()].copy()))
        return rows


def main() -> None:
    """Run every search, score its best candidates over time, and draw."""
    seconds = float(sys.argv[1]) if len(sys.argv) > 1 else 60.0
    motions = [record_excitation(s) for s in (0, 1)]
    settings = identify_settings(terms=TERMS)
    nominal = replace(OLD, breakaway=TRUTH.breakaway)  # every search gets the breakaway torques of ramps
    space = search_space(ROBOT, nominal, settings.bounds, TERMS, motions[0])
    windows = cut_windows(motions[0], settings.window_s, slowest=CLEAR * OLD.dq_min)
    held_out = ReplayResidual(space, motions[1], cut_windows(motions[1], 0.2), stride=5, batch=SHOWN)

    def errors(x: np.ndarray) -> np.ndarray:
        return 1e3 * np.linalg.norm(held_out.errors(x).reshape(len(x), -1, ROBOT.n), axis=-1).mean(1)

    figure, axis = plt.subplots(figsize=(7, 4.2), layout="constrained")
    rows: dict[str, dict[str, str]] = {}
    for name in ("ga", "least_squares", "staged"):
        torque_data = TorqueResidual(space, motions[0])
        data = ReplayResidual(space, motions[0], windows, stride=settings.stride, batch=72)
        problem = TimedProblem.of(data, torque_data, settings.prior)
        log, u, count = problem.log, problem.start, 0
        # only the clock ends a search: its own limits (generations, convergence) are lifted
        free = {"generations": 100_000, "minutes": seconds / 60, "max_evaluations": 12, "patience": 100_000}
        plan = searches(name, **free) if name == "ga" else searches(name)
        while time.perf_counter() - log.began < seconds and count < 8:
            for search in plan if count == 0 else plan[-1:]:
                u = search(problem, u, lambda row: None)
                problem = problem.reweighted(u, fitted=True)
            count += 1
        trail = [p for p in log.trail if p[0] <= seconds]
        trail = [trail[i] for i in np.unique(np.linspace(0, len(trail) - 1, SHOWN).round().astype(int))]
        at = np.array([t for t, _ in trail])
        error = errors(space.from_unit(np.array([u for _, u in trail])))
        axis.step([*at, seconds], [*error, error[-1]], where="post", label=name)
        moments = {f"{t:g} s": t for t in (5, 15, 30, seconds)}
        rows[name] = {k: f"{error[at <= t][-1]:.2f}" if (at <= t).any() else "" for k, t in moments.items()}
        print(name, rows[name], flush=True)
    noise = errors(replace(space, nominal=TRUTH).start[None])[0]
    axis.axhline(noise, color="0.6", lw=1, label="true parameters")
    axis.set(xlabel="seconds", ylabel="error of eq. (8), mrad, held-out motion", yscale="log")
    axis.legend()
    figure.savefig(RESULTS / "searches.png", dpi=130)
    text = (
        f"{seconds:g} s each on the same 20 s of motion ({len(space.start)} parameters). Error of "
        f"eq. (8) in replays of 0.2 s of other motion, mrad; the truth leaves {noise:.2f}."
    )
    parts = [text, markdown_rows(rows, "search, after"), "![](searches.png)"]
    write_page("searches", "Searches at equal time", "python benchmarks/searches.py", parts)


if __name__ == "__main__":
    main()
