"""Measure Sim2Real on hidden twins on which nothing was tuned, and what velocity noise in training is for.

Each part skips finished runs; without a part the script only writes benchmarks/results/transfer.md:
    python benchmarks/transfer.py twins [SEED ...]  identify, train, transfer: identified and nominal, without DR,
                                                    one training seed (100-109 rigid, 200-209 elastic)
    python benchmarks/transfer.py noise [SEED ...]  trainings with and without velocity noise, on elastic development
                                                    twins, by default 0
All runs go through run.py, into run folders named judge_* and noise_*.
"""

import json
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from common import (
    JUDGING,
    RESULTS,
    ROOT,
    markdown,
    markdown_rows,
    put_section,
    run_parallel,
    stamp,
    twin_variant,
)

RUNS = ROOT / "runs"
TWIN_STEPS = 500_000  # env steps: 2 to 4 minutes of a core
GOALS = 60  # of the trainings with noise
STEPS = ("algo.demonstrations=0", "budget.minutes=null", f"budget.env_steps={TWIN_STEPS}")
NOISES = (0.0, 0.05)  # rad/s
STIFF = 6e4  # Nm/rad, gears of the strongest joints: four times the twin's own
NOMINAL = ("friction=gaz2019", "inertia=nominal")
CONDITIONS = {"nominal, no DR": NOMINAL, "identified, no DR": ("calibration=runs/identify/judge_{}",)}
MEASURES = {
    "success_2cm": ("< 2 cm, %", 100),
    "success_1cm": ("< 1 cm, %", 100),
    "return_smooth": ("return", 1),
    "predicted": ("predicted return", 1),
    "kept": ("predicted / measured, %", 100),
    "ee_path_rmse_mm": ("path gap, mm", 1),
    "tau_rmse_Nm": ("torque gap, Nm", 1),
    "time_to_reach_s": ("time to reach, s", 1),
    "overshoot_m": ("overshoot, mm", 1000),
    "rest": ("at rest, %", 100),
    "limited": ("cycles limited, %", 100),
    "stops": ("stops", 1),
}


def short(label: str) -> str:
    """Return a condition as part of a run folder's name."""
    return label.replace(", ", "_").replace(" ", "").replace("=", "")


def training_name(seed: int, label: str) -> str:
    """Return the name of a training; all twins share that of the nominal model."""
    return "judge_nominal" if CONDITIONS[label] is NOMINAL else f"judge_{seed}"


def twins(seeds: Sequence[int]) -> None:
    """Identify each twin, train with each model, transfer every policy to its twin."""
    arms = {seed: [f"arm.variant={twin_variant(seed)}", f"arm.seed={seed}"] for seed in seeds}
    run_parallel([["stage=identify", *arms[seed], f"name=judge_{seed}"] for seed in seeds])
    trainings = {}
    for label, model in CONDITIONS.items():
        for seed in seeds:
            name = training_name(seed, label)
            trainings[name] = [f"name={name}", *STEPS, "dr=none", "seed=0", *(word.format(seed) for word in model)]
    run_parallel(list(trainings.values()))
    pairs = [
        (seed, label, f"policy=runs/train/{training_name(seed, label)}") for label in CONDITIONS for seed in seeds
    ]
    run_parallel(["stage=transfer", p, *arms[s], f"name=judge_{s}_{short(label)}"] for s, label, p in pairs)


def noise(seeds: Sequence[int]) -> None:
    """Train for each development twin with the noise of NOISES; the policy without noise also gets stiff gears."""
    arms = {seed: ["arm.variant=elastic", f"arm.seed={seed}"] for seed in seeds}
    run_parallel([["stage=identify", *arms[seed], f"name=noise_{seed}"] for seed in seeds])
    pairs = [(seed, level) for seed in seeds for level in NOISES]
    found = {seed: f"calibration=runs/identify/noise_{seed}" for seed in seeds}
    how = ["dr=none", *STEPS]
    run_parallel([[*how, found[s], f"task.speed_noise={v}", f"name=noise_{s}_{v:g}"] for s, v in pairs])
    to = [(s, f"{v:g}", f"noise_{s}_{v:g}", ()) for s, v in pairs]
    to += [(s, "0", f"noise_{s}_stiff", (f"arm.stiffness={STIFF:g}",)) for s in seeds]
    transfers = []
    for seed, level, name, words in to:
        policy = f"policy=runs/train/noise_{seed}_{level}"
        transfers.append(
            ["stage=transfer", policy, *arms[seed], *words, f"evaluation.episodes={GOALS}", f"name={name}"]
        )
    run_parallel(transfers)


def noise_table() -> list[str]:
    """Return the scores of policies trained with each noise, in their simulation and on the twin."""
    rows = {}
    for folder in sorted((RUNS / "transfer").glob("noise_*")):
        if not (result := summary(folder)).get("twin"):
            continue
        _, seed, level = folder.name.split("_")
        predicted, twin = result["predicted"], result["twin"]
        name = "0, four times as stiff" if level == "stiff" else level
        rows[seed, name] = {
            "predicted < 1 cm, %": f"{100 * predicted['success_1cm']:.0f}",
            "predicted at rest, %": f"{100 * predicted['rest']:.0f}",
            "predicted return": f"{predicted['return_paper']:.0f}",
            "< 1 cm, %": f"{100 * twin['success_1cm']:.0f}",
            "at rest, %": f"{100 * twin['rest']:.0f}",
            "return": f"{twin['return_smooth']:.0f}",
        }
    if not rows:
        return []
    table = pd.DataFrame.from_dict(rows, orient="index").rename_axis(["development twin", "noise, rad/s"])
    return [markdown(table.reset_index().set_index("development twin"))]


