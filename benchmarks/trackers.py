"""What all trackers at once cost a training.

`python benchmarks/trackers.py` counts processor time of this process and of those that the trackers start: while
nothing is logged, and per row. A training logs a row every 1,000 updates, and those are what `UPDATES_PER_S` says.
`python benchmarks/trackers.py --minutes 3 --pairs 4` trains with and without them in turn and compares the rates;
for that the machine must be quiet.
"""

import argparse
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Semaphore

import pandas as pd
import psutil
from common import MACHINE, ROOT, side_by_side
from hydra import compose, initialize_config_dir

from r2s.reporting.trackers.behind import Trackers
from r2s.stages.build import open_run

UPDATES_PER_S = 300.0  # more than docs/speed.md has for TQC on two threads: the worse case
ALL = "tracker=[csv,tensorboard,mlflow,wandb,trackio]"
ROWS, QUIET_S, PACE_S = 200, 20.0, 0.1


def processor_s() -> float:
    """Return the seconds of processor time of this process and of its children."""
    me = psutil.Process()
    times = [p.cpu_times() for p in (me, *me.children(recursive=True))]
    return sum(t.user + t.system for t in times)


def counted(root: Path) -> None:
    """Print processor time while nothing is logged, and per row of a training's metrics."""
    with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        cfg = compose("config", [ALL, f"root={root}", "name=cost"])
    with open_run(cfg, []) as run:
        assert isinstance(run.watcher, Trackers)
        row = dict.fromkeys([f"loss_{k}" for k in range(12)], 0.5)
        ready = Semaphore(0)
        run.watcher._send(lambda tracker: ready.release())  # after the stores are open and the servers started
        for _ in run.watcher._behind:
            ready.acquire(timeout=60.0)
        began = processor_s()
        time.sleep(QUIET_S)
        idle = (processor_s() - began) / QUIET_S
        began = processor_s()
        for k in range(ROWS):
            run.log("metrics", {"env_steps": k} | row)
            time.sleep(PACE_S)
        each = max(0.0, (processor_s() - began - idle * ROWS * PACE_S) / ROWS)
    share = idle + each * UPDATES_PER_S / 1000
    print(f"{MACHINE}: {ALL}")
    print(f"{1e3 * idle:.2f} ms of processor time a second while nothing is logged, {1e3 * each:.1f} ms a row")
    print(f"at {UPDATES_PER_S:.0f} updates/s: {100 * share:.2f} % of one core")


def trained(root: Path, minutes: float, pairs: int) -> None:
    """Print env_steps of trainings with all trackers over those without, one after the other."""
    ratios = []
    for k in range(pairs):
        steps = {}
        for name, words in sorted({"without": [], "with": [ALL]}.items(), reverse=bool(k % 2)):
            how = [f"root={root}", f"name={name}_{k}", f"budget.minutes={minutes}", f"seed={k}"]
            side_by_side([[*how, *words]])
            curve = pd.read_csv(root / "train" / f"{name}_{k}" / "evaluations.csv")
            steps[name] = curve["env_steps"].iloc[-1]
        ratios.append(steps["with"] / steps["without"])
        print(f"pair {k}: {100 * (1 - ratios[-1]):.2f} % lost", flush=True)
    print(
        f"{MACHINE}: median of {pairs} pairs of {minutes:g} min: {100 * (1 - pd.Series(ratios).median()):.2f} % lost"
    )


def main() -> None:
    """Count, or train with and without."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=0.0, help="of each training; 0: processor time is counted")
    parser.add_argument("--pairs", type=int, default=4)
    typed = parser.parse_args()
    with TemporaryDirectory() as folder:
        if typed.minutes:
            trained(Path(folder), typed.minutes, typed.pairs)
        else:
            counted(Path(folder))


if __name__ == "__main__":
    main()
