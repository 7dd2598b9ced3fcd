"""Measure TQC after 1 minute on all cores and after 4 and 12 minutes on one core: dr=paper, five seeds.

`python benchmarks/minutes.py one`, `four` and `twelve` train what is missing, "one" a training at a time, the others
as many as there are cores. Each writes the sections of benchmarks/results/minutes.md with finished runs: the last
policy of every training on the goals, starts and arms of all reports, the saved policy on others that chose no
setting, and the model-based reference. Run folders: runs/train/one_*, four_* and twelve_*.
"""

import json
import sys
from dataclasses import dataclass

import numpy as np
from common import RESULTS, ROOT, markdown_rows, put_section, run_parallel, run_scripts, stamp
from omegaconf import OmegaConf

from r2s.learning.evaluate import make_evaluation
from r2s.learning.policy import load_policy
from r2s.stages.train import make_parts

OTHER_GOALS = 2_026_1123  # seed of goals that chose no setting, like those in r2s/learning/evaluate.py
COUNT = 1000  # of them: the mean return over 200 goals varies by 2 with the goals


@dataclass(frozen=True)
class Part:
    """Trainings of one length; `alone`: one at a time on all cores, otherwise each on one core."""

    minutes: int
    seeds: range
    settings: tuple[str, ...] = ()
    alone: bool = False

    @property
    def words(self) -> list[str]:
        """The settings of its trainings."""
        return ["algo=tqc", "dr=paper", f"budget.minutes={self.minutes}", *self.settings]


PARTS = {
    "one": Part(1, range(185, 190), alone=True),
    "four": Part(4, range(165, 170), ("reward=long",)),
    "twelve": Part(12, range(170, 175), ("reward=long",)),
}
WHICH = {"last": "last", "saved": "saved, 1000 other goals"}
SHOWN = (  # policy, measure, label, scale, targets after 1, 4 and 12 minutes
    ("last", "success_1cm", "< 1 cm, %", 100, {"one": 98.0, "four": 98.0}),
    ("last", "success_5mm", "< 5 mm, %", 100, {}),
    ("last", "return_paper", "return", 1, {"four": -75.0, "twelve": -80.0}),
    ("last", "rest", "at rest, %", 100, {"one": 98.0, "four": 98.0, "twelve": 98.0}),
    ("last", "limited", "cycles limited by the safety filter, %", 100, {"four": 5.0, "twelve": 5.0}),
    ("saved", "success_1cm", "< 1 cm, %", 100, {"four": 98.0}),
    ("saved", "return_paper", "return", 1, {"twelve": -80.0}),
    ("saved", "rest", "at rest, %", 100, {"four": 98.0, "twelve": 98.0}),
    ("saved", "limited", "cycles limited by the safety filter, %", 100, {"four": 5.0, "twelve": 5.0}),
    ("last", "env_steps", "env steps, thousands", 1e-3, {}),
)


def load_summary(name: str) -> dict | None:
    """Return the summary of a training, None if it has not finished."""
    path = ROOT / "runs" / "train" / name / "summary.json"
    return json.loads(path.read_text()) if path.is_file() else None


def on_other_goals(name: str) -> dict:
    """Return the measures of a saved policy on the goals, starts and draws of OTHER_GOALS."""
    folder = ROOT / "runs" / "train" / name
    parts = make_parts(OmegaConf.load(folder / "config.yaml"))
    evaluate = make_evaluation(parts.robot, parts.task, parts.draw, episodes=COUNT, nthread=1, seed=OTHER_GOALS)
    return parts.task.measures(evaluate(load_policy(folder, parts.robot, parts.task)))


def section(name: str) -> list[str]:
    """Return the paragraphs of one part."""
    part = PARTS[name]
    found = {seed: row for seed in part.seeds if (row := load_summary(f"{name}_{seed}"))}
    found = {seed: row | {"saved": on_other_goals(f"{name}_{seed}")} for seed, row in found.items()}
    if not found:
        return []
    rows = {}
    for which, measure, what, scale, targets in SHOWN:
        values = {f"seed {seed}": scale * row[which][measure] for seed, row in found.items()}
        label = f"{WHICH[which]}: {what}" + (f" (target: {targets[name]:g})" if name in targets else "")
        rows[label] = {"median": float(np.median(list(values.values()))), **values}
    table = {label: {k: f"{x:.1f}" for k, x in row.items()} for label, row in rows.items()}
    return [stamp(f"python run.py {' '.join(part.words)}"), markdown_rows(table)]


def train_all(name: str) -> None:
    """Run what is missing of one part, and the model-based reference."""
    jobs = [[f"name={name}_{seed}", f"seed={seed}", *PARTS[name].words] for seed in PARTS[name].seeds]
    if PARTS[name].alone:
        for job in jobs:
            run_scripts([["run.py", *job, "skip_completed=true"]])
    else:
        run_parallel(jobs)
    run_parallel([["name=minutes_oracle", "algo=oracle", "dr=paper"]])


def main(name: str | None) -> None:
    """Train, write the page."""
    if name:
        train_all(name)
    page = RESULTS / "minutes.md"
    for each, part in PARTS.items():
        if paragraphs := section(each):
            put_section(page, f"{part.minutes} minute{'s' * (part.minutes > 1)}", paragraphs)
    if oracle := (load_summary("minutes_oracle") or {}).get("last"):
        text = (
            f"`algo=oracle` has {100 * oracle['success_1cm']:.1f} % < 1 cm and a return of "
            f"{oracle['return_paper']:.1f} on the same goals and arms."
        )
        put_section(page, "The model-based reference", [text])


if __name__ == "__main__":
    if len(sys.argv) > 2 or (len(sys.argv) == 2 and sys.argv[1] not in PARTS):
        raise SystemExit(__doc__)
    main(sys.argv[1] if len(sys.argv) == 2 else None)
