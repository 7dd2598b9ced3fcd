"""Time of the steps of an identification: a twin of the Panda, 20 s of motion and its ramps, default settings.

`python benchmarks/identify_speed.py [FOLDER]` alternates with the checkout in FOLDER (an earlier state of r2s) and
writes benchmarks/results/identify_speed.md. Reading, verdict, prediction errors and figures are not part of the time.
"""

import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from common import ROBOT, ROOT, conf, identify_settings, markdown_rows, searches, write_page

import r2s.identification.identify as identification
from r2s.physics.dynamics import nominal_dynamics
from r2s.recordings.ramps import read_ramps
from r2s.recordings.readers import read

ROUNDS = 3  # identifications in each checkout; the page shows medians
TWIN = ("arm=twin", "arm.variant=rigid", "arm.seed=0")  # a development twin


def steps(folder: Path) -> dict[str, float]:
    """Identify the recording in a run folder; return the seconds of each step, and of all together."""
    recording, ramps = read(folder / "train.npz", torque="commanded"), read_ramps(folder / "ramps.npz")
    seconds: dict[str, float] = {}

    def timed(step):
        def run(state):
            began = time.perf_counter()
            state = step(state)
            seconds[step.__name__] = time.perf_counter() - began
            return state

        return run

    original = identification.STEPS
    identification.STEPS = tuple(map(timed, original))
    start, began = nominal_dynamics(ROBOT, **conf("friction/uniform")), time.perf_counter()
    how = identify_settings(family="auto")
    identification.identify(ROBOT, start, recording, searches("staged"), how, ramps=ramps)
    identification.STEPS = original
    return seconds | {"all, with the posterior": time.perf_counter() - began}


def main() -> None:
    """Record the twin, alternate between the checkouts, and write the page."""
    if "steps" in sys.argv:
        folder = Path(sys.argv[-1])
        steps(folder)  # compiles what is missing
        print(json.dumps(steps(folder)))
        return
    before = [Path(a).resolve() for a in sys.argv[1:]][:1]
    found: dict[Path, list] = {place: [] for place in (ROOT, *before)}
    with tempfile.TemporaryDirectory() as root:
        record = [sys.executable, str(ROOT / "run.py"), "stage=identify", *TWIN, f"root={root}", "name=twin"]
        subprocess.run(record, check=True, stdout=subprocess.DEVNULL)
        (folder,) = Path(root).rglob("ramps.npz")
        for place in ROUNDS * list(found):
            script = __file__ if place == ROOT else shutil.copy(__file__, place / "benchmarks")
            command, env = [sys.executable, str(script), "steps", str(folder.parent)], {"PYTHONPATH": str(place)}
            out = subprocess.run(command, check=True, capture_output=True, env=os.environ | env, cwd=place).stdout
            found[place].append(json.loads(out.splitlines()[-1]))
    medians = {place: {k: float(np.median([r[k] for r in runs])) for k in runs[0]} for place, runs in found.items()}
    rows = {}
    for name, now in medians[ROOT].items():
        rows[name.replace("_", " ")] = {"now, s": f"{now:.1f}"}
        if before:
            was = medians[before[0]][name]
            ratio = f"{now / was:.2f}" if was > 0.1 else ""
            rows[name.replace("_", " ")] |= {"before, s": f"{was:.1f}", "ratio": ratio}
    turns = ""
    if before:
        commit = subprocess.check_output(["git", "rev-parse", "--short", "HEAD"], cwd=before[0], text=True).strip()
        turns = f", in turns with commit {commit} (before)"
    text = (
        f"`identify` of {' '.join(TWIN)}: 20 s of motion and two ramps per joint and direction, default settings, "
        f"friction.family=auto; medians of {ROUNDS} identifications{turns}."
    )
    table = markdown_rows(rows, "step")
    print(table)
    write_page(
        "identify_speed", "Time of an identification", "python benchmarks/identify_speed.py FOLDER", [text, table]
    )


if __name__ == "__main__":
    main()
