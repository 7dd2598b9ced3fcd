"""task=push: five trainings with demonstrations, and the reference that demonstrates, also on hidden twins.

    python benchmarks/push.py [page | rigid_100 elastic_200 ...]

Trains what is missing, each on one core, and writes benchmarks/results/push.md; `page` trains nothing. The goals of
reports, boxes and arms selected nothing. With twins, identifies each and runs the reference on the twin with its box,
with the nominal and with the identified model, EPISODES goals each, and replaces the page's section on twins. A twin
takes about 6 minutes of one core. Run folders: runs/push.
"""

import json
import re
import sys

import numpy as np
from common import (
    NOMINAL,
    RESULTS,
    ROOT,
    cells,
    identify_twins,
    markdown_rows,
    put_section,
    run_parallel,
    stamp,
    write_page,
)

from r2s.tasks.push_measures import PUSH

RUNS = ROOT / "runs" / "push"
EPISODES = 8
TWINS = "The reference on twins"
SEEDS = range(190, 195)  # nothing was chosen on them
MINUTES = 10
POLICY = ("task=push", "algo=tqc", "algo.gamma=0.98", f"budget.minutes={MINUTES}")


def trained(name: str) -> dict[str, str] | None:
    """Return the cells of the last policy of a run, None if it has not finished."""
    path = RUNS / "train" / name / "summary.json"
    return cells(PUSH, json.loads(path.read_text())["last"]) if path.is_file() else None


def on_twins(twins: list[tuple[str, str]]) -> list[str]:
    """Run the reference on twins (variant, seed) with both models; return the parts of their section."""
    identify_twins([(v, int(s), RUNS / "identify" / f"{v}_{s}") for v, s in twins], RUNS)
    common = "task=push", "algo=pusher", f"evaluation.episodes={EPISODES}", f"root={RUNS}"
    identified = [(f"calibration={RUNS / 'identify' / f'{v}_{s}'}", f"name=identified_{v}_{s}") for v, s in twins]
    run_parallel([[*common, *NOMINAL, "name=nominal"], *([*common, *words] for words in identified)])
    arm = "simulator=none", "arm=twin", "arm.surface=box", f"evaluation.episodes={EPISODES}", f"root={RUNS}"
    models = {"nominal": "nominal", "identified": "identified_{}_{}"}
    run_parallel(
        [
            *("stage=transfer", *arm, f"policy={RUNS / 'train' / name.format(v, s)}"),
            *(f"arm.variant={v}", f"arm.seed={s}", f"name={model}_on_{v}_{s}"),
        ]
        for v, s in twins
        for model, name in models.items()
    )
    rows = {}
    for variant in dict.fromkeys(v for v, _ in twins):
        for model in models:
            own = [f"{model}_on_{v}_{s}" for v, s in twins if v == variant]
            each = [json.loads((RUNS / "transfer" / n / "summary.json").read_text())["twin"] for n in own]
            mean = {key: float(np.mean([values[key] for values in each])) for key in PUSH.rows}
            success = [100 * values["success"] for values in each]
            rows[f"{variant}, {model} model"] = (
                {"twins": str(len(own))}
                | cells(PUSH, mean)
                | {"success by twin, %": f"{min(success):.0f} to {max(success):.0f}"}
            )
    what = f"`algo=pusher` with each model on the twin with its box; {EPISODES} goals on each; means over the twins."
    return [
        stamp(" ".join(["python benchmarks/push.py", *(f"{v}_{s}" for v, s in twins)])),
        what,
        markdown_rows(rows),
    ]


def main() -> None:
    """Train what is missing and write the page, or its section on twins."""
    words = sys.argv[1:]
    if words and all(re.fullmatch(r"(rigid|elastic)_\d+", w) for w in words):
        put_section(RESULTS / "push.md", TWINS, on_twins([(v, s) for v, _, s in (w.partition("_") for w in words)]))
        return
    if words not in ([], ["page"]):
        raise SystemExit(__doc__)
    if not words:
        jobs = [["task=push", "algo=pusher", f"root={RUNS}", "name=reference"]]
        jobs += [[*POLICY, f"seed={seed}", f"root={RUNS}", f"name=seed_{seed}"] for seed in SEEDS]
        run_parallel(jobs)
    rows = {"`algo=pusher`": trained("reference")} | {f"policy, seed {s}": trained(f"seed_{s}") for s in SEEDS}
    rows = {label: row for label, row in rows.items() if row}
    parts = [
        f"{len(rows) - 1} of {len(SEEDS)} trainings have finished; the last policy of each.",
        f"`python run.py {' '.join(POLICY)}`, one core each; 200 goals, `dr=box`: each with its own box and arm.",
        markdown_rows(rows),
    ]
    section = "".join((RESULTS / "push.md").read_text().partition(f"## {TWINS}")[1:]).strip()
    write_page("push", "Pushing a box", "python benchmarks/push.py", [*parts, *([section] if section else [])])


if __name__ == "__main__":
    main()
