"""How far TQC gets in 4, 8 and 12 minutes on one core, dr=paper, five seeds, as many at once as there are cores.

`python benchmarks/minutes.py` trains what is missing (five times twelve minutes with reward=long) and writes
docs/minutes.md: the last evaluation before each mark, the median of the seeds, and the model-based reference beside
them. Run folders: runs/train/minutes_*.
"""

import json

import numpy as np
import pandas as pd
from common import MACHINE, ROOT, STEADY, markdown, side_by_side

SEEDS = range(30, 35)
ASKED = (  # measure, minutes, what is asked, how it is written
    ("success_1cm", 4, 0.98, "< 1 cm, %", 100),
    ("success_5mm", 8, 0.95, "< 5 mm, %", 100),
    ("return_paper", 12, -80.0, "return", 1),
)
MINUTES = 12


def main() -> None:
    """Train, read the evaluations, write the page."""
    train = ROOT / "runs" / "train"
    shared = ("dr=paper", f"budget.minutes={MINUTES}")
    jobs = [[f"name=minutes_{seed}", "algo=tqc", *STEADY, "reward=long", f"seed={seed}", *shared] for seed in SEEDS]
    side_by_side([*jobs, ["name=minutes_oracle", "algo=oracle", *shared]])
    rows = {}
    for seed in SEEDS:
        curve = pd.read_csv(train / f"minutes_{seed}" / "evaluations.csv")
        for measure, until, asked, what, scale in ASKED:
            # the last evaluation of all begins when the time is over
            seen = curve[curve["wall_clock_s"] <= 60 * until + 5 * (until == MINUTES)][measure]
            key = f"{what} within {until} min (asked: {scale * asked:g})"
            rows.setdefault(key, {})[f"seed {seed}"] = scale * seen.iloc[-1]
    table = pd.DataFrame.from_dict(rows, orient="index")
    table.insert(0, "median", np.median(table.to_numpy(), axis=1))
    oracle = json.loads((train / "minutes_oracle" / "summary.json").read_text())["last"]
    pages = [
        "# Minutes to a policy",
        f"`python benchmarks/minutes.py` on {MACHINE}, one core per training, two trainings at a time: TQC, dr=paper,"
        f" reward=long, {' '.join(STEADY)}, one training of {MINUTES} minutes per seed, 200 goals held for the last "
        "0.5 s. The last evaluation before the mark; compilation and evaluations count as time. The schedule of "
        "reward=long was chosen on seed 12.",
        markdown(table.map(lambda x: f"{x:.1f}").rename_axis("")),
        f"The model-based reference (`algo=oracle`) has {100 * oracle['success_1cm']:.1f} % < 1 cm and a return of "
        f"{oracle['return_paper']:.1f} on the same goals and arms.",
    ]
    (ROOT / "docs" / "minutes.md").write_text("\n\n".join(pages) + "\n")
    print("written: docs/minutes.md")


if __name__ == "__main__":
    main()
