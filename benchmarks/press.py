"""task=press or wipe on the hidden twins: the reference on the nominal and on the identified model, and a policy.

    python benchmarks/press.py [task=wipe] [minutes=8] [rigid_0 elastic_0 ...]

Identifies each twin, evaluates `algo=hybrid_force` with both models, trains a policy on the identified one if minutes
are given, and runs all on the twin with its surface, EPISODES goals each. Writes results/TASK.md. Finished
runs are kept in runs/TASK and not repeated; both tasks share the identifications.
"""

import json
import re
import sys
from pathlib import Path

from common import ROOT, identify_twins, markdown_rows, run_parallel, write_page

from r2s.tasks.press_measures import PRESS
from r2s.tasks.wipe_measures import WIPE

EPISODES, SIMULATED = 12, 100
TABLES = {"press": PRESS, "wipe": WIPE}
TITLES = {"press": "Pressing on a surface", "wipe": "Wiping a surface"}
FORCES = {"press": "forces of 5 to 20 N with one step", "wipe": "forces of 5 to 20 N, paths at 0.05 to 0.2 m/s"}
NOMINAL = "friction=gaz2019", "inertia=nominal"


def rows_of(task: str, folder: Path, row: str) -> dict[str, str]:
    """Return the cells of one row of a run's summary.json."""
    values, table = json.loads((folder / "summary.json").read_text())[row], TABLES[task]
    return {table[key].column.replace("\n", " "): table[key].cell(values[key]) for key in table.rows}


def main() -> None:
    """Run what is missing and write the page."""
    words = sys.argv[1:]
    task = "wipe" if "task=wipe" in words else "press"
    runs = ROOT / "runs" / task
    minutes = next((w.removeprefix("minutes=") for w in words if w.startswith("minutes=")), None)
    names = [w for w in words if re.fullmatch(r"(rigid|elastic)_\d+", w)] or ["rigid_0", "elastic_0"]
    identified = ROOT / "runs" / "press"
    twins = [(*name.split("_"), identified / "identify" / name) for name in names]
    identify_twins([(v, int(s), folder) for v, s, folder in twins], identified)
    press = f"task={task}", f"root={runs}", f"evaluation.episodes={SIMULATED}"
    jobs = [[*press, *NOMINAL, "algo=hybrid_force", "name=nominal"]]
    models = {"reference, nominal": "nominal"}
    for v, s, folder in twins:
        calibrated = [*press, f"calibration={folder}"]
        jobs.append([*calibrated, "algo=hybrid_force", f"name=identified_{v}_{s}"])
        if minutes:
            jobs.append([*calibrated, "algo=tqc", f"budget.minutes={minutes}", f"name=policy_{v}_{s}"])
    run_parallel(jobs)
    models |= {"reference, identified": "identified_{}_{}"} | (
        {"policy, identified": "policy_{}_{}"} if minutes else {}
    )
    jobs = [
        [
            *("stage=transfer", f"root={runs}", f"policy={runs / 'train' / folder.format(v, s)}", "simulator=none"),
            *("arm=twin", "arm.surface=true", f"arm.variant={v}", f"arm.seed={s}", f"evaluation.episodes={EPISODES}"),
            f"name={v}_{s}_{folder.split('_')[0]}",
        ]
        for v, s, _ in twins
        for folder in models.values()
    ]
    run_parallel(jobs)
    table, simulated = {}, {}
    for label, folder in models.items():
        for v, s, _ in twins:
            table[f"{label}: {v} {s}"] = rows_of(task, runs / "transfer" / f"{v}_{s}_{folder.split('_')[0]}", "twin")
            simulated[f"{label} ({v} {s})"] = rows_of(task, runs / "train" / folder.format(v, s), "best")
    parts = [
        f"{EPISODES} goals on each twin, {FORCES[task]}. No force is fed back.",
        markdown_rows(table, "on the twin"),
        f"In MuJoCo, {SIMULATED} goals with `dr=contact`: each with a surface of its own, friction within 10 %.",
        markdown_rows(simulated, "in simulation"),
    ]
    write_page(task, TITLES[task], "python benchmarks/press.py " + " ".join(words), parts)


if __name__ == "__main__":
    main()
