"""Why does reward=paper, eq. (2) of the paper, not reach, and what does?

`python benchmarks/paper_reward.py` trains what is missing (RUNS: three hours on one core) and writes
benchmarks/results/paper_reward.md with its figure; `page` trains nothing. Finished trainings are kept, so you may
interrupt it; the first seed of every row comes first. Run folders: runs/paper_reward/train/*.
"""

import json
import sys
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path

import numpy as np
import pandas as pd
from common import RESULTS, ROOT, markdown_rows, run_parallel, write_page
from paper_returns import GAMMAS, PROFILES, SHARES, Motions, shaking, step_cost

RUNS_AT = ROOT / "runs" / "paper_reward"
SHARED = ("budget.minutes=null", "evaluation.env_steps=62500", "evaluation.episodes=100", "dr=paper")
FALLING = {  # exploration: correlated, and falling to where a joint at rest stays at rest
    "tqc": ("algo.explore_end=0.05",),
    "ddpg": ("algo.explore_std=0.2", "algo.explore_end=0.01"),
}
EARLY = (
    "reward=to_paper",
    "reward.anneal=[0.3,0.7]",
)  # eq. (2) acts alone before noise and learning rate have fallen
ALONE = ("reward=paper", "algo.action_l2=0")
CORRELATED = ("algo.explore_correlation=0.9",)
STILLS = (0.003, 0.01, 0.03, 0.06, 0.1, 0.3)  # standard deviations of an action
PULLS = (0.0, 1.54, 3.0, 5.0, 7.0)  # S of the figure


@dataclass(frozen=True)
class Way:
    """How a training gets to eq. (2): a label, its length and its overrides."""

    label: str
    env_steps: int
    words: tuple[str, ...]
    falling: bool = True
    demonstrations: int = 0

    def job(self, name: str, algo: str, gamma: float, seed: int) -> list[str]:
        """Return the words of one training."""
        words = [*SHARED, *self.words, *(FALLING[algo] if self.falling else ()), f"algo={algo}", f"seed={seed}"]
        return [
            *words,
            f"algo.demonstrations={self.demonstrations}",
            f"algo.gamma={gamma:g}",
            f"budget.env_steps={self.env_steps}",
            f"root={RUNS_AT}",
            f"name={name}",
        ]


WAYS = {
    "settled": Way("+experiment=paper_reward", 500_000, ("+experiment=paper_reward",), falling=False),
    "alone": Way("eq. (2) alone, action_l2 0", 250_000, (*ALONE, *CORRELATED)),
    "demonstrated": Way(
        "eq. (2) alone, action_l2 0, demonstrations", 250_000, (*ALONE, *CORRELATED), demonstrations=6400
    ),
    "weighed": Way("eq. (2) alone, action_l2 0.5", 500_000, ("reward=paper", *CORRELATED)),
    "noisy": Way("curriculum that ends in eq. (2), noise stays", 500_000, EARLY, falling=False),
    "quiet": Way("curriculum that ends in eq. (2), noise falls", 500_000, EARLY),
}
SEEDS = range(3)
JUDGED = range(3, 6)  # of the settings that reach; seeds 10 and 11 chose them
RUNS = [("settled", "tqc", 0.97, seed) for seed in JUDGED]  # way, algorithm, gamma, seed
RUNS += [  # every row's first seed first
    (way, algo, gamma, seed)
    for seed in SEEDS
    for way, algos, gammas in (
        ("quiet", ("tqc",), (0.99, 0.97, 0.995)),
        ("noisy", ("tqc",), (0.99,)),
        ("weighed", ("tqc", "ddpg"), (0.99,)),
        ("demonstrated", ("tqc", "ddpg"), (0.99,)),
        ("alone", ("tqc", "ddpg"), (0.99, 0.97, 0.995, 0.95)),
    )
    for gamma in gammas
    for algo in algos
]


def folder(run: tuple[str, str, float, int]) -> Path:
    """Return the run folder of a training."""
    way, algo, gamma, seed = run
    return RUNS_AT / "train" / f"{way}_{algo}_{gamma:g}_{seed}"


def finished() -> list[tuple[str, str, float, int]]:
    """Return the trainings that have a summary."""
    return [run for run in RUNS if (folder(run) / "summary.json").is_file()]


def commit(run: tuple[str, str, float, int]) -> str:
    """Return the commit of a training, with a + for uncommitted changes."""
    git = json.loads((folder(run) / "meta.json").read_text())["git"]
    return git["commit"][:7] + "+" * git["dirty"]


def trainings_table() -> str:
    """Return a row per way, algorithm and gamma: the last policy of each seed, on the goals of all reports."""
    rows, order = {}, list(WAYS)
    done = sorted(finished(), key=lambda run: (order.index(run[0]), run[1], run[2], run[3]))
    for (way, algo, gamma), runs in groupby(done, key=lambda run: run[:3]):
        same = list(runs)
        last = [json.loads((folder(run) / "summary.json").read_text())["last"] for run in same]

        def each(key: str, scale: float, digits: int, last=last) -> str:
            return ", ".join(f"{scale * row[key]:.{digits}f}" for row in last)

        rows[f"{WAYS[way].label}; {algo}, gamma {gamma:g}"] = {
            "seeds": len(last),
            "commit": ", ".join(dict.fromkeys(commit(run) for run in same)),
            "1000 env steps": f"{last[0]['env_steps'] / 1000:.0f}",
            "< 2 cm, %": each("success_2cm", 100, 1),
            "< 1 cm, %": each("success_1cm", 100, 1),
            "median distance, mm": each("distance_median_m", 1e3, 1),
            "return": each("return_paper", 1, 1),
            "at rest, %": each("rest", 100, 1),
            "limited, %": each("limited", 100, 1),
        }
    return markdown_rows(rows, "training")


