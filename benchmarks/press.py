"""task=press and wipe on the hidden twins: the reference on the nominal and on the identified model, and policies.

    python benchmarks/press.py [minutes=8] [rigid_0 elastic_0 ...]

Identifies each twin, evaluates `algo=hybrid_force` with both models, trains policies on the identified one if minutes
are given, with the twin's seed, and runs all on the twin with its surface, EPISODES goals each. Writes
results/press.md. Finished runs are kept in runs/press and not repeated. A twin takes about 4 minutes of one core, and
minutes= twice more.
"""

import json
import re
import sys
from pathlib import Path

from common import NOMINAL, ROOT, cells, identify_twins, markdown_rows, run_parallel, write_page

from r2s.tasks.press_measures import PRESS
from r2s.tasks.wipe_measures import WIPE

EPISODES, SIMULATED = 12, 100
RUNS = ROOT / "runs" / "press"
TABLES = {"press": PRESS, "wipe": WIPE}
FORCES = {
    "press": "Pressing: forces of 5 to 20 N with one step",
    "wipe": "Wiping: paths at 0.05 to 0.2 m/s under 5 to 20 N",
}
Twin = tuple[str, str]  # variant and seed


def rows_of(task: str, folder: Path, row: str) -> dict[str, str]:
    """Return the cells of one row of a run's summary.json."""
    return cells(TABLES[task], json.loads((folder / "summary.json").read_text())[row])


def models_of(task: str, twins: list[Twin], minutes: str | None) -> dict[str, dict[Twin, str]]:
    """Train or evaluate what is missing in simulation; return {label: {twin: name of its run}}."""
    common = f"task={task}", f"root={RUNS}", f"evaluation.episodes={SIMULATED}"
    jobs = [[*common, *NOMINAL, "algo=hybrid_force", f"name={task}_nominal"]]
    names = {"reference, nominal": dict.fromkeys(twins, f"{task}_nominal")}
    algos = {"reference": ["algo=hybrid_force"]}
    if minutes:
        algos["policy"] = ["algo=tqc", f"budget.minutes={minutes}"]
    for what, words in algos.items():
        names[f"{what}, identified"] = {(v, s): f"{task}_{what}_{v}_{s}" for v, s in twins}
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
    transferred = {
        f"{label}: {v} {s}": rows_of(task, RUNS / "transfer" / name, "twin")
        for (label, v, s), name in on_twin.items()
    }
    simulated = {f"{label}: {v} {s}": rows_of(task, RUNS / "train" / name, "best") for label, v, s, name in runs}
    rows = [json.loads((RUNS / "train" / name / "summary.json").read_text())["last"] for *_, name in runs]
    steps = [row["env_steps"] for row in rows if row["env_steps"]]  # the reference has none
    return [
        f"## {FORCES[task]}",
        f"{EPISODES} goals on each twin. No force is fed back."
        + (f" Policies had {min(steps):,} to {max(steps):,} env steps." if steps else ""),
        markdown_rows(transferred, "on the twin"),
        f"In MuJoCo, {SIMULATED} goals with `dr=contact`: each with a surface of its own, friction within 10 %.",
        markdown_rows(simulated, "in simulation"),
    ]


def main() -> None:
    """Run what is missing and write the page."""
    words = sys.argv[1:]
    minutes = next((w.removeprefix("minutes=") for w in words if w.startswith("minutes=")), None)
    named = [w for w in words if re.fullmatch(r"(rigid|elastic)_\d+", w)] or ["rigid_0", "elastic_0"]
    twins = [(v, s) for v, _, s in (name.partition("_") for name in named)]
    identify_twins([(v, int(s), RUNS / "identify" / f"{v}_{s}") for v, s in twins], RUNS)
    about = [f"Policies: `algo=tqc budget.minutes={minutes}` on one core, the twin's seed."] if minutes else []
    parts = about + [part for task in TABLES for part in section(task, models_of(task, twins, minutes))]
    write_page("press", "Pressing and wiping", " ".join(["python benchmarks/press.py", *words]), parts)


if __name__ == "__main__":
    main()
