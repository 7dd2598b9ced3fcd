"""task=press on the hidden twins: the reference on the nominal and on the identified model, and a policy.

    python benchmarks/press.py [minutes=8] [rigid_0 elastic_0 ...]

Identifies each twin, evaluates `algo=hybrid_force` with both models, trains a policy on the identified one if minutes
are given, and runs all on the twin with its surface, EPISODES goals each. Writes results/press.md. Finished runs are
kept in runs/press and not repeated.
"""

import json
import re
import sys
from pathlib import Path

from common import ROOT, identify_twins, markdown_rows, run_parallel, write_page

from r2s.tasks.press_measures import PRESS

EPISODES, SIMULATED = 12, 100
RUNS = ROOT / "runs" / "press"
COLUMNS = (
    "force_rmse_first_N",
    "force_rmse_last_N",
    "overshoot_N",
    "overshoot_share",
    "impact_N",
    "contact",
    "success",
)
NOMINAL = "friction=gaz2019", "inertia=nominal"


def rows_of(folder: Path, row: str) -> dict[str, str]:
    """Return the cells of one row of a run's summary.json."""
    values = json.loads((folder / "summary.json").read_text())[row]
    return {PRESS[key].column.replace("\n", " "): PRESS[key].cell(values[key]) for key in COLUMNS}


def main() -> None:
    """Run what is missing and write the page."""
    words = sys.argv[1:]
    minutes = next((w.removeprefix("minutes=") for w in words if w.startswith("minutes=")), None)
    names = [w for w in words if re.fullmatch(r"(rigid|elastic)_\d+", w)] or ["rigid_0", "elastic_0"]
    twins = [(*name.split("_"), RUNS / "identify" / name) for name in names]
    identify_twins([(v, int(s), folder) for v, s, folder in twins], RUNS)
    press = "task=press", f"root={RUNS}", f"evaluation.episodes={SIMULATED}"
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
            *("stage=transfer", f"root={RUNS}", f"policy={RUNS / 'train' / folder.format(v, s)}", "simulator=none"),
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
            table[f"{label}: {v} {s}"] = rows_of(RUNS / "transfer" / f"{v}_{s}_{folder.split('_')[0]}", "twin")
            simulated[f"{label} ({v} {s})"] = rows_of(RUNS / "train" / folder.format(v, s), "best")
    parts = [
        f"{EPISODES} goals on each twin, forces of 5 to 20 N with one step. No force is fed back.",
        markdown_rows(table, "on the twin"),
        f"In MuJoCo, {SIMULATED} goals with `dr=contact`: each with a surface of its own, friction within 10 %.",
        markdown_rows(simulated, "in simulation"),
    ]
    write_page("press", "Pressing on a surface", "python benchmarks/press.py " + " ".join(words), parts)


if __name__ == "__main__":
    main()
