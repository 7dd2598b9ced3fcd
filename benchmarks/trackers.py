"""Measure the cost of all trackers together in a training.

`python benchmarks/trackers.py` counts processor time of this process and of the trackers' processes: while nothing is
logged, and per row. A training logs a row every 1,000 updates; `UPDATES_PER_S` converts.
`python benchmarks/trackers.py --minutes 3 --pairs 4` trains with and without them at the same time, on a core each,
and compares the rates; servers stay on the core of their training.
"""

import argparse
import os
import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Semaphore

import pandas as pd
import psutil
from common import MACHINE, ROOT
from hydra import compose, initialize_config_dir

from r2s.reporting.trackers.async_tracker import Trackers
from r2s.stages.build import open_run

UPDATES_PER_S = 300.0  # more than benchmarks/results/speed.md has for TQC on two threads: the worse case
ALL = "tracker=[csv,tensorboard,mlflow,wandb,trackio]"
# pins this process to a core, which its children inherit, then runs run.py in the same process
PINNED = """
import os, runpy, sys
os.sched_setaffinity(0, {int(sys.argv[1])})
sys.argv = sys.argv[2:]
sys.path.insert(0, os.path.dirname(sys.argv[0]))
runpy.run_path(sys.argv[0], run_name="__main__")
"""
ROWS, QUIET_S, PACE_S = 200, 20.0, 0.1


def processor_s() -> float:
    """Return the processor time of this process and of its children, s."""
    me = psutil.Process()
    times = [p.cpu_times() for p in (me, *me.children(recursive=True))]
    return sum(t.user + t.system for t in times)


def count(root: Path) -> None:
    """Print processor time without logging, and per row of a training's metrics."""
    with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        cfg = compose("config", [ALL, f"root={root}", "name=cost"])
    with open_run(cfg, []) as run:
        assert isinstance(run.tracker, Trackers)
        row = dict.fromkeys([f"loss_{k}" for k in range(12)], 0.5)
        ready = Semaphore(0)
        run.tracker._send(lambda tracker: ready.release())  # when stores and servers are ready
        for _ in run.tracker._trackers:
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


def train(root: Path, minutes: float, pairs: int) -> None:
    """Print env_steps of trainings with all trackers over those without: both at once, a core each, then swapped.

    Other load on the machine affects both. Swapping cancels a difference between cores: the ratio of a pair is the
    geometric mean of both runs.
    """
    cores = sorted(os.sched_getaffinity(0))[:2]
    if len(cores) < 2:
        sys.exit("error: expected two cores, one for each training; this process may use one")
    losses = []
    for k in range(pairs):
        ratio = 1.0
        for swap in (0, 1):
            at_once = {}
            for name, core in zip(("without", "with"), cores[:: 1 - 2 * swap], strict=True):
                typed = [f"root={root}", f"name={name}_{k}_{swap}", f"budget.minutes={minutes}", f"seed={k}"]
                typed += ["threads=1", *([ALL] if name == "with" else [])]
                at_once[name] = subprocess.Popen(
                    [sys.executable, "-c", PINNED, str(core), str(ROOT / "run.py"), *typed], cwd=ROOT
                )
            if any([training.wait() for training in at_once.values()]):
                sys.exit("error: a training failed")
            steps = {
                name: pd.read_csv(root / "train" / f"{name}_{k}_{swap}" / "evaluations.csv")["env_steps"].iloc[-1]
                for name in at_once
            }
            ratio *= (steps["with"] / steps["without"]) ** 0.5
        losses.append(100 * (1 - ratio))
        print(f"pair {k}: {losses[-1]:.2f} % lost", flush=True)
    mean, apart = pd.Series(losses).mean(), pd.Series(losses).sem()
    print(f"{MACHINE}: mean of {pairs} pairs of twice {minutes:g} min: {mean:.2f} +- {apart:.2f} % lost")


def main() -> None:
    """Count processor time, or train with and without trackers."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=0.0, help="of each training; 0 counts processor time")
    parser.add_argument("--pairs", type=int, default=4)
    typed = parser.parse_args()
    with TemporaryDirectory() as folder:
        if typed.minutes:
            train(Path(folder), typed.minutes, typed.pairs)
        else:
            count(Path(folder))


if __name__ == "__main__":
    main()