def summary(folder: Path) -> dict:
    """Return the summary of a transfer, {} if it has not finished."""
    path = folder / "summary.json"
    return json.loads(path.read_text()) if path.is_file() else {}


def transfers() -> pd.DataFrame:
    """Return the measures of every transfer to its twin, a row each."""
    rows = []
    for label in CONDITIONS:
        for folder in sorted((RUNS / "transfer").glob(f"judge_[12]??_{short(label)}")):
            if (result := summary(folder)).get("twin"):
                predicted = result["predicted"]["return_paper"]
                row = {"condition": label, "twin": int(folder.name.split("_")[1])}
                kept = predicted / result["twin"]["return_smooth"]  # both are negative
                rows.append(row | result["twin"] | {"predicted": predicted, "kept": kept})
    return pd.DataFrame(rows)


def cell(values: np.ndarray) -> str:
    """Return the mean of values (twins,) and a 95 % bootstrap interval, without NaN: of no overshoot."""
    drawn = values[np.random.default_rng(0).integers(len(values), size=(10_000, len(values)))]
    low, high = np.nanpercentile(np.nanmean(drawn, axis=1), [2.5, 97.5])
    return f"{np.nanmean(values):.1f} [{low:.1f}, {high:.1f}]"


def conditions_table(table: pd.DataFrame) -> str:
    """Return every measure of every condition."""
    out = {}
    for label, own in table.groupby("condition", sort=False):
        cells = {name: cell(own[key].to_numpy() * scale) for key, (name, scale) in MEASURES.items()}
        out[label] = {"twins": str(len(own))} | cells
        out[label]["worst twin < 2 cm, %"] = f"{100 * own['success_2cm'].min():.1f}"
    return markdown_rows(out, "trained on")


def twins_tables() -> list[str]:
    """Return a table over conditions for each variant of twin, and the effect of identification."""
    table = transfers()
    pages = []
    for variant, seeds in JUDGING.items():
        own = table[table["twin"].isin(seeds)] if len(table) else table
        pages += [
            f"### {variant.capitalize()}, seeds {seeds[0]} to {seeds[-1]}",
            *(twins_of(own) if len(own) else []),
        ]
    return pages


def twins_of(table: pd.DataFrame) -> list[str]:
    """Return the table of one variant, and the path gaps of its twins."""
    bare, ours = (table[table["condition"] == label].set_index("twin") for label in CONDITIONS)
    ratio = (bare["ee_path_rmse_mm"] / ours["ee_path_rmse_mm"]).dropna()
    ranges = [
        f"{name} {100 * ours[key].min():.3g} to {100 * ours[key].max():.3g} %"
        for key, name in (("success_1cm", "< 1 cm"), ("rest", "at rest"), ("limited", "limited"), ("kept", "return"))
    ]
    text = (
        f"Path gap, nominal over identified: {', '.join(f'{r:.1f}' for r in ratio)}; median {ratio.median():.1f}. "
        f"Single identified twins: {', '.join(ranges)} (predicted over measured)."
    )
    return [conditions_table(table), text]


def pictures() -> list[str]:
    """Copy the figures of the first twin and return the lines that show them."""
    what = {
        "torque": ("identify/judge_100/figures/torque.png", "Torque on validation motion, before and after"),
        "identified": (
            "transfer/judge_100_identified_noDR/figures/traces.png",
            "Policy of the identified model: training simulation, prediction, twin",
        ),
        "nominal": (
            "transfer/judge_100_nominal_noDR/figures/traces.png",
            "Policy of the nominal model without DR",
        ),
    }
    lines = []
    for name, (path, caption) in what.items():
        if (RUNS / path).is_file():
            shutil.copy(RUNS / path, RESULTS / f"transfer_{name}.png")
            lines.append(f"{caption}:\n\n![{name}](transfer_{name}.png)")
    return lines


NOISE = """\
A policy trained without noise vibrates on an elastic twin; noise up to 0.05 rad/s in training removes this. 0.1 rad/s
was too much to learn with (development twin, one seed a row)."""


def main() -> None:
    """Rewrite the sections of the page with finished runs."""
    command = "python benchmarks/transfer.py twins"
    identified = f"{stamp(command)} 20 s of motion and ramps per twin, {TWIN_STEPS:,} env steps, no DR."
    sections = {
        "Hidden twins": (identified, twins_tables() if len(transfers()) else []),
        "Noise against gears that swing": (f"{stamp('python benchmarks/transfer.py noise')} {NOISE}", noise_table()),
        "One twin, four goals": ("", pictures()),
    }
    page = RESULTS / "transfer.md"
    for heading, (words, tables) in sections.items():
        if tables:
            put_section(page, heading, [words, *tables] if words else tables)


if __name__ == "__main__":
    part, *words = sys.argv[1:] or ["page"]
    seeds = [int(w) for w in words]
    if part == "noise":
        noise(seeds or [0])
    if part == "twins":
        twins(seeds or [seed for judging in JUDGING.values() for seed in judging])
    main()
