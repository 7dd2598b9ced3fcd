"""Compare DDPG, TD3, SAC and TQC, and TQC of TorchRL and sb3-contrib: equal wall-clock time, five seeds, one thread.

`python benchmarks/algorithms.py` trains each algorithm with its committed defaults; without demonstrations; and the
peers of benchmarks/algorithms_peers.py (those whose packages are installed), which have none either; as many at a
time as there are cores. It writes benchmarks/results/algorithms.md with its figures and skips finished trainings, so
you may interrupt it; with `page` it only writes. Run folders: runs/train/shown_* (defaults), runs/train/algo_*, of
the peers runs/bench/algo_*.
"""

import json
import shutil
import subprocess
import sys
from dataclasses import replace
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from algorithms_peers import final_distances
from common import RESULTS, ROOT, conf, load_training, markdown, markdown_rows, run_scripts, write_page

from r2s.learning.evaluate import make_evaluation
from r2s.learning.randomization import UniformRandomization
from r2s.reporting.comparison.grouping import group
from r2s.reporting.comparison.scores import improvement_table, measures_in, summary_table
from r2s.reporting.comparison.statistics import interquartile_mean, interval
from r2s.reporting.comparison.trainings import Trained, read_trainings
from r2s.reporting.tables import scores_rows

ALGORITHMS = ("tqc", "sac", "td3", "ddpg")
PEERS = {"torchrl": "torchrl", "sb3": "sb3_contrib"}  # their packages
LABELS = {"torchrl": "TorchRL's TQC", "sb3": "sb3-contrib's TQC"}
SEEDS = range(65, 70)  # no setting was chosen on them
MINUTES = 2
SETS = {"algo": ("algo.demonstrations=0",), "shown": ()}  # names of runs and their settings
MARKS = {
    "95 % < 2 cm": ("success_2cm", 0.95),
    "98 % < 1 cm": ("success_1cm", 0.98),
    "95 % < 5 mm": ("success_5mm", 0.95),
    "98 % at rest": ("rest", 0.98),
}
TRAIN, BENCH = ROOT / "runs/train", ROOT / "runs/bench"


def train_all() -> None:
    """Run what is missing, seed by seed, as many trainings at a time as there are cores."""
    jobs = []
    for seed in SEEDS:
        for algo in ALGORITHMS:
            words = [f"algo={algo}", f"seed={seed}", f"budget.minutes={MINUTES}", "dr=paper", "threads=1"]
            for name, own in SETS.items():
                jobs.append(["run.py", *words, *own, f"name={name}_{algo}_{seed}", "skip_completed=true"])
        for peer in (p for p, package in PEERS.items() if find_spec(package)):
            folder = BENCH / f"algo_{peer}_{seed}"
            if not (folder / "summary.json").is_file():
                jobs.append(["benchmarks/algorithms_peers.py", peer, str(seed), str(MINUTES), str(folder)])
    run_scripts(jobs)


def read_peers(like: list[Trained]) -> dict[str, list[Trained]]:
    """Return the trainings of the peers, as trainings of r2s with the same seeds."""
    found: dict[str, list[Trained]] = {}
    for peer, label in LABELS.items():
        for own in like:
            folder = BENCH / f"algo_{peer}_{own.seed}"
            if (folder / "summary.json").is_file():
                last = json.loads((folder / "summary.json").read_text())["last"]
                curve = pd.read_csv(folder / "evaluations.csv")
                found.setdefault(label, []).append(replace(own, folder=folder, algo=label, curve=curve, last=last))
    return found


def reached(runs: list[Trained], measure: str, level: float) -> str:
    """Return the median over seeds of minutes until an evaluation reached `level`; "-" if most seeds never did."""
    minutes = []
    for run in runs:
        good = run.curve[run.curve[measure] >= level]
        minutes.append(good["wall_clock_s"].iloc[0] / 60 if len(good) else np.inf)
    middle = float(np.median(minutes))
    return f"{middle:.1f}" if np.isfinite(middle) else "-"


def at_steps(groups: dict[str, list[Trained]], env_steps: float) -> str:
    """Return a table of the evaluations at this number of env steps, interpolated in each training's curve."""
    rows = {}
    keys = {"success_2cm": "< 2 cm, %", "success_1cm": "< 1 cm, %", "success_5mm": "< 5 mm, %"}
    for label, runs in groups.items():
        rows[label] = {}
        for key, name in keys.items():
            x = np.array([100 * np.interp(env_steps, r.curve["env_steps"], r.curve[key]) for r in runs])
            low, high = interval([x], lambda d: interquartile_mean(d[0]))
            rows[label][name] = f"{float(interquartile_mean(x)):.1f} [{low:.1f}, {high:.1f}]"
        seconds = [np.interp(env_steps, r.curve["env_steps"], r.curve["wall_clock_s"]) for r in runs]
        rows[label]["minutes"] = f"{np.median(seconds) / 60:.1f}"
    return markdown_rows(rows)


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


def distances(run: Trained) -> np.ndarray:
    """Return the largest distances (goals,) m in the last 0.5 s of the selected policy, on the goals of reports."""
    path = run.folder / "distances.npy"
    if not path.is_file():
        robot, dynamics, task, policy = load_training(run.folder)
        draw = UniformRandomization(robot, dynamics, **conf("dr/paper"))
        np.save(path, final_distances(make_evaluation(robot, task, draw)(policy), task))
    return np.load(path)


