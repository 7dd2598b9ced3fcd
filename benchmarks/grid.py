"""The paper's experiment on its terms: eq. (2) from first to last step, four algorithms, a grid, five seeds.

`python benchmarks/grid.py` trains every setting of the grid once (SEED), then the best of each algorithm on seeds
that chose nothing (JUDGED), as many trainings at a time as there are cores, and writes "The paper's grid" in
benchmarks/results/algorithms.md. Finished trainings are kept; `page` trains nothing. Run folders:
runs/paper_grid/train/*.
"""

import sys
from itertools import product

import numpy as np
import pandas as pd
from algorithms import ALGORITHMS, ranking
from common import RESULTS, ROOT, markdown, markdown_rows, put_section, run_parallel, stamp

from r2s.reporting.comparison.grouping import group
from r2s.reporting.comparison.scores import improvement_table, measures_in, sensitivity_table, summary_table
from r2s.reporting.comparison.trainings import Trained, read_trainings
from r2s.reporting.tables import scores_rows

RUNS_AT = ROOT / "runs" / "paper_grid"
LRS = (5e-4, 1e-3, 2e-3, 4e-3)
GAMMAS = (0.97, 0.99)  # at 0.95 the last 2 cm gain nothing (benchmarks/results/paper_reward.md)
SEED, JUDGED = 70, range(75, 80)
ENV_STEPS = 200_000
MEASURE = "return_paper"  # of the last evaluation, selects a setting; larger is better
SHARED = ("reward=paper", "algo.action_l2=0", "algo.explore_end=0.05", "dr=paper", "evaluation.episodes=100")
SHARED += ("algo.demonstrations=0", "evaluation.env_steps=50000", f"root={RUNS_AT}")
SHARED += ("budget.minutes=null", f"budget.env_steps={ENV_STEPS}")


def name(algo: str, lr: float, gamma: float, seed: int) -> str:
    """Return the run folder's name of a training."""
    return f"{algo}_lr{lr:g}_gamma{gamma:g}_{seed}"


def train(algo: str, lr: float, gamma: float, seed: int) -> list[str]:
    """Return the words of a training."""
    own = (f"algo={algo}", f"algo.lr={lr:g}", f"algo.gamma={gamma:g}", f"seed={seed}")
    return [*SHARED, *own, f"name={name(algo, lr, gamma, seed)}"]


def read(*settings: tuple[str, float, float, int]) -> list[Trained]:
    """Return finished trainings."""
    return read_trainings([RUNS_AT / "train" / name(*setting) for setting in settings])[0]


def settings(algo: str) -> list[tuple[str, float, float, int]]:
    """Return the grid of an algorithm."""
    return [(algo, lr, gamma, SEED) for lr, gamma in product(LRS, GAMMAS)]


def best(algo: str) -> tuple[str, float, float]:
    """Return the setting that the last evaluations select, on the goals of selection."""
    found = {setting[:3]: read(setting)[0].curve[MEASURE].iloc[-1] for setting in settings(algo)}
    return max(found, key=lambda setting: found[setting])


def judged() -> dict[str, list[Trained]]:
    """Return the trainings of the best setting of each algorithm."""
    return {algo: read(*((*best(algo), seed) for seed in JUDGED)) for algo in ALGORITHMS}


def grid_table() -> str:
    """Return the return of the last policy of each setting, on the goals of reports."""
    rows: dict[str, dict[str, str]] = {}
    for algo in ALGORITHMS:
        runs = {setting: read(setting)[0].last[MEASURE] for setting in settings(algo)}
        rows[algo] = {f"lr {lr:g}, gamma {gamma:g}": f"{x:.0f}" for (_, lr, gamma, _), x in runs.items()}
    return markdown_rows(rows, "return")


def section() -> list[str]:
    """Return the paragraphs of the section."""
    groups = judged()
    scores = scores_rows(measures_in(groups), summary_table(groups))
    chosen = {algo: "lr {:g}, gamma {:g}".format(*best(algo)[1:]) for algo in ALGORITHMS}
    scores.insert(0, "setting", pd.Series(chosen))
    every = group([run for algo in ALGORITHMS for run in read(*settings(algo))]).members
    spread = sensitivity_table(every, MEASURE).set_index("algo").loc[list(ALGORITHMS)]
    lost = (spread["best"] - spread["median"]).sort_values()
    spread = spread[["best", "median", "worst"]].map("{:.0f}".format).rename_axis("return, over the settings")
    origin, better = next(iter(groups.values()))[0].origin, improvement_table(groups)
    reach = max(np.mean([r.last["success_2cm"] for r in g]) for g in groups.values())
    return [
        f"{stamp('python benchmarks/grid.py')} Trained on commit {origin['commit']}. Eq. (2) from first to last: "
        f"{' '.join(SHARED[:3])}, {ENV_STEPS:,} env steps, seed {SEED}. The return of the last evaluation "
        f"selects a setting; these are its last policies on {len(JUDGED)} other seeds and on other goals, starts and "
        "arms, interquartile mean with a 95 % interval:",
        markdown(scores.rename_axis("best setting").fillna("")),
        f"Probability of improvement by the return: {ranking(better, MEASURE)}.",
        f"At most {100 * reach:.1f} % of the goals are reached within 2 cm, and planned motions that reach have "
        "returns of -61 to -95 (paper_reward.md). So the ranking is one of policies that do not reach."
        if reach < 0.5
        else f"At most {100 * reach:.1f} % of the goals are reached within 2 cm.",
        grid_table(),
        markdown(spread),
        "Lost from the best to the median setting: " + ", ".join(f"{a} {x:.0f}" for a, x in lost.items()) + ".",
    ]


def main() -> None:
    """Train the grid, then the best settings, and write the section."""
    if sys.argv[1:] != ["page"]:
        run_parallel(train(*setting) for algo in ALGORITHMS for setting in settings(algo))
        run_parallel(train(*best(algo), seed) for seed in JUDGED for algo in ALGORITHMS)
    put_section(RESULTS / "algorithms.md", "The paper's grid", section())


if __name__ == "__main__":
    main()
