"""task=press and wipe on the hidden twins: the reference on the nominal and on the identified model, and policies.

    python benchmarks/press.py [env_steps=320000] [policies=10] [rigid_0 elastic_0 ...]

Identifies each twin, evaluates `algo=hybrid_force` with both models, and runs both on the twin with its surface,
EPISODES goals each. With env_steps=, also trains and runs policies on the identified model of the first `policies=`
twins (default: all), with the twin's seed. Writes results/press.md. Finished runs are kept in runs/press and not
repeated. A twin takes about 4 minutes of one core, and each of its two policies 5.
"""

import json
import re
import sys
from pathlib import Path

from common import (
    NOMINAL,
    ROOT,
    cells,
    identify_twins,
    markdown_rows,
    means,
    run_parallel,
    training_time,
    worst,
    write_page,
)

from r2s.tasks.press_measures import PRESS
from r2s.tasks.wipe_measures import WIPE

EPISODES, SIMULATED = 12, 100
RUNS = ROOT / "runs" / "press"
ALGO = "algo=tqc", "budget.minutes=null"
TABLES = {"press": PRESS, "wipe": WIPE}
FORCES = {
    "press": "Pressing: forces of 5 to 20 N with one step",
    "wipe": "Wiping: paths at 0.05 to 0.2 m/s under 5 to 20 N",
}
Twin = tuple[str, str]  # variant and seed


def row_of(folder: Path, row: str) -> dict[str, float]:
    """Return the measures of one row of a run's summary.json."""
    return json.loads((folder / "summary.json").read_text())[row]


def summarized(task: str, each: dict[str, list[dict[str, float]]], name: str) -> str:
    """Return a table of {label: rows of the twins}: the means, and the worst twin of each column."""
    rows = {}
    for label, values in each.items():
        rows[f"{label}, mean of {len(values)}"] = cells(TABLES[task], means(TABLES[task], values))
        rows[f"{label}, worst in each column"] = cells(TABLES[task], worst(TABLES[task], values))
    return markdown_rows(rows, name)


def models_of(task: str, twins: list[Twin], env_steps: str | None, policies: int) -> dict[str, dict[Twin, str]]:
    """Train or evaluate what is missing in simulation; return {label: {twin: name of its run}}."""
    common = f"task={task}", f"root={RUNS}", f"evaluation.episodes={SIMULATED}"
    jobs = [[*common, *NOMINAL, "algo=hybrid_force", f"name={task}_nominal"]]
    names = {"reference, nominal": dict.fromkeys(twins, f"{task}_nominal")}
    algos = {"reference": ["algo=hybrid_force"]}
    if env_steps:
        algos["policy"] = [*ALGO, f"budget.env_steps={env_steps}"]
    for what, words in algos.items():
        chosen = twins[:policies] if what == "policy" else twins
        names[f"{what}, identified"] = {(v, s): f"{task}_{what}_{v}_{s}" for v, s in chosen}
        for (v, s), name in names[f"{what}, identified"].items():
            own = f"calibration={RUNS / 'identify' / f'{v}_{s}'}", f"seed={s}"
            jobs.append([*common, *own, *words, f"name={name}"])
    run_parallel(jobs)
    return names


def section(task: str, names: dict[str, dict[Twin, str]]) -> list[str]:
    """Run the models on their twins; return the part of a task for the page."""
    runs = [(label, *twin, name) for label, each in names.items() for twin, name in each.items()]
    on_twin = {(label, v, s): f"{name}_on_{v}_{s}" for label, v, s, name in runs}
    arm = "simulator=none", "arm=twin", "arm.surface=true", f"evaluation.episodes={EPISODES}", f"root={RUNS}"
    run_parallel(
        [
            *("stage=transfer", *arm, f"policy={RUNS / 'train' / name}"),
            *(f"arm.variant={v}", f"arm.seed={s}", f"name={on_twin[label, v, s]}"),
        ]
        for label, v, s, name in runs
    )
    transferred = {f"{v}, {label}": [] for label, each in names.items() for v, _ in each}
    simulated = {key: [] for key in transferred if not key.endswith("nominal")}
    for (label, v, s), name in on_twin.items():
        transferred[f"{v}, {label}"].append(row_of(RUNS / "transfer" / name, "twin"))
        if f"{v}, {label}" in simulated:
            simulated[f"{v}, {label}"].append(row_of(RUNS / "train" / names[label][v, s], "best"))
    simulated["reference, nominal"] = [row_of(RUNS / "train" / f"{task}_nominal", "best")]
    policies = [RUNS / "train" / name for label, _, _, name in runs if label.startswith("policy")]
    return [
        f"## {FORCES[task]}",
        f"{EPISODES} goals on each twin. No force is fed back."
        + (f" Policies: {training_time(policies)}, one core each." if policies else ""),
        summarized(task, transferred, "on the twin"),
        f"In MuJoCo, {SIMULATED} goals with `dr=contact`: each with a surface of its own, friction within 10 %.",
        summarized(task, simulated, "in simulation"),
    ]


def main() -> None:
    """Run what is missing and write the page."""
    words = sys.argv[1:]
    given = dict(w.split("=", 1) for w in words if "=" in w)
    env_steps = given.get("env_steps")
    named = [w for w in words if re.fullmatch(r"(rigid|elastic)_\d+", w)] or ["rigid_0", "elastic_0"]
    twins = [(v, s) for v, _, s in (name.partition("_") for name in named)]
    identify_twins([(v, int(s), RUNS / "identify" / f"{v}_{s}") for v, s in twins], RUNS)
    about = [f"Policies: `{' '.join(ALGO)} budget.env_steps={env_steps}`, the twin's seed."] if env_steps else []
    policies = int(given.get("policies", len(twins)))
    parts = about + [part for task in TABLES for part in section(task, models_of(task, twins, env_steps, policies))]
    write_page("press", "Pressing and wiping", " ".join(["python benchmarks/press.py", *words]), parts)


if __name__ == "__main__":
    main()