def draw_profiles(path: Path, groups: dict[str, list[Trained]], shown: dict[str, list[Trained]]) -> None:
    """Draw the share of episodes of all seeds that end within a distance, with the lowest and highest seed.

    Dashed, without these: the trainings of r2s with demonstrations.
    """
    levels = np.geomspace(0.5e-3, 0.2, 120)
    figure, axis = plt.subplots(figsize=(7.5, 4.2), layout="constrained")
    for k, (label, runs) in enumerate(groups.items()):
        shares = np.stack([(distances(run)[:, None] < levels).mean(0) for run in runs])
        axis.plot(1e3 * levels, 100 * shares.mean(0), color=f"C{k}", label=label)
        axis.fill_between(1e3 * levels, 100 * shares.min(0), 100 * shares.max(0), color=f"C{k}", alpha=0.15, lw=0)
        if label in shown:
            share = np.mean([(distances(run)[:, None] < levels).mean(0) for run in shown[label]], axis=0)
            axis.plot(1e3 * levels, 100 * share, "--", color=f"C{k}", label=f"{label}, demonstrations")
    axis.set(xscale="log", xlabel="distance in the last 0.5 s, mm", ylabel="episodes within it, %", ylim=(0, 101))
    axis.grid(alpha=0.3)
    axis.legend(frameon=False)
    figure.savefig(path, dpi=110)


def read_own(name: str) -> dict[str, list[Trained]]:
    """Return the trainings of one of SETS by algorithm."""
    folders = [str(TRAIN / f"{name}_{a}_{s}") for a in ALGORITHMS for s in SEEDS]
    own = {g[0].algo: g for g in group(read_trainings(folders)[0]).members.values()}
    return {a: own[a] for a in ALGORITHMS}


def tables(groups: dict[str, list[Trained]]) -> list[str]:
    """Return the scores of the last policies, and the minutes until an evaluation met each of MARKS."""
    times = {label: {mark: reached(runs, *level) for mark, level in MARKS.items()} for label, runs in groups.items()}
    counts = {
        label: {key: f"{np.median([r.last[key] for r in runs]):,.0f}" for key in ("env_steps", "updates")}
        for label, runs in groups.items()
    }
    scores = scores_rows(measures_in(groups), summary_table(groups)).join(pd.DataFrame.from_dict(counts, "index"))
    return [
        markdown(scores.rename_axis("success within, %").fillna("")),
        "Minutes until an evaluation first met the level, median over seeds:",
        markdown_rows(times),
    ]


def ranks(own: dict[str, list[Trained]]) -> list[str]:
    """Return the rankings by success and by return."""
    better = improvement_table(own)
    return [
        "Probability of improvement with a 95 % interval:",
        f"- by success within 1 cm: {ranking(better, 'success_1cm')}",
        f"- by the return under eq. (2): {ranking(better, 'return_paper')}",
    ]


def main() -> None:
    """Train, compare, write the page."""
    if sys.argv[1:] != ["page"]:
        train_all()
    shutil.rmtree(ROOT / "runs/compare/algorithms", ignore_errors=True)
    compare = [sys.executable, "run.py", "stage=compare", "runs=runs/train/shown_*", "name=algorithms"]
    subprocess.run(compare, cwd=ROOT, check=True)
    shutil.copy(ROOT / "runs/compare/algorithms/figures/learning.png", RESULTS / "algorithms.png")
    own, shown = read_own("algo"), read_own("shown")
    groups = own | read_peers(own["tqc"])
    draw_profiles(RESULTS / "algorithms_profiles.png", groups, shown)
    least = min(r.last["env_steps"] for runs in own.values() for r in runs)
    origin, of_shown = own["tqc"][0].origin, shown["tqc"][0].origin
    page = RESULTS / "algorithms.md"
    _, heading, grid = page.read_text().partition("\n## The paper's grid\n")  # benchmarks/grid.py writes this section
    parts = [
        f"Trained on {origin['cpu']}, {origin['cores']} cores, as many trainings at a time as cores: {len(SEEDS)} "
        f"seeds, {MINUTES:g} minutes and one thread per training. dr=paper, 200 goals, success for the last 0.5 s; "
        "last policy on the goals of reports, interquartile mean over seeds with a 95 % bootstrap interval.",
        "## The defaults: with demonstrations",
        f"Commit {of_shown['commit']}.",
        *tables(shown),
        *ranks(shown),
        "![learning curves](algorithms.png)",
        "## From scratch, beside peers",
        f"`algo.demonstrations=0`; commit {origin['commit']}.",
        *tables(groups),
        f"At equal env steps, {least:,.0f}, on the goals of selection; minutes are those that the steps took:",
        at_steps(own, least),
        "Selected policies, share of episodes by their distance; bands reach from the lowest to the highest seed; "
        "dashed: with demonstrations.",
        "![performance profiles](algorithms_profiles.png)",
        "Does the paper's ranking hold?",
        *ranks(own),
    ]
    write_page("algorithms", "Four algorithms", "python benchmarks/algorithms.py", parts)
    page.write_text(page.read_text() + heading + grid)


if __name__ == "__main__":
    main()
