"""Four algorithms at equal wall-clock: DDPG, TD3, SAC and TQC, five seeds each, one thread per training.

`python benchmarks/algorithms.py trials` trains each algorithm with its TRIALS on the tuning seed and prints what came
out; the winners are in conf/algo. `python benchmarks/algorithms.py` trains 4 x 5 of the committed defaults and
TQC under reward=paper beside them, as many at once as there are cores, and writes docs/algorithms.md with its figure.
Both run only what is missing, so they can be stopped. Run folders: runs/train/{trial,algo}_*.
"""

import json
import shutil
import subprocess
import sys
from itertools import pairwise

import numpy as np
import pandas as pd
from common import MACHINE, ROOT, markdown, side_by_side

from r2s.reporting.comparison import improvement_table, sensitivity_table, summary_table
from r2s.reporting.grouping import group
from r2s.reporting.tables import scores_rows
from r2s.reporting.trainings import read_trainings

ALGORITHMS = ("tqc", "sac", "td3", "ddpg")
SEEDS = range(20, 25)
MINUTES = 2.5
TUNING_SEED = 50
TRIAL_MINUTES = 1.5
TRIALS = {  # as many for each; everything that differs is named, so that it stays what it was
    "tqc": [
        "algo.lr=5e-4 algo.target_entropy=-10 algo.tau=0.01",
        "algo.lr=1e-3 algo.target_entropy=-10 algo.tau=0.01",
        "algo.lr=2e-3 algo.target_entropy=-10 algo.tau=0.01",
        "algo.lr=1e-3 algo.target_entropy=-7 algo.tau=0.01",
        "algo.lr=1e-3 algo.target_entropy=-10 algo.tau=0.02",
        "algo.lr=2e-3 algo.target_entropy=-10 algo.tau=0.02",
    ],
    "sac": [
        "algo.lr=5e-4 algo.tau=0.01 algo.target_entropy=-10",
        "algo.lr=1e-3 algo.tau=0.01 algo.target_entropy=-10",
        "algo.lr=1e-3 algo.tau=0.02 algo.target_entropy=-10",
        "algo.lr=1e-3 algo.tau=0.01 algo.target_entropy=-7",
        "algo.lr=1e-3 algo.tau=0.02 algo.target_entropy=-7",
        "algo.lr=2e-3 algo.tau=0.02 algo.target_entropy=-10",
    ],
    "td3": [
        "algo.lr=1e-3 algo.explore_std=0.3 algo.tau=0.01 algo.policy_delay=2",
        "algo.lr=1e-3 algo.explore_std=0.5 algo.tau=0.01 algo.policy_delay=2",
        "algo.lr=1e-3 algo.explore_std=0.3 algo.tau=0.02 algo.policy_delay=2",
        "algo.lr=1e-3 algo.explore_std=0.3 algo.tau=0.01 algo.policy_delay=1",
        "algo.lr=1e-3 algo.explore_std=0.5 algo.tau=0.02 algo.policy_delay=2",
        "algo.lr=2e-3 algo.explore_std=0.5 algo.tau=0.02 algo.policy_delay=2",
    ],
    "ddpg": [
        "algo.lr=1e-3 algo.explore_std=0.3 algo.tau=0.01",
        "algo.lr=1e-3 algo.explore_std=0.5 algo.tau=0.01",
        "algo.lr=1e-3 algo.explore_std=0.3 algo.tau=0.02",
        "algo.lr=5e-4 algo.explore_std=0.3 algo.tau=0.01",
        "algo.lr=1e-3 algo.explore_std=0.5 algo.tau=0.02",
        "algo.lr=2e-3 algo.explore_std=0.3 algo.tau=0.02",
    ],
}
QUIET = {  # not trials: the noise that the papers of TD3 and DDPG explore with
    "td3": "algo.lr=1e-3 algo.explore_std=0.1 algo.tau=0.02 algo.policy_delay=2",
    "ddpg": "algo.lr=1e-3 algo.explore_std=0.1 algo.tau=0.02",
}
MARKS = {
    "95 % < 2 cm": ("success_2cm", 0.95),
    "98 % < 1 cm": ("success_1cm", 0.98),
    "95 % < 5 mm": ("success_5mm", 0.95),
}


def trial_jobs() -> dict[str, list[str]]:
    """Return {name of a run: its words} of every trial, and of the quiet two."""
    return {
        f"trial_{algo}_{k}": [f"algo={algo}", *words.split()]
        for algo, settings in TRIALS.items()
        for k, words in enumerate(settings)
    } | {f"quiet_{algo}": [f"algo={algo}", *words.split()] for algo, words in QUIET.items()}


def trials() -> None:
    """Try every setting on its algorithm, on a seed that is not compared later."""
    shared = (f"seed={TUNING_SEED}", f"budget.minutes={TRIAL_MINUTES}")
    side_by_side([[f"name={name}", *words, *shared] for name, words in trial_jobs().items()])
    print(trials_table())


def trials_table() -> str:
    """Return what came out of the trials."""
    rows = {}
    for name, words in trial_jobs().items():
        path = ROOT / "runs" / "train" / name / "summary.json"
        if path.is_file():
            last = json.loads(path.read_text())["last"]
            cells = {k: f"{100 * last[f'success_{k}']:.1f}" for k in ("2cm", "1cm", "5mm")}
            rows[" ".join(words).replace("algo.", "")] = cells | {"return": f"{last['return_paper']:.1f}"}
    if not rows:
        return "Not run."
    return markdown(pd.DataFrame.from_dict(rows, orient="index").rename_axis("success within, %"))


