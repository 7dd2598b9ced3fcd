"""Compare DDPG, TD3, SAC and TQC at equal wall-clock time: five seeds each, one thread per training.

`python benchmarks/algorithms.py trials` trains each algorithm with the settings in TRIALS on the tuning seed and
prints the scores; conf/algo holds the best ones. `python benchmarks/algorithms.py` trains the committed defaults of
each algorithm, and TQC with reward=paper, and writes benchmarks/results/algorithms.md with its figure. Both skip
finished trainings, so you may interrupt them. Run folders: runs/train/{trial,algo}_*.
"""

import json
import shutil
import subprocess
import sys
from itertools import pairwise

import numpy as np
import pandas as pd
from common import RESULTS, ROOT, markdown, markdown_rows, run_parallel, write_page

from r2s.reporting.comparison.grouping import group
from r2s.reporting.comparison.scores import improvement_table, measures_in, sensitivity_table, summary_table
from r2s.reporting.comparison.trainings import read_trainings
from r2s.reporting.tables import scores_rows

ALGORITHMS = ("tqc", "sac", "td3", "ddpg")
SEEDS = range(20, 25)
MINUTES = 2.5
TUNING_SEED = 50
TRIAL_MINUTES = 1.5
TRIALS = {  # equally many per algorithm; each names its settings in full, independent of the defaults in conf/algo
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
QUIET = {  # not trials: the exploration noise of the TD3 and DDPG papers
    "td3": "algo.lr=1e-3 algo.explore_std=0.1 algo.tau=0.02 algo.policy_delay=2",
    "ddpg": "algo.lr=1e-3 algo.explore_std=0.1 algo.tau=0.02",
}
MARKS = {
    "95 % < 2 cm": ("success_2cm", 0.95),
    "98 % < 1 cm": ("success_1cm", 0.98),
    "95 % < 5 mm": ("success_5mm", 0.95),
}


def trial_jobs() -> dict[str, list[str]]:
    """Return {run name: overrides} of every trial and of the two in QUIET."""
    return {
        f"trial_{algo}_{k}": [f"algo={algo}", *words.split()]
        for algo, settings in TRIALS.items()
        for k, words in enumerate(settings)
    } | {f"quiet_{algo}": [f"algo={algo}", *words.split()] for algo, words in QUIET.items()}


def trials() -> None:
    """Train every setting of each algorithm on a seed that the comparison does not use."""
    shared = (f"seed={TUNING_SEED}", f"budget.minutes={TRIAL_MINUTES}")
    run_parallel([[f"name={name}", *words, *shared] for name, words in trial_jobs().items()])
    print(trials_table())


def trials_table() -> str:
    """Return the scores of the trials."""
    rows = {}
    for name, words in trial_jobs().items():
        path = ROOT / "runs" / "train" / name / "summary.json"
        if path.is_file():
            last = json.loads(path.read_text())["last"]
            cells = {k: f"{100 * last[f'success_{k}']:.1f}" for k in ("2cm", "1cm", "5mm")}
            rows[" ".join(words).replace("algo.", "")] = cells | {"return": f"{last['return_paper']:.1f}"}
    if not rows:
        return "Not run."
    return markdown_rows(rows, "success within, %")


def sensitivity() -> list[str]:
    """Return how much each algorithm loses with other settings than its best, and whether TQC loses least."""
    train = ROOT / "runs" / "train"
    folders = [str(train / name) for name in trial_jobs() if name.startswith("trial") and (train / name).is_dir()]
    if not folders:
        return ["Not run."]
    grouped, out, least = group(read_trainings(folders)[0]).members, [], {}
    for measure, title, scale in (("success_1cm", "< 1 cm, %", 100), ("return_paper", "return", 1)):
        table = sensitivity_table(grouped, measure).set_index("algo")
        least[title] = (table["best"] - table["median"]).abs().idxmin()  # one seed: nothing is held out
        columns = {column: f"{column} {title}" for column in ("best", "median", "worst")}
        out.append((scale * table[list(columns)]).rename(columns=columns).map("{:.1f}".format))
    losses = "; ".join(f"by {title.removesuffix(', %')}: {algo}" for title, algo in least.items())
    holds = "confirmed" if set(least.values()) == {"tqc"} else "not confirmed"
    return [
        "The paper claims that TQC is the least sensitive to its settings. Over the trials below, of one seed each, "
        f"the smallest loss from the best to the median setting is, {losses}: {holds}. An algorithm without a good "
        "setting has little to lose, and the best is scored on the seed that chose it.",
        markdown(pd.concat(out, axis=1).rename_axis("over the trials")),
    ]


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
        "last 0.5 s; last evaluation, interquartile mean over seeds with a 95 % bootstrap interval. conf/algo has "
        f"the best of {len(TRIALS['tqc'])} trials of {TRIAL_MINUTES:g} minutes (TRIALS of the script; seed "
        f"{TUNING_SEED}).",
        markdown(scores.rename_axis("success within, %").fillna("")),
        "Minutes until an evaluation first met the level, median over seeds:",
        markdown_rows(times),
        "![learning curves](algorithms.png)",
        "## Does the paper's ranking hold?",
        "Probability of improvement with a 95 % interval:",
        f"- by success within 1 cm: {ranking(better, 'success_1cm')}",
        f"- by the return under eq. (2): {ranking(better, 'return_paper')}",
        "## How much the settings matter",
        *sensitivity(),
        "## The trials",
        f"{TRIAL_MINUTES:g} minutes each, seed {TUNING_SEED}; success within 1 cm chose conf/algo. The last two rows "
        "use the exploration noise of the TD3 and DDPG papers, 0.1, which hardly moves a joint out of its dead zone.",
        trials_table(),
    ]
    write_page("algorithms", "Four algorithms", "python benchmarks/algorithms.py", parts)
    page.write_text(page.read_text() + heading + grid)


if __name__ == "__main__":
    trials() if sys.argv[1:] == ["trials"] else main()
