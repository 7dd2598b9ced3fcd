"""The whole chain on one machine: each step is a command that can be run by itself, in a run folder of its own."""

import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from threading import Thread

from r2s.errors import UserError
from r2s.stages.build import console, make_robot, open_run

OWN = ("stage=", "name=", "pipeline.", "budget.", "threads=", "root=")  # what the chain sets for its steps itself
MODELS = ("identified", "nominal")


def run_step(commands: dict[str, Sequence[str]]) -> None:
    """Run commands side by side and pass on what they print, each line under its label.

    Raises:
        UserError: one of them failed; the others are stopped.
    """
    running: dict[str, subprocess.Popen] = {}
    last: dict[str, str] = {}

    def relay(label: str, process: subprocess.Popen) -> None:
        assert process.stdout is not None
        for line in process.stdout:
            if line.strip():
                last[label] = line.strip()
            print(f"  {label:<10} | {line.rstrip()}", file=sys.stderr, flush=True)

    threads = []
    try:
        for label, command in commands.items():
            print(f"  {label:<10} $ python run.py {' '.join(command[3:])}", file=sys.stderr, flush=True)
            piped = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
            process = subprocess.Popen(command, **piped, env=os.environ | {"PYTHONUNBUFFERED": "1", "COLUMNS": "110"})  # type: ignore[call-overload]
            running[label] = process
            threads.append(Thread(target=relay, args=(label, process), daemon=True))
            threads[-1].start()
        for label, process in running.items():
            if process.wait() != 0:
                threads[list(running).index(label)].join()
                raise UserError(
                    f"{label} failed with exit status {process.returncode}: {last.get(label, 'no output')}"
                )
    finally:
        for process in running.values():
            if process.poll() is None:
                process.terminate()
        for thread in threads:
            thread.join(timeout=5)


def check_free(root: Path, name: str) -> None:
    """Raise UserError if a folder that a step of the chain `name` would write is there already."""
    steps = [
        root / "identify" / name,
        *(root / stage / f"{name}_{m}" for stage in ("train", "transfer") for m in MODELS),
    ]
    if taken := [str(folder) for folder in steps if folder.exists()]:
        raise UserError(f"name: {name} is taken, {taken[0]} is there already; give another name=")


def run_chain(
    program: Sequence[str], root: Path, name: str, overrides: Sequence[str], train_minutes: float | None
) -> tuple[Path, dict[str, Path], dict[str, Path]]:
    """Identify on the arm, train on the identified and on the nominal model, take both policies to the arm.

    The two trainings have the same recipe, time and machine, so that what differs on the arm is the model.

    Args:
        program: the command that runs a stage. root: of run folders.
        name: of this chain; its steps are named after it.
        overrides: what the user typed; handed on to every step.
        train_minutes: of each training; None leaves `budget` to the overrides.

    Returns:
        The run folders: identification, {label: training}, {label: transfer}.

    Raises:
        UserError: a step failed, or one of these folders is there already.
    """
    check_free(root, name)
    theirs = [o for o in overrides if not o.startswith(OWN)]
    half = f"threads={max(1, (os.cpu_count() or 2) // 2)}"
    budget = (
        [f"budget.minutes={train_minutes}"] if train_minutes else [o for o in overrides if o.startswith("budget.")]
    )
    common = [*program, *theirs, f"root={root}"]
    identified = root / "identify" / name
    print("1/3 record the arm and identify it", file=sys.stderr)
    run_step({"identify": [*common, "stage=identify", f"name={name}"]})
    changes = [f"calibration={identified}"], ["friction=gaz2019", "inertia=nominal"]
    models = dict(zip(MODELS, changes, strict=True))
    print("2/3 train on both models, side by side", file=sys.stderr)
    run_step({k: [*common, "stage=train", f"name={name}_{k}", half, *budget, *m] for k, m in models.items()})
    trained = {k: root / "train" / f"{name}_{k}" for k in models}
    print("3/3 take both policies to the arm", file=sys.stderr)
    run_step({k: [*common, "stage=transfer", f"name={name}_{k}", half, f"policy={trained[k]}"] for k in models})
    return identified, trained, {k: root / "transfer" / f"{name}_{k}" for k in models}


def pipeline(cfg, overrides):
    """Every stage on the embedded default, each a process of its own; one table, one recording, one report."""
    from r2s.reporting import pages
    from r2s.reporting.tables import reach_table
    from r2s.runs import read_summary

    robot = make_robot(cfg)
    if cfg.name and not (Path(cfg.root) / "pipeline" / cfg.name).exists():
        check_free(Path(cfg.root), cfg.name)
    with open_run(cfg, overrides) as run:
        program = [sys.executable, "-m", "r2s"]
        name, minutes = run.folder.name, cfg.pipeline.train_minutes
        identified, trained, transferred = run_chain(program, Path(cfg.root), name, overrides, minutes)
        rows = {}
        for label, folder in transferred.items():
            for where, row in read_summary(folder, "transfer").items():
                rows[f"{label} model, {where}"] = row
        run.summary({"identify": read_summary(identified, "identify"), "reach": rows})
        pages.pipeline(run, robot, identified, trained, transferred, rows)
        reach_table(console(), rows, "policies trained on the identified and on the nominal model")
    print(f"written: {run.folder} (look: rerun {run.folder / 'recording.rrd'})")