def stops_table(stops: dict) -> str:
    """Return the returns of motions that stop at a share of the initial distance."""
    head = {share: f"stops at {share:g} d0" if share else "goes to the goal" for share in SHARES}
    names = {1: "over 4 s"} | {g: f"gamma {g:g}" for g in GAMMAS}
    return markdown_rows(
        {
            f"{profile}, {name}": {head[share]: f"{stops[profile, share][key]:.1f}" for share in SHARES}
            for profile in PROFILES
            for key, name in names.items()
        },
        "best return of eq. (2)",
    )


def rest_table(motions: Motions) -> str:
    """Return what resting short of the goal is worth, and going on from there."""
    rows = {}
    for share in SHARES[1:]:
        both = motions.going_on(share)
        label = f"at rest {share:g} d0 ({1e3 * share * motions.distance[:, 0].mean():.0f} mm) short"
        rows[label] = {f"gamma {g:g}": f"{both[g][0]:.1f} / {both[g][1]:.1f}" for g in GAMMAS}
    return markdown_rows(rows, "stays / goes on")


def noise_table() -> str:
    """Return S of arms that hold still under noise on their actions, and where eq. (2) is then cheapest."""
    rows, d = {}, np.linspace(0.0, 1.0, 1001)
    for std in STILLS:
        white, kept = shaking(std, 0.0), shaking(std, 0.9)
        best = (float(d[step_cost(d, s).argmin()]) for s in (white[0], kept[0]))
        cells = [f"{white[0]:.1f}", f"{kept[0]:.1f}", *(f"{x:.2f} d0" for x in best), f"{100 * white[1]:.0f}"]
        head = ("S, white", "S, correlation 0.9", "best distance, white", "best distance, correlated", "limited, %")
        rows[f"{std:g}"] = dict(zip(head, cells, strict=True))
    return markdown_rows(rows, "standard deviation of an action")


def plot(stops: dict) -> None:
    """Draw what eq. (2) pays for stopping short, for shaking, and the distances of the trainings."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, (left, middle, right) = plt.subplots(1, 3, figsize=(13, 4), layout="constrained")
    for gamma in GAMMAS:
        lost = [100 * (stops[PROFILES[1], s][gamma] / stops[PROFILES[1], 0.0][gamma] - 1) for s in SHARES]
        left.plot(SHARES, lost, marker="o", label=f"gamma {gamma:g}")
    left.set(xlabel="stops at this share of d0", ylabel="return lost, %", title="Stopping short", yscale="symlog")
    d = np.linspace(0.0, 0.4, 201)
    for s in PULLS:
        cost = step_cost(d, s)
        middle.plot(d, cost, label=f"S = {s:g}")
        middle.plot(d[cost.argmin()], cost.min(), "ko", markersize=4)
    middle.set(xlabel="distance over d0", ylabel="cost of a step", title="Shaking, S = sum tanh|ddq|")
    colors = dict(zip(WAYS, ("k", "C3", "C4", "C1", "C0", "C2"), strict=True))
    for run in finished():
        curve = pd.read_csv(folder(run) / "evaluations.csv")
        label = WAYS[run[0]].label
        seen = right.get_legend_handles_labels()[1]
        style = "--" if run[1] == "ddpg" else "-"
        x, y = curve["env_steps"] / 1e6, 1e3 * curve["distance_median_m"]
        right.plot(x, y, style, color=colors[run[0]], label=None if label in seen else label)
    right.axhline(20.0, color="black", linestyle=":")
    right.set(
        xlabel="million env steps",
        ylabel="median distance, mm",
        yscale="log",
        ylim=(0.9, 5e3),
        title="Trainings (dashed: ddpg)",
    )
    for axis in (left, middle, right):
        axis.legend(fontsize=7)
    figure.savefig(RESULTS / "paper_reward.png", dpi=110)


def page() -> None:
    """Write the page from the finished trainings."""
    motions = Motions()
    stops = {(profile, share): motions.stopping(profile, share) for profile in PROFILES for share in SHARES}
    plot(stops)
    parts = [
        f"{len(finished())} of {len(RUNS)} trainings have finished. The last policy of each seed, on goals, "
        "starts and arms on which nothing was selected; success lasts 0.5 s. limited: cycles in which the "
        "safety filter acts. Where eq. (2) acts alone from the first step, exploration noise has a correlation of "
        "0.9 from step to step.",
        trainings_table(),
        "![](paper_reward.png)",
        "## Stopping short, without learning",
        "Straight lines in joint space to 50 goals of selection, within the allowed speeds and accelerations; the "
        "best of several durations. A discounted return includes the rest after 4 s, because episodes are truncated.",
        stops_table(stops),
        "From rest short of the goal (breakaway is not included):",
        rest_table(motions),
        "## Shaking",
        "Arms hold still for 2 s under noise on their actions. With S = sum tanh|ddq|, a step of eq. (2) costs "
        "2 d + S (0.05 / (1.15 - d) + 0.03 / (0.15 + d)): it is cheapest at the goal only for S <= 1.54.",
        noise_table(),
    ]
    write_page("paper_reward", "Eq. (2) alone", "python benchmarks/paper_reward.py", parts)


if __name__ == "__main__":
    if sys.argv[1:] not in ([], ["page"]):
        sys.exit(f"error: paper_reward.py: unknown argument '{sys.argv[1]}'; allowed: page")
    if len(sys.argv) == 1:
        run_parallel(WAYS[run[0]].job(folder(run).name, *run[1:]) for run in RUNS)
    page()
