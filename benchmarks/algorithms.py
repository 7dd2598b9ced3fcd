"""Compare DDPG, TD3, SAC and TQC at equal wall-clock time: five seeds each, one thread per training.

`python benchmarks/algorithms.py` trains the committed defaults of each algorithm, and TQC with reward=paper, and
writes benchmarks/results/algorithms.md with its figure. It skips finished trainings, so you may interrupt it. Run
folders: runs/train/algo_*.
"""

import shutil
import subprocess
import sys
from itertools import pairwise

import numpy as np
import pandas as pd
from common import RESULTS, ROOT, markdown, markdown_rows, run_parallel, write_page

from r2s.reporting.comparison.grouping import group
from r2s.reporting.comparison.scores import improvement_table, measures_in, summary_table
from r2s.reporting.comparison.trainings import read_trainings
from r2s.reporting.tables import scores_rows

ALGORITHMS = ("tqc", "sac", "td3", "ddpg")
SEEDS = range(20, 25)
MINUTES = 2.5
MARKS = {
    "95 % < 2 cm": ("success_2cm", 0.95),
    "98 % < 1 cm": ("success_1cm", 0.98),
    "95 % < 5 mm": ("success_5mm", 0.95),
}


def reached(runs: list, measure: str, level: float) -> str:
    """Return the median over seeds of minutes until an evaluation reached `level`; "-" if most seeds never did."""
    minutes = []
    for run in runs:
        good = run.curve[run.curve[measure] >= level]
        minutes.append(good["wall_clock_s"].iloc[0] / 60 if len(good) else np.inf)
    middle = float(np.median(minutes))
    return f"{middle:.1f}" if np.isfinite(middle) else "-"


def ranking(table: pd.DataFrame, measure: str) -> str:
    """Return the algorithms from best to worst with the probability of each step."""
    p = {(r["better"], r["than"]): r for r in table.to_dict("records") if r["measure"] == measure}
    names = sorted({a for a, _ in p})
    score = {a: sum(p[a, b]["probability"] for b in names if b != a) for a in names}
    order = sorted(names, key=lambda a: -score[a])
    steps = []
    for a, b in pairwise(order):
        r = p[a, b]
        steps.append(f"{a} over {b}: {r['probability']:.2f} [{r['low']:.2f}, {r['high']:.2f}]")
    return f"**{' > '.join(order)}** ({'; '.join(steps)})"


def main() -> None:
    """Train, compare, write the page."""
    jobs = {f"algo_{algo}_{seed}": [f"algo={algo}", f"seed={seed}"] for seed in SEEDS for algo in ALGORITHMS}
    jobs |= {f"algo_paper_{seed}": ["algo=tqc", "reward=paper", f"seed={seed}"] for seed in SEEDS[:2]}
    run_parallel([[f"name={name}", *words, f"budget.minutes={MINUTES}"] for name, words in jobs.items()])
    train = ROOT / "runs" / "train"
    folders = [str(train / f"algo_{a}_{s}") for a in ALGORITHMS for s in SEEDS]
    paper = [str(p) for p in sorted(train.glob("algo_paper_*"))]
    shutil.rmtree(ROOT / "runs" / "compare" / "algorithms", ignore_errors=True)
    compare = [sys.executable, "run.py", "stage=compare", "runs=runs/train/algo_*", "name=algorithms"]
    subprocess.run(compare, cwd=ROOT, check=True)
    shutil.copy(ROOT / "runs/compare/algorithms/figures/learning.png", RESULTS / "algorithms.png")
    by_algorithm = {g[0].algo: g for g in group(read_trainings(folders)[0]).members.values()}
    by_reward = {"tqc, reward=paper": read_trainings(paper)[0]} if paper else {}
    times = {
        label: {mark: reached(runs, *level) for mark, level in MARKS.items()}
        for label, runs in (by_algorithm | by_reward).items()
    }
    better = improvement_table(by_algorithm)
    updates = {a: {"updates": f"{np.median([r.last['updates'] for r in g]):,.0f}"} for a, g in by_algorithm.items()}
    groups = by_algorithm | by_reward
    scores = scores_rows(measures_in(groups), summary_table(groups)).join(
        pd.DataFrame.from_dict(updates, orient="index")
    )
    page = RESULTS / "algorithms.md"
    _, heading, grid = page.read_text().partition("\n## The paper's grid\n")  # benchmarks/grid.py writes this section
    parts = [
        f"{len(SEEDS)} seeds, {MINUTES:g} minutes and one thread per training. dr=paper, 200 goals, success for the "
        "last 0.5 s; last evaluation, interquartile mean over seeds with a 95 % bootstrap interval.",
        markdown(scores.rename_axis("success within, %").fillna("")),
        "Minutes until an evaluation first met the level, median over seeds:",
        markdown_rows(times),
        "![learning curves](algorithms.png)",
        "## Does the paper's ranking hold?",
        "Probability of improvement with a 95 % interval:",
        f"- by success within 1 cm: {ranking(better, 'success_1cm')}",
        f"- by the return under eq. (2): {ranking(better, 'return_paper')}",
    ]
    write_page("algorithms", "Four algorithms", "python benchmarks/algorithms.py", parts)
    page.write_text(page.read_text() + heading + grid)


if __name__ == "__main__":
    main()
