"""How far TQC gets in 4, 8 and 12 minutes on all cores, dr=paper, five seeds one after the other.

`python benchmarks/minutes.py` trains what is missing (five times twelve minutes with reward=long, five times four
with the default) and writes docs/minutes.md: the last evaluation before each mark, and the median of the seeds. Run
folders: runs/train/minutes_*.
"""

import subprocess
import sys

import numpy as np
import pandas as pd
from algorithms import markdown
from common import MACHINE, ROOT

SEEDS = range(20, 25)
ASKED = (  # measure, minutes, what is asked, how it is written
    ("success_1cm", 4, 0.98, "< 1 cm, %", 100),
    ("success_5mm", 8, 0.95, "< 5 mm, %", 100),
    ("return_paper", 12, -80.0, "return", 1),
)
RUNS = {"reward=long, 12 minutes": ("reward=long", 12), "the default, 4 minutes": ("reward=curriculum", 4)}


def main() -> None:
    """Train, read the evaluations, write the page."""
    pages = [
        "# Minutes to a policy",
        f"`python benchmarks/minutes.py` on {MACHINE}, all of them for one training: TQC, dr=paper, 200 goals held "
        "for the last 0.5 s. The last evaluation before the mark; compilation and evaluations count as time.",
    ]
    for title, (reward, minutes) in RUNS.items():
        rows = {}
        for seed in SEEDS:
            name = f"minutes_{minutes}_{seed}"
            words = [f"name={name}", f"seed={seed}", reward, f"budget.minutes={minutes}", "only_missing=true"]
            subprocess.run([sys.executable, "run.py", "algo=tqc", "dr=paper", *words], cwd=ROOT, check=True)
            curve = pd.read_csv(ROOT / "runs" / "train" / name / "evaluations.csv")
            for measure, until, asked, what, scale in ASKED:
                # the last evaluation of all begins when the time is over
                seen = curve[curve["wall_clock_s"] <= 60 * min(until, minutes) + 5][measure]
                key = f"{what} within {min(until, minutes)} min (asked: {scale * asked:g})"
                rows.setdefault(key, {})[f"seed {seed}"] = scale * seen.iloc[-1]
        table = pd.DataFrame.from_dict(rows, orient="index")
        table.insert(0, "median", np.median(table.to_numpy(), axis=1))
        pages += [f"## {title}", markdown(table.map(lambda x: f"{x:.1f}").rename_axis(""))]
    (ROOT / "docs" / "minutes.md").write_text("\n\n".join(pages) + "\n")
    print("written: docs/minutes.md")


if __name__ == "__main__":
    main()
