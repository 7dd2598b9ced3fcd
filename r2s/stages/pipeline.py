"""The whole chain on one machine: each step is a command that can be run by itself, in a run folder of its own."""

import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from threading import Thread
from typing import Any

from r2s.errors import Stopped, UserError, check_number
from r2s.stages import identify, train, transfer
from r2s.stages.adapting import is_taught, is_told
from r2s.stages.build import CONF, GROUP, PACKAGE, console, make_robot, open_run, unread

STEPS = (
    "1/3 record the arm and identify it",
    "2/3 train on both models, side by side",
    "3/3 take both policies to the arm",
)
STOPPED = 3  # exit status of a step that a stopped arm has ended, as of r2s/cli.py
MODELS = ("identified", "nominal")
# with adapt=, what else goes to the arm: computed torque on the identified model, and its policy with the adapter
COMPUTED, ADAPTED = "computed", "adapted"
ROWS = {COMPUTED: "computed torque", ADAPTED: "identified model + adapter"}
WHY = {
    "calibration": "it identifies for itself",
    "policy": "it trains its policies itself",
    "budget": "pipeline.train_minutes= says how long, or null leaves it to budget=",
    "only_missing": "its steps are run folders of their own",
}


def reads(cfg):
    """Return the keys of the config that the steps read, but for those that the chain sets itself."""
    keys = {"pipeline", *identify.reads(cfg), *train.reads(cfg), *transfer.reads(cfg)} - {"calibration", "policy"}
    return keys if cfg.pipeline.train_minutes is None else keys - {"budget"}


def handed_on(overrides: Sequence[str], step: Any) -> list[str]:
    """Return those of the typed overrides that a step reads, by its config."""
    own = ("stage=", "name=", "root=", "threads=", "pipeline.")
    return [o for o in overrides if not o.startswith(own) and not unread(o.lstrip("+~").split("=")[0], step)]


def run_step(words: dict[str, list[str]]) -> None:
    """Run commands side by side, {label: words}, and pass on what they print, each line under its label.

    Raises:
        UserError: one of them failed; the others are stopped.
        Stopped: an arm was stopped in one of them; so are the others.
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
        for label, typed in words.items():
            print(f"  {label:<10} $ python run.py {' '.join(typed)}", file=sys.stderr, flush=True)
            command = [*front_door(), *typed]
            piped = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
            process = subprocess.Popen(command, **piped, env=os.environ | {"PYTHONUNBUFFERED": "1", "COLUMNS": "110"})  # type: ignore[call-overload]
            running[label] = process
            threads.append(Thread(target=relay, args=(label, process), daemon=True))
            threads[-1].start()
        for label, process in running.items():
            if process.wait() != 0:
                threads[list(running).index(label)].join()
                if process.returncode == STOPPED:
                    raise Stopped(f"{label}: {last.get(label, 'no output').removeprefix('stopped: ')}")
                raise UserError(
                    f"{label} failed with exit status {process.returncode}: {last.get(label, 'no output')}"
                )
    finally:
        for process in running.values():
            if process.poll() is None:
                process.terminate()
        for thread in threads:
            thread.join(timeout=5)


def front_door() -> list[str]:
    """Return the command that this process is: from a checkout or as installed, with the user's own config folder."""
    from hydra.core.hydra_config import HydraConfig

    program = [str(PACKAGE.parent / "run.py")] if CONF.parent != PACKAGE else ["-m", "r2s"]
    own = [s.path for s in HydraConfig.get().runtime.config_sources if s.provider == "command-line"]
    return [sys.executable, *program, *(word for path in own for word in ("--config-dir", path))]


def composed(words: Sequence[str], what: str) -> Any:
    """Return the config of the command that front_door() and these words make.

    Raises:
        UserError: there is none; `what` was typed wrongly.
    """
    from hydra import compose
    from hydra.errors import HydraException
    from omegaconf.errors import OmegaConfBaseException

    try:
        return compose("config", list(words))  # by the Hydra that runs this job, which knows the user's own folder
    except (HydraException, OmegaConfBaseException) as error:
        said = " ".join(str(error).split()).removeprefix("In 'config': ")
        said = said.split(" Config search path")[0].split(" To append")[0]
        raise UserError(f"{what}: {said}") from None


