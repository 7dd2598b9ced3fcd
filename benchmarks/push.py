"""task=push: five trainings with demonstrations, and the reference that demonstrates, also on hidden twins.

    python benchmarks/push.py [page | [env_steps=600000] rigid_100 elastic_200 ...]

Trains what is missing, each on one core, and writes benchmarks/results/push.md; `page` trains nothing. The goals of
reports, boxes and arms selected nothing. With twins, identifies each and runs the reference on the twin with its box,
with the nominal and with the identified model, EPISODES goals each, and replaces the page's section on twins. With
env_steps, trains a policy on each identified model too, with the twin's seed, and replaces the section on policies
instead. A twin takes 3 minutes of one core, a policy of 900,000 env steps 10 to 24 more. Run folders: runs/push.
Finished runs are not repeated: after a change of pusher or task, delete the folders train and transfer.
"""

import json
import re
import sys

from common import (
    NOMINAL,
    RESULTS,
    ROOT,
    cells,
    identify_twins,
    markdown_rows,
    means,
    put_section,
    run_parallel,
    stamp,
    training_time,
    write_page,
)

from r2s.tasks.push_measures import PUSH

RUNS = ROOT / "runs" / "push"
EPISODES = 20
TWINS, POLICIES = "The reference on twins", "Policies on twins"
SEEDS = range(190, 195)  # nothing was chosen on them
ALGO = "algo=tqc", "algo.gamma=0.98", "budget.minutes=null"
POLICY = ("task=push", *ALGO, "budget.env_steps=600000")
TWIN = re.compile(r"(rigid|elastic)_\d+")


def trained(name: str) -> dict[str, str] | None:
    """Return the cells of the last policy of a run, None if it has not finished."""
    path = RUNS / "train" / name / "summary.json"
    return cells(PUSH, json.loads(path.read_text())["last"]) if path.is_file() else None


def trained_for(twins: list[tuple[str, str]], env_steps: str | None) -> dict[str, str]:
    """Train or evaluate what is missing in simulation; return {label: name of a run with places for the twin}."""
    common, of_twins = ("task=push", f"root={RUNS}"), f"evaluation.episodes={EPISODES}"
    jobs = [[*common, of_twins, "algo=pusher", *NOMINAL, "name=nominal"]]
    names = {"nominal model": "nominal", "identified model": "identified_{}_{}"}
    if env_steps:
        names["policy, identified model"] = "policy_{}_{}"
    for v, s in twins:
        own = [*common, f"calibration={RUNS / 'identify' / f'{v}_{s}'}"]
        jobs.append([*own, of_twins, "algo=pusher", f"name=identified_{v}_{s}"])
        if env_steps:
            jobs.append([*own, *ALGO, f"budget.env_steps={env_steps}", f"seed={s}", f"name=policy_{v}_{s}"])
    run_parallel(jobs)
    return names


def on_twins(words: list[str], env_steps: str | None) -> list[str]:
    """Run the models on twins (variant_seed); return the parts of their section."""
    twins = [(v, s) for v, _, s in (w.partition("_") for w in words)]
    identify_twins([(v, int(s), RUNS / "identify" / f"{v}_{s}") for v, s in twins], RUNS)
    models = trained_for(twins, env_steps)
    arm = "simulator=none", "arm=twin", "arm.surface=box", f"evaluation.episodes={EPISODES}", f"root={RUNS}"
    on_twin = {(m, v, s): f"{name.partition('_')[0]}_on_{v}_{s}" for m, name in models.items() for v, s in twins}
    run_parallel(
        [
            *("stage=transfer", *arm, f"policy={RUNS / 'train' / models[m].format(v, s)}"),
            *(f"arm.variant={v}", f"arm.seed={s}", f"name={name}"),
        ]
        for (m, v, s), name in on_twin.items()
    )
    rows = {}
    for variant in dict.fromkeys(v for v, _ in twins):
        for model in models:
            own = [name for (m, v, _), name in on_twin.items() if (m, v) == (model, variant)]
            each = [json.loads((RUNS / "transfer" / n / "summary.json").read_text())["twin"] for n in own]
            success = [100 * values["success"] for values in each]
            rows[f"{variant}, {model}"] = (
                {"twins": str(len(own))}
                | cells(PUSH, means(PUSH, each))
                | {"success by twin, %": f"{min(success):.0f} to {max(success):.0f}"}
            )
    what = f"`algo=pusher` with each model on the twin with its box; {EPISODES} goals on each; means over the twins."
    if env_steps:
        runs = [RUNS / "train" / models["policy, identified model"].format(v, s) for v, s in twins]
        what += f" Policies: `{' '.join(ALGO)} budget.env_steps={env_steps}` on one core, the twin's seed: "
        what += f"{training_time(runs)}."
    return [
        stamp(" ".join(["python benchmarks/push.py", *([f"env_steps={env_steps}"] if env_steps else []), *words])),
        what,
        markdown_rows(rows),
    ]


def main() -> None:
    """Train what is missing and write the page, or its section on twins."""
    words = sys.argv[1:]
    env_steps = words[0].partition("=")[2] if words and re.fullmatch(r"env_steps=[1-9]\d*", words[0]) else None
    twins = words[1:] if env_steps else words
    if twins and all(TWIN.fullmatch(word) for word in twins):
        put_section(RESULTS / "push.md", POLICIES if env_steps else TWINS, on_twins(twins, env_steps))
        return
    if words not in ([], ["page"]):
        raise SystemExit(__doc__)
    if not words:
        jobs = [["task=push", "algo=pusher", f"root={RUNS}", "name=reference"]]
        jobs += [[*POLICY, f"seed={seed}", f"root={RUNS}", f"name=seed_{seed}"] for seed in SEEDS]
        run_parallel(jobs)
    rows = {"`algo=pusher`": trained("reference")} | {f"policy, seed {s}": trained(f"seed_{s}") for s in SEEDS}
    rows = {label: row for label, row in rows.items() if row}
    runs = [RUNS / "train" / f"seed_{s}" for s in SEEDS]
    done = [run for run in runs if (run / "summary.json").is_file()]
    took = f": {training_time(done)}" if done else ""
    parts = [
        f"{len(rows) - 1} of {len(SEEDS)} trainings have finished; the last policy of each.",
        f"`python run.py {' '.join(POLICY)}`, one core each{took}.",
        "200 goals, `dr=box`: each with its own box and arm.",
        markdown_rows(rows),
    ]
    kept = "".join((RESULTS / "push.md").read_text().partition("## ")[1:]).strip()
    write_page("push", "Pushing a box", "python benchmarks/push.py", [*parts, *([kept] if kept else [])])


if __name__ == "__main__":
    main()