def sensitivity() -> list[str]:
    """Return how much each algorithm lost by other settings than its best, and whether TQC lost least."""
    train = ROOT / "runs" / "train"
    folders = [str(train / name) for name in trial_jobs() if name.startswith("trial") and (train / name).is_dir()]
    if not folders:
        return ["Not run."]
    grouped, out, least = group(read_trainings(folders)[0]).members, [], {}
    for measure, title, scale in (("success_1cm", "< 1 cm, %", 100), ("return_paper", "return", 1)):
        table = sensitivity_table(grouped, measure).set_index("algo")
        least[title] = table["spread"].idxmin()
        columns = {column: f"{column} {title}" for column in ("best", "median", "worst")}
        out.append((scale * table[list(columns)]).rename(columns=columns).map("{:.1f}".format))
    said = "; ".join(f"by {title.removesuffix(', %')}: {algo}" for title, algo in least.items())
    holds = "confirmed" if set(least.values()) == {"tqc"} else "not confirmed"
    return [
        "The paper claims that TQC is the least sensitive to its settings. Over the trials below, of one seed each, "
        f"the least is lost from the best to the median setting {said}: {holds}. Read with the table: where no "
        "setting was good there is little to lose.",
        markdown(pd.concat(out, axis=1).rename_axis("over the trials")),
    ]


def reached(runs: list, measure: str, level: float) -> str:
    """Return the median over seeds of the minutes until an evaluation first had `level`; "-": most seeds never."""
    minutes = []
    for run in runs:
        there = run.curve[run.curve[measure] >= level]
        minutes.append(there["wall_clock_s"].iloc[0] / 60 if len(there) else np.inf)
    middle = float(np.median(minutes))
    return f"{middle:.1f}" if np.isfinite(middle) else "-"


def ranking(table: pd.DataFrame, measure: str) -> str:
    """Return the algorithms from best to worst, and how sure each step is."""
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
    side_by_side([[f"name={name}", *words, f"budget.minutes={MINUTES}"] for name, words in jobs.items()])
    train = ROOT / "runs" / "train"
    folders = [str(train / f"algo_{a}_{s}") for a in ALGORITHMS for s in SEEDS]
    paper = [str(p) for p in sorted(train.glob("algo_paper_*"))]
    name = "name=algorithms"
    shutil.rmtree(ROOT / "runs" / "compare" / "algorithms", ignore_errors=True)
    subprocess.run([sys.executable, "run.py", "stage=compare", "runs=runs/train/algo_*", name], cwd=ROOT, check=True)
    shutil.copy(ROOT / "runs/compare/algorithms/figures/learning.png", ROOT / "docs/algorithms.png")
    by_algorithm = {g[0].algo: g for g in group(read_trainings(folders)[0]).members.values()}
    by_reward = {"tqc, reward=paper": read_trainings(paper)[0]} if paper else {}
    times = {
        label: {mark: reached(runs, *what) for mark, what in MARKS.items()}
        for label, runs in (by_algorithm | by_reward).items()
    }
    better = improvement_table(by_algorithm)
    updates = {a: {"updates": f"{np.median([r.last['updates'] for r in g]):,.0f}"} for a, g in by_algorithm.items()}
    scores = scores_rows(summary_table(by_algorithm | by_reward)).join(
        pd.DataFrame.from_dict(updates, orient="index")
    )
    pages = [
        "# Four algorithms at equal wall-clock",
        f"`python benchmarks/algorithms.py` on {MACHINE}: {len(SEEDS)} seeds each, {MINUTES:g} minutes of wall clock "
        "and one thread per training, two trainings at a time. dr=paper, 200 goals, success held for the last 0.5 s; "
        "last evaluation, interquartile mean over seeds with a 95 % bootstrap interval. Networks, replay, curriculum "
        "and evaluation are shared; each algorithm has the settings of conf/algo, the best of "
        f"{len(TRIALS['tqc'])} trials of {TRIAL_MINUTES:g} minutes (TRIALS of the script; seed {TUNING_SEED}).",
        markdown(scores.rename_axis("success within, %").fillna("")),
        "Minutes until an evaluation first got there, median over seeds:",
        markdown(pd.DataFrame.from_dict(times, orient="index").rename_axis("")),
        "![learning curves](algorithms.png)",
        "## Does the paper's ranking hold?",
        "The paper finds TQC best. Here, by the probability that a run of the one is better than a run of the other, "
        "with a 95 % interval:",
        f"- by success within 1 cm: {ranking(better, 'success_1cm')}",
        f"- by the return under eq. (2): {ranking(better, 'return_paper')}",
        "## How much the settings matter",
        *sensitivity(),
        "## The trials",
        f"{TRIAL_MINUTES:g} minutes each, seed {TUNING_SEED}; by success within 1 cm the best of each algorithm is "
        "what conf/algo has. The last two rows are no trials: they have the noise that the papers of TD3 and DDPG "
        "explore with, 0.1, which asks for 1 Nm and hardly ever moves a joint out of its dead zone.",
        trials_table(),
    ]
    page = ROOT / "docs" / "algorithms.md"
    grid = page.read_text().partition("\n## The paper's grid\n")[1:]  # benchmarks/grid.py wrote it
    page.write_text("\n\n".join(pages) + "\n" + "".join(grid))
    print("written: docs/algorithms.md")


if __name__ == "__main__":
    trials() if sys.argv[1:] == ["trials"] else main()
