"""Run the paper's grid search (48 trainings of one seed) and a search with a quarter as many trials.

`python benchmarks/grid.py [SEEDS] [MINUTES]`, by default 0 and 2.5, runs `+experiment=paper_grid` and then
`+experiment=tune`, skipping finished trainings; then it writes "The paper's grid" in
benchmarks/results/algorithms.md. Run folders: runs/train/{grid,tuned}_*, runs/tune/tuned.
"""

import os
import subprocess
import sys
from collections.abc import Sequence

import pandas as pd
from common import RESULTS, ROOT, markdown, put_section, stamp

from r2s.reporting.comparison.grouping import group
from r2s.reporting.comparison.scores import sensitivity_table
from r2s.reporting.comparison.trainings import Trained, read_trainings
from r2s.reporting.tuning import against_table
from r2s.tasks.reach import REACH

ALGORITHMS = ("tqc", "sac", "td3", "ddpg")
AXES = {"algo.lr": "lr", "algo.batch_size": "batch", "algo.gamma": "gamma"}
MEASURE = "return_paper"  # selects the best setting; larger is better
SHOWN = {"success_1cm": ("< 1 cm, %", 100, 1), "success_5mm": ("< 5 mm, %", 100, 1)}
SHOWN |= {"rest": ("at rest, %", 100, 1), "return_paper": ("return", 1, 1), "env_steps": ("1000 env steps", 1e-3, 0)}
TRIALS = 12
TUNED = ROOT / "runs" / "tune" / "tuned"
GRID = "runs/train/grid_*"


def run(words: Sequence[str]) -> None:
    """Run a command of r2s; end the script if it fails."""
    if subprocess.call([sys.executable, "run.py", *words], cwd=ROOT, env=os.environ | {"OMP_NUM_THREADS": "1"}):
        sys.exit(f"failed: {' '.join(words)}")


def settings(jobs: list[Trained]) -> pd.DataFrame:
    """Return a row per algorithm and setting, mean over seeds: selection score, and last policy on unseen goals."""
    rows = []
    for r in jobs:
        axes = {axis: r.settings[key] for key, axis in AXES.items()}
        rows.append({"algo": r.algo, **axes, "selected by": r.curve[MEASURE].iloc[-1], **r.last})
    return pd.DataFrame(rows).groupby(["algo", *AXES.values()], as_index=False)[["selected by", *SHOWN]].mean()


def best_table(each: pd.DataFrame) -> pd.DataFrame:
    """Return the setting of each algorithm that its evaluations selected, scored on unseen goals."""
    best = each.loc[each.groupby("algo")["selected by"].idxmax()].set_index("algo").loc[list(ALGORITHMS)]
    settings = [f"lr {r.lr:g}, batch {r.batch:.0f}, gamma {r.gamma:g}" for r in best.itertuples()]
    out = pd.DataFrame({"setting": settings})
    out.index = pd.Index(best.index, name="best of each")
    for key, (title, scale, digits) in SHOWN.items():
        out[title] = (scale * best[key]).map(lambda x, d=digits: f"{x:.{d}f}")
    return out


def spread_table(jobs: list[Trained], each: pd.DataFrame) -> tuple[pd.DataFrame, dict[str, str]]:
    """Return best, median and worst setting per algorithm, and the smallest loss from best to median."""
    out, least, grouped = {}, {}, group(jobs).members
    for key in ("success_1cm", "return_paper"):
        title, scale, _ = SHOWN[key]
        table = sensitivity_table(grouped, key).set_index("algo").loc[list(ALGORITHMS)]
        least[title] = str(table["spread"].fillna((table["best"] - table["median"]).abs()).idxmin())
        for column in ("best", "median", "worst"):
            out[f"{column} {title}"] = (scale * table[column]).map("{:.1f}".format)
    good = (each["success_1cm"] >= 0.9).groupby(each["algo"]).agg(["sum", "count"])
    out["settings with 90 % < 1 cm"] = good.apply(lambda r: f"{r['sum']} of {r['count']}", axis=1)
    return pd.DataFrame(out).loc[list(ALGORITHMS)].rename_axis("over the settings"), least


def axes_table(each: pd.DataFrame) -> pd.DataFrame:
    """Return the median return of each algorithm at each value of each axis."""
    columns = {}
    for axis in AXES.values():
        for value, some in each.groupby(axis):
            columns[f"{axis} {value:g}"] = some.groupby("algo")["return_paper"].median().map("{:.0f}".format)
    return pd.DataFrame(columns).loc[list(ALGORITHMS)].rename_axis("median return")


def section(seeds: str, minutes: float) -> list[str]:
    """Return the paragraphs of the section."""
    jobs = read_trainings(sorted(ROOT.glob(GRID)))[0]
    each = settings(jobs)
    spread, least = spread_table(jobs, each)
    order = {
        SHOWN[key][0]: list(each.groupby("algo")[key].max().sort_values(ascending=False).index)
        for key in ("success_1cm", "return_paper")
    }
    leads = "leads" if all(names[0] == "tqc" for names in order.values()) else "does not lead in both"
    holds = "confirmed" if set(least.values()) == {"tqc"} else "not confirmed"
    ranks = "; ".join(f"by {title.removesuffix(', %')}: {' > '.join(names)}" for title, names in order.items())
    loses = "; ".join(f"by {title.removesuffix(', %')}: {name}" for title, name in least.items())
    text = [
        f"{stamp('python benchmarks/grid.py')} conf/experiment/paper_grid.yaml with budget.minutes={minutes:g} and "
        f"seed {seeds}, {len(jobs)} jobs. The return of the last evaluation selects a setting; the table shows its "
        "last policy on other goals, starts and arms.",
        markdown(best_table(each)),
        f"Best setting of each, {ranks}: TQC {leads}. Smallest loss from the best to the median setting, {loses}: "
        f"TQC as the least sensitive is {holds}. With one seed a difference of some points is chance, and the best "
        "is scored on the seed that chose it.",
        markdown(spread),
        markdown(axes_table(each)),
    ]
    trials = pd.read_csv(TUNED / "trials.csv")
    against = against_table(trials, MEASURE, str(ROOT / GRID), not REACH[MEASURE].lower_is_better)
    assert against is not None
    counts = trials["state"].value_counts()
    shown = against.map(lambda x: f"{x:.4g}").set_index("minutes").rename_axis("minutes of training")
    return [
        *text,
        f"`+experiment=tune` with {len(trials)} trials of as many minutes ({counts.get('complete', 0)} finished, "
        f"{counts.get('pruned', 0)} were stopped early): best return so far at equal compute; the grid's is the mean "
        "over random orders.",
        markdown(shown),
    ]


def main() -> None:
    """Run the grid and the search, and write the section."""
    seeds = sys.argv[1] if len(sys.argv) > 1 else "0"
    minutes = float(sys.argv[2]) if len(sys.argv) > 2 else 2.5
    run(["-m", "+experiment=paper_grid", f"budget.minutes={minutes:g}", f'grid.seed="{seeds}"'])
    if not (TUNED / "trials.csv").is_file():
        begun = [f"resume={TUNED}"] if TUNED.is_dir() else ["name=tuned"]
        run(["+experiment=tune", f"budget.minutes={minutes:g}", f"tune.trials={TRIALS}", "tune.startup=4", *begun])
    put_section(RESULTS / "algorithms.md", "The paper's grid", section(seeds, minutes))


if __name__ == "__main__":
    main()
