"""task=press with costs (Lagrange multipliers), with the driver's limit of force, with both, and with neither.

    python benchmarks/safe_learning.py

Trains TQC under the four combinations and all algorithms with costs, then writes results/safe_learning.md and
results/safe_learning.png. Finished runs are kept in runs/safe_learning and not repeated.
"""

import json
import sys

import matplotlib.pyplot as plt
import pandas as pd
from common import RESULTS, ROOT, markdown_rows, run_parallel, write_page

RUNS = ROOT / "runs" / "safe_learning"
COSTS = {"excess_force": (0.08, "N"), "impact_speed": (4e-4, "m/s")}
LIMITED = "safety.force_max=40", "safety.speed_near=0.03"
KEPT = tuple(f"costs.{name}={limit:g}" for name, (limit, _) in COSTS.items())
MEASURED = tuple(f"costs.{name}=1e6" for name in COSTS)  # limits that nothing reaches
WAYS = {"neither": MEASURED, "costs": KEPT, "limit of force": MEASURED + LIMITED, "both": KEPT + LIMITED}
ALGORITHMS = "ddpg", "sac", "td3", "tqc"
ENV_STEPS = 240_000  # of each training
LAST = 0.25  # share of a training at its end, of which means are reported


def name_of(label: str, algo: str) -> str:
    """Return the run's name."""
    return f"{algo}_{label.replace(' ', '_')}"


def metrics(name: str) -> pd.DataFrame:
    """Return metrics.csv of a run."""
    return pd.read_csv(RUNS / "train" / name / "metrics.csv")


def row_of(name: str) -> dict[str, str]:
    """Return the cells of one training: costs at its end, multipliers, interventions and the policy's measures."""
    rows = metrics(name)
    end = rows[rows.env_steps > (1 - LAST) * rows.env_steps.max()]
    cells = {}
    for cost, (limit, unit) in COSTS.items():
        mean, multiplier = end[f"term_{cost}"].mean(), -end[f"weight_{cost}"] * limit
        cells[f"{cost}, {unit}, at most {limit:g}"] = f"{mean:.3g}"
        cells[f"multiplier of {cost}"] = f"{multiplier.mean():.2f} ± {multiplier.std():.2f}"
    cells["filter active in training, %"] = f"{0.0 - 100 * end.term_filter_penalty.mean():.1f}"
    best = json.loads((RUNS / "train" / name / "summary.json").read_text())["best"]
    shown = (("return_press", "return", 1, ".0f"), ("success", "success, %", 100, ".0f"))
    shown += (("force_rmse_N", "force RMSE, N", 1, ".2f"), ("overshoot_N", "overshoot, N", 1, ".2f"))
    shown += (("impact_N", "impact, N", 1, ".1f"), ("limited", "filter active, %", 100, ".1f"))
    return cells | {label: f"{scale * best[key]:{style}}" for key, label, scale, style in shown}


def plot(names: dict[str, str]) -> None:
    """Draw costs over their limits and multipliers of the trainings against env steps."""
    figure, axes = plt.subplots(2, len(COSTS), figsize=(10, 6), sharex=True, layout="constrained")
    for (cost, (limit, unit)), (above, below) in zip(COSTS.items(), axes.T, strict=True):
        for label, name in names.items():
            rows = metrics(name)
            smooth = rows[[f"term_{cost}", f"weight_{cost}"]].rolling(10, min_periods=1).mean()
            above.plot(rows.env_steps / 1e6, smooth[f"term_{cost}"], label=label)
            below.plot(rows.env_steps / 1e6, -limit * smooth[f"weight_{cost}"], label=label)
        above.axhline(limit, color="black", linestyle=":")
        above.set(title=f"{cost.replace('_', ' ')}, {unit}", yscale="log")
        below.set(title="Lagrange multiplier", xlabel="env steps, millions")
    axes[0, 0].legend()
    figure.savefig(RESULTS / "safe_learning.png", dpi=110)


def main() -> None:
    """Train what is missing and write the page."""
    shared = "task=press", f"root={RUNS}", "budget.minutes=null", f"budget.env_steps={ENV_STEPS}"
    runs = {(label, "tqc"): words for label, words in WAYS.items()} | {("costs", algo): KEPT for algo in ALGORITHMS}
    run_parallel(
        [*shared, f"algo={algo}", f"name={name_of(label, algo)}", *words] for (label, algo), words in runs.items()
    )
    rows = {f"{algo}, {label}": row_of(name_of(label, algo)) for label, algo in runs}
    plot({algo: name_of("costs", algo) for algo in ALGORITHMS})
    table = markdown_rows(pd.DataFrame(rows).to_dict(), "training")
    text = (
        f"Means over the last quarter of each training of {ENV_STEPS:,} env steps, exploration included. The "
        "last columns are of the saved policy on the goals of all reports. Costs are means over all steps. Limit of "
        f"force: `{' '.join(LIMITED)}`."
    )
    write_page(
        "safe_learning",
        "Costs and a limit of force",
        " ".join(["python", *sys.argv]),
        [text, table, "![costs and multipliers over env steps](safe_learning.png)"],
    )


if __name__ == "__main__":
    main()