def labels(cfg: Any) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the names of what is trained, and of what goes to the arm."""
    if cfg.adapt.name == "none":
        return MODELS, MODELS
    learnt = (ADAPTED,) if is_told(cfg) or is_taught(cfg) else ()  # a policy that is told, or a network
    return (*MODELS, COMPUTED, *learnt), (*MODELS, COMPUTED, ADAPTED)


def check_free(root: Path, name: str, cfg: Any) -> None:
    """Raise UserError if a folder that a step of the chain `name` would write is there already."""
    steps = [root / "identify" / name]
    for stage, each in zip(("train", "transfer"), labels(cfg), strict=True):
        steps += [root / stage / f"{name}_{m}" for m in each]
    if taken := [str(folder) for folder in steps if folder.exists()]:
        raise UserError(f"name: {name} is taken, {taken[0]} is there already; give another name=")


def commands(cfg: Any, name: str, overrides: Sequence[str]) -> list[dict[str, list[str]]]:
    """Return what a chain runs, one {label: words of a command} per step: identify, train, transfer.

    The two trainings have the same recipe, time and machine, so that what differs on the arm is the model. With an
    adapter what the arm carries, and how it has changed, is not there while it is identified: nobody announces it.

    Args:
        cfg: of the pipeline. name: of this chain; its steps are named after it.
        overrides: what the user typed; each step gets what it reads.
    """
    root, choice = Path(cfg.root), chosen(overrides, cfg)
    both, adapts = cfg.threads or os.cpu_count() or 2, cfg.adapt.name != "none"

    def without(*heads: str) -> list[str]:
        return [o for o in overrides if not o.lstrip("+~").startswith(tuple(f"{h}{c}" for h in heads for c in "=."))]

    def step(
        stage: str, label: str, *words: str, calibration: str | None = None, typed: Sequence[str] = overrides
    ) -> list[str]:
        config = cfg.copy()
        config.stage, config.calibration = stage, calibration
        if typed is not overrides:  # without an adapter, as identify is whatever was typed
            config.adapt = {"name": "none"}
        full = f"{name}_{label}" if stage != "identify" else name
        threads = cfg.threads if stage == "identify" else max(1, both // 2)
        head = [f"root={root}", f"stage={stage}", f"name={full}", f"threads={threads}"]
        return [*handed_on(typed, config), *head, *words]

    minutes = cfg.pipeline.train_minutes
    budget = [] if minutes is None else [f"budget.minutes={minutes}"]
    known = f"calibration={root / 'identify' / name}"
    bare = without("adapt")
    trained = {
        "identified": step("train", "identified", *budget, known, calibration=known, typed=bare),
        "nominal": step("train", "nominal", *budget, *choice, typed=bare),
    }
    if adapts:
        reference = without("adapt", "algo", "dr", "reward", "evaluation.env_steps", "compile", "matmul", "device")
        words = "algo=computed_torque", "dr=none", known
        trained[COMPUTED] = step("train", COMPUTED, *words, calibration=known, typed=reference)
    if ADAPTED in labels(cfg)[0]:
        own = budget if is_told(cfg) else []
        trained[ADAPTED] = step("train", ADAPTED, *own, known, calibration=known)
    transferred = {}
    for label in labels(cfg)[1]:
        source = MODELS[0] if label == ADAPTED and not is_told(cfg) else label
        given = [f"policy={root / 'train' / f'{name}_{source}'}"]
        if label == ADAPTED and is_taught(cfg):
            given.append(f"adapt.network={root / 'train' / f'{name}_{ADAPTED}'}")
        transferred[label] = step("transfer", label, *given, typed=overrides if label == ADAPTED else bare)
    as_it_is = without("arm.payload", "arm.load", "arm.friction", "arm.late") if adapts else overrides
    return [
        {"identify": step("identify", "identify", typed=as_it_is)},
        trained,
        transferred,
    ]


def check_steps(cfg: Any, overrides: Sequence[str]) -> None:
    """Raise UserError where a step would refuse what was typed: said now, not after the arm was identified."""
    first, trained, _ = commands(cfg, cfg.name or "pipeline", overrides)
    identify.make_parts(composed(first["identify"], "stage=identify"))
    train.check(composed(trained["nominal"], "stage=train"))  # the identified model is not there yet


def chosen(overrides: Sequence[str], cfg: Any) -> list[str]:
    """Return the words by which a training gets the model that identification starts from."""
    from hydra.core.hydra_config import HydraConfig

    choices = HydraConfig.get().runtime.choices
    typed = {o.split("=")[0] for o in overrides}
    return [f"{group}={choices[group]}" for group in ("friction", "inertia") if group not in typed]


def pipeline(cfg, overrides):
    """Every stage on the embedded default, each a process of its own; one table, one recording, one report."""
    from r2s.reporting import pages
    from r2s.reporting.tables import reach_table
    from r2s.runs import read_summary

    if cfg.pipeline.train_minutes is not None:
        check_number("pipeline.train_minutes", cfg.pipeline.train_minutes, "(0, inf)")
    robot, root = make_robot(cfg), Path(cfg.root)
    if "calibration" in cfg.dr:
        raise UserError(
            "dr: the nominal training of stage=pipeline has no calibration to draw from; another dr= does"
        )
    if cfg.name and not (root / "pipeline" / cfg.name).exists():
        check_free(root, cfg.name, cfg)
    check_steps(cfg, overrides)
    with open_run(cfg, overrides) as run:
        name = run.folder.name
        check_free(root, name, cfg)
        os.environ.setdefault(GROUP, name)  # its steps belong together
        for what, step in zip(STEPS, commands(cfg, name, overrides), strict=True):
            print(what, file=sys.stderr)
            run_step(step)
        identified = root / "identify" / name
        trained = {m: root / "train" / f"{name}_{m}" for m in MODELS}
        transferred = {ROWS.get(m, f"{m} model"): root / "transfer" / f"{name}_{m}" for m in labels(cfg)[1]}
        rows = {}
        for label, folder in transferred.items():
            for where, row in read_summary(folder, "transfer").items():
                rows[f"{label}, {where}"] = row
        run.summary({"identify": read_summary(identified, "identify"), "reach": rows})
        pages.pipeline(run, robot, identified, trained, transferred, rows)
        reach_table(console(), rows, "policies trained on the identified and on the nominal model")
    print(f"written: {run.folder} (look: rerun {run.folder / 'recording.rrd'})")
