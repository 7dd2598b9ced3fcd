"""SAC of the examples (TorchRL's own parts, stable-baselines3) beside r2s's, at equal env steps, five seeds.

`python benchmarks/ecosystem.py` trains what is missing, as many trainings at a time as cores, and writes a section of
benchmarks/results/algorithms.md. Run folders: runs/train/own_sac_*, runs/bench/ecosystem/*.
"""

import json
import sys
from importlib import import_module

import numpy as np
from common import RESULTS, ROOT, markdown_rows, put_section, run_scripts, stamp

from r2s.reporting.comparison.statistics import interquartile_mean, interval

ENV_STEPS = 200_000
SEEDS = range(75, 80)  # no setting was chosen on them
EXAMPLES = {"torchrl_sac": "TorchRL's parts", "sb3_sac": "stable-baselines3"}
OWN = "algo=sac", "algo.demonstrations=0", "dr=paper", "budget.minutes=null", f"budget.env_steps={ENV_STEPS}"
SHOWN = {"success_2cm": ("< 2 cm, %", 100), "success_1cm": ("< 1 cm, %", 100), "success_5mm": ("< 5 mm, %", 100)}
SHOWN |= {"return_paper": ("return", 1), "rest": ("at rest, %", 100)}
AT = ROOT / "runs/bench/ecosystem"


def train(example: str, seed: int) -> None:
    """Train with one of the examples, as its command does, and save the measures of the policy."""
    sys.path.insert(0, str(ROOT / "examples"))
    measures = import_module(example).train(ENV_STEPS, "dr=paper", "threads=1", seed=seed)
    AT.mkdir(parents=True, exist_ok=True)
    (AT / f"{example}_{seed}.json").write_text(json.dumps(measures))


def own_name(seed: int) -> str:
    """Return the name of a training of r2s."""
    return f"own_sac_{seed}"


def jobs() -> list[list[str]]:
    """Return what has to run, seed by seed."""
    found = []
    for seed in SEEDS:
        words = f"seed={seed}", f"name={own_name(seed)}", "threads=1", "skip_completed=true"
        found.append(["run.py", *OWN, *words])
        for example in EXAMPLES:
            if not (AT / f"{example}_{seed}.json").is_file():
                found.append(["benchmarks/ecosystem.py", example, str(seed)])
    return found


def cells(measures: list[dict]) -> dict[str, str]:
    """Return the interquartile means over seeds with their 95 % intervals."""
    row = {"seeds": str(len(measures))}
    for key, (column, scale) in SHOWN.items():
        x = scale * np.array([m[key] for m in measures])
        low, high = interval([x], lambda d: interquartile_mean(d[0]))
        row[column] = f"{float(interquartile_mean(x)):.1f} [{low:.1f}, {high:.1f}]"
    return row


def main() -> None:
    """Train one, or all and write the section."""
    if len(sys.argv) == 3 and sys.argv[1] in EXAMPLES:
        return train(sys.argv[1], int(sys.argv[2]))
    if sys.argv[1:]:
        raise SystemExit(__doc__)
    run_scripts(jobs())
    own = [ROOT / "runs/train" / own_name(seed) / "summary.json" for seed in SEEDS]
    rows = {"r2s": cells([json.loads(path.read_text())["last"] for path in own])}
    for example, label in EXAMPLES.items():
        found = [json.loads((AT / f"{example}_{seed}.json").read_text()) for seed in SEEDS]
        rows[f"{label} (`examples/{example}.py`)"] = cells(found)
    about = f"SAC from scratch, {ENV_STEPS:,} env steps, `dr=paper`, last policies on the goals of reports, "
    about += "interquartile mean over seeds with a 95 % interval."
    parts = [stamp("python benchmarks/ecosystem.py"), about, markdown_rows(rows, "SAC of")]
    put_section(RESULTS / "algorithms.md", "The same environment in other libraries", parts)


if __name__ == "__main__":
    main()
