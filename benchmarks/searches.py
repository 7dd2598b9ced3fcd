"""ga, cmaes, least_squares and staged at equal wall-clock: error on motion not fitted against time, one figure.

`python benchmarks/searches.py [SECONDS]` gives each search the recording of benchmarks/known_truth.py (seed 0) and
the same time. Writes docs/searches.md and docs/searches.png.
"""

import sys
import time

import matplotlib
import numpy as np
from common import MACHINE, OLD, ROBOT, ROOT, fourier, how, record, replace, searches
from known_truth import NOISE, TERMS, TRUTH

from r2s.arm.simulated import SimulatedArm
from r2s.identification.identify import CLEAR
from r2s.identification.problem import Problem, searched
from r2s.identification.replay_residual import ReplayResidual
from r2s.identification.torque_residual import TorqueResidual

matplotlib.use("Agg")
import matplotlib.pyplot as plt

SHOWN = 40  # moments of a search whose best candidate is judged


class Watched(Problem):
    """A Problem that remembers when which candidate was the best yet."""

    def watch(self) -> None:
        """Start the clock."""
        self.began, self.best, self.trail = time.perf_counter(), {}, []

    def _with_prior(self, data, u):
        rows = super()._with_prior(data, u)
        cost, key = (rows**2).sum(1), id(data)
        if cost.min() < self.best.get(key, np.inf):
            self.best[key] = cost.min()
            self.trail.append((time.perf_counter() - self.began, u[cost.argmin()].copy()))
        return rows

    def adapt(self, u, fitted):
        """Adapt, and judge anew: costs of other weights do not compare."""
        super().adapt(u, fitted)
        self.best = {}


def main() -> None:
    """Run every search, judge what it had found when, and draw."""
    seconds = float(sys.argv[1]) if len(sys.argv) > 1 else 60.0
    motions = [
        record(SimulatedArm(ROBOT, TRUTH, **NOISE, seed=0), fourier(ROBOT, duration=20.0, seed=s)) for s in (0, 1)
    ]
    s = how(terms=TERMS)
    nominal = replace(OLD, breakaway=TRUTH.breakaway)  # edges come from ramps, for all searches alike
    space = searched(ROBOT, nominal, s.bounds, TERMS, motions[0])
    timing = {"window_s": s.window_s, "stride": s.stride, "slowest": CLEAR * OLD.dq_min}
    judge = ReplayResidual(ROBOT, space, motions[1], window_s=0.2, stride=5, batch=SHOWN)
    figure, axis = plt.subplots(figsize=(7, 4.2), layout="constrained")
    lines = []
    for name in ("ga", "cmaes", "least_squares", "staged"):
        quick = TorqueResidual(ROBOT, space, motions[0])
        data = ReplayResidual(ROBOT, space, motions[0], **timing, batch=72)
        problem = Watched(data, quick, s.prior)
        problem.watch()
        u, count = problem.start, 0
        # stops of their own (generations, convergence) are lifted: only the clock ends a search
        free = {"generations": 100_000, "minutes": seconds / 60, "max_evaluations": 12, "patience": 100_000}
        plan = searches(name, **free) if name in ("ga", "cmaes") else searches(name)
        while time.perf_counter() - problem.began < seconds and count < 8:
            for search in plan if count == 0 else plan[-1:]:
                u = search(problem, u, lambda row: None)
                problem.adapt(u, fitted=True)
            count += 1
        trail = [p for p in problem.trail if p[0] <= seconds]
        trail = [trail[i] for i in np.unique(np.linspace(0, len(trail) - 1, SHOWN).round().astype(int))]
        at = np.array([t for t, _ in trail])
        candidates = space.from_unit(np.array([u for _, u in trail]))
        error = 1e3 * np.linalg.norm(judge.error(candidates).reshape(len(at), -1, ROBOT.n), axis=-1).mean(1)
        axis.step([*at, seconds], [*error, error[-1]], where="post", label=name)
        share = [f"{error[at <= t][-1]:.2f}" if (at <= t).any() else "" for t in (5, 15, 30, seconds)]
        lines.append(f"| {name} | " + " | ".join(share) + " |")
        print(lines[-1], flush=True)
    noise = (
        1e3
        * np.linalg.norm(
            judge.error(replace(space, nominal=replace(TRUTH)).start[None]).reshape(1, -1, ROBOT.n), axis=-1
        ).mean()
    )
    axis.axhline(noise, color="0.6", lw=1, label="the truth itself")
    axis.set(xlabel="seconds", ylabel="error of eq. (8), mrad, motion not fitted", yscale="log")
    axis.legend()
    figure.savefig(ROOT / "docs" / "searches.png", dpi=130)
    head = [
        "# Searches at equal wall-clock",
        "",
        f"`python benchmarks/searches.py` on {MACHINE}: {seconds:g} s each on the recording of known_truth.py",
        f"(seed 0; {len(space.start)} parameters). Error of eq. (8) in replays of 0.2 s of other motion, mrad; the",
        f"truth itself has {noise:.2f} (start states are measured).",
        "",
        f"| search | after 5 s | 15 s | 30 s | {seconds:g} s |",
        "|---|---|---|---|---|",
    ]
    (ROOT / "docs" / "searches.md").write_text("\n".join([*head, *lines, "", "![](searches.png)"]) + "\n")
    print("written: docs/searches.md, docs/searches.png")


if __name__ == "__main__":
    main()
