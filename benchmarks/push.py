"""task=push in simulation: five trainings with demonstrations beside the reference that demonstrates.

`python benchmarks/push.py` trains what is missing, each on one core, and writes benchmarks/results/push.md; `page`
trains nothing. The goals of reports, boxes and arms selected nothing. Run folders: runs/push/train/*.
"""

import json
import sys

from common import ROOT, markdown_rows, run_parallel, write_page

from r2s.tasks.push_measures import PUSH

RUNS = ROOT / "runs" / "push"
SEEDS = range(190, 195)  # nothing was chosen on them
MINUTES = 10
POLICY = ("task=push", "algo=tqc", "algo.gamma=0.98", f"budget.minutes={MINUTES}")


def cells(name: str) -> dict[str, str] | None:
    """Return the cells of the last policy of a run, None if it has not finished."""
    path = RUNS / "train" / name / "summary.json"
    if not path.is_file():
        return None
    values = json.loads(path.read_text())["last"]
    return {PUSH[key].column.replace("\n", " "): PUSH[key].cell(values[key]) for key in PUSH.rows}


def main() -> None:
    """Train what is missing and write the page."""
    if sys.argv[1:] not in ([], ["page"]):
        raise SystemExit(__doc__)
    if not sys.argv[1:]:
        jobs = [["task=push", "algo=pusher", f"root={RUNS}", "name=reference"]]
        jobs += [[*POLICY, f"seed={seed}", f"root={RUNS}", f"name=seed_{seed}"] for seed in SEEDS]
        run_parallel(jobs)
    rows = {"`algo=pusher`": cells("reference")} | {f"policy, seed {s}": cells(f"seed_{s}") for s in SEEDS}
    rows = {label: row for label, row in rows.items() if row}
    parts = [
        f"{len(rows) - 1} of {len(SEEDS)} trainings have finished; the last policy of each.",
        f"`python run.py {' '.join(POLICY)}`, one core each; 200 goals, `dr=box`: each with its own box and arm.",
        markdown_rows(rows),
    ]
    write_page("push", "Pushing a box", "python benchmarks/push.py", parts)


if __name__ == "__main__":
    main()
